# SPDX-License-Identifier: BSD-3-Clause
"""Objectives inside OMPL, and planning with them, where costs are known exactly."""

import json
from itertools import pairwise

import disk_world
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ompl import base as ob
from ompl import geometric as og

from vprism_plan.errors import PlanningError
from vprism_plan.planning import (
    VPrismMinimaxRiskObjective,
    VPrismRiskObjective,
    VPrismStateValidityChecker,
    plan,
    quiet_ompl,
    state_space,
    to_state,
)
from vprism_plan.planning.attempts import not_found
from vprism_plan.planning.objectives import PathCost, RiskObjective
from vprism_plan.planning.path import cheapen, shorten
from vprism_plan.planning.search import CLOCKS

START, GOAL = [-0.7, 0.0], [0.7, 0.0]
ZIGZAG = np.array([[-0.9, -0.9], [-0.9, 0.9], [-0.8, 0.9], [0.0, 0.9], [0.9, 0.9], [0.9, -0.9]])


def slope(Q):
    """Rate 1 + y: trapezoids integrate it exactly."""
    return 1.0 + Q[:, 1]


def above(Q):
    """Risk only above the middle."""
    return np.clip(Q[:, 1], 0.0, None)


def one_disk(continuous=()):
    return disk_world.DiskChecker([(0.0, 0.0)], [0.3], disk_world.robot(2, continuous))


def ompl_path(checker, rows):
    si = ob.SpaceInformation(state_space(checker.robot))
    si.setStateValidityChecker(VPrismStateValidityChecker(si, checker))
    with quiet_ompl():
        si.setup()
    path = og.PathGeometric(si)
    for row in rows:
        path.append(to_state(si.getStateSpace(), np.array(row)))
    return si, path


def test_the_cost_of_a_path_is_the_integral_and_not_what_the_binding_made_of_it():
    """A Python stateCost of StateCostIntegralObjective is never called: every cost is 1."""
    si, path = ompl_path(one_disk(), [(-1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)])
    objective = VPrismRiskObjective(si, one_disk(), kind=slope, length_weight=0.5)
    # 2 at a mean rate of 1, 2 at a rate of 2, and half the length.
    assert path.cost(objective).value() == pytest.approx(2.0 + 4.0 + 0.5 * 4.0)
    state = to_state(si.getStateSpace(), np.array([0.0, 0.25]))
    assert objective.stateCost(state).value() == pytest.approx(1.25)


def test_a_subclass_of_the_objective_keeps_its_overrides():
    class Doubled(VPrismRiskObjective):
        def motionCost(self, s1, s2):
            return ob.Cost(2.0 * super().motionCost(s1, s2).value())

    si, path = ompl_path(one_disk(), [(-1.0, 0.0), (1.0, 0.0)])
    objective = Doubled(si, one_disk(), kind=slope, length_weight=0.0)
    assert path.cost(objective).value() == pytest.approx(4.0)


def test_minimax_costs_the_worst_state():
    si, path = ompl_path(one_disk(), [(-1.0, -1.0), (-1.0, 0.5), (1.0, -0.5)])
    objective = VPrismMinimaxRiskObjective(si, one_disk(), kind=slope)
    assert path.cost(objective).value() == pytest.approx(1.5)


@settings(max_examples=50, deadline=None)
@given(q=st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4), weight=st.floats(0.0, 2.0))
def test_the_heuristic_never_exceeds_the_cost_and_directions_cost_the_same(q, weight):
    checker = one_disk()
    si = ob.SpaceInformation(state_space(checker.robot))
    objective = VPrismRiskObjective(si, checker, kind=above, length_weight=weight)
    a, b = (to_state(si.getStateSpace(), np.array(p)) for p in (q[:2], q[2:]))
    cost = objective.motionCost(a, b).value()
    assert objective.motionCostHeuristic(a, b).value() <= cost + 1e-12
    assert objective.motionCost(b, a).value() == pytest.approx(cost, abs=1e-12)


