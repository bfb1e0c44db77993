# SPDX-License-Identifier: BSD-3-Clause
"""What went wrong once, in silence: each test is named after what broke."""

import pytest
from small_urdfs import LINK, TWO, chain, joint

from vprism_plan.cli import main
from vprism_plan.robots import Robot

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
    Robot.from_urdf(path, spheres={"kinematics": {"collision_spheres": table}})
    assert "without spheres" in caplog.text
    assert "['b']" in caplog.text
