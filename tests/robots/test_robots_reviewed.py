# SPDX-License-Identifier: BSD-3-Clause
"""What went wrong once, in silence: each test is named after what broke."""

import numpy as np
import pytest
import yaml
from small_urdfs import LIMIT, LINK, TWO, chain, joint

from vprism_plan.cli import main
from vprism_plan.errors import RobotError
from vprism_plan.robots import Robot, read_spheres
from vprism_plan.robots.geometry import find_mesh
from vprism_plan.robots.sphere_files import _yaml
from vprism_plan.robots.sphere_fit import SphereFit

BIG = [{"center": [0, 0, 0], "radius": 0.06}]
SMALL = [{"center": [0, 0, 0], "radius": 0.03}]
BARE = '<link name="{0}"/>'
NO_GEOMETRY = TWO.replace(
    "".join(LINK.format(n) for n in "abc"), "".join(BARE.format(n) for n in "abc")
)
MESHED = TWO.replace('<sphere radius="0.05"/>', '<mesh filename="gone.stl"/>')


@pytest.mark.parametrize("change", [{"padding": 0.05}, {"scale": 2.0}])
def test_a_padded_robot_is_compared_as_it_was_read(write, change):
    robot = Robot.from_urdf(write(TWO), spheres=dict.fromkeys("abc", SMALL))
    assert (
        robot.with_padding(**change).report().to_dict()["links"]
        == (robot.report().to_dict()["links"])
    )
    assert robot.with_padding(**change).report().enclosed is False
    meshed = Robot.from_urdf(write(MESHED), spheres=dict.fromkeys("abc", BIG))
    assert meshed.with_padding(**change).report().enclosed is None


def test_a_file_with_a_buffer_does_not_hide_what_is_bare(write):
    table = {"kinematics": {"collision_spheres": dict.fromkeys("abc", SMALL)}}
    table["kinematics"]["collision_sphere_buffer"] = 0.1
    assert Robot.from_urdf(write(TWO), spheres=table).report().enclosed is False


def test_nothing_to_compare_with_is_not_called_enclosed(write, tmp_path, capsys):
    path = write(NO_GEOMETRY)
    robot = Robot.from_urdf(path, spheres=dict.fromkeys("abc", BIG))
    assert robot.report().enclosed is None
    robot.write_spheres(tmp_path / "arm_spheres.yml")
    assert main(["robot", str(path)]) == 0
    out = capsys.readouterr().out
    assert "unknown whether they enclose" in out
    assert "every link is proved" not in out


def test_a_link_of_two_equal_spheres_can_be_reported(write):
    twice = LINK.replace("</link>", "") + LINK.split(">", 1)[1]
    text = chain(joint("j1", "a", "b"), links=("a",)).replace("</robot>", "")
    report = Robot.from_urdf(write(text + twice.format("b") + "</robot>")).report()
    assert {link.link: link.enclosed for link in report.links} == {"a": True, "b": True}


def test_a_link_without_spheres_is_named_as_unchecked(write, tmp_path, capsys, caplog):
    path = write(TWO)
    table = {"a": BIG, "b": [], "c": BIG}
    robot = Robot.from_urdf(path, spheres=table)
    report = robot.report()
    assert report.enclosed is False
    (row,) = (link for link in report.links if link.link == "b")
    assert (row.enclosed, row.coverage, row.unchecked) == (False, 0.0, True)
    assert "NOT CHECKED" in report.text()
    assert not caplog.records  # an empty list in our own file is on purpose
    robot.write_spheres(tmp_path / "arm_spheres.yml")
    assert main(["robot", str(path)]) == 0
    assert "no spheres at all: b" in capsys.readouterr().out
    foreign = Robot.from_urdf(path, spheres={"kinematics": {"collision_spheres": table}})
    for one in (robot, foreign):
        assert "links without spheres are not checked: b" in one.warnings


def pair(a, b):
    return frozenset((a, b))


RIGID_TIP = joint("fixed", "c", "d", kind="fixed", limit="")
FOUR = chain(joint("j1", "a", "b"), joint("j2", "b", "c"), RIGID_TIP, links=("a", "b", "c", "d"))


def test_with_an_srdf_every_pair_is_tested_or_has_a_reason(write, urdf_folder):
    srdf = write('<robot name="chain"><disable_collisions link1="a" link2="b"/></robot>', "x.srdf")
    robot = Robot.from_urdf(write(FOUR), srdf=srdf)
    assert robot.disabled_pairs[pair("a", "b")] == ""  # the SRDF's own word stands
    assert robot.disabled_pairs[pair("b", "c")] == "Adjacent"
    assert robot.disabled_pairs[pair("c", "d")] == "Adjacent"
    locked = Robot.from_urdf(write(FOUR), srdf=srdf, joints=["j1"])
    assert locked.disabled_pairs[pair("b", "d")] == "Rigid"
    for one in (robot, locked, Robot.from_urdf(urdf_folder / "panda.urdf")):
        names = one.link_names
        tested = {pair(names[a], names[b]) for a, b in one.collision_pairs}
        every = {pair(a, b) for a in names for b in names if a != b}
        assert tested | set(one.disabled_pairs) >= every
        assert not tested & set(one.disabled_pairs)