def test_a_turn_behind_pi_is_integrated_where_it_goes():
    checker = one_disk(continuous=(0,))
    si, path = ompl_path(checker, [(3.0, 0.0), (-3.0, 0.0)])
    seen = []

    def rates(Q):
        seen.append(Q.copy())
        return np.ones(len(Q))

    objective = VPrismRiskObjective(si, checker, kind=rates, length_weight=1.0)
    gap = 2 * np.pi - 6.0
    assert path.cost(objective).value() == pytest.approx(2 * gap)
    assert min(Q[:, 0].min() for Q in seen) >= 3.0 - 1e-12
    cost = PathCost(checker, RiskObjective(rates, length_weight=1.0))
    assert cost.edge(np.array([3.0, 0.0]), np.array([3.0 + gap, 0.0])) == pytest.approx(2 * gap)


def test_clearance_reaches_those_that_ask_for_it():
    checker = one_disk()
    _si, path = ompl_path(checker, [(0.5, 0.0), (0.9, 0.0)])
    # OMPL averages the clearance of the path's states.
    assert path.clearance() == pytest.approx(0.5 * (0.2 + 0.6))


@pytest.mark.parametrize("planner", ["RRTstar", "InformedRRTstar", "SORRTstar", "BITstar"])
def test_planners_that_honour_an_objective_go_where_the_risk_is_not(planner):
    result = plan(
        one_disk(), [-0.7, 0.05], [0.7, 0.05], planner, time_limit=0.4, clock="process",
        simplify_time=0.2, objective=RiskObjective(above),
    )  # fmt: skip
    assert result.solved, result.message
    assert result.path[1:-1, 1].min() < -0.25
    assert result.report.objective == "function"
    assert result.report.cost == pytest.approx(
        PathCost(one_disk(), RiskObjective(above)).path(result.path), abs=1e-12
    )


def test_costs_fall_over_time_and_the_last_path_is_the_best():
    found = []
    for _ in range(2):
        result = plan(
            one_disk(), START, GOAL, "RRTstar", seed=5, time_limit=60.0, stop="converged",
            convergence=(0.05, 40), clock="process", objective=RiskObjective(slope, spacing=0.2),
            simplify=False,
        )  # fmt: skip
        history = result.report.history
        assert len(history) > 2
        assert all(b.cost <= a.cost + 1e-12 for a, b in pairwise(history))
        assert all(b.time >= a.time for a, b in pairwise(history))
        assert result.report.cost <= history[-1].cost + 1e-9
        cost = PathCost(one_disk(), RiskObjective(slope, spacing=0.2))
        for step in history:
            assert cost.path(step.path) == pytest.approx(step.cost, rel=1e-6)
        found.append(result.path)
    assert np.array_equal(*found)


def test_length_has_a_history_too():
    wall = disk_world.wall_with_gap()
    result = plan(wall, [-0.7, -0.5], [0.7, -0.5], "RRTstar", time_limit=0.3, clock="process")
    assert result.report.objective == "length"
    assert result.report.cost == result.report.path_length
    costs = [step.cost for step in result.report.history]
    assert len(costs) > 1
    assert costs == sorted(costs, reverse=True)
    told = json.loads(json.dumps(result.report.to_dict(), allow_nan=False))
    assert [step["cost"] for step in told["history"]] == costs


def test_a_straight_way_is_taken_at_once_only_if_it_runs_no_risk():
    free = disk_world.DiskChecker([], [], disk_world.robot())
    low, high = [[-0.7, -0.4], [0.7, -0.4]], [[-0.7, 0.4], [0.7, 0.4]]
    known = {"time_limit": 0.2, "clock": "process", "simplify_time": 0.1}
    safe = plan(free, *low, "RRTstar", objective=RiskObjective(above), **known)
    assert safe.report.direct
    risky = plan(free, *high, "RRTstar", objective=RiskObjective(above), **known)
    assert risky.solved
    assert not risky.report.direct
    assert risky.report.history[0].path.tolist() == high
    assert risky.report.cost < risky.report.history[0].cost


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), worst=st.booleans())
def test_neither_shortening_nor_moving_waypoints_raises_the_cost(seed, worst):
    checker = disk_world.wall_with_gap()
    rng = np.random.default_rng(seed)
    at, size = rng.uniform(-1, 1, (4, 2)), rng.uniform(0.1, 0.5, 4)

    def bumps(Q):
        return np.exp(-np.sum((Q[:, None] - at) ** 2, axis=2) / size**2).sum(axis=1)

    cost = PathCost(checker, RiskObjective(bumps, spacing=0.05, worst=worst))
    accepted = {(a.tobytes(), b.tobytes()) for a, b in pairwise(ZIGZAG)}

    def check(a, b):
        verdict = checker.check_motion(a, b)
        if verdict:
            accepted.add((a.tobytes(), b.tobytes()))
        return verdict

    def now():
        return 0.0

    short = shorten(ZIGZAG, check, seed, 1.0, now, cost)
    assert cost.path(short) <= cost.path(ZIGZAG) + 1e-12
    calls = iter(range(40))
    cheap = cheapen(short, check, seed, 30.0, lambda: float(next(calls, 99)), cost)
    assert cost.path(cheap) <= cost.path(short) + 1e-12
    for path in (short, cheap):
        assert np.array_equal(path[[0, -1]], ZIGZAG[[0, -1]])
        assert all((a.tobytes(), b.tobytes()) in accepted for a, b in pairwise(path))


