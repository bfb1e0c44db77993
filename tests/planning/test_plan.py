# SPDX-License-Identifier: BSD-3-Clause
"""`plan`: what it finds, what it refuses, and that it says which is which."""

import time
from itertools import pairwise

import disk_world
import numpy as np
import pytest
from ompl import util as ou

from vprism_plan.errors import PlanningError
from vprism_plan.planning import plan, quiet_ompl
from vprism_plan.planning.planners import PLANNERS
from vprism_plan.planning.search import checked_seed

START, GOAL = [-0.7, -0.5], [0.7, -0.5]
# The rest of `planners()` is tested in test_planners.py, in less detail.
COMMON = ["RRTConnect", "RRTstar", "InformedRRTstar", "BITstar", "KPIECE1", "AORRTC"]
OPTIMISING = [name for name in COMMON if PLANNERS[name].reports_cost]


def quick(planner):
    """Arguments that end a search by itself, so that it does not depend on the clock."""
    return {"planner": planner, "time_limit": 20.0, "stop": "first"}


def edges_are_valid(checker, path):
    return all(checker.check_motion(a, b) for a, b in pairwise(path))


@pytest.mark.parametrize("planner", COMMON)
@pytest.mark.parametrize("dof", [2, 3])
def test_every_planner_goes_round_the_wall(planner, dof):
    checker = disk_world.wall_with_gap(dof)
    start, goal = START + [0.1] * (dof - 2), GOAL + [-0.1] * (dof - 2)
    result = plan(checker, start, goal, **quick(planner))
    assert result.solved, result.message
    assert result.status == "exact"
    assert result.path.shape[1] == dof
    assert result.path[0].tolist() == start
    assert result.path[-1].tolist() == goal
    assert np.isfinite(result.path).all()
    assert edges_are_valid(checker, result.path)
    report = result.report
    assert (report.planner, report.seed, report.direct) == (planner, 0, False)
    assert report.waypoints == len(result.path) > 2
    assert report.path_length == pytest.approx(
        np.linalg.norm(np.diff(result.path, axis=0), axis=1).sum()
    )
    assert 0.0 < report.min_clearance <= checker.clearance(start)
    assert report.state_checks > 2
    assert report.motion_checks > report.waypoints
    assert report.planning_time > 0.0
    assert report.certified
    assert report.tolerance == 0.0
    assert report.shares == {"occluded": 0.25}


@pytest.mark.parametrize("planner", COMMON)
def test_the_same_seed_gives_the_same_bits_and_another_seed_does_not(planner):
    checker = disk_world.wall_with_gap()
    first, again = (plan(checker, START, GOAL, seed=3, **quick(planner)) for _ in range(2))
    assert first.solved
    assert np.array_equal(first.path, again.path)
    others = [plan(checker, START, GOAL, seed=s, **quick(planner)).path for s in (4, 5, 6)]
    assert any(p.shape != first.path.shape or not np.array_equal(p, first.path) for p in others)


@pytest.mark.parametrize("planner", OPTIMISING)
def test_an_optimising_planner_that_may_converge_comes_near_the_shortest_path(planner):
    checker = disk_world.wall_with_gap()
    # Over the topmost ball, centre (0, 0.55), radius 0.15: two tangents and an arc.
    reach = np.hypot(0.7, 1.05)
    angle = np.pi - np.arctan2(1.05, 0.7) - np.arccos(0.15 / reach)
    shortest = 2 * np.sqrt(reach**2 - 0.15**2) + 0.15 * 2 * (
        np.pi / 2 - (np.pi - angle - np.pi / 2)
    )
    result = plan(
        checker,
        START,
        GOAL,
        planner,
        time_limit=20.0,
        stop="converged",
        convergence=(0.05, 400),
    )
    assert result.solved
    assert result.report.planning_time < 15.0
    assert result.report.path_length < 1.25 * shortest


def test_an_optimising_planner_uses_its_time_and_no_more():
    result = plan(
        disk_world.wall_with_gap(), START, GOAL, "RRTstar", time_limit=0.4, clock="process"
    )
    assert result.solved
    assert 0.39 < result.report.planning_time < 1.0


def test_a_free_line_is_taken_without_a_search():
    checker = disk_world.wall_with_gap()
    result = plan(checker, [-0.7, 0.8], [0.7, 0.8], "RRTstar", time_limit=30.0)
    assert result.solved
    assert result.report.direct
    assert result.report.planning_time == 0.0
    assert result.path.tolist() == [[-0.7, 0.8], [0.7, 0.8]]


def test_start_equal_to_goal_is_solved():
    result = plan(disk_world.wall_with_gap(), START, START)
    assert result.solved
    assert result.path.tolist() == [START, START]
    assert result.report.path_length == 0.0


@pytest.mark.parametrize("planner", COMMON)
def test_where_no_path_exists_the_answer_is_no(planner):
    began = time.perf_counter()
    result = plan(disk_world.closed_wall(), [-0.7, 0.0], [0.7, 0.0], planner, time_limit=0.5)
    assert time.perf_counter() - began < 5.0
    assert not result.solved
    assert result.status in {"approximate", "timeout"}
    assert result.path is None
    assert (result.approximate_path is not None) == (result.status == "approximate")
    assert result.report.waypoints == 0
    assert planner in result.message


