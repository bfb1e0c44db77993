# SPDX-License-Identifier: BSD-3-Clause
"""What the robot carries collides as the robot does: with the world, with itself, on the way."""

import numpy as np
import pytest
import trimesh

import vprism_plan as vp

RADIUS, OFFSET, CARRIED = 0.015, np.array([0.0, 0.03, -0.12]), 0.03


@pytest.fixture(scope="module")
def carrying(demo_world, ball_robot) -> vp.CollisionChecker:
    """A ball that flies with a larger ball hanging below it."""
    robot = ball_robot(RADIUS).attach("load", "ball", spheres=[(*OFFSET, CARRIED)])
    return vp.CollisionChecker(demo_world, robot)


def places(n: int = 1500) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.column_stack([rng.uniform(-0.4, 0.4, (n, 2)), rng.uniform(0.02, 0.6, n)])


def test_a_carried_ball_is_checked_like_a_robot_of_its_own(demo_world, ball_robot, carrying):
    """The carrier alone, and a robot that is the load alone: both must be free."""
    Q = places()
    alone = vp.CollisionChecker(demo_world, ball_robot(RADIUS))
    load = vp.CollisionChecker(demo_world, ball_robot(CARRIED))
    expected = np.minimum(alone.clearance_batch(Q), load.clearance_batch(Q + OFFSET))
    np.testing.assert_allclose(carrying.clearance_batch(Q), expected, atol=1e-9)
    valid = carrying.is_valid_batch(Q)
    np.testing.assert_array_equal(valid, alone.is_valid_batch(Q) & load.is_valid_batch(Q + OFFSET))
    only_load = alone.is_valid_batch(Q) & ~valid
    assert only_load.sum() > 20
    for q in Q[only_load][:20]:
        report = carrying.explain(q)
        assert {contact.link for contact in report.contacts} == {"load"}


def test_a_motion_that_only_the_load_cannot_make_is_refused(demo_world, ball_robot, carrying):
    alone = vp.CollisionChecker(demo_world, ball_robot(RADIUS))
    refused = 0
    for qa, qb in zip(places(400)[::2], places(400)[1::2], strict=True):
        steps = qa + np.linspace(0, 1, 200)[:, None] * (qb - qa)
        if carrying.check_motion(qa, qb):
            assert carrying.is_valid_batch(steps).all()
        elif alone.check_motion(qa, qb):
            refused += 1
    assert refused > 5


def test_a_box_in_the_pandas_hand_keeps_away_from_table_and_arm(demo_world, repository):
    robot = vp.Robot.from_urdf(
        repository / "urdf" / "panda.urdf",
        base_pose=np.block(
            [[np.eye(3), np.array([[-0.6], [0.3], [0.0]])], [np.zeros((1, 3)), 1.0]]
        ),
    )
    box = trimesh.creation.box((0.04, 0.04, 0.25))
    pose = np.eye(4)
    pose[2, 3] = 0.1
    carrying = robot.attach(
        "box", "panda_hand_tcp", mesh=box, pose=pose, touch_links=["hand", "panda_link7"]
    )
    checker = vp.CollisionChecker(demo_world, carrying)
    bare = vp.CollisionChecker(demo_world, robot)
    rng = np.random.default_rng(0)
    Q = rng.uniform(robot.lower, robot.upper, (4000, 7))
    valid = checker.is_valid_batch(Q)
    assert not (valid & ~bare.is_valid_batch(Q)).any()
    corners = trimesh.bounds.corners(box.bounds)
    named: set[str] = set()
    for q in Q[valid][:150]:
        T = carrying.link_poses(q)["box"]
        assert (corners @ T[:3, :3].T + T[:3, 3])[:, 2].min() > 0.0
    for q in Q[~valid & bare.is_valid_batch(Q)][:150]:
        contacts = checker.explain(q).contacts
        assert contacts
        for contact in contacts:
            assert "box" in (contact.link, contact.body)
            named.add(contact.body if contact.link == "box" else contact.link)
    assert "support surface" in named
    assert named & set(robot.link_names)