def test_a_written_srdf_holds_for_other_values_of_locked_joints(write, tmp_path, caplog):
    """Locked at 0, the tip never comes near the base; locked at pi, it is on it."""
    wide = '<limit lower="-4" upper="4" effort="1" velocity="1"/>'
    path = write(
        chain(
            joint("j1", "a", "b"),
            joint("j2", "b", "c", axis="0 1 0", limit=wide),
            joint("j3", "c", "d", limit=LIMIT),
            links=("a", "b", "c", "d"),
        )
    )
    first = Robot.from_urdf(path, joints=["j1", "j3"])
    assert first.disabled_pairs[pair("a", "d")] == "Never"
    assert first.disabled_pairs[pair("a", "c")] == "Never"
    assert first.disabled_pairs[pair("b", "c")] == "Adjacent"
    first.write_srdf(tmp_path / "out.srdf")
    assert "locked joints only" in caplog.text
    again = Robot.from_urdf(
        path, srdf=tmp_path / "out.srdf", joints=["j1", "j3"], locked={"j2": 3.1}
    )
    tested = {pair(again.link_names[a], again.link_names[b]) for a, b in again.collision_pairs}
    assert {pair("a", "c"), pair("a", "d")} <= tested


def test_rigid_pairs_are_not_written(write, tmp_path):
    path = write(FOUR)
    Robot.from_urdf(path, joints=["j1"]).write_srdf(tmp_path / "out.srdf")
    assert "Rigid" not in (tmp_path / "out.srdf").read_text()
    again = Robot.from_urdf(path, srdf=tmp_path / "out.srdf", joints=["j1", "j2"])
    assert len(again.collision_pairs) > 0


def test_never_pairs_are_tested_once_a_scale_makes_links_larger(write):
    far = {"xyz": "0 0 0.3", "axis": "0 0 1"}
    path = write(chain(joint("j1", "a", "b", **far), joint("j2", "b", "c", **far)))
    robot = Robot.from_urdf(path)
    assert robot.disabled_pairs[pair("a", "c")] == "Never"
    assert len(robot.collision_pairs) == 0
    for same in (robot.with_padding(0.5), robot.with_padding(scale=0.5)):
        assert same.disabled_pairs == robot.disabled_pairs
    for large in (robot.with_padding(scale={"a": 13.0}), robot.with_padding(scale=7.0)):
        assert pair("a", "c") not in large.disabled_pairs
        assert large.collision_pairs.tolist() == [[0, 2]]
        assert set(large.touching_shares(10).values()) == {1.0}


MESH = (
    '<robot name="r"><link name="base"/><link name="tip"><collision><geometry>'
    '<mesh filename="{}"/></geometry></collision></link><joint name="j" type="continuous">'
    '<parent link="base"/><child link="tip"/><axis xyz="0 0 1"/></joint></robot>'
)
PYRAMID = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 {}\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


def ascii_stl(corner: str) -> str:
    faces = [("0 0 0", "0.1 0 0", "0 0.1 0"), ("0 0 0", "0.1 0 0", corner)]
    body = "".join(
        "facet normal 0 0 1\nouter loop\n"
        + "".join(f"vertex {point}\n" for point in face)
        + "endloop\nendfacet\n"
        for face in faces
    )
    return f"solid s\n{body}endsolid s\n"


@pytest.mark.parametrize(
    ("name", "text"), [("m.obj", PYRAMID.format("nan")), ("m.stl", ascii_stl("0 0 nan"))]
)
def test_vertices_that_are_not_finite_are_refused_and_not_cut_out(write, arm, name, text):
    file = write(text, name)
    with pytest.raises(RobotError, match=rf"link 'tip', .*{name}'.*not finite"):
        Robot.from_urdf(write(MESH.format(name)))
    with pytest.raises(RobotError, match=rf"{name}'.*not finite"):
        arm.attach("tool", "c", mesh=file)


def test_a_mesh_without_area_is_refused(write):
    write("v 0 0 0\nv 0.1 0.1 0.1\nv 0.3 0.3 0.3\nf 1 2 3\n", "line.obj")
    with pytest.raises(RobotError, match=r"link 'tip', .*line.obj'.* no area"):
        Robot.from_urdf(write(MESH.format("line.obj")))


