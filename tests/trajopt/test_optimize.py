# SPDX-License-Identifier: BSD-3-Clause
"""`optimize` hands out verified paths only, and says why where there is none."""

import json
import time
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from planning.disk_world import DiskChecker, closed_wall, robot, wall_with_gap
from trajopt.disk_cost import BallCost, disk_cost

from vprism_plan.errors import PlanningError
from vprism_plan.trajopt import SmoothnessCost, optimize

START, GOAL = np.array([-0.8, -0.4]), np.array([0.8, -0.3])
SMALL = {"waypoints": 16, "max_iterations": 80, "seeds": 6}


def run(checker, start=START, goal=GOAL, **given):
    cost = given.pop("cost", None) or disk_cost(checker)
    return optimize(checker, start, goal, **{"cost": cost, **SMALL, **given})


def every_edge_is_free(checker, path):
    return all(checker.check_motion(a, b) for a, b in pairwise(path))


def length(path):
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


@pytest.fixture
def gap():
    return wall_with_gap()


@pytest.mark.parametrize("method", ["lbfgs", "adam"])
def test_a_path_round_the_wall_is_found_and_free(gap, method):
    assert not gap.check_motion(START, GOAL)
    result = run(gap, method=method)
    assert result.solved
    assert every_edge_is_free(gap, result.path)
    assert result.report.winner_name in result.message
    # Over the wall's end and straight from there to both ends is the shortest way.
    corner = np.array([0.0, 0.55 + 0.15])
    shortest = np.linalg.norm(corner - START) + np.linalg.norm(GOAL - corner)
    assert shortest < length(result.path) < 1.12 * shortest
    assert result.report.path_length == pytest.approx(length(result.path))


@settings(max_examples=6)
@given(
    st.tuples(*[st.floats(0.25, 0.95)] * 2),
    st.tuples(*[st.floats(-0.95, 0.95)] * 2),
    st.sampled_from(["lbfgs", "adam"]),
)
def test_ends_are_bit_for_bit_and_what_is_solved_is_free(x, y, method):
    """Whatever the query: few iterations, so that some are not solved."""
    gap = wall_with_gap()
    start, goal = np.array([-x[0], y[0]]), np.array([x[1], y[1]])
    result = run(gap, start, goal, seeds=3, method=method, max_iterations=10, repairs=0)
    for rows in (result.begun, result.ended):
        assert np.array_equal(rows[:, 0], np.tile(start, (3, 1)))
        assert np.array_equal(rows[:, -1], np.tile(goal, (3, 1)))
    assert result.solved == (result.path is not None) == (result.status == "exact")
    if result.solved:
        assert every_edge_is_free(gap, result.path)
        assert np.array_equal(result.path[0], start)
        assert np.array_equal(result.path[-1], goal)
    else:
        assert result.status == "verification_failed"
        assert "edge" in result.message


class Refusing:
    """A checker that agrees with another one, and takes one kind of verdict back."""

    def __init__(self, checker, refuses):
        self._checker, self._refuses = checker, refuses
        self.robot, self.asked = checker.robot, 0

    def __getattr__(self, name):
        return getattr(self._checker, name)

    def check_motion(self, qa, qb):
        self.asked += 1
        return self._checker.check_motion(qa, qb) and not self._refuses(qa, qb)

    def check_motion_report(self, qa, qb):
        if self._refuses(qa, qb):
            return SimpleNamespace(
                valid=False, certified=False, tolerance=0.0, text=lambda: "no\nway"
            )
        return self._checker.check_motion_report(qa, qb)


def test_a_checker_that_refuses_everything_gets_no_path_through(gap):
    refusing = Refusing(gap, lambda qa, qb: True)
    result = run(refusing, seeds=3, guard=BallCost(gap, weight=1e3), repairs=2)
    assert not result.solved
    assert result.path is None
    assert result.status == "verification_failed"
    assert result.report.rounds == 3
    assert "no way" in result.message
    assert "edge 0 of 15" in result.message
    assert all("edge 0" in seed.refused for seed in result.report.seeds)
    assert not result.explanation.valid
    assert np.array_equal(result.best[0], START)
    assert refusing.asked >= 9


def test_one_refused_edge_is_enough(gap):
    """A gate across the goal's side that no path can avoid, and that no cost knows."""
    refusing = Refusing(gap, lambda qa, qb: qa[0] < 0.5 <= qb[0])
    over = np.array([START, [0.0, 0.9], GOAL])
    assert run(gap, initial=over, seeds=1).solved
    result = run(refusing, initial=over, seeds=1, guard=BallCost(gap), repairs=1)
    assert not result.solved
    refused = int(result.message.split("edge ")[1].split(" ")[0])
    assert result.best[refused, 0] < 0.5 <= result.best[refused + 1, 0]


