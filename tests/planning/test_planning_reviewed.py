# SPDX-License-Identifier: BSD-3-Clause
"""What a review of the planning code broke, kept from breaking again."""

import disk_world
import numpy as np
import pytest
from ompl import base as ob

from vprism_plan.errors import PlanningError
from vprism_plan.planning import attempts, plan, state_space
from vprism_plan.planning.objectives import RiskObjective
from vprism_plan.planning.path import MotionCheck, verified
from vprism_plan.planning.planners import GuidedGoal
from vprism_plan.planning.result import PlanReport
from vprism_plan.planning.search import SearchOutcome


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


def test_a_path_that_costs_nothing_is_noted_once():
    """BITstar returned at once from every further call, and each made an entry."""
    wall = disk_world.wall_with_gap()
    result = plan(
        wall, [-0.7, -0.5], [0.7, -0.5], "BITstar", 0.5, simplify=False,
        objective=RiskObjective(kind=lambda Q: np.zeros(len(Q)), length_weight=0.0),
        clock="process",
    )  # fmt: skip
    assert result.solved
    assert len(result.report.history) <= 2


def test_states_of_a_lead_are_nearest_to_the_one_before():
    """At most a tenth of a step apart: what is nearest past a thin wall is on this side."""
    si = ob.SpaceInformation(state_space(disk_world.robot()))
    lead = np.array([(-0.8, -0.8), (-0.5, 0.6), (-0.3, 0.6), (-0.1, -0.6), (0.1, -0.6)])
    guided = GuidedGoal(si, lead[-1:], 0, 0.5, lead)
    rows = np.array([lead[0], *guided._queue[::-1]])
    assert np.linalg.norm(np.diff(rows, axis=0), axis=1).max() <= 0.05 + 1e-9
    for k in range(1, len(rows)):
        assert np.argmin(np.linalg.norm(rows[:k] - rows[k], axis=1)) == k - 1


@pytest.mark.parametrize(
    "options", [{"planner": "FMT"}, {"planner": "RRTstar", "warm_start": False}]
)
def test_a_known_direct_motion_is_not_thrown_away(options, monkeypatch):
    """And the goal that it leads to is the one that was asked about."""

    def nothing(*unused):
        return SearchOutcome("timeout", None, None, 0.1, 0, 0)

    monkeypatch.setattr(attempts, "search", nothing)
    blocked_first = disk_world.DiskChecker([(0.0, 0.5)], [0.2], disk_world.robot())
    result = plan(
        blocked_first, [-0.5, 0.5], [[0.5, 0.5], [0.5, 0.0]], time_limit=0.3, simplify_time=0.1,
        objective=RiskObjective(kind=ones), **options,
    )  # fmt: skip
    assert result.solved
    assert result.report.goal_index == 1


def test_the_goal_of_a_lead_round_a_continuous_joint_is_named(monkeypatch):
    """The lead ends at 3.3, a whole turn from its goal, and nearer to the other one."""

    def nothing(*unused):
        return SearchOutcome("timeout", None, None, 0.1, 0, 0)

    monkeypatch.setattr(attempts, "search", nothing)
    turning = disk_world.DiskChecker([(2.5, 0.0)], [0.05], disk_world.robot(2, (0,)))
    goals = [[2.0, 0.0], [3.3 - 2.0 * np.pi, 0.3]]
    result = plan(
        turning, [3.0, 0.0], goals, "RRTstar", 0.3, simplify_time=0.1,
        objective=RiskObjective(kind=ones),
    )  # fmt: skip
    assert result.solved
    assert result.report.goal_index == 1
