# SPDX-License-Identifier: BSD-3-Clause
"""Planning with the real checker and a real robot description, pose goals among it."""

from itertools import pairwise

import disk_world
import numpy as np
import pytest
from oracles.checker_oracle import BallWorld, world_clearance
from scipy.spatial.transform import Rotation

from vprism_plan.collision import CollisionChecker
from vprism_plan.errors import PlanningError
from vprism_plan.planning import PoseGoalConfig, plan
from vprism_plan.robots import Robot

AXES = ["0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0"]
STEPS = ["0 0 0.15", "0 0 0.1", "0.3 0 0", "0.25 0 0", "0.1 0 0", "0.1 0 0"]


def write_arm(folder, first="continuous"):
    """Six turning joints, a tool flange, one sphere per link."""
    link = (
        '<link name="{}"><collision><geometry><sphere radius="0.04"/></geometry></collision></link>'
    )
    parts = ['<robot name="arm">', link.format("base"), '<link name="tool0"/>']
    for i, (axis, step) in enumerate(zip(AXES, STEPS, strict=True)):
        kind = first if i == 0 else "revolute"
        limit = '<limit lower="-2.6" upper="2.6" effort="1" velocity="2"/>'
        parts += [
            link.format(f"link{i}"),
            f'<joint name="j{i}" type="{kind}"><origin xyz="{step}"/>'
            f'<parent link="{"base" if i == 0 else f"link{i - 1}"}"/><child link="link{i}"/>'
            f'<axis xyz="{axis}"/>{limit}</joint>',
        ]
    parts.append(
        '<joint name="flange" type="fixed"><origin xyz="0.05 0 0.02" rpy="0.1 0.2 0.3"/>'
        '<parent link="link5"/><child link="tool0"/></joint></robot>'
    )
    file = folder / "arm.urdf"
    file.write_text("".join(parts))
    base = np.eye(4)
    base[:3, :3] = Rotation.from_euler("z", 0.4).as_matrix()
    base[:3, 3] = [0.1, -0.2, 0.3]
    return Robot.from_urdf(file, base_pose=base)


def ball_world(centers, radius):
    centers = np.asarray(centers, dtype=float)
    return BallWorld(centers, np.full(len(centers), radius), np.zeros((0, 4)))


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    return write_arm(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def crowded(arm):
    """Balls in the way of the elbow and the tool when the first joint turns."""
    q = np.array([0.0, 0.2, 0.3, 0.0, 0.2, 0.0])
    centers = [arm.link_poses(q)[name][:3, 3] for name in ("link4", "tool0")]
    return CollisionChecker(ball_world(centers, 0.08).baked(), arm)


START = np.array([-1.0, 0.2, 0.3, 0.0, 0.2, 0.0])
GOAL = np.array([1.0, 0.2, 0.3, 0.0, 0.2, 0.0])


@pytest.mark.parametrize(
    "planner", ["RRTConnect", "RRTstar", "InformedRRTstar", "BITstar", "KPIECE1", "AORRTC"]
)
def test_paths_of_a_real_arm_pass_the_checker_and_the_truth(planner, arm, crowded):
    result = plan(crowded, START, GOAL, planner, time_limit=20.0, stop="first")
    assert result.solved, result.message
    assert not result.report.direct
    world = ball_world(
        [
            arm.link_poses(np.array([0.0, 0.2, 0.3, 0.0, 0.2, 0.0]))[name][:3, 3]
            for name in ("link4", "tool0")
        ],
        0.08,
    )
    for a, b in pairwise(result.path):
        assert crowded.check_motion(a, b)
        for t in np.linspace(0.0, 1.0, 20):
            # The checker may sample at its finest step, two millimetres.
            assert world_clearance(arm.arrays, world, a + t * (b - a)) > -0.002
    assert result.report.tolerance <= 0.002


@pytest.mark.parametrize("seed", range(4))
def test_a_pose_is_reached_by_the_tool(arm, seed):
    checker = CollisionChecker(ball_world([[9.0, 9.0, 9.0]], 0.1).baked(), arm)
    rng = np.random.default_rng(seed)
    for _ in range(50):
        wanted = rng.uniform(arm.lower, arm.upper)
        if checker.is_valid(wanted):
            break
    pose = arm.link_poses(wanted)["tool0"]
    result = plan(checker, np.zeros(6), pose, seed=seed)
    assert result.solved, result.message
    assert result.report.goal_index is not None
    reached = arm.link_poses(result.path[-1])["tool0"]
    np.testing.assert_allclose(reached[:3, 3], pose[:3, 3], atol=1e-4)
    turn = Rotation.from_matrix(reached[:3, :3].T @ pose[:3, :3]).magnitude()
    assert turn < 1e-3
    other = plan(checker, np.zeros(6), pose, seed=seed)
    assert np.array_equal(result.path, other.path)


def test_a_pose_for_another_link(arm, crowded):
    pose = arm.link_poses(GOAL)["link3"]
    result = plan(crowded, START, pose, pose_goal=PoseGoalConfig(link="link3"))
    assert result.solved, result.message
    np.testing.assert_allclose(arm.link_poses(result.path[-1])["link3"], pose, atol=1e-3)


def test_a_pose_out_of_reach_is_an_invalid_goal(crowded):
    pose = np.eye(4)
    pose[:3, 3] = 5.0
    result = plan(crowded, START, pose)
    assert result.status == "invalid_goal"
    assert "no configuration within the joint limits reaches the pose" in result.message


def test_a_pose_inside_an_obstacle_says_what_is_touched(arm):
    pose = arm.link_poses(GOAL)["tool0"]
    checker = CollisionChecker(ball_world([pose[:3, 3]], 0.12).baked(), arm)
    result = plan(checker, START, pose)
    assert result.status == "invalid_goal"
    assert "configurations found for the goal pose are invalid" in result.message
    assert "object:1" in result.message
    assert result.explanation.contacts


def test_a_pose_that_is_none_and_a_link_that_is_none_are_refused(arm, crowded):
    skewed = np.eye(4)
    skewed[0, 1] = 0.5
    with pytest.raises(PlanningError, match="goal pose is not rigid"):
        plan(crowded, START, skewed)
    with pytest.raises(PlanningError, match=r"no link 'hand'.*tool0"):
        plan(crowded, START, np.eye(4), pose_goal=PoseGoalConfig(link="hand"))
    with pytest.raises(PlanningError, match="give the goal as joint values"):
        plan(disk_world.wall_with_gap(), [-0.7, -0.5], np.eye(4))


@pytest.mark.parametrize("value", [{"attempts": 0}, {"max_goals": 0}, {"rotation_tolerance": 0.0}])
def test_meaningless_pose_settings_are_named(value):
    with pytest.raises(PlanningError, match=next(iter(value))):
        PoseGoalConfig(**value)


def test_an_invalid_start_is_explained_by_the_real_checker(arm):
    tool = arm.link_poses(START)["link5"][:3, 3]
    checker = CollisionChecker(ball_world([tool], 0.1).baked(), arm)
    result = plan(checker, START, GOAL)
    assert result.status == "invalid_start"
    assert "link5" in result.message
    assert "object:1" in result.message
    assert "\n" not in result.message
