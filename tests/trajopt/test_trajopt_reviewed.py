# SPDX-License-Identifier: BSD-3-Clause
"""What a review of the trajectory optimiser broke, kept from breaking again."""

import numpy as np
import pytest
import torch
from planning.disk_world import DiskChecker, robot

from vprism_plan.trajopt import optimize
from vprism_plan.trajopt._minimize import REASONS, Limits, lbfgs

START, GOAL = np.array([-0.5, 0.6]), np.array([0.5, 0.6])
SMALL = {"waypoints": 8, "max_iterations": 20, "seeds": 3, "repairs": 0}


class NoLimits(DiskChecker):
    """A checker that leaves the joint limits to others."""

    def _inside_limits(self, q):
        return True


def outwards(q):
    return -q.square().sum(dim=(-1, -2))


def short(q):
    return q.diff(dim=-2).square().sum(dim=(-1, -2))


def test_the_cost_of_a_trajectory_that_limits_cut_off_is_its_own():
    checker = DiskChecker([(0.0, -5.0)], [0.1], robot())
    result = optimize(checker, START, GOAL, cost=outwards, **SMALL)
    assert result.solved
    assert result.report.cost == pytest.approx(float(outwards(torch.from_numpy(result.path))))


def test_an_initial_path_outside_the_limits_is_not_handed_out():
    ys = np.linspace(-1.2, 1.2, 20)
    checker = NoLimits(np.stack([0.0 * ys, ys], axis=1), np.full(20, 0.15), robot())
    around = np.array([START, [-0.5, 1.6], [0.5, 1.6], GOAL])
    result = optimize(checker, START, GOAL, cost=short, initial=around, **SMALL)
    assert not result.solved


def test_a_clearance_not_to_be_kept_may_be_numpys():
    checker = DiskChecker([(0.0, -5.0)], [0.1], robot())
    result = optimize(checker, START, GOAL, cost=short, keep_clearance=np.bool_(False), **SMALL)
    assert result.solved
    assert result.report.kept_clearance is None


def test_no_row_of_nan_reaches_the_cost():
    """The second row begins where the gradient is infinite."""

    def evaluate(x, rows):
        assert torch.isfinite(x).all()
        x = x.detach().requires_grad_()
        value = x.abs().sqrt().sum(dim=1)
        (gradient,) = torch.autograd.grad(value.sum(), x)
        gradient[rows == 1] = torch.nan
        return value.detach(), gradient

    found = lbfgs(evaluate, torch.tensor([[1.0, 2.0], [0.0, 1.0]]), Limits(5, 1e-6))
    assert REASONS[int(found.reason[1])] == "stalled"
    assert REASONS[int(found.reason[0])] != "running"
    assert found.x[1].tolist() == [0.0, 1.0]