def test_another_packages_file_is_not_taken_in_silence(tmp_path, caplog):
    mine = tmp_path / "mine"
    (mine / "meshes").mkdir(parents=True)
    (mine / "meshes" / "m.obj").write_text(PYRAMID.format(0.1))
    urdf, name = mine / "r.urdf", "package://other/meshes/m.obj"
    assert find_mesh(name, urdf, None)[0] == mine / "meshes" / "m.obj"
    assert "'package://other/meshes/m.obj'" in caplog.text
    caplog.clear()
    assert find_mesh("package://mine/meshes/m.obj", urdf, None)[0] is not None
    (tmp_path / "ros" / "other").mkdir(parents=True)
    ros = tmp_path / "ros"
    for dirs in ({"other": ros / "other"}, ros, [ros / "other"]):
        assert find_mesh(name, urdf, dirs)[0] is None
    assert not caplog.records


@pytest.mark.parametrize("xyz", ["0.3", "0 0 0.3 0", "0 0", "", "0 0 inf", "0 0 x"])
@pytest.mark.parametrize("where", ["joint", "link"])
def test_an_origin_is_three_finite_numbers(write, where, xyz):
    origin = f'<origin xyz="{xyz}"/>'
    if where == "joint":
        text = TWO.replace('<origin xyz="0 0 0.3"/>', origin)
    else:
        text = TWO.replace("<collision>", f"<collision>{origin}", 1)
    with pytest.raises(RobotError, match=rf"{where} '.*' .*<origin> with xyz=.*; write finite"):
        Robot.from_urdf(write(text))
    with pytest.raises(RobotError, match="rpy="):
        Robot.from_urdf(write(text.replace(origin, '<origin rpy="0.3"/>')))


@pytest.mark.parametrize("center", [[0.1], 0.2, [[0, 0, 0]], [0, 0, 0, 0], None])
def test_a_centre_is_three_numbers(center):
    with pytest.raises(RobotError, match="expected"):
        read_spheres({"a": [{"center": center, "radius": 0.1}]})


def test_a_second_list_for_a_link_does_not_replace_the_first(write):
    row = "- {center: [0, 0, 0], radius: 0.1}"
    path = write(f"collision_spheres:\n  a:\n  {row}\n  b: []\n  a:\n  {row}\n", "s.yml")
    with pytest.raises(RobotError, match=r"s\.yml' is not valid YAML.*'a' occurs twice(.|\n)*5"):
        read_spheres(path)
    merged = "x: &x {a: 1, b: 2}\ny: {<<: *x, a: 3}\n"
    assert _yaml(write(merged, "merged.yml")) == yaml.safe_load(merged)


@pytest.mark.parametrize(
    ("factor", "turns"), [("1", True), ("-2", True), ("0", True), ("0.5", False), ("1.5", False)]
)
def test_a_continuous_follower_is_where_it_was_after_a_whole_turn(write, factor, turns):
    follow = f'<mimic joint="j1" multiplier="{factor}"/>'
    free = {"kind": "continuous", "limit": ""}
    text = chain(joint("j1", "a", "b", **free), joint("j2", "b", "c", extra=follow, **free))
    robot = Robot.from_urdf(write(text))
    assert robot.continuous.tolist() == [turns]
    np.testing.assert_array_equal([robot.lower[0], robot.upper[0]], [-np.pi, np.pi])


def test_written_spheres_keep_the_buffer_of_the_file(write, tmp_path):
    content = {"collision_spheres": dict.fromkeys("abc", BIG)}
    content["collision_sphere_buffer"] = {"a": 0.01, "b": 0.02}
    path = write(TWO)
    robot = Robot.from_urdf(path, spheres={"kinematics": content})
    robot.with_padding(0.5).write_spheres(tmp_path / "out.yml")
    assert "without the padding" in (tmp_path / "out.yml").read_text()
    again = Robot.from_urdf(path, spheres=tmp_path / "out.yml")
    np.testing.assert_array_equal(again.sphere_radii, robot.sphere_radii)
    np.testing.assert_array_equal(again.arrays.link_padding, robot.arrays.link_padding)
    np.testing.assert_allclose(again.arrays.link_padding, [0.01, 0.02, 0.0])
    with pytest.raises(RobotError, match=r"pads the links \['hnad'\]"):
        read_spheres({"collision_spheres": {"a": BIG}, "padding": {"hnad": 0.1}})


def test_a_fit_for_links_that_are_not_there_is_refused(write):
    with pytest.raises(RobotError, match=r"max_spheres names the links \['hnad'\]"):
        Robot.from_urdf(write(TWO), fit=SphereFit(max_spheres={"hnad": 1}))


def test_fit_and_spheres_are_not_both_taken(write, capsys):
    assert main(["robot", str(write(TWO)), "--fit", "--spheres", "s.yml"]) == 2
    assert "--fit does not go with --spheres" in capsys.readouterr().err
