# SPDX-License-Identifier: BSD-3-Clause
from pathlib import Path

import pytest
from small_urdfs import TWO

from vprism_plan.robots import Robot

ROBOTS = ("panda", "ur5e", "planar3")


@pytest.fixture(scope="session")
def urdf_folder(repository: Path) -> Path:
    return repository / "urdf"


@pytest.fixture(scope="session")
def robots(urdf_folder: Path) -> dict[str, Robot]:
    return {name: Robot.from_urdf(urdf_folder / f"{name}.urdf") for name in ROBOTS}


GRIPPER = """<robot name="gripper">
  <link name="base"/><link name="palm"/><link name="left"/><link name="right"/>
  <joint name="wrist" type="continuous"><parent link="base"/><child link="palm"/>
    <axis xyz="0 0 2"/><limit effort="5" velocity="0"/></joint>
  <joint name="slide" type="prismatic"><parent link="palm"/><child link="left"/>
    <origin xyz="0 0 0.1"/><axis xyz="0 0 1"/>
    <limit lower="0.01" upper="0.05" effort="5" velocity="0.1"/></joint>
  <joint name="follow" type="prismatic"><parent link="palm"/><child link="right"/>
    <origin xyz="0 0 0.1"/><axis xyz="1 0 0"/><mimic joint="slide" multiplier="-2" offset="0.01"/>
    <limit lower="-0.1" upper="0.1" effort="5" velocity="0.1"/></joint>
</robot>"""
GRIPPER_SPHERES = {
    "palm": [{"center": [0, 0, 0.02], "radius": 0.03}],
    "left": [{"center": [0, 0, 0.02], "radius": 0.01}],
    "right": [{"center": [0, 0, -0.02], "radius": 0.01}],
}


@pytest.fixture(scope="session")
def gripper(tmp_path_factory) -> Robot:
    path = tmp_path_factory.mktemp("gripper") / "gripper.urdf"
    path.write_text(GRIPPER)
    return Robot.from_urdf(path, spheres=GRIPPER_SPHERES)


@pytest.fixture
def write(tmp_path):
    def to(text: str, name: str = "arm.urdf"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return to


@pytest.fixture
def arm(write) -> Robot:
    return Robot.from_urdf(write(TWO))
