# SPDX-License-Identifier: BSD-3-Clause
"""What a review of the planning code broke, kept from breaking again."""

import disk_world
import numpy as np
import pytest

from vprism_plan.errors import PlanningError
from vprism_plan.planning import RiskObjective, plan
from vprism_plan.planning._verify import MotionCheck, verified
from vprism_plan.planning.result import PlanReport


class NoLimits(disk_world.DiskChecker):
    """A checker that leaves the joint limits to others."""

    def _inside_limits(self, q):
        return True


def away_from_the_bottom(Q):
    return np.where(np.abs(Q[:, 0]) < 0.3, np.clip(3.0 - Q[:, 1], 0.0, None), 0.0)


def ones(Q):
    return np.ones(len(Q))


def free():
    return NoLimits([(0.0, -5.0)], [0.1], disk_world.robot())


# One step beyond the limits would cost less: samples around the path and moved waypoints.
@pytest.mark.parametrize("simplify", [False, True])
def test_paths_stay_within_limits_that_the_checker_does_not_know(simplify):
    result = plan(
        free(), [-0.5, 0.97], [0.5, 0.97], "RRTstar", 0.3, simplify=simplify, simplify_time=0.2,
        objective=RiskObjective(kind=away_from_the_bottom),
    )  # fmt: skip
    assert result.solved
    assert np.abs(result.path).max() <= 1.0 + 1e-9


def test_the_last_word_refuses_a_path_outside_the_limits():
    path = np.array([[-0.5, 0.0], [0.0, 1.5], [0.5, 0.0]])
    report = PlanReport(planner="RRT", seed=0, time_limit=1.0)
    result = verified(free(), path, 0.1, report)
    assert result.status == "verification_failed"
    assert "joint limits" in result.message
    assert not MotionCheck(free())(path[0], path[1])
    assert MotionCheck(free())(path[0], path[2])


@pytest.mark.parametrize(
    ("rates", "named"),
    [
        (lambda Q: -np.ones(len(Q)), "-1.0"),
        (lambda Q: np.full(len(Q), np.nan), "nan"),
        (lambda Q: np.ones((len(Q), 1)), "shape"),
    ],
)
def test_rates_that_crash_a_planner_are_refused(rates, named):
    for objective in (RiskObjective(kind=rates), RiskObjective(kind=rates, worst=True)):
        with pytest.raises(PlanningError, match=named):
            plan(free(), [-0.5, 0.0], [0.5, 0.0], "RRTstar", 0.1, objective=objective)
    with pytest.raises(PlanningError, match=named):
        objective.cost(free()).risk.state(np.zeros(2))


@pytest.mark.parametrize("spacing", [0.0, -0.1, np.nan, np.inf])
def test_spacings_that_sample_nothing_are_refused(spacing):
    with pytest.raises(PlanningError, match="spacing"):
        RiskObjective(kind=ones, spacing=spacing)