def test_the_next_candidate_is_taken_where_the_best_is_refused(gap):
    """A gate that only knows one way round: the other is longer, and free."""
    centers = np.array([[0.0, 0.05]])
    checker = DiskChecker(centers, np.array([0.4]), robot())
    below = Refusing(checker, lambda qa, qb: min(qa[1], qb[1]) < -0.2)
    start, goal = np.array([-0.8, 0.0]), np.array([0.8, 0.0])
    free = run(checker, start, goal, seeds=7)
    assert free.path[:, 1].min() < -0.3
    result = run(below, start, goal, seeds=7)
    assert result.solved
    assert result.path[:, 1].max() > 0.4
    assert result.report.cost > free.report.cost
    seeds = result.report.seeds
    refused = [seed.cost for seed in seeds if seed.refused]
    assert refused
    assert max(refused) <= seeds[result.report.winner].cost


def test_no_path_exists_and_the_answer_says_what_is_in_the_way():
    result = run(closed_wall(), guard=BallCost(closed_wall(), weight=1e4), repairs=2)
    assert result.status == "verification_failed"
    assert "point touches a ball" in result.message
    assert "none of 6 seeds" in result.message


def test_repairs_solve_what_too_light_a_cost_draws_through_the_wall(gap):
    light = disk_cost(gap, weight=300.0)
    assert not run(gap, cost=light, repairs=0).solved
    result = run(gap, cost=light, guard=BallCost(gap, weight=3e4), repairs=4)
    assert result.solved
    assert result.report.rounds > 1
    assert every_edge_is_free(gap, result.path)
    assert "repair" in result.history.terms
    assert set(result.history.round) == set(range(result.report.rounds))


def test_the_same_arguments_give_the_same_bits(gap):
    first, second = (run(gap, seed=5, seeds=4, max_iterations=30) for _ in range(2))
    assert np.array_equal(first.path, second.path)
    assert np.array_equal(first.ended, second.ended)
    assert np.array_equal(first.history.cost, second.history.cost)
    assert not np.array_equal(first.begun, run(gap, seed=6, seeds=4, max_iterations=1).begun)


@pytest.mark.parametrize("method", ["lbfgs", "adam"])
def test_seeds_do_not_know_of_each_other(gap, method):
    """Alone, among others, and in another order each ends where it ends."""
    rng = np.random.default_rng(0)
    paths = [np.stack([START, rng.uniform(-0.9, 0.9, 2), GOAL]) for _ in range(3)]
    together = run(gap, initial=paths, seeds=3, method=method)
    backwards = run(gap, initial=paths[::-1], seeds=3, method=method)
    assert np.allclose(together.ended, backwards.ended[::-1], atol=1e-6)
    for k, path in enumerate(paths):
        alone = run(gap, initial=path, seeds=1, method=method)
        assert np.allclose(alone.ended[0], together.ended[k], atol=1e-6)
        assert alone.report.seeds[0].stopped == together.report.seeds[k].stopped
    costs = [seed.cost for seed in together.report.seeds]
    assert (
        together.report.winner == int(np.argmin(costs))
        or together.report.seeds[int(np.argmin(costs))].refused
    )


def test_more_seeds_only_add_to_fewer(gap):
    few, many = (run(gap, seeds=count, max_iterations=2) for count in (3, 7))
    assert np.array_equal(few.begun, many.begun[:3])
    names = [seed.name for seed in many.report.seeds]
    assert names == ["straight", "via 0", "noise 0", "via 1", "noise 1", "via 2", "noise 2"]


def test_costs_in_the_history_only_fall_and_terms_add_up(gap):
    history = run(gap).history
    assert (np.diff(history.cost, axis=0) <= 0.0).all()
    assert np.allclose(sum(history.terms.values()), history.cost)
    assert set(history.terms) == {"smoothness", "balls", "joint limits"}


def test_a_free_straight_line_converges_at_once_to_itself():
    checker = DiskChecker(np.empty((0, 2)), np.empty(0), robot())
    result = run(checker, seeds=1, cost=SmoothnessCost())
    assert result.solved
    line = START + np.linspace(0.0, 1.0, 16)[:, None] * (GOAL - START)
    assert np.allclose(result.path, line, atol=1e-6)
    assert result.report.seeds[0].stopped in ("converged", "stalled")
    assert result.report.seeds[0].iterations < 10


def test_iterations_are_capped(gap):
    result = run(gap, max_iterations=3, repairs=0)
    assert all(seed.iterations <= 3 for seed in result.report.seeds)
    assert any(seed.stopped == "iterations" for seed in result.report.seeds)


class Slow(SmoothnessCost):
    """Takes a hundredth of a second a look."""

    def evaluate(self, q):
        time.sleep(0.01)
        return super().evaluate(q)


