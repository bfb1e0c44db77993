# SPDX-License-Identifier: BSD-3-Clause
"""Spheres from other programs' files mean what these programs mean, and ours come back exactly."""

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from oracles.checker_oracle import BallWorld
from small_urdfs import TWO, chain, joint

from vprism_plan.collision import CollisionChecker
from vprism_plan.errors import RobotError
from vprism_plan.planning import time_parameterize
from vprism_plan.planning._inverse_kinematics import find_tip
from vprism_plan.robots import Robot, read_spheres, write_spheres
from vprism_plan.robots.pairs import pair_gaps

ONE = {"center": [0.1, 0.0, -0.2], "radius": 0.07}
OFF = {"center": [0, 0, 0], "radius": -10.0}
TABLE = {"a": [ONE], "b": [ONE, OFF], "c": [ONE]}
KEPT = [0.1, 0.0, -0.2, 0.07]
CUROBO = {"collision_spheres": TABLE, "collision_sphere_buffer": 0.004, "base_link": "a"}
XRDF = {
    "format": "xrdf",
    "format_version": 1.0,
    "collision": {"geometry": "mine", "buffer_distance": {"b": 0.01}},
    "self_collision": {"geometry": "mine"},
    "geometry": {"other": {"spheres": {"a": [OFF]}}, "mine": {"spheres": TABLE}},
}


def saved(tmp_path, content, name="robot.yml"):
    path = tmp_path / name
    path.write_text(yaml.safe_dump(content))
    return path


def curobo_by_reference(tmp_path):
    (tmp_path / "spheres").mkdir()
    saved(tmp_path / "spheres", {"robot": "r", "collision_spheres": TABLE})
    kinematics = CUROBO | {"collision_spheres": "spheres/robot.yml"}
    return saved(tmp_path, {"robot_cfg": {"kinematics": kinematics}})


@pytest.mark.parametrize(
    ("make", "padding"),
    [
        (curobo_by_reference, {"a": 0.004, "b": 0.004, "c": 0.004}),
        (lambda p: saved(p, {"robot_cfg": {"kinematics": CUROBO}}), dict.fromkeys("abc", 0.004)),
        (lambda p: saved(p, {"kinematics": CUROBO}), dict.fromkeys("abc", 0.004)),
        (lambda p: saved(p, {"robot": "r", "collision_spheres": TABLE}), {}),
        (lambda p: saved(p, XRDF, "robot.xrdf"), {"b": 0.01}),
    ],
    ids=["curobo v1", "curobo v2", "curobo kinematics", "curobo spheres", "xrdf"],
)
def test_foreign_files_are_understood(tmp_path, write, make, padding):
    path = make(tmp_path)
    table = read_spheres(path)
    assert table.padding == padding
    for link in "abc":
        np.testing.assert_array_equal(table.spheres[link], [KEPT])
    robot = Robot.from_urdf(write(TWO), spheres=path)
    assert robot.link_names == ("a", "b", "c")
    grown = np.array([padding.get(link, 0.0) for link in "abc"])
    np.testing.assert_allclose(robot.sphere_radii, 0.07 + grown, rtol=1e-15)
    np.testing.assert_array_equal(robot.arrays.link_padding, grown)
    np.testing.assert_array_equal(robot.link_spheres["b"], [KEPT])


def test_links_that_a_foreign_file_leaves_out_are_fitted(tmp_path, write):
    table = {"a": [ONE], "attached_object": [OFF]}
    path = saved(tmp_path, {"robot_cfg": {"kinematics": {"collision_spheres": table}}})
    robot = Robot.from_urdf(write(TWO), spheres=path)
    assert robot.sphere_sources == {"a": "file", "b": "urdf", "c": "urdf"}
    report = {link.link: link.enclosed for link in robot.report().links}
    assert report == {"a": False, "b": True, "c": True}


