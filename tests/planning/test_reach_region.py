# SPDX-License-Identifier: BSD-3-Clause
"""Goals that are a region: drawn, solved, refused with reasons, planned to."""

import json

import numpy as np
import pytest
from oracles.checker_oracle import BallWorld
from scipy.spatial.transform import Rotation

from vprism_plan._resources import urdf_path
from vprism_plan.collision import CollisionChecker
from vprism_plan.errors import PlanningError
from vprism_plan.planning import PoseGoalConfig, ReachRegion, plan
from vprism_plan.planning.goals import solve_region
from vprism_plan.robots import Robot

DOWN = np.diag([1.0, -1.0, -1.0])
START = np.array([0.0, -1.2, 1.2, -1.5, -1.5, 0.0])
FEW = PoseGoalConfig(attempts=24, iterations=60)


@pytest.fixture(scope="module")
def arm():
    return Robot.from_urdf(urdf_path("ur5e"))


@pytest.fixture(scope="module")
def free(arm):
    far = np.array([[9.0, 9.0, 9.0]])
    return CollisionChecker(BallWorld(far, np.array([0.1]), np.zeros((0, 4))).baked(), arm)


REGIONS = {
    "box": ReachRegion.box([0.3, -0.3, 0.2], [0.6, 0.3, 0.5], link="tool0"),
    "ball": ReachRegion.sphere([0.4, 0.2, 0.4], 0.1, link="tool0"),
    "fixed": ReachRegion.box([0.3, -0.2, 0.2], [0.6, 0.2, 0.5], link="tool0", rotation=DOWN),
    "axis": ReachRegion.box(
        [0.3, -0.2, 0.2], [0.6, 0.2, 0.5], link="tool0", rotation=DOWN, tilt=0.1,
        free_axis=[0.0, 0.0, 1.0],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REGIONS)
def test_every_solution_is_in_the_region_by_the_links_own_pose(name, arm):
    region = REGIONS[name]
    found = solve_region(arm, region, START, 0, FEW)
    assert len(found) >= 5
    assert (found >= arm.lower).all()
    assert (found <= arm.upper).all()
    for q in found:
        T = arm.link_poses(q)["tool0"]
        away = T[:3, 3] - region.pose[:3, 3]
        if name == "ball":
            assert np.linalg.norm(away) <= 0.1 + 1e-6
        else:
            assert (np.abs(away) <= region.extent + 1e-6).all()
        if name == "fixed":
            assert Rotation.from_matrix(DOWN.T @ T[:3, :3]).magnitude() < 2e-3
        if name == "axis":
            assert np.arccos(np.clip(-T[2, 2], -1, 1)) <= 0.1 + 1e-6
    if name == "axis":  # any turn about the axis will do, and turns are found
        headings = [np.arctan2(*arm.link_poses(q)["tool0"][:2, 0]) for q in found]
        assert np.ptp(headings) > 1.0


def test_plan_reaches_a_region(free, arm):
    result = plan(free, START, REGIONS["axis"], time_limit=30.0, pose_goal=FEW)
    assert result.solved, result.message
    T = arm.link_poses(result.path[-1])["tool0"]
    assert REGIONS["axis"].contains(T[None, :3, :3], T[None, :3, 3]).all()


def test_solutions_that_the_checker_refuses_are_listed_with_the_reason(arm):
    around = REGIONS["ball"].pose[None, :3, 3]
    blocked = CollisionChecker(BallWorld(around, np.array([0.25]), np.zeros((0, 4))).baked(), arm)
    turned = START + np.array([np.pi, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert blocked.is_valid(turned)
    result = plan(blocked, turned, REGIONS["ball"], time_limit=5.0, pose_goal=FEW)
    assert result.status == "invalid_goal"
    assert "found for the goal region are invalid" in result.message
    assert len(result.report.refused_goals) >= 1
    assert all(refused.reason for refused in result.report.refused_goals)
    told = json.loads(json.dumps(result.report.to_dict()))
    assert told["refused_goals"][0]["reason"]


def test_a_region_out_of_reach_is_an_invalid_goal(free):
    region = ReachRegion.sphere([5.0, 0.0, 0.0], 0.1, link="tool0")
    result = plan(free, START, region, pose_goal=FEW)
    assert result.status == "invalid_goal"
    assert "reaches the region (24 attempts)" in result.message


def test_the_same_seed_draws_the_same_goals(arm):
    first, again, other = (solve_region(arm, REGIONS["box"], START, s, FEW) for s in (1, 1, 2))
    assert np.array_equal(first, again)
    assert first.shape != other.shape or not np.array_equal(first, other)


@pytest.mark.parametrize(("make", "message"), [
    (lambda: ReachRegion.box([1, 0, 0], [0, 1, 1]), "lower first"),
    (lambda: ReachRegion.sphere([0, 0], 1.0), "point"),
    (lambda: ReachRegion.sphere([0, 0, 0], -1.0), "extent"),
    (lambda: ReachRegion(2 * np.eye(4), [1.0]), "pose of a region.*rigid"),
    (lambda: ReachRegion.sphere([0, 0, 0], 1.0, rotation=np.ones((3, 3))), "rotation.*rigid"),
    (lambda: ReachRegion.sphere([0, 0, 0], 1.0, rotation=DOWN, tilt=0.0), "tilt is 0"),
    (lambda: ReachRegion.sphere([0, 0, 0], 1.0, free_axis=[0, 0, 1]), "free already"),
    (
        lambda: ReachRegion.sphere([0, 0, 0], 1.0, rotation=DOWN, free_axis=[0, 0, 0]),
        "free_axis",
    ),
])  # fmt: skip
def test_a_malformed_region_names_the_value(make, message):
    with pytest.raises(PlanningError, match=message):
        make()


def test_an_unknown_link_is_named(free):
    with pytest.raises(PlanningError, match="no link 'claw'"):
        plan(free, START, ReachRegion.sphere([0.4, 0.0, 0.4], 0.1, link="claw"))
