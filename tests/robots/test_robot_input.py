# SPDX-License-Identifier: BSD-3-Clause
"""What a user gives: every unusable description is refused by name, nothing is guessed."""

import numpy as np
import pytest
import torch
from small_urdfs import TWO, chain, joint

from vprism_plan.errors import RobotError, VPrismError
from vprism_plan.robots import Robot


def test_missing_files_are_named(write, tmp_path):
    path = write(TWO)
    with pytest.raises(RobotError, match=r"no URDF file at '.*absent.urdf'"):
        Robot.from_urdf(tmp_path / "absent.urdf")
    with pytest.raises(RobotError, match=r"no SRDF file at '.*absent.srdf'"):
        Robot.from_urdf(path, srdf=tmp_path / "absent.srdf")
    with pytest.raises(RobotError, match=r"no sphere file at '.*absent.yml'"):
        Robot.from_urdf(path, spheres=tmp_path / "absent.yml")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"joints": ["j1", "j9"]},
            r"unknown or non-actuated joints \['j9'\]; valid: \['j1', 'j2'\]",
        ),
        ({"joints": ["j1", "j1"]}, "names a joint twice"),
        ({"joints": "j1"}, "give a sequence"),
        ({"joints": []}, "needs at least one"),
        ({"locked": {"j1": 0.0}}, r"locked names \['j1'\]; joints that can be locked here: \[\]"),
        (
            {"joints": ["j1"], "locked": {"j2": 2.0}},
            r"'j2' is locked at 2.0; its limits are \[-1, 1\]",
        ),
        ({"joints": ["j1"], "locked": {"j2": np.nan}}, "'j2' is locked at nan"),
        ({"base_pose": np.eye(3)}, r"base_pose has shape \(3, 3\)"),
        ({"base_pose": "here"}, r"base_pose is no \(4, 4\) array"),
        ({"base_pose": np.full((4, 4), np.nan)}, "NaN"),
        ({"base_pose": np.diag([1.0, 1.0, -1.0, 1.0])}, "determinant -1"),
        ({"base_pose": 2 * np.eye(4)}, "not rigid"),
        ({"base_pose": np.eye(4) + np.eye(4)[[3, 0, 1, 2]]}, "not rigid"),
    ],
)
def test_bad_options_are_refused(write, options, message):
    with pytest.raises(RobotError, match=message):
        Robot.from_urdf(write(TWO), **options)


@pytest.mark.parametrize(
    ("spheres", "message"),
    [
        ({"zz": []}, r"unknown link 'zz'; links: \['a', 'b', 'c'\]"),
        ({"a": [{"center": [0, 0, 0], "radius": 1}]}, r"no spheres for the links \['b', 'c'\]"),
        ({"a": [{"center": [0, 0], "radius": 1}]}, "expected {center"),
        ({"a": [{"center": [0, 0, 0]}]}, "expected {center"),
        ({"a": [{"center": [0, 0, 0], "radius": -10}]}, "radius positive"),
        ({"a": [{"center": [0, np.nan, 0], "radius": 1}]}, "must be finite"),
        ({"a": "big"}, "expected a list"),
        ({"a": [0.1]}, "expected {center"),
    ],
)
def test_bad_spheres_are_refused(write, spheres, message):
    with pytest.raises(RobotError, match=message):
        Robot.from_urdf(write(TWO), spheres=spheres)


@pytest.mark.parametrize("text", ["[1, 2]", "a: [", "just words"])
def test_bad_sphere_files_are_refused(write, text):
    path = write(text, "spheres.yml")
    with pytest.raises(RobotError, match=r"spheres.yml' (is not valid YAML|holds no sphere table)"):
        Robot.from_urdf(write(TWO), spheres=path)


def test_sphere_files_may_be_nested_as_other_planners_write_them(write):
    inner = "{a: [{center: [0, 0, 0], radius: 0.2}], b: [], c: null}"
    flat = write(inner, "flat.yml")
    nested = write(f"robot_cfg: {{kinematics: {{collision_spheres: {inner}}}}}", "nested.yml")
    for path in (flat, nested):
        robot = Robot.from_urdf(write(TWO), spheres=path)
        assert robot.link_names == ("a",)  # b and c are left out on purpose
        np.testing.assert_array_equal(robot.sphere_radii, [0.2])


