# SPDX-License-Identifier: BSD-3-Clause
"""URDF files that cannot be used are refused, and the message names what is wrong."""

import pytest
from small_urdfs import TWO, chain, joint

from vprism_plan.errors import RobotError
from vprism_plan.robots import Robot

MALFORMED = {
    "not XML": ("<robot name='x'><link", "not well-formed XML"),
    "not a robot": ("<sdf/>", "root element .* is <sdf>"),
    "xacro": (
        '<robot name="x" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:arm/></robot>',
        "xacro macros; expand it first",
    ),
    "no links": ('<robot name="x"/>', "has no links"),
    "link without a name": ('<robot name="x"><link/></robot>', "<link> .* has no 'name'"),
    "link twice": (chain(links=("a", "a")), r"link names \['a'\] occur more than once"),
    "joint twice": (
        chain(joint("j", "a", "b"), joint("j", "b", "c")),
        r"joint names \['j'\] occur more than once",
    ),
    "no parent": (
        '<robot name="x"><link name="a"/><joint name="j" type="fixed"><child link="a"/>'
        "</joint></robot>",
        "joint 'j' .* names no parent link",
    ),
    "unknown link": (chain(joint("j1", "a", "zz")), "unknown link 'zz'; links:"),
    "two parents": (
        chain(joint("j1", "a", "c"), joint("j2", "b", "c")),
        "link 'c' .* two parent joints: 'j1' and 'j2'",
    ),
    "several roots": (chain(joint("j1", "a", "b")), r"several roots \['a', 'c'\]"),
    "cycle": (
        chain(joint("j1", "a", "b"), joint("j2", "b", "c"), joint("j3", "c", "a")),
        "joints form a cycle",
    ),
    "cycle beside the root": (
        chain(joint("j1", "b", "c"), joint("j2", "c", "b")),
        r"joints \['j1', 'j2'\] .* form a cycle",
    ),
    "unknown type": (chain(joint("j1", "a", "b", kind="ball")), "type 'ball'; valid:"),
    "floating below what moves": (
        chain(joint("j1", "a", "b"), joint("j2", "b", "c", kind="floating")),
        r"joints \['j2'\] .* floating or planar; .* make them fixed",
    ),
    "planar below what moves": (
        chain(joint("j1", "a", "b"), joint("j2", "b", "c", kind="planar")),
        r"joints \['j2'\] .* floating or planar",
    ),
    "words for a radius": (TWO.replace('"0.05"', '"wide"', 1), "link 'a' .* 'wide'"),
    "no radius": (TWO.replace('radius="0.05"', "", 1), "link 'a' .* no 'radius'"),
    "words for a limit": (TWO.replace('upper="1"', 'upper="far"', 1), "joint 'j1' .* 'far'"),
    "words for a factor": (
        chain(
            joint("j1", "a", "b"),
            joint("j2", "b", "c", extra='<mimic joint="j1" multiplier="half"/>'),
        ),
        "joint 'j2' .* 'half'",
    ),
    "reversed limits": (
        chain(joint("j1", "a", "b", limit='<limit lower="2" upper="1" velocity="1"/>')),
        r"joint 'j1' .* limits \[2.0, 1.0\]",
    ),
    "NaN limit": (
        chain(joint("j1", "a", "b", limit='<limit lower="nan" upper="1" velocity="1"/>')),
        "joint 'j1' .* must be finite",
    ),
    "no limit": (chain(joint("j1", "a", "b", limit="")), "no lower and upper <limit>"),
    "half a limit": (
        chain(joint("j1", "a", "b", limit='<limit upper="1" velocity="1"/>')),
        "no lower and upper <limit>",
    ),
    "negative velocity": (
        chain(joint("j1", "a", "b", limit='<limit lower="0" upper="1" velocity="-1"/>')),
        "velocity limit -1.0",
    ),
    "soft limits apart from the hard ones": (
        chain(
            joint("j1", "a", "b", extra='<safety_controller soft_lower_limit="5" k_velocity="1"/>')
        ),
        r"'j1' .* soft limits \[5, .*leave nothing",
    ),
    "soft limits that are no numbers": (
        chain(
            joint(
                "j1", "a", "b", extra='<safety_controller soft_upper_limit="nan" k_velocity="1"/>'
            )
        ),
        "'j1' .*soft limits",
    ),
    "zero axis": (chain(joint("j1", "a", "b", axis="0 0 0")), "axis .* not all zero"),
    "short axis": (chain(joint("j1", "a", "b", axis="0 1")), "needs three finite numbers"),
    "scaled prismatic axis": (
        chain(joint("j1", "a", "b", kind="prismatic", axis="0 0 2")),
        "axis of length 2; write a unit axis",
    ),
    "bad number": (chain(joint("j1", "a", "b", xyz="0 zero 0")), "<origin> with xyz='0 zero 0'"),
    "NaN origin": (chain(joint("j1", "a", "b", xyz="0 nan 0")), "<origin> with xyz='0 nan 0'"),
    "NaN mimic": (
        chain(
            joint("j1", "a", "b"), joint("j2", "b", "c", extra='<mimic joint="j1" offset="nan"/>')
        ),
        "joint 'j2' .* non-finite mimic",
    ),
    "mimic of nothing": (
        chain(joint("j1", "a", "b"), joint("j2", "b", "c", extra='<mimic joint="zz"/>')),
        r"mimics 'zz', which is no moving joint; valid: \['j1', 'j2'\]",
    ),
    "mimics itself": (
        chain(
            joint("j1", "a", "b", extra='<mimic joint="j2"/>'),
            joint("j2", "b", "c", extra='<mimic joint="j1"/>'),
        ),
        "mimics itself",
    ),
    "nothing moves": (
        chain(joint("j1", "a", "b", kind="fixed"), joint("j2", "b", "c", kind="fixed")),
        "no joint of 'chain' moves",
    ),
    "negative radius": (TWO.replace('"0.05"', '"-0.05"'), "sphere of size .* must be positive"),
    "cone": (TWO.replace("<sphere", "<cone"), "link 'a' .* <cone>; read are .*'capsule'"),
    "capsule without length": (TWO.replace("<sphere", "<capsule"), "link 'a' .* no 'length'"),
}


