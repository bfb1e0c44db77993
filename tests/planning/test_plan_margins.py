# SPDX-License-Identifier: BSD-3-Clause
"""The widest margin that finds a path is the one that is kept."""

from pathlib import Path

import disk_world
import numpy as np
import pytest
from oracles.checker_oracle import BallWorld

import vprism_plan as vp
from vprism_plan.errors import ConfigError, PlanningError
from vprism_plan.planning import plan

URDF = Path(__file__).resolve().parents[2] / "urdf" / "planar3.urdf"
START, GOAL = np.array([0.6, 0.3, 0.2]), np.array([-0.6, -0.3, -0.2])
LADDER = (0.02, 0.01, 0.005, 0.0)


@pytest.fixture(scope="module")
def robot():
    return vp.Robot.from_urdf(URDF)


def checker_with_ball(robot, gap):
    """A ball that the start's arm clears by `gap` metres."""
    centers = np.asarray(robot.sphere_centers(torch_of(START)))
    last = int(np.argmax(np.linalg.norm(centers[:, :2], axis=1)))
    outward = centers[last] / np.linalg.norm(centers[last])
    center = centers[last] + (robot.sphere_radii[last] + gap + 0.03) * outward
    world = BallWorld(center[None], np.array([0.03]), np.zeros((0, 4)))
    return vp.CollisionChecker(world.baked(), robot)


def torch_of(q):
    import torch

    return torch.as_tensor(q, dtype=torch.float64)


@pytest.mark.parametrize(("gap", "kept"), [(0.045, 0.02), (0.016, 0.01), (0.004, 0.0)])
def test_the_widest_margin_that_works_is_kept(robot, gap, kept):
    checker = checker_with_ball(robot, gap)
    result = plan(checker, START, GOAL, margins=(0.02, 0.01, 0.0), seed=1)
    assert result.solved, result.message
    assert f"kept {1000 * kept:g} mm beyond" in result.message
    strict = checker.with_extra_margin(kept)
    assert all(
        strict.check_motion(a, b) for a, b in zip(result.path, result.path[1:], strict=False)
    )
    wider = [step for step in (0.02, 0.01) if step > kept]
    for step in wider:
        assert not plan(checker.with_extra_margin(step), START, GOAL, time_limit=1.0).solved


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