def test_xrdf_with_one_geometry_needs_no_name_and_a_buffer_may_be_one_number():
    content = {
        "format": "xrdf",
        "world_collision": {"buffer_distance": 0.02},
        "geometry": {"mine": {"spheres": TABLE}},
    }
    assert read_spheres(content).padding == dict.fromkeys("abc", 0.02)
    shrinking = content | {"world_collision": {"buffer_distance": -0.02}}
    assert read_spheres(shrinking).padding == {}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"format": "xrdf"}, "XRDF without a 'geometry' section"),
        (XRDF | {"collision": {"geometry": "none"}}, "'none', which has no spheres; geometries:"),
        ({"kinematics": {"collision_spheres": "gone.yml"}}, "takes its spheres from 'gone.yml'"),
        ({"kinematics": {"base_link": "a"}}, "holds no sphere table"),
        ({"kinematics": CUROBO | {"collision_sphere_buffer": "wide"}}, "buffer of link 'a'"),
        ({"kinematics": CUROBO | {"collision_sphere_buffer": {"b": np.nan}}}, "buffer of link 'b'"),
        ({"robot": "r", "collision_spheres": {"a": [{"center": [0, 0], "radius": 1}]}}, "expected"),
        ({"kinematics": {"collision_spheres": {"zz": [ONE]}}}, "unknown link 'zz'"),
        ({"robot": "r", "collision_spheres": {"a": [OFF], "b": [], "c": []}}, "no link a sphere"),
    ],
)
def test_foreign_files_that_cannot_be_used_say_why(write, content, message):
    with pytest.raises(RobotError, match=message):
        Robot.from_urdf(write(TWO), spheres=content)


numbers = st.floats(-1e3, 1e3, allow_nan=False, width=64)
rows = st.lists(st.tuples(numbers, numbers, numbers, st.floats(5e-324, 1e3)), max_size=3)


@given(st.dictionaries(st.sampled_from(["a", "link_1", "no", "null", "l-2", "1"]), rows))
def test_written_spheres_come_back_bit_by_bit(tmp_path_factory, table):
    path = tmp_path_factory.mktemp("spheres") / "s.yml"
    spheres = {link: np.array(r, dtype=float).reshape(-1, 4) for link, r in table.items()}
    write_spheres(path, spheres, "one\ntwo")
    back = read_spheres(path).spheres if spheres else {}
    assert list(back) == list(spheres)
    for link, expected in spheres.items():
        np.testing.assert_array_equal(back[link], expected)


def test_a_robot_read_from_what_it_wrote_is_the_same(robots, urdf_folder, tmp_path):
    robot = robots["panda"]
    robot.write_spheres(tmp_path / "s.yml")
    robot.write_srdf(tmp_path / "p.srdf")
    again = Robot.from_urdf(
        urdf_folder / "panda.urdf", srdf=tmp_path / "p.srdf", spheres=tmp_path / "s.yml"
    )
    assert again.joint_names == robot.joint_names
    assert again.locked == robot.locked
    assert again.disabled_pairs == robot.disabled_pairs
    np.testing.assert_array_equal(again.collision_pairs, robot.collision_pairs)
    np.testing.assert_array_equal(again.arrays.sphere_center, robot.arrays.sphere_center)
    np.testing.assert_array_equal(again.sphere_radii, robot.sphere_radii)
    np.testing.assert_array_equal(again.named_states["ready"], robot.named_states["ready"])
    assert again.groups["hand"] == robot.groups["hand"]


# ------------------------------------------------------- what such files say beside spheres
WHOLE = {
    "curobo": CUROBO
    | {
        "self_collision_buffer": {"a": 0.01, "c": 0.02, "b": -0.01},
        "self_collision_ignore": {"a": ["c", "zz"]},
        "cspace": {
            "joint_names": ["j2", "finger", "j1"],
            "retract_config": [0.5, 0.01, 0.25],
            "max_acceleration": [3.0, 1.0, 4.0],
        },
        "lock_joints": {"finger": 0.02},
        "ee_link": "b",
    },
    "xrdf": XRDF
    | {
        "self_collision": {
            "geometry": "mine",
            "buffer_distance": {"a": 0.01, "c": 0.02},
            "ignore": {"a": ["c", "zz"]},
        },
        "cspace": {"joint_names": ["j2", "j1"], "acceleration_limits": [3.0, 4.0]},
        "default_joint_positions": {"j1": 0.25, "finger": 0.02, "j2": 0.5},
        "tool_frames": ["b"],
    },
}
FINGER = joint(
    "finger", "c", "d", kind="prismatic", limit='<limit lower="0" upper="0.04" velocity="1"/>'
)
FOUR = chain(
    joint("j1", "a", "b"), joint("j2", "b", "c", xyz="0.3 0 0"), FINGER, links=("a", "b", "c", "d")
)


def whole(tmp_path, kind):
    """The robot file, which leaves link d to be fitted."""
    content = WHOLE[kind]
    return saved(tmp_path, {"kinematics": content} if kind == "curobo" else content, f"r.{kind}")


