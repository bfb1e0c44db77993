# SPDX-License-Identifier: BSD-3-Clause
"""Descriptions that MoveIt and others take are taken, and mean the same here."""

import itertools
import pickle
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from oracles.checker_oracle import BallWorld, world_clearance
from small_urdfs import LIMIT, LINK, TWO, chain, joint

from vprism_plan.collision import CollisionChecker
from vprism_plan.errors import PlanningError, RobotError
from vprism_plan.planning import plan
from vprism_plan.planning._inverse_kinematics import find_tip
from vprism_plan.robots import Robot
from vprism_plan.robots.report import enclosed

# Two arms on a lift, each with a gripper, as a package of MoveIt has it: a virtual joint, groups
# that name later ones, states of both arms, names of another version of the robot.
ARM = ("{0}_base", "{0}_upper", "{0}_fore", "{0}_hand")


def arm(side, y):
    links = [name.format(side) for name in ARM]
    joints = [joint(f"{side}_mount", "lift", links[0], kind="fixed", xyz=f"0 {y} 0.2")]
    for i, axis in enumerate(("0 0 1", "0 1 0")):
        joints.append(joint(f"{side}_{i}", links[i], links[i + 1], axis=axis, xyz="0.3 0 0"))
    grip = '<limit lower="0" upper="0.04" effort="1" velocity="1"/>'
    joints.append(
        joint(f"{side}_grip", links[2], links[3], kind="prismatic", xyz="0.3 0 0", limit=grip)
    )
    return [LINK.format(name) for name in links] + joints


TWIN = "\n".join(
    [
        '<robot name="twin">',
        '<link name="floor"/><link name="base_link"><visual><geometry><sphere radius="1"/>'
        "</geometry></visual></link>",
        LINK.format("lift"),
        joint("drive", "floor", "base_link", kind="planar"),
        joint("rise", "base_link", "lift", kind="prismatic", limit=LIMIT.replace("-1", "0")),
        *arm("left", 0.4),
        *arm("right", -0.4),
        "</robot>",
    ]
)
TWIN_SRDF = """<robot name="twin">
  <group name="both_arms"><group name="left_arm"/><group name="right_arm"/></group>
  <group name="left_arm"><chain base_link="left_base" tip_link="left_fore"/></group>
  <group name="right_arm"><joint name="odometry"/><joint name="right_0"/><joint name="right_1"/>
    <joint name="right_wrist"/><link name="right_camera"/></group>
  <group_state name="home" group="both_arms">
    <joint name="odometry" value="0 0 0"/><joint name="left_0" value="0.5"/>
    <joint name="left_1" value="-0.5"/><joint name="right_wrist" value="1"/></group_state>
  <end_effector name="gripper" parent_link="right_fore" group="gripper"/>
  <virtual_joint name="odometry" type="planar" parent_frame="map" child_link="floor"/>
  <passive_joint name="right_castor"/>
  <disable_collisions link1="left_base" link2="right_base" reason="Never"/>
  <disable_collisions link1="left_base" link2="right_camera" reason="Never"/>
</robot>"""


@pytest.fixture
def twin(write):
    write(TWIN_SRDF, "arm.srdf")
    return write(TWIN)


def test_a_moveit_configuration_is_read_as_moveit_reads_it(twin):
    robot = Robot.from_urdf(twin, group="right_arm")
    assert robot.joint_names == ("right_0", "right_1")
    assert robot.locked == {
        "rise": 0.0, "left_0": 0.5, "left_1": -0.5, "left_grip": 0.0, "right_grip": 0.0,
    }  # fmt: skip
    assert robot.groups["both_arms"] == ("left_upper", "left_fore", "right_upper", "right_fore")
    assert robot.disabled_pairs[frozenset(("left_base", "right_base"))] == "Never"
    names, drive, bare, *_ = robot.warnings
    assert names.endswith("left out: joint 'right_wrist', link 'right_camera'")
    assert "['drive']" in drive
    assert bare == "links without spheres are not checked: base_link (it has only a <visual>)"
    both = Robot.from_urdf(twin, group="both_arms")
    assert both.joint_names == ("left_0", "left_1", "right_0", "right_1")
    assert both.named_states == {}  # "home" leaves the right arm open


@pytest.mark.parametrize(("first", "names"), [("a", "bc"), ("c", "ab")])
def test_a_disabled_pair_with_an_unknown_name_stays_tested(write, first, names):
    pair = f'<disable_collisions link1="{first}" link2="zz" reason="Never"/>'
    srdf = write(f'<robot name="chain">{pair}</robot>', "other.srdf")
    robot = Robot.from_urdf(write(TWO), srdf=srdf)
    assert len(robot.collision_pairs) == 1
    assert any("left out: link 'zz'" in text for text in robot.warnings)