def test_without_the_cost_a_shortcut_would_take_the_risk():
    free = disk_world.DiskChecker([], [], disk_world.robot())
    way = np.array([[-0.9, 0.0], [0.0, -0.8], [0.9, 0.0]])

    def ridge(Q):
        return 100.0 * np.exp(-(np.sum(Q**2, axis=1)) / 0.2**2)

    blind = shorten(way, free.check_motion, 0, 1.0, lambda: 0.0)
    aware = shorten(
        way, free.check_motion, 0, 1.0, lambda: 0.0, PathCost(free, RiskObjective(ridge))
    )
    assert len(blind) == 2
    assert PathCost(free, RiskObjective(ridge)).path(aware) <= PathCost(
        free, RiskObjective(ridge)
    ).path(way)


@pytest.mark.parametrize("planner", ["RRTConnect", "AORRTC", "PRMstar", "KPIECE1"])
def test_planners_that_would_ignore_an_objective_refuse_it(planner):
    with pytest.raises(PlanningError, match=f"{planner} does not honour.*RRTstar, Informed"):
        plan(one_disk(), START, GOAL, planner, objective=RiskObjective(above))


@pytest.mark.parametrize(("arguments", "message"), [
    ({"kind": "fear"}, "'fear'.*'survival', 'joint'"),
    ({"length_weight": -1.0}, "length_weight is -1"),
    ({"length_weight": np.nan}, "length_weight is nan"),
])  # fmt: skip
def test_a_malformed_objective_names_the_value(arguments, message):
    with pytest.raises(PlanningError, match=message):
        RiskObjective(**arguments)


def test_a_checker_without_a_posterior_is_told_what_to_bring():
    with pytest.raises(PlanningError, match="DiskChecker has no posterior"):
        plan(one_disk(), START, GOAL, "RRTstar", objective=RiskObjective("joint"))


class Clock:
    """Time that passes only where a test says so."""

    def __init__(self, monkeypatch):
        self.time = 0.0
        monkeypatch.setitem(CLOCKS, "wall", lambda: self.time)

    def step(self, seconds, done):
        def run():
            self.time += seconds
            done.append(seconds)

        return run


class Prepared(RiskObjective):
    """An objective whose preparation takes the time that it is given."""

    steps = ()

    def preparation(self, checker):
        return Prepared.steps


def test_preparing_an_objective_counts_and_stops_when_the_time_is_up(monkeypatch):
    clock, done = Clock(monkeypatch), []
    monkeypatch.setattr(Prepared, "steps", [clock.step(t, done) for t in (0.02, 0.04, 9.0)])
    result = plan(one_disk(), START, GOAL, "RRTstar", 0.05, objective=Prepared(slope))
    assert done == [0.02, 0.04]
    assert (result.status, result.path) == ("timeout", None)
    assert result.report.objective_time == pytest.approx(0.06)
    assert "preparing the objective 'function' took 0.06 s of the 0.05 s" in result.message


def test_the_search_gets_what_preparing_left(monkeypatch):
    clock, done = Clock(monkeypatch), []
    monkeypatch.setattr(Prepared, "steps", [clock.step(t, done) for t in (0.5, 1.5)])
    limits = []

    def searched(judge, query, report, lead):
        limits.append(query.request.time_limit)
        return not_found("timeout", None, report)

    monkeypatch.setattr("vprism_plan.planning.attempts.searched", searched)
    result = plan(one_disk(), START, GOAL, "RRTstar", 5.0, objective=Prepared(slope))
    assert done == [0.5, 1.5]
    assert limits == [pytest.approx(3.0)]
    assert "within 5 s" in result.message
