# SPDX-License-Identifier: BSD-3-Clause
"""Spheres that do not hold their link are named, with the link and by how much."""

import pytest
import trimesh

import vprism_plan as vp

URDF = (
    '<robot name="r"><link name="base"/><link name="arm"><collision><origin xyz="0 0 0.2"/>'
    '<geometry>{}</geometry></collision></link><joint name="j" type="revolute">'
    '<parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>'
    '<limit lower="-2" upper="2" effort="1" velocity="1"/></joint></robot>'
)
BOX = '<box size="0.2 0.2 0.3"/>'


def robot(tmp_path, radius: float, shape: str = BOX) -> vp.Robot:
    path = tmp_path / "r.urdf"
    path.write_text(URDF.format(shape))
    return vp.Robot.from_urdf(path, spheres={"arm": [{"center": [0, 0, 0.2], "radius": radius}]})


@pytest.mark.parametrize("name", ["panda", "ur5e", "planar3"])
def test_bundled_robots_have_nothing_to_say(repository, name):
    assert vp.Robot.from_urdf(repository / "urdf" / f"{name}.urdf").warnings == ()


@pytest.mark.parametrize("kind", ["box", "mesh"])
def test_given_spheres_that_leave_a_link_bare_loaded_without_a_word(tmp_path, kind):
    trimesh.creation.box((0.2, 0.2, 0.3)).export(tmp_path / "block.stl")
    shape = BOX if kind == "box" else '<mesh filename="block.stl"/>'
    (text,) = robot(tmp_path, 0.05, shape).warnings
    assert "arm by 156 mm" in text  # half the diagonal, 206 mm, less the sphere
    assert "fit" in text
    assert robot(tmp_path, 0.207, shape).warnings == ()
    padded = robot(tmp_path, 0.05, shape).with_padding(0.3)
    assert padded.warnings == (text,)  # padding is a distance to keep, not a link


def test_links_that_nothing_can_judge_are_named(tmp_path):
    (text,) = robot(tmp_path, 0.3, '<mesh filename="gone.stl"/>').warnings
    assert "arm" in text
    assert "package_dirs" in text