def test_joints_to_the_world_are_the_base(write):
    floating = chain(joint("world", "a", "b", kind="floating"), joint("j", "b", "c"))
    still = floating.replace("floating", "fixed")
    base = np.eye(4)
    base[:3, 3] = 1.0, 2.0, 3.0
    robots = [Robot.from_urdf(write(text), base_pose=base) for text in (floating, still)]
    assert robots[0].joint_names == ("j",)
    np.testing.assert_array_equal(*(robot.sphere_centers([0.4]) for robot in robots))
    assert any("['world']" in text for text in robots[0].warnings)
    assert not robots[1].warnings


@pytest.mark.parametrize("at", [0.0, 0.25])
def test_joints_without_room_are_locked(write, at):
    limit = f'<limit lower="{at}" upper="{at}" effort="1" velocity="1"/>'
    urdf = write(chain(joint("j1", "a", "b", limit=limit), joint("j2", "b", "c")))
    robot = Robot.from_urdf(urdf)
    assert robot.joint_names == ("j2",)
    assert robot.locked == {"j1": at}
    with pytest.raises(RobotError, match=r"\['j1'\]; valid: \['j2'\]"):
        Robot.from_urdf(urdf, joints=["j1"])


def test_a_capsule_is_a_cylinder_between_balls(write):
    capsule = '<capsule radius="0.04" length="0.2"/>'
    origin = '<collision><origin xyz="0.1 0 0" rpy="0 1.5707963267948966 0"/>'
    text = TWO.replace('<sphere radius="0.05"/>', capsule, 1).replace("<collision>", origin, 1)
    robot = Robot.from_urdf(write(text))
    solids = robot.geometry["a"]
    assert [solid.kind for solid in solids] == ["cylinder", "sphere", "sphere"]
    ends = np.array([[x, y, 0.0] for x in (-0.0, 0.2) for y in (-1e-9, 1e-9)])
    points = np.array([[0.24, 0, 0], [-0.04, 0, 0], [0.1, 0.04, 0]])
    gaps = np.min([solid.signed_distance(points) for solid in solids], axis=0)
    np.testing.assert_allclose(gaps, 0.0, atol=1e-12)
    assert (np.min([solid.signed_distance(ends) for solid in solids], axis=0) < -0.039).all()
    whole = trimesh.creation.capsule(height=0.2, radius=0.04)
    whole.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))
    whole.apply_translation([0.1, 0, 0])
    hair = [0.0, 0.0, 0.0, 1e-9]  # its corners are on the balls, up to rounding
    assert enclosed(np.array(whole.triangles), robot.link_spheres["a"] + hair)


def test_a_follower_without_limits_has_those_of_its_driver(write):
    follower = joint("j2", "b", "c", limit="", extra='<mimic joint="j1" multiplier="-3"/>')
    robot = Robot.from_urdf(write(chain(joint("j1", "a", "b"), follower)))
    assert robot.joint_names == ("j1",)
    np.testing.assert_array_equal([robot.lower, robot.upper], [[-1.0], [1.0]])
    poses = robot.link_poses([0.2])
    turned = np.arctan2(poses["c"][1, 0], poses["c"][0, 0])
    assert turned == pytest.approx(0.2 - 0.6)


# ------------------------------------------------------------------------ values by name
JOINT_STATE = SimpleNamespace(name=["gripper", "j2", "j1"], position=[0.7, 0.2, 0.1])


@pytest.mark.parametrize("values", [{"j1": 0.1, "j2": 0.2, "wheel": 3.0}, JOINT_STATE])
def test_values_by_name_do_wherever_a_configuration_does(write, values):
    robot = Robot.from_urdf(write(TWO))
    np.testing.assert_array_equal(robot.values(values), [0.1, 0.2])
    np.testing.assert_array_equal(robot.sphere_centers(values), robot.sphere_centers([0.1, 0.2]))
    checker = CollisionChecker(far_away(), robot)
    assert checker.explain(values).valid
    assert checker.check_motion(values, [0.3, 0.4])
    planned = plan(checker, values, {"j1": 0.3, "j2": 0.4})
    np.testing.assert_array_equal(planned.path[[0, -1]], [[0.1, 0.2], [0.3, 0.4]])


def test_a_missing_joint_is_named(write):
    robot = Robot.from_urdf(write(TWO))
    with pytest.raises(RobotError, match=r"no value for the joints \['j2'\]; it names \['J2', 'j1"):
        robot.values({"j1": 0.0, "J2": 0.0})
    with pytest.raises(RobotError, match=r"not finite: {'j2': nan}"):
        robot.values({"j1": 0.0, "j2": np.nan})


# -------------------------------------------------------------------------- locked joints
def far_away():
    return BallWorld(np.array([[50.0, 0.0, 0.0]]), np.array([0.01]), np.empty((0, 4))).baked()


def same(one, other):
    assert one.joint_names == other.joint_names
    assert one.locked == other.locked
    assert one.link_names == other.link_names
    assert one.disabled_pairs == other.disabled_pairs
    for name, value in vars(one.arrays).items():
        np.testing.assert_array_equal(value, getattr(other.arrays, name), err_msg=name)


