# SPDX-License-Identifier: BSD-3-Clause
"""URDF text for robots of a few links."""

LINK = '<link name="{0}"><collision><geometry><sphere radius="0.05"/></geometry></collision></link>'
JOINT = (
    '<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
    '<origin xyz="{xyz}"/><axis xyz="{axis}"/>{limit}{extra}</joint>'
)
LIMIT = '<limit lower="-1" upper="1" effort="1" velocity="1"/>'


def joint(name, parent, child, **given) -> str:
    values = {"kind": "revolute", "xyz": "0 0 0.3", "axis": "0 0 1", "limit": LIMIT, "extra": ""}
    return JOINT.format(name=name, parent=parent, child=child, **(values | given))


def chain(*joints: str, links=("a", "b", "c")) -> str:
    parts = [LINK.format(link) for link in links] + list(joints)
    return f'<robot name="chain">{"".join(parts)}</robot>'


TWO = chain(joint("j1", "a", "b"), joint("j2", "b", "c", xyz="0.3 0 0"))
