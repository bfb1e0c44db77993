# SPDX-License-Identifier: BSD-3-Clause
"""The widest margin that finds a path is the one that is kept."""

from itertools import pairwise
from pathlib import Path

import disk_world
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.checker_oracle import BallWorld

import vprism_plan as vp
from vprism_plan.errors import ConfigError, PlanningError
from vprism_plan.planning import attempts, plan
from vprism_plan.planning.path import MotionCheck
from vprism_plan.planning.search import SearchOutcome, SearchRequest, search

URDF = Path(__file__).resolve().parents[2] / "urdf" / "planar3.urdf"
START, GOAL = np.array([0.6, 0.3, 0.2]), np.array([-0.6, -0.3, -0.2])
NOTHING = SearchOutcome("timeout", None, None, 0.0, 0, 0)
LADDER = (0.02, 0.01, 0.005, 0.0)


@pytest.fixture(scope="module")
def robot():
    return vp.Robot.from_urdf(URDF)


def checker_with_ball(robot, gap, mirrored=False):
    """A ball that the start's arm clears by `gap` metres; and one for the goal's."""
    centers = np.asarray(robot.sphere_centers(torch_of(START)))
    last = int(np.argmax(np.linalg.norm(centers[:, :2], axis=1)))
    outward = centers[last] / np.linalg.norm(centers[last])
    center = centers[last] + (robot.sphere_radii[last] + gap + 0.03) * outward
    balls = np.stack([center, center * [1.0, -1.0, 1.0]])[: 1 + mirrored]
    world = BallWorld(balls, np.full(len(balls), 0.03), np.zeros((0, 4)))
    return vp.CollisionChecker(world.baked(), robot)


def torch_of(q):
    import torch

    return torch.as_tensor(q, dtype=torch.float64)


def holds(checker, path):
    return all(checker.check_motion(a, b) for a, b in pairwise(path))


@pytest.mark.parametrize(("gap", "kept"), [(0.045, 0.02), (0.016, 0.01), (0.004, 0.0)])
@pytest.mark.parametrize("tight", ["start", "end"])
def test_the_widest_margin_that_works_is_kept(robot, gap, kept, tight):
    checker = checker_with_ball(robot, gap)
    ends = (START, GOAL) if tight == "start" else (GOAL, START)
    result = plan(checker, *ends, margins=(0.02, 0.01, 0.0), seed=1)
    assert result.solved, result.message
    assert holds(checker.with_extra_margin(kept), result.path)
    for step in (0.02, 0.01):
        if step > kept:
            assert not plan(checker.with_extra_margin(step), *ends, time_limit=1.0).solved
    if kept == 0.02:
        assert "kept 20 mm beyond the checker's margin" in result.message
        assert result.report.middle is None
        return
    # An end that is too near costs the margin there, and only there.
    wide, first, last = result.report.middle
    assert wide == 0.02
    between = f"kept 20 mm beyond the checker's margin between waypoints {first} and {last}"
    assert f"{between}; {1000 * kept:g} mm at the {tight}" in result.message
    assert first == (tight == "start")
    assert last == len(result.path) - 1 - (tight == "end")
    assert holds(checker.with_extra_margin(0.02), result.path[first : last + 1])
    short = plan(checker, *ends, margins=None, seed=1).report.path_length
    assert result.report.path_length <= 1.1 * short


@pytest.mark.parametrize("interpolate", [None, 0.1])
def test_both_ends_may_be_tight(robot, interpolate):
    checker = checker_with_ball(robot, 0.006, mirrored=True)
    result = plan(checker, START, GOAL, interpolate=interpolate)
    assert result.solved, result.message
    assert "at both ends" in result.message
    wide, first, last = result.report.middle
    assert 0 < first < last < len(result.path) - 1
    assert holds(checker, result.path)
    # Pieces of an edge that holds a margin hold it up to what sampling leaves open.
    assert checker.clearance_batch(result.path[first : last + 1]).min() > wide - 1e-3