def test_time_is_up_and_what_there_is_then_is_verified():
    free = DiskChecker(np.empty((0, 2)), np.empty(0), robot())
    wall = closed_wall()
    result = run(free, cost=Slow(acceleration=1e-3), seeds=5, tolerance=1e-12, time_limit=0.1)
    assert result.solved
    assert {seed.stopped for seed in result.report.seeds} == {"time"}
    result = run(
        wall, cost=Slow(acceleration=1e-3), guard=BallCost(wall), tolerance=1e-12, time_limit=0.1
    )
    assert result.status == "timeout"
    assert result.path is None
    assert "time was up" in result.message
    assert result.report.rounds == 1


def test_start_or_goal_in_a_ball_is_refused_with_the_reason(gap):
    inside = np.array([0.0, 0.0])
    for start, goal, status in ((inside, GOAL, "invalid_start"), (START, inside, "invalid_goal")):
        result = run(gap, start, goal)
        assert result.status == status
        assert not result.solved
        assert result.history is None
        assert "touches a ball" in result.message
        json.dumps(result.to_dict())


def test_of_several_goals_the_nearest_that_has_a_path_is_reached(gap):
    inside, near, far = np.array([0.0, 0.0]), np.array([-0.4, 0.1]), GOAL
    refused_near = Refusing(gap, lambda qa, qb: np.array_equal(qb, near))
    for checker, reached in ((gap, near), (refused_near, far)):
        result = run(checker, START, np.stack([far, inside, near]))
        assert result.solved, result.message
        assert np.array_equal(result.path[-1], reached)
        assert every_edge_is_free(gap, result.path)
    none = run(gap, START, np.stack([inside, inside + 0.01]))
    assert none.status == "invalid_goal"
    assert "all 2 configurations given as goals are invalid" in none.message
    beside = far - [0.2, 0.0]
    walled = run(closed_wall(), START, np.stack([far, beside]), repairs=0)
    assert not walled.solved
    assert np.array_equal(walled.best[-1], beside)
    with pytest.raises(PlanningError, match="initial leads to one goal"):
        run(gap, START, np.stack([far, near]), initial=np.array([START, [0.0, 0.9], GOAL]))


def test_results_go_to_json(gap):
    result = run(gap, seeds=3, max_iterations=5)
    loaded = json.loads(json.dumps(result.to_dict()))
    assert loaded["status"] == result.status
    assert len(loaded["report"]["seeds"]) == 3
    assert np.shape(loaded["history"]["cost"])[1] == 3


def test_continuous_joints_go_the_short_way_round():
    turning = DiskChecker(np.empty((0, 2)), np.empty(0), robot(2, continuous=(0,)))
    start, goal = np.array([3.0, 0.0]), np.array([-3.0, 0.5])
    result = run(turning, start, goal, cost=SmoothnessCost(robot=turning.robot), seeds=3)
    assert result.solved
    assert np.array_equal(result.path[0], start)
    assert result.path[-1] == pytest.approx([2 * np.pi - 3.0, 0.5])
    assert np.abs(np.diff(result.path[:, 0])).sum() < 0.3
    # A path that went the long way stays one: it may have reasons.
    long = np.stack([start, [0.0, 0.2], goal])
    kept = run(turning, start, goal, cost=SmoothnessCost(), initial=long, seeds=1)
    assert kept.solved
    assert kept.path[-1] == pytest.approx(goal)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"method": "newton"}, "'lbfgs', 'adam'"),
        ({"seeds": 0}, "seeds is 0"),
        ({"waypoints": 3}, "whole number, at least 4"),
        ({"max_iterations": 0}, "max_iterations is 0"),
        ({"tolerance": 0.0}, "tolerance is 0.0"),
        ({"time_limit": -1.0}, "time_limit is -1.0"),
        ({"clearance_step": 0.0}, "clearance_step"),
        ({"repairs": -1}, "repairs is -1"),
        ({"seed": -3}, "seed is -3"),
        ({"cost": 3.0}, "cost is a float"),
        ({"keep_clearance": True}, "no initial path"),
        ({"keep_clearance": float("nan")}, "keep_clearance is nan"),
        ({"initial": [[0.0, 0.0], [0.5, 0.5]]}, "initial path 0 begins elsewhere"),
        ({"initial": [START, [0.5, 0.5]]}, "ends elsewhere"),
        ({"initial": [START]}, "at least two waypoints"),
        ({"initial": [START, [np.nan, 0.0], GOAL]}, "NaN"),
    ],
)
def test_wrong_arguments_are_named(gap, wrong, says):
    with pytest.raises(PlanningError, match=says):
        run(gap, **wrong)


def test_without_a_world_a_cost_must_be_given(gap):
    with pytest.raises(PlanningError, match="no default cost for a DiskChecker"):
        optimize(gap, START, GOAL)