@pytest.mark.parametrize("case", MALFORMED)
def test_malformed_urdfs_are_refused_by_name(write, case):
    text, message = MALFORMED[case]
    if "several" not in case and case != "cycle beside the root" and text.count("<joint") == 1:
        text = text.replace("</robot>", joint("rest", "a", "c") + "</robot>")
    with pytest.raises(RobotError, match=message):
        Robot.from_urdf(write(text))


def test_what_does_not_matter_is_ignored(write):
    noise = (
        "<!-- a comment --><transmission name='t'/><gazebo/><material name='m'/>"
        "<link name='a'><visual><geometry><capsule radius='1' length='1'/></geometry></visual>"
    )
    robot = Robot.from_urdf(write(TWO.replace('<link name="a">', noise, 1)))
    assert robot.joint_names == ("j1", "j2")


def test_soft_limits_narrow_the_range_as_in_moveit(write):
    """Of either side, the stricter one; a continuous joint has none."""
    limit = '<limit lower="-2" upper="2" velocity="1" effort="1"/>'
    soft = '<safety_controller soft_lower_limit="{}" soft_upper_limit="{}" k_velocity="1"/>'
    robot = Robot.from_urdf(
        write(
            chain(
                joint("j1", "a", "b", limit=limit, extra=soft.format(-1.5, 3.0)),
                joint("j2", "b", "c", kind="continuous", extra=soft.format(-0.1, 0.1)),
            )
        )
    )
    assert robot.lower[0] == -1.5
    assert robot.upper[0] == 2.0
    assert robot.upper[1] > 3.0