def test_an_approximate_solution_is_a_failure_kept_apart():
    result = plan(disk_world.closed_wall(), [-0.7, 0.0], [0.7, 0.0], time_limit=0.3)
    assert result.status == "approximate"
    assert not result.solved
    assert result.path is None
    assert result.approximate_path[0].tolist() == [-0.7, 0.0]
    assert result.approximate_path[-1, 0] < 0.0


@pytest.mark.parametrize(("what", "start", "goal"), [
    ("start", [0.0, 0.0], GOAL),
    ("goal", START, [0.0, 0.0]),
])  # fmt: skip
def test_an_invalid_end_is_explained_and_not_searched_for(what, start, goal):
    result = plan(disk_world.wall_with_gap(), start, goal, time_limit=60.0)
    assert result.status == f"invalid_{what}"
    assert not result.solved
    assert result.path is None
    assert result.message == f"{what} is invalid: point touches a ball"
    assert result.explanation.valid is False
    assert result.report.planning_time == 0.0


def test_an_end_outside_the_limits_names_the_joint_even_if_the_checker_does_not_mind():
    class Careless(disk_world.DiskChecker):
        def _inside_limits(self, q):
            return True

    checker = Careless([], [], disk_world.robot())
    result = plan(checker, START, [0.7, 1.5])
    assert result.status == "invalid_goal"
    assert "joint_1 is 1.5, outside its limits [-1, 1]" in result.message


@pytest.mark.parametrize("planner", COMMON)
def test_motions_accepted_wrongly_during_the_search_are_caught(planner):
    class Liar(disk_world.DiskChecker):
        def check_motion_buffer(self, qa, qb):
            return True

        def check_motion(self, qa, qb):
            return super().check_motion_buffer(np.asarray(qa), np.asarray(qb))

    honest = disk_world.closed_wall()
    liar = Liar(honest.centers, honest.radii, honest.robot)
    result = plan(liar, START, GOAL, **quick(planner))
    assert result.status == "verification_failed"
    assert not result.solved
    assert result.path is None
    assert not edges_are_valid(honest, result.approximate_path)
    assert result.report.searches == 5
    assert "on the way" in result.message
    assert result.explanation.valid is False


def test_a_path_that_fails_its_verification_is_searched_for_again():
    class LiesAtFirst(disk_world.DiskChecker):
        lies = 8

        def check_motion_buffer(self, qa, qb):
            self.lies -= 1
            return self.lies > 0 or super().check_motion_buffer(qa, qb)

        def check_motion(self, qa, qb):
            return super().check_motion_buffer(np.asarray(qa), np.asarray(qb))

    honest = disk_world.wall_with_gap()
    results = []
    for _ in range(2):
        checker = LiesAtFirst(honest.centers, honest.radii, honest.robot)
        results.append(plan(checker, START, GOAL, time_limit=20.0))
    assert results[0].solved
    assert results[0].report.searches > 1
    assert edges_are_valid(honest, results[0].path)
    assert np.array_equal(results[0].path, results[1].path)


@pytest.mark.parametrize("planner", COMMON)
@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_what_the_checker_raises_comes_out_of_every_planner(planner, error):
    class Breaks(disk_world.DiskChecker):
        def check_motion_buffer(self, qa, qb):
            raise error("sensor unplugged")

        def check_motion(self, qa, qb):
            return False

    checker = Breaks([], [], disk_world.robot())
    with pytest.raises(error, match="unplugged"):
        plan(checker, START, GOAL, planner, time_limit=5.0)
    assert plan(disk_world.wall_with_gap(), START, GOAL, **quick(planner)).solved


@pytest.mark.parametrize("planner", COMMON)
@pytest.mark.parametrize("continuous", [(0,), (0, 1)])
def test_continuous_joints_go_the_short_way_round(planner, continuous):
    # A wall through 0 from end to end: only the way behind pi is left.
    ys = np.linspace(-np.pi, np.pi, 45)
    wall = np.stack([0 * ys, ys], axis=1)
    block = np.array([[np.pi, 0.0]])
    robot = disk_world.robot(2, continuous)
    checker = disk_world.DiskChecker(
        np.concatenate([wall, block]), np.full(len(ys) + 1, 0.15), robot
    )
    result = plan(checker, [2.5, 0.0], [-2.5, 0.0], **quick(planner))
    assert result.solved, result.message
    assert edges_are_valid(checker, result.path)
    assert result.path[0].tolist() == [2.5, 0.0]
    turns = (result.path[-1] - [-2.5, 0.0]) / (2 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-9)
    assert round(turns[0]) == 1
    assert np.all(np.abs(np.diff(result.path, axis=0)) < np.pi)


def test_a_start_given_with_whole_turns_keeps_them():
    checker = disk_world.wall_with_gap()
    checker = disk_world.DiskChecker([(0.0, 0.0)], [0.3], disk_world.robot(2, (0,)))
    start = [-0.9 + 4 * np.pi, 0.0]
    result = plan(checker, start, [0.9, 0.0])
    assert result.solved
    assert not result.report.direct
    assert result.path[0].tolist() == start
    assert edges_are_valid(checker, result.path)


