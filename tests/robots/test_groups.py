# SPDX-License-Identifier: BSD-3-Clause
"""SRDF groups as sets of links, against what MoveIt makes of the same entries."""

import pytest
from small_urdfs import TWO, chain, joint

from vprism_plan.errors import RobotError
from vprism_plan.robots import Robot

TREE = chain(
    joint("j1", "a", "b"),
    joint("j2", "b", "c"),
    joint("j3", "b", "d"),
    joint("mount", "d", "e", kind="fixed", limit=""),
    links=("a", "b", "c", "d", "e"),
)


def groups_of(write, entries: str) -> dict[str, tuple[str, ...]]:
    srdf = write(f'<robot name="chain">{entries}</robot>', "groups.srdf")
    return Robot.from_urdf(write(TREE), srdf=srdf).groups


@pytest.mark.parametrize(
    ("entries", "expected"),
    [
        ('<joint name="j1"/>', ("b",)),
        ('<joint name="j3"/><joint name="j1"/>', ("d", "b")),
        ('<link name="e"/>', ("e",)),
        ('<link name="a"/>', ("a",)),
        ('<chain base_link="a" tip_link="e"/>', ("b", "d", "e")),
        ('<chain base_link="b" tip_link="e"/>', ("d", "e")),
        ('<group name="first"/><link name="c"/><link name="c"/>', ("b", "d", "c")),
        ("", ()),
    ],
)
def test_every_kind_of_entry_names_links(write, entries, expected):
    """The base of a chain is no member, nor what hangs below a joint's child."""
    first = '<group name="first"><chain base_link="a" tip_link="d"/></group>'
    groups = groups_of(write, f'{first}<group name="g">{entries}</group>')
    assert groups == {"first": ("b", "d"), "g": expected}


def test_a_virtual_joint_moves_no_link_of_the_robot(write):
    virtual = '<virtual_joint name="world" type="fixed" parent_frame="w" child_link="a"/>'
    group = '<group name="g"><joint name="world"/><joint name="j2"/></group>'
    assert groups_of(write, virtual + group) == {"g": ("c",)}


def test_without_an_srdf_there_are_no_groups(write):
    assert Robot.from_urdf(write(TWO)).groups == {}


def test_the_shipped_panda_names_its_hand_and_its_fingers(robots):
    panda = robots["panda"]
    fingers = ("panda_leftfinger", "panda_rightfinger")
    assert panda.groups == {
        "arm": tuple(f"panda_link{i}" for i in range(1, 8)),
        "hand": ("panda_hand", *fingers),
        "fingers": fingers,
    }
    assert panda.links_of("hand") == ("panda_hand", *fingers)
    assert panda.links_of("panda_hand") == ("panda_hand",)


def test_links_of_names_only_what_is_checked(write):
    entries = '<group name="g"><link name="c"/><link name="d"/></group><group name="none"/>'
    entries += '<group name="b"><link name="a"/></group><group name="bare"><link name="c"/></group>'
    srdf = write(f'<robot name="chain">{entries}</robot>', "groups.srdf")
    ball = [{"center": [0, 0, 0], "radius": 0.05}]
    spheres = dict.fromkeys("abd", ball) | {"c": [], "e": []}
    robot = Robot.from_urdf(write(TREE), srdf=srdf, spheres=spheres)
    assert robot.groups["g"] == ("c", "d")
    assert robot.links_of("g") == ("d",)
    assert robot.links_of("b") == ("b",)  # the link, not the group of that name
    valid = r"links: \['a', 'b', 'd'\], groups: \['b', 'bare', 'g', 'none'\]"
    for name in ("bare", "none", "c"):
        with pytest.raises(RobotError, match=f"'{name}' has no collision spheres.*{valid}"):
            robot.links_of(name)
    with pytest.raises(RobotError, match=f"'wrist' is no link or group of chain.*{valid}"):
        robot.links_of("wrist")