def test_a_robot_without_any_shape_is_refused(write):
    bare = '<robot name="x"><link name="a"/><link name="b"/>' + joint("j1", "a", "b") + "</robot>"
    with pytest.raises(RobotError, match=r"no link has collision geometry; .*pass spheres="):
        Robot.from_urdf(write(bare))


def test_joints_come_in_the_order_asked_for(write):
    robot = Robot.from_urdf(write(TWO), joints=("j2", "j1"))
    forward = Robot.from_urdf(write(TWO))
    q = np.array([0.3, -0.6])
    np.testing.assert_allclose(robot.link_poses(q[::-1])["c"], forward.link_poses(q)["c"])


SRDF = """<robot name="chain">
  <virtual_joint name="world" type="fixed" parent_frame="world" child_link="a"/>
  <group name="arm"><joint name="world"/><joint name="j1"/></group>
  <group name="all"><group name="arm"/><link name="c"/></group>
  <group_state name="bent" group="all">
    <joint name="j1" value="0.5"/><joint name="j2" value="0.25"/>
  </group_state>
  <group_state name="half" group="arm"><joint name="j2" value="0.75"/></group_state>
  <disable_collisions link1="a" link2="c" reason="Never"/>
</robot>"""


def test_srdf_chooses_joints_locks_the_rest_and_disables_pairs(write):
    write(SRDF, "arm.srdf")
    robot = Robot.from_urdf(write(TWO))
    assert robot.joint_names == ("j1",)
    assert robot.locked == {"j2": 0.25}
    assert robot.named_states.keys() == {"bent"}
    assert len(robot.collision_pairs) == 0
    both = Robot.from_urdf(write(TWO), joints=["j2", "j1"])
    np.testing.assert_array_equal(both.named_states["bent"], [0.25, 0.5])
    np.testing.assert_array_equal(both.neutral, [0.0, 0.0])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<robot", "<robot", ""),
        ('<group name="arm"/>', '<group name="all"/>', r"group 'all' .* is in itself"),
        ('value="0.5"', 'value="1 2"', "gives joint 'j1' the value '1 2'"),
        ('value="0.5"', 'value="inf"', "gives joint 'j1' the value 'inf'"),
        ('value="0.25"', 'value="9"', "'j2' is locked at 9.0"),
        ("</robot>", "", "not well-formed XML"),
        ("<robot name", "<srdf name", "not well-formed XML"),
        ('<link name="c"/>', '<chain base_link="c" tip_link="a"/>', "'c' is not above 'a'"),
    ],
)
def test_malformed_srdfs_are_refused(write, old, new, message):
    path = write(TWO)
    srdf = write(SRDF.replace(old, new), "other.srdf")
    if not message:
        Robot.from_urdf(path, srdf=srdf)
        return
    with pytest.raises(RobotError, match=message):
        Robot.from_urdf(path, srdf=srdf)


def test_without_an_srdf_only_what_always_touches_is_left_out(write, caplog):
    links = ("a", "b", "c", "d")
    text = chain(
        joint("j1", "a", "b"),
        joint("j2", "b", "c", xyz="0 0 0.01"),
        joint("j3", "c", "d", xyz="0.5 0 0"),
        links=links,
    )
    near_c = text.replace('xyz="0 0 0.3"', 'xyz="0 0 0.02"')
    robot = Robot.from_urdf(write(near_c))
    pairs = {(robot.link_names[i], robot.link_names[j]) for i, j in robot.collision_pairs}
    assert pairs == set()
    reasons = {tuple(sorted(pair)): why for pair, why in robot.disabled_pairs.items()}
    assert reasons == {
        **dict.fromkeys([("a", "b"), ("b", "c"), ("c", "d")], "Adjacent"),
        ("a", "c"): "Always",
        **dict.fromkeys([("a", "d"), ("b", "d")], "Never"),
    }
    assert "their spheres always overlap: [('a', 'c')]" in caplog.text