def test_locking_is_as_if_it_had_been_read_so(twin):
    both = Robot.from_urdf(twin, group="both_arms")
    one = both.with_locked({"left_0": 0.3, "left_1": 0.2, "rise": 0.5})
    locked = {"left_0": 0.3, "left_1": 0.2, "rise": 0.5}
    same(one, Robot.from_urdf(twin, joints=["right_0", "right_1"], locked=locked))
    same(both.with_locked({"rise": 0.0}), both)
    same(pickle.loads(pickle.dumps(both)).with_locked(locked), one)


def test_what_was_changed_before_stays_changed(twin):
    base = np.eye(4)
    base[0, 3] = 2.0

    def changed(robot):
        ball = [[0.0, 0.0, 0.0, 0.02]]
        robot = robot.with_padding(0.01, {"lift": 1.5}).attach("mug", "left_hand", spheres=ball)
        robot = robot.attach("pen", "right_hand", spheres=ball, touch_links=["right_fore"])
        return robot.with_base_pose(base).detach("mug")

    both = Robot.from_urdf(twin, group="both_arms")
    values = {"left_0": -0.3, "left_1": 0.1}
    same(changed(both).with_locked(values), changed(both.with_locked(values)))


def test_values_that_cannot_be_locked_are_refused(twin):
    both = Robot.from_urdf(twin, group="both_arms")
    with pytest.raises(RobotError, match=r"locked names \['elbow'\]"):
        both.with_locked({"elbow": 0.0})
    with pytest.raises(RobotError, match=r"'rise' is locked at 1.1; .* leaves by 0.1"):
        both.with_locked({"rise": 1.1})
    with pytest.raises(RobotError, match="leave one to move"):
        both.with_locked(dict.fromkeys(both.joint_names, 0.0))
    assert both.with_locked({"rise": 1.0 + 1e-6}).locked["rise"] == 1.0


def test_locked_links_are_checked_against_the_world_by_choice(twin):
    """Against the plain distance of every sphere below a joint, on random balls and edges."""
    rng = np.random.default_rng(4)
    both = Robot.from_urdf(twin, group="both_arms")
    lax = both.with_locked({"left_0": 0.3, "left_1": 0.2})
    strict = lax.with_locked({}, check_locked=True)
    carrying = strict.attach("mug", "left_hand", spheres=[[0.0, 0.0, 0.1, 0.06]])
    assert [n for n, f in zip(strict.link_names, strict.fixed_links, strict=True) if f] == []
    assert "left_fore" in np.array(lax.link_names)[lax.fixed_links]
    seen = {True: 0, False: 0}
    for _ in range(40):
        ball = rng.uniform([-0.2, -0.9, 0.1], [1.0, 0.9, 0.9])
        world = BallWorld(ball[None], np.array([0.05]), np.empty((0, 4)))
        for robot in (lax, strict, carrying):
            checker = CollisionChecker(world.baked(spacing=0.02), robot)
            q = rng.uniform(robot.lower, robot.upper, (6, robot.dof))
            exact = world_clearance(robot.arrays, world, q) > 0.0
            for row, free in zip(q, exact, strict=True):
                if checker.is_valid(row):
                    assert free
                    seen[robot is lax] += 1
            for a, b in itertools.pairwise(q):
                if checker.check_motion(a, b):
                    between = a + np.linspace(0.0, 1.0, 60)[:, None] * (b - a)
                    assert (world_clearance(robot.arrays, world, between) > -5e-4).all()
    assert min(seen.values()) > 50


# ------------------------------------------------------------------------- the end effector
@pytest.mark.parametrize(
    ("last", "expected"),
    [("flange", 0.05), ("end_effector_link", 0.05), ("gripper_base", 0.05), ("link_6", 0.05)],
)
def test_any_end_of_a_chain_reaches_poses(write, last, expected):
    tail = f'<link name="{last}"/>' + joint("fix", "c", last, kind="fixed", xyz="0.05 0 0")
    robot = Robot.from_urdf(write(TWO.replace("</robot>", tail + "</robot>")))
    held = robot.attach("mug", last, spheres=[[0.0, 0.0, 0.0, 0.02]])
    for one in (robot, held):
        tip = find_tip(one, None)
        assert tip.chain == (2, 1)
        assert tip.offset[0, 3] == expected


def test_the_hand_of_the_arm_that_moves_is_meant(twin):
    for side in ("left", "right"):
        robot = Robot.from_urdf(twin, group=f"{side}_arm")
        tip = find_tip(robot, None)
        assert (tip.frame, tip.offset[0, 3]) == (robot.links[f"{side}_hand"].frame, 0.3)


def test_two_ends_have_to_be_told_apart(write):
    write(TWIN_SRDF, "arm.srdf")
    both = Robot.from_urdf(write(TWIN.replace("_hand", "_part")), group="both_arms")
    with pytest.raises(PlanningError, match="no link looks like the end effector"):
        find_tip(both, None)
    assert find_tip(both, "left_part").chain == (3, 1)


def test_an_ordinary_robot_has_nothing_odd(robots):
    assert all(robot.warnings == () for robot in robots.values())