def test_resampling_keeps_the_path_and_bounds_the_spacing():
    checker = disk_world.wall_with_gap()
    coarse = plan(checker, START, GOAL)
    fine = plan(checker, START, GOAL, interpolate=0.05)
    assert fine.solved
    assert np.linalg.norm(np.diff(fine.path, axis=0), axis=1).max() <= 0.05 + 1e-12
    assert fine.report.path_length == pytest.approx(coarse.report.path_length)
    assert all(any(np.array_equal(q, p) for p in fine.path) for q in coarse.path)


def test_simplification_shortens():
    checker = disk_world.wall_with_gap()
    raw = plan(checker, START, GOAL, simplify=False, seed=1)
    short = plan(checker, START, GOAL, simplify=True, seed=1)
    assert short.report.path_length < raw.report.path_length
    assert raw.solved
    assert short.solved


def test_a_whole_number_of_seconds_will_do():
    assert plan(disk_world.wall_with_gap(), START, GOAL, time_limit=5).solved


def test_several_calls_with_numpy_lists_and_tuples_agree():
    checker = disk_world.wall_with_gap()
    paths = [plan(checker, kind(START), kind(GOAL)).path for kind in (list, tuple, np.array)]
    assert np.array_equal(paths[0], paths[1])
    assert np.array_equal(paths[0], paths[2])


@pytest.mark.parametrize(("arguments", "message"), [
    ({"planner": "EST"}, "'EST'.*'RRTConnect', 'RRT', 'RRTstar', 'InformedRRTstar', .*LBKPIECE1"),
    ({"planner": "PRM", "clock": "process"}, "second thread"),
    ({"planner": "PRMstar", "stop": "converged"}, "does not say what its path costs"),
    ({"objective": "risk"}, "objective is 'risk'.*RiskObjective"),
    ({"time_limit": 0}, "time_limit is 0"),
    ({"time_limit": -1.0}, "time_limit is -1"),
    ({"time_limit": np.nan}, "time_limit is nan"),
    ({"time_limit": np.inf}, "time_limit is inf"),
    ({"seed": -1}, "seed is -1"),
    ({"stop": "soon"}, "'soon'.*'limit', 'first', 'converged'"),
    ({"convergence": (0.0, 10)}, "convergence"),
    ({"step": 0.0}, "step is 0"),
    ({"planner": "BITstar", "step": 0.1}, "no step length"),
    ({"interpolate": 0.0}, "interpolate is 0"),
    ({"clearance_step": -1.0}, "clearance_step is -1"),
    ({"simplify_time": -1.0}, "simplify_time is -1"),
])  # fmt: skip
def test_a_malformed_query_names_the_value(arguments, message):
    with pytest.raises(PlanningError, match=message):
        plan(disk_world.wall_with_gap(), START, GOAL, **arguments)


@pytest.mark.parametrize(("start", "goal", "message"), [
    ([0.0], GOAL, r"start has shape \(1,\).*joint_0, joint_1"),
    (START, [0.0, 0.0, 0.0], r"goal has shape \(3,\)"),
    ([np.nan, 0.0], GOAL, "start is .*nan.*finite"),
    (START, [0.0, np.inf], "goal is .*inf.*finite"),
    (START, np.zeros((2, 3)), r"goal has shape \(2, 3\)"),
    (START, [START, [np.nan, 0.0]], "goal 1 is .*nan.*finite"),
    (START, np.zeros((0, 2)), r"goal has shape \(0, 2\)"),
])  # fmt: skip
def test_what_is_not_a_configuration_is_an_error(start, goal, message):
    with pytest.raises(PlanningError, match=message):
        plan(disk_world.wall_with_gap(), start, goal)


@pytest.mark.parametrize("seed", [1.5, True, "1", None])
def test_a_seed_is_a_whole_number(seed):
    with pytest.raises(PlanningError, match="whole number, at least 0"):
        checked_seed(seed)


def test_ompl_is_silent_inside_and_as_loud_as_before_outside(capfd):
    before = ou.getLogLevel()
    ou.setLogLevel(ou.LogLevel.LOG_WARN)
    try:
        plan(disk_world.wall_with_gap(), START, GOAL)
        assert ou.getLogLevel() == ou.LogLevel.LOG_WARN
        with quiet_ompl(), quiet_ompl():
            assert ou.getLogLevel() == ou.LogLevel.LOG_NONE
        with pytest.raises(ZeroDivisionError), quiet_ompl():
            _ = 1 / 0
        assert ou.getLogLevel() == ou.LogLevel.LOG_WARN
    finally:
        ou.setLogLevel(before)
    out, err = capfd.readouterr()
    assert out == err == ""


def test_overlapping_silences_restore_the_level_once_the_last_one_ends():
    before = ou.getLogLevel()
    first, second = quiet_ompl(), quiet_ompl()
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert ou.getLogLevel() == ou.LogLevel.LOG_NONE
    second.__exit__(None, None, None)
    assert ou.getLogLevel() == before
