# SPDX-License-Identifier: BSD-3-Clause
"""The parts of an SRDF that planning needs: groups, named states, disabled pairs."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from pathlib import Path

from vprism_plan._files import reading
from vprism_plan.errors import RobotError
from vprism_plan.robots._model import RobotModel
from vprism_plan.robots._xml import robot_element


@dataclass(frozen=True)
class SemanticModel:
    """What an SRDF adds to a URDF.

    Attributes:
        groups: Group name -> names of the joints in it, in file order.
        group_links: Group name -> names of the links in it, in file order.
        states: (state name, group) -> joint name -> value, in file order.
        disabled: Unordered link pair -> the reason the file gives.
    """

    groups: dict[str, tuple[str, ...]] = field(default_factory=dict)
    group_links: dict[str, tuple[str, ...]] = field(default_factory=dict)
    states: dict[tuple[str, str], dict[str, float]] = field(default_factory=dict)
    disabled: dict[frozenset[str], str] = field(default_factory=dict)

    def state_value(self, joint: str) -> float | None:
        """The joint's value in the first state that names it ("ready" before others)."""
        ranked = sorted(self.states, key=lambda key: key[0] != "ready")
        return next((self.states[k][joint] for k in ranked if joint in self.states[k]), None)

    def merged_states(self) -> dict[str, dict[str, float]]:
        """State name -> joint values, merged over the groups that share the name."""
        merged: dict[str, dict[str, float]] = {}
        for (name, _group), values in self.states.items():
            merged.setdefault(name, {}).update(values)
        return merged


def load_srdf(path: str | Path, model: RobotModel) -> SemanticModel:
    """Read an SRDF and check every name in it against the URDF.

    Args:
        path: The SRDF file.
        model: The robot it belongs to.

    Raises:
        RobotError: The file is missing or malformed, or names links or joints the
            robot does not have: a disabled pair with a typing error would
            otherwise disable nothing, or the wrong thing.
    """
    path = Path(path)
    if not path.is_file():
        raise RobotError(f"no SRDF file at '{path}'; give an existing file, or leave srdf=None")
    with reading(path, "a usable SRDF", RobotError):
        root = robot_element(path, "an SRDF")
        groups, links = _groups(root, model, path)
        states, disabled = _states(root, model, path), _disabled(root, model, path)
        return SemanticModel(groups, links, states, disabled)


def _groups(
    root: ET.Element, model: RobotModel, path: Path
) -> tuple[dict[str, tuple[str, ...]], dict[str, tuple[str, ...]]]:
    """The joints and the links of every group.

    As in MoveIt, the links of a group are those that its joints move directly: the base
    of a chain is not one of them, nor is what hangs below a joint's child.
    """
    groups: dict[str, tuple[str, ...]] = {}
    links: dict[str, tuple[str, ...]] = {}
    parent_of = {joint.child: joint for joint in model.joints}
    # A virtual joint ties the base to the world; it is no joint of the URDF.
    virtual = {element.get("name", "") for element in root.findall("virtual_joint")}
    for group in root.findall("group"):
        joints: list[str] = []
        named: list[str] = []
        for member in group:
            name = member.get("name", "")
            if member.tag == "joint" and name not in virtual:
                joints.append(_known(name, model.joint_map, "joint", path))
                named.append(model.joint_map[name].child)
            elif member.tag == "link":
                named.append(_known(name, model.links, "link", path))
                if name in parent_of:
                    joints.append(parent_of[name].name)
            elif member.tag == "group":
                joints += groups[_known(name, groups, "group", path)]
                named += links[name]
            elif member.tag == "chain":
                base = _known(member.get("base_link", ""), model.links, "link", path)
                tip = _known(member.get("tip_link", ""), model.links, "link", path)
                chain: list[str] = []
                while tip != base:
                    if tip not in parent_of:
                        raise RobotError(
                            f"group '{group.get('name')}' in '{path}': "
                            f"'{base}' is not above '{member.get('tip_link')}'"
                        )
                    chain.append(parent_of[tip].name)
                    tip = parent_of[tip].parent
                joints += reversed(chain)
                named += [model.joint_map[joint].child for joint in reversed(chain)]
        groups[group.get("name", "")] = tuple(dict.fromkeys(joints))
        links[group.get("name", "")] = tuple(dict.fromkeys(named))
    return groups, links


def _states(
    root: ET.Element, model: RobotModel, path: Path
) -> dict[tuple[str, str], dict[str, float]]:
    states: dict[tuple[str, str], dict[str, float]] = {}
    for state in root.findall("group_state"):
        values: dict[str, float] = {}
        for joint in state.findall("joint"):
            name = _known(joint.get("name", ""), model.joint_map, "joint", path)
            try:
                values[name] = float(joint.get("value", ""))
            except ValueError:
                values[name] = math.nan
            if not math.isfinite(values[name]):
                raise RobotError(
                    f"state '{state.get('name')}' in '{path}' gives joint '{name}' the value "
                    f"{joint.get('value')!r}; one finite number is supported"
                )
        states[state.get("name", ""), state.get("group", "")] = values
    return states


def _disabled(root: ET.Element, model: RobotModel, path: Path) -> dict[frozenset[str], str]:
    pairs: dict[frozenset[str], str] = {}
    for element in root.findall("disable_collisions"):
        names = [
            _known(element.get(key, ""), model.links, "link", path) for key in ("link1", "link2")
        ]
        pairs[frozenset(names)] = element.get("reason", "")
    return pairs


def _known(name: str, valid: object, what: str, path: Path) -> str:
    if name not in valid:  # type: ignore[operator]
        raise RobotError(
            f"'{path}' names the {what} '{name}', which the robot does not have; "
            f"valid: {sorted(valid)}"  # type: ignore[call-overload]
        )
    return name
