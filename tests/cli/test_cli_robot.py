# SPDX-License-Identifier: BSD-3-Clause
"""The command `robot`, on a robot that is read at once."""

import json

import numpy as np
import pytest

from vprism_plan.cli import main
from vprism_plan.robots import Robot
from vprism_plan.viz import robot_figure


@pytest.fixture(scope="module")
def planar(repository):
    return repository / "urdf" / "planar3.urdf"


def test_text_says_of_every_link_whether_it_is_held(planar, capsys):
    assert main(["robot", str(planar)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("planar3: 3 joints (")
    for link in ("base", "link1", "link2", "link3"):
        assert any(line.startswith(link) and "proved" in line for line in lines)
    assert any("every link is proved to be enclosed" in line for line in lines)


def test_json_and_files_hold_the_same_robot(planar, tmp_path, capsys):
    out = {
        "spheres": tmp_path / "s.yml",
        "srdf": tmp_path / "p.srdf",
        "picture": tmp_path / "p.png",
    }
    command = ["robot", str(planar), "--fit", "--max-spheres", "6", "--json"]
    command += ["--spheres-output", str(out["spheres"]), "--srdf-output", str(out["srdf"])]
    assert main([*command, "--picture", str(out["picture"])]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["enclosed"] is True
    assert 0.0 < said["protrusion"] < 0.1
    assert said["spheres"] == sum(link["spheres"] for link in said["links"])
    robot = Robot.from_urdf(planar, srdf=out["srdf"], spheres=out["spheres"])
    assert len(robot.sphere_radii) == said["spheres"]
    assert len(robot.collision_pairs) == said["tested_pairs"]
    assert out["picture"].stat().st_size > 10_000


def test_a_mesh_that_is_missing_is_one_line_and_bad_input(tmp_path, capsys):
    path = tmp_path / "r.urdf"
    path.write_text(
        '<robot name="r"><link name="a"/><link name="b"><collision><geometry>'
        '<mesh filename="package://gone/b.stl"/></geometry></collision></link>'
        '<joint name="j" type="continuous"><parent link="a"/><child link="b"/></joint></robot>'
    )
    assert main(["robot", str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "link 'b'" in line
    assert "package_dirs" in line


def test_the_picture_shows_spheres_around_what_the_urdf_draws(planar):
    robot = Robot.from_urdf(planar)
    figure = robot_figure(robot, title="three links")
    bare, covered = (axis.images[0].get_array() for axis in figure.axes)
    assert figure.get_suptitle() == "three links"
    drawn, over = ((picture < 0.99).any(axis=2) for picture in (bare, covered))
    assert drawn.any()
    assert (over | ~drawn).all()  # nothing of the robot sticks out
    assert over.sum() > drawn.sum()
    q = np.array([1.0, 0.5, -0.5])
    assert not np.array_equal(robot_figure(robot, q).axes[0].images[0].get_array(), bare)
