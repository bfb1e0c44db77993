# SPDX-License-Identifier: BSD-3-Clause
"""Joint values beyond a limit by rounding are on it, for everybody; more is told by how much.

Found: 144 of 1400 ends of MotionBenchMaker's Fetch were refused for less than three microradians,
with "6.2832, outside [-6.2832, 6.2832]".
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.small_scenes import at, small_map

import vprism_plan as vp
from vprism_plan.collision.packing import waypoints
from vprism_plan.errors import RobotError
from vprism_plan.robots.kinematics import outside_limits
from vprism_plan.trajopt import optimize

TOLERANCE = 1e-5
LIMITS = ((-6.28319, 6.28319), (0.01, 0.38615))  # of a turning and of a sliding joint
ARM = """<robot name="lift"><link name="base"/><link name="arm"/><link name="hand"><collision>
  <origin xyz="0.1 0 0"/><geometry><sphere radius="0.02"/></geometry></collision></link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
  <limit lower="{}" upper="{}" effort="1" velocity="1"/></joint>
  <joint name="slide" type="prismatic"><parent link="arm"/><child link="hand"/><axis xyz="0 0 1"/>
  <limit lower="{}" upper="{}" effort="1" velocity="1"/></joint></robot>"""


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    path = tmp_path_factory.mktemp("lift") / "lift.urdf"
    path.write_text(ARM.format(*LIMITS[0], *LIMITS[1]))
    return vp.Robot.from_urdf(path, base_pose=at(-1.0, -1.0, 0.2))


@pytest.fixture(scope="module")
def world():
    return vp.World(small_map(), vp.WorldConfig(occluded="free"))


@pytest.fixture(scope="module")
def checkers(world, robot):
    bounded = vp.CollisionChecker(world, robot, vp.CheckerConfig(max_risk=0.2))
    return vp.CollisionChecker(world, robot), bounded, vp.MeshChecker(world, robot)


ends = st.tuples(st.sampled_from([0, 1]), st.sampled_from([0, 1]))


@given(end=ends, share=st.floats(0.0, 1.9))
def test_all_agree_on_what_is_outside(checkers, robot, end, share):
    """The kernel, its reasons, the second opinion and the planner's own look."""
    joint, side = end
    q = np.array([0.3, 0.1])
    q[joint] = (robot.lower, robot.upper)[side][joint] + (-1, 1)[side] * share * TOLERANCE
    outside = bool(outside_limits(robot, q).any())
    if abs(share - 1.0) > 1e-6:
        assert outside == (share > 1.0)
    for checker in checkers:
        assert checker.is_valid(q) == (not outside)
        assert checker.check_motion(q, q) == (not outside)
        assert bool(checker.contacts(q)) == outside
        assert checker.explain(q).valid == (not outside)


def test_copies_in_single_precision_are_taken(checkers, robot):
    for limit in (robot.lower, robot.upper):
        copy = limit.astype(np.float32)
        assert (copy.astype(float) != limit).any()
        for checker in checkers:
            assert checker.is_valid(copy)
    assert len(waypoints(robot, [robot.lower.astype(np.float32), robot.upper])) == 2


@pytest.mark.parametrize("solve", [vp.plan, optimize])
def test_plans_begin_and_end_on_the_limit(checkers, robot, solve):
    over = robot.upper + 3e-6
    result = solve(checkers[0], over, robot.lower - 3e-6, time_limit=5.0)
    assert result.solved, result.message
    np.testing.assert_allclose(result.path[[0, -1]], [robot.upper, robot.lower], atol=1e-12)
    assert (result.path <= robot.upper).all()
    assert (result.path >= robot.lower).all()


def test_an_excess_is_told_in_digits_that_differ(checkers, robot):
    q = np.array([robot.upper[0] + 2e-5, 0.1])
    result = vp.plan(checkers[0], q, [0.0, 0.1], nudge=0.0)
    assert result.status == "invalid_start"
    assert (
        "joint turn is 6.28321, outside its limits [-6.28319, 6.28319] by 2e-05" in result.message
    )
    moved = vp.plan(checkers[0], [robot.upper[0] + 1e-3, 0.1], [0.0, 0.1])
    assert moved.solved
    assert "by 0.001); the path begins at a free configuration beside it" in moved.warnings[0]
    with pytest.raises(RobotError, match=r"slide goes .* outside its limits .* by 0.0001"):
        waypoints(robot, [[0.0, robot.upper[1] + 1e-4]])


def test_the_end_of_a_safe_motion_is_the_limit(checkers, robot):
    q, step = np.array([0.0, 0.1]), np.array([0.0, 1.0])
    for beyond in (0.0, 5e-6):
        q[1] = robot.upper[1] + beyond
        assert checkers[0].max_safe_motion(q, step).fraction <= 1.1e-5