@pytest.mark.parametrize(
    ("q", "message"),
    [
        ([0.0], r"shape \(1,\); expected \(2,\) for the joints \['j1', 'j2'\]"),
        ([[0.0, 0.0]], r"shape \(1, 2\)"),
        (0.0, r"shape \(\)"),
        ([0.0, np.nan], r"not finite: {'j2': nan}"),
        ([np.inf, 0.0], r"not finite: {'j1': inf}"),
        (["a", "b"], "cannot be read from list"),
        (None, r"cannot be read from NoneType|shape \(\)"),
    ],
)
def test_bad_configurations_are_refused(arm, q, message):
    with pytest.raises(RobotError, match=message):
        arm.check_configuration(q)
    with pytest.raises(VPrismError):
        arm.link_poses(q)


def test_good_configurations_become_fresh_float64(arm):
    given = np.array([1, 0], dtype=np.int32)
    for q in (given, given.tolist(), torch.tensor([1.0, 0.0]), tuple(given)):
        checked = arm.check_configuration(q)
        assert checked.dtype == np.float64
        np.testing.assert_array_equal(checked, [1.0, 0.0])
    own = np.array([0.5, 9.0])  # outside the limits: a verdict, not an error
    checked = arm.check_configuration(own)
    checked[0] = 7.0
    assert own[0] == 0.5


@pytest.mark.parametrize(
    ("q", "message"),
    [
        (torch.zeros(3), r"q has shape \(3,\)"),
        (torch.zeros(()), r"q has shape \(\)"),
        (torch.tensor([0.0, float("nan")]), "NaN"),
        (torch.zeros(2, dtype=torch.float16), "valid: torch.float32, torch.float64"),
    ],
)
def test_bad_tensors_are_refused(arm, q, message):
    with pytest.raises(RobotError, match=message):
        arm.sphere_centers(q)


def test_numbers_give_an_array_of_centres_and_tensors_a_tensor(arm):
    q = [0.2, -0.4]
    centers = arm.sphere_centers(q)
    assert isinstance(centers, np.ndarray)
    in_torch = arm.sphere_centers(torch.tensor([q], dtype=torch.float64))
    np.testing.assert_array_equal(in_torch[0].numpy(), centers)
    np.testing.assert_array_equal(arm.sphere_centers(np.array([q, q]))[1], centers)
    for bad, message in (([1.0], "shape"), ([1.0, np.nan], "NaN"), ("ab", "real numbers")):
        with pytest.raises(RobotError, match=message):
            arm.sphere_centers(bad)


def test_velocity_limits_of_zero_mean_none_is_stated(gripper):
    np.testing.assert_array_equal(gripper.velocity_limits, [np.inf, 0.1])
    np.testing.assert_array_equal(gripper.neutral, [0.0, 0.01])


def test_random_configurations_repeat_and_stay_within_limits(robots):
    for robot in robots.values():
        one, two = (robot.random_configuration(np.random.default_rng(3)) for _ in range(2))
        np.testing.assert_array_equal(one, two)
        assert ((one >= robot.lower) & (one <= robot.upper)).all()


def test_moving_the_base_leaves_the_original_alone(arm):
    T = np.eye(4)
    T[:3, 3] = [1, 2, 3]
    moved = arm.with_base_pose(T)
    T[:3, 3] = 0
    np.testing.assert_array_equal(moved.arrays.base_t, [1, 2, 3])
    np.testing.assert_array_equal(moved.base_pose[:3, 3], [1, 2, 3])
    np.testing.assert_array_equal(arm.base_pose, np.eye(4))
    with pytest.raises(RobotError, match="not rigid"):
        arm.with_base_pose(np.zeros((4, 4)))


def test_reading_a_robot_imports_no_torch(repository):
    import subprocess
    import sys

    code = (
        "import sys; from vprism_plan.robots import Robot; r = Robot.from_urdf('urdf/panda.urdf');"
        "r.link_poses(r.neutral); sys.exit('torch' in sys.modules or 'numba' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=repository, check=False).returncode == 0