@pytest.mark.parametrize("kind", WHOLE)
def test_a_whole_robot_file_is_the_robot(tmp_path, write, kind):
    robot = Robot.from_urdf(write(FOUR), spheres=whole(tmp_path, kind))
    assert robot.joint_names == ("j2", "j1")
    assert robot.locked == {"finger": 0.02}
    np.testing.assert_array_equal(robot.neutral, [0.5, 0.25])
    np.testing.assert_array_equal(robot.acceleration_limits, [3.0, 4.0])
    assert robot.tool == "b"
    assert find_tip(robot, None).chain == (1,)
    assert robot.disabled_pairs[frozenset("ac")] == "Ignored"
    np.testing.assert_array_equal(robot.arrays.link_buffer, [0.01, 0.0, 0.02, 0.0])
    (odd,) = [text for text in robot.warnings if "lacks" in text]
    assert "('zz',)" in odd
    # What is asked for outranks the file.
    other = Robot.from_urdf(
        write(FOUR), spheres=whole(tmp_path, kind), joints=["j1"], locked={"finger": 0.0}
    )
    assert other.locked == {"j2": 0.5, "finger": 0.0}
    timed = time_parameterize(robot, np.array([[0.0, 0.0], [0.5, 0.0]]), velocity_limits=[1.0, 1.0])
    assert timed.duration == pytest.approx(0.5 / 1.0 + 1.0 / 3.0)


@pytest.mark.parametrize("kind", WHOLE)
def test_a_self_collision_buffer_is_kept_between_links(tmp_path, write, kind):
    """Links come less near to each other, to the world as near as before."""
    buffer = {"a": 0.01, "c": 0.02}
    if kind == "curobo":
        plain = WHOLE[kind] | {"self_collision_ignore": {}, "self_collision_buffer": None}
        content = plain | {"self_collision_buffer": buffer}
    else:
        plain = WHOLE[kind] | {"self_collision": {"ignore": {}}}
        content = plain | {"self_collision": {"ignore": {}, "buffer_distance": buffer}}
    files = [{"kinematics": c} if kind == "curobo" else c for c in (content, plain)]
    tables = [read_spheres(file) for file in files]
    assert [table.buffer for table in tables] == [buffer, {}]
    kept, bare = (Robot.from_urdf(write(FOUR), spheres=file) for file in files)
    pair = sorted(kept.link_names.index(name) for name in "ac")
    at = kept.collision_pairs.tolist().index(pair)
    q = np.random.default_rng(0).uniform(kept.lower, kept.upper, (50, kept.dof))
    gaps = [pair_gaps(r.arrays, q, r.collision_pairs)[:, at] for r in (kept, bare)]
    np.testing.assert_allclose(gaps[0], gaps[1] - 0.03, atol=1e-12)
    world = BallWorld(np.array([[0.4, 0.1, 0.3]]), np.array([0.05]), np.empty((0, 4))).baked()
    for row in q[:10]:
        one, two = (CollisionChecker(world, robot) for robot in (kept, bare))
        assert one.clearance(row) == two.clearance(row)
        apart = [float(c.self_clearance_batch(row[None])[0]) for c in (one, two)]
        assert apart[0] <= apart[1]


def test_self_padding_is_written_and_read_back(tmp_path, write):
    robot = Robot.from_urdf(write(FOUR), spheres=whole(tmp_path, "curobo"))
    robot.write_spheres(tmp_path / "own.yml")
    again = Robot.from_urdf(write(FOUR), spheres=tmp_path / "own.yml")
    np.testing.assert_array_equal(again.arrays.link_buffer, robot.arrays.link_buffer)
    np.testing.assert_array_equal(again.arrays.link_padding, robot.arrays.link_padding)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"cspace": {"joint_names": ["j1"], "retract_config": [0.1, 0.2]}}, "shorter|longer"),
        ({"cspace": ["j1"]}, "a usable file of spheres"),
        ({"lock_joints": {"finger": "open"}}, "'open'"),
        ({"lock_joints": {"finger": float("nan")}}, "finite"),
        ({"self_collision_ignore": ["a"]}, "a usable file of spheres"),
        ({"cspace": {"joint_names": ["j1"], "max_acceleration": "fast"}}, "'fast'"),
    ],
)
def test_a_broken_robot_file_is_one_clear_line(write, change, words):
    with pytest.raises(RobotError, match=words) as caught:
        read_spheres({"kinematics": CUROBO | change})
    assert "\n" not in str(caught.value)