@pytest.mark.parametrize("margins", [(5.0, 0.0), (0.02, 0.0)])
def test_without_room_in_the_middle_the_path_is_what_it_was(robot, margins, monkeypatch):
    checker = checker_with_ball(robot, 0.004)
    if margins[0] < 5.0:  # there is a place with room at either end, and no way between them
        monkeypatch.setattr(attempts, "search", lambda *_: NOTHING)
        refuses = lambda self, a, b: self._check.__self__ is checker  # noqa: E731
        monkeypatch.setattr(MotionCheck, "__call__", refuses)
    result = plan(checker, START, GOAL, margins=margins)
    assert result.report.middle is None
    assert result.message.endswith("kept 0 mm beyond the checker's margin")
    assert np.array_equal(result.path, plan(checker, START, GOAL, margins=None).path)


def test_a_search_for_so_many_motions_ends_before_its_time():
    checker = disk_world.wall_with_gap()
    checker.check_motion_buffer = lambda a, b: False
    request = SearchRequest("RRTConnect", 60.0, 0, "first", (0.01, 1000), None, "wall", 25)
    ends = np.array([-0.9, -0.9]), np.array([[0.9, -0.9]])
    found = search(checker, *ends, request)
    assert found.path is None or found.status == "approximate"
    assert 25 <= found.motion_checks < 40


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_whatever_the_balls_a_path_is_valid_and_what_is_said_of_it_true(robot, seed):
    rng = np.random.default_rng(seed)
    centers, radii = rng.uniform(-0.6, 0.6, (4, 3)) * [1.0, 1.0, 0.1], rng.uniform(0.02, 0.08, 4)
    world = BallWorld(centers, radii, np.zeros((0, 4))).baked()
    checker = vp.CollisionChecker(world, robot)
    ends = rng.uniform(robot.lower, robot.upper, (200, robot.dof))
    room = checker.clearance_batch(ends)
    near = ends[checker.is_valid_batch(ends) & (room < 0.02)]
    free = ends[checker.with_extra_margin(0.02).is_valid_batch(ends)]
    if len(near) == 0 or len(free) == 0:
        return
    result = plan(checker, free[0], near[0], time_limit=0.5, margins=(0.02, 0.0), seed=seed)
    if not result.solved:
        return
    assert holds(checker, result.path)
    assert np.array_equal(result.path[0], free[0])
    turns = (result.path[-1] - near[0]) / (2.0 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns) * robot.continuous, atol=1e-12)
    if result.report.middle is not None:
        wide, first, last = result.report.middle
        assert (wide, first) == (0.02, 0)
        assert holds(checker.with_extra_margin(wide), result.path[first : last + 1])


def test_without_any_way_the_most_permissive_answer_is_given(robot):
    checker = checker_with_ball(robot, -0.02)
    result = plan(checker, START, GOAL, margins=LADDER)
    assert result.status == "invalid_start"
    assert result.message == plan(checker, START, GOAL).message


def test_an_extra_margin_adds_to_the_checkers_own(robot):
    checker = vp.CollisionChecker(
        checker_with_ball(robot, 0.03).world, robot, vp.CheckerConfig(margin=0.004)
    )
    assert checker.with_extra_margin(0.01).config.margin == pytest.approx(0.014)
    with pytest.raises(ConfigError, match="widened"):
        checker.with_extra_margin(-0.01)


@pytest.mark.parametrize("extra", [(), (0.0, 0.01), (0.01, 0.01), (-0.01,), (float("nan"),)])
def test_margins_that_do_not_decrease_are_refused(robot, extra):
    with pytest.raises(PlanningError, match="decreasing"):
        plan(checker_with_ball(robot, 0.03), START, GOAL, margins=extra)


def test_a_checker_without_margins_is_refused():
    free = np.array([False, False])
    point = disk_world.PointRobot(np.full(2, -1.0), np.full(2, 1.0), free)
    checker = disk_world.DiskChecker(np.array([[0.0, 0.9]]), np.array([0.05]), point)
    with pytest.raises(PlanningError, match="with_extra_margin"):
        plan(checker, [0.0, 0.0], [0.5, 0.5], margins=LADDER)
