# SPDX-License-Identifier: BSD-3-Clause
"""The parts of an SRDF that planning needs: groups, named states, disabled pairs."""

from __future__ import annotations

import logging
import math
import xml.etree.ElementTree as ET
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vprism_plan._files import reading, write_text
from vprism_plan.errors import RobotError
from vprism_plan.robots.plain_xml import MOST_BYTES, robot_element
from vprism_plan.robots.sphere_files import finite_values
from vprism_plan.robots.urdf import LIMIT_TOLERANCE, RobotModel

Names = dict[str, tuple[str, ...]]
RIGID = "Rigid"  # why a pair is not tested, where no joint moves its links
_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class SemanticModel:
    """What an SRDF adds to a URDF, in file order."""

    groups: Names = field(default_factory=dict)  # of links
    # (state, group) -> joint -> value
    states: dict[tuple[str, str], dict[str, float]] = field(default_factory=dict)
    disabled: dict[frozenset[str], str] = field(default_factory=dict)  # pair -> reason
    warnings: tuple[str, ...] = ()

    def state_value(self, joint: str) -> float | None:
        """The joint's value in the first state that names it ("ready" before others)."""
        ranked = sorted(self.states, key=lambda key: key[0] != "ready")
        return next((self.states[k][joint] for k in ranked if joint in self.states[k]), None)

    def full_states(self, joints: Sequence[str]) -> dict[str, np.ndarray]:
        """States, merged over the groups that share the name, that have all of these joints."""
        merged: dict[str, dict[str, float]] = {}
        for (name, _group), values in self.states.items():
            merged.setdefault(name, {}).update(values)
        return {
            name: np.array([values[joint] for joint in joints])
            for name, values in merged.items()
            if values.keys() >= set(joints)
        }


def load_srdf(path: str | Path, model: RobotModel) -> SemanticModel:
    """Read an SRDF as MoveIt does: what the robot does not have is left out, with a warning.

    So a disabled pair with a typing error disables nothing, and stays tested.

    Raises:
        RobotError: The file is missing or malformed.
    """
    path = Path(path)
    if not path.is_file():
        raise RobotError(f"no SRDF file at '{path}'; give an existing file, or leave srdf=None")
    with reading(path, "a usable SRDF", RobotError, MOST_BYTES):
        root = robot_element(path, "an SRDF")
        missing: Missing = set()
        groups = _groups(root, model, missing, path)
        states, disabled = _states(root, model, missing, path), _disabled(root, model, missing)
        # A virtual joint ties the base to the world; it is no joint of the URDF.
        missing -= {("joint", element.get("name", "")) for element in root.findall("virtual_joint")}
        named = ", ".join(sorted(f"{what} '{name}'" for what, name in missing))
        odd = f"'{path}' names what {model.name} does not have, left out: {named}"
        return SemanticModel(groups, states, disabled, (odd,) if missing else ())


Missing = set[tuple[str, str]]  # "joint", "link" or "group", and a name in vain


def _has(what: str, name: str, valid: Collection[str], missing: Missing) -> bool:
    """Whether there is something of that name; what there is not is noted."""
    if name not in valid:
        missing.add((what, name))
    return name in valid


def _groups(root: ET.Element, model: RobotModel, missing: Missing, path: Path) -> Names:
    """The links of every group: as in MoveIt, what its joints move directly."""
    elements = {element.get("name", ""): element for element in root.findall("group")}
    tables: dict[str, Any] = {"joint": model.joint_map, "link": model.links, "group": elements}
    groups: Names = {}

    def chain(group: str, base: str, tip: str) -> list[str]:
        if not all(_has("link", end, model.links, missing) for end in (base, tip)):
            return []
        above = model.above(tip)
        if base not in above:
            raise RobotError(f"group '{group}' in '{path}': '{base}' is not above '{tip}'")
        return above[: above.index(base)][::-1]

    def read(group: str, above: tuple[str, ...] = ()) -> tuple[str, ...]:
        if group in above:
            raise RobotError(f"group '{group}' in '{path}' is in itself, through {list(above)}")
        if group in groups:
            return groups[group]
        links: list[str] = []
        for member in elements[group]:
            name, kind = member.get("name", ""), member.tag
            if kind == "chain":
                links += chain(group, member.get("base_link", ""), member.get("tip_link", ""))
            elif kind in tables and _has(kind, name, tables[kind], missing):
                one = model.joint_map[name].child if kind == "joint" else name
                links += read(name, (*above, group)) if kind == "group" else (one,)
        groups[group] = tuple(dict.fromkeys(links))
        return groups[group]

    for name in elements:
        read(name)
    return groups


def _states(
    root: ET.Element, model: RobotModel, missing: Missing, path: Path
) -> dict[tuple[str, str], dict[str, float]]:
    states: dict[tuple[str, str], dict[str, float]] = {}
    for state in root.findall("group_state"):
        values = {joint.get("name", ""): joint.get("value", "") for joint in state.findall("joint")}
        values = {n: v for n, v in values.items() if _has("joint", n, model.joint_map, missing)}
        values = {n: v for n, v in values.items() if model.joint_map[n].moves}
        found = f"state '{state.get('name')}' in '{path}' gives joint"
        states[state.get("name", ""), state.get("group", "")] = finite_values(values, (), found)
    return states


def _disabled(root: ET.Element, model: RobotModel, missing: Missing) -> dict[frozenset[str], str]:
    pairs: dict[frozenset[str], str] = {}
    for element in root.findall("disable_collisions"):
        ends = {element.get(key, "") for key in ("link1", "link2")}
        if len([end for end in ends if _has("link", end, model.links, missing)]) == len(ends):
            pairs[frozenset(ends)] = element.get("reason", "")
    return pairs


def choose_joints(
    model: RobotModel,
    semantics: SemanticModel,
    joints: Sequence[str] | None,
    group: str | None = None,
) -> tuple[str, ...]:
    """The joints of a configuration: given, of the group, of the group "arm", or else all."""
    valid = model.movable

    def of(name: str) -> list[str]:
        joints = (model.joint_above.get(link) for link in semantics.groups.get(name, ()))
        return [joint.name for joint in joints if joint is not None and joint.name in valid]

    if group is not None:
        if joints is not None:
            raise RobotError(f"both joints and the group {group!r} are given; give one of them")
        joints = of(group)
        if not joints:
            found = f"the SRDF of '{model.name}' has no group {group!r} with joints that move"
            raise RobotError(f"{found}; groups: {sorted(semantics.groups)}")
    if joints is None:
        chosen = tuple(of("arm")) or valid
    elif isinstance(joints, str):
        raise RobotError(f"joints is the string {joints!r}; give a sequence of joint names")
    else:
        chosen = tuple(joints)
    unknown = [name for name in chosen if name not in valid]
    if unknown:
        raise RobotError(f"unknown or non-actuated joints {unknown}; valid: {list(valid)}")
    if len(set(chosen)) != len(chosen):
        raise RobotError(f"joints {list(chosen)} names a joint twice")
    if not chosen:
        raise RobotError(f"no joint of '{model.name}' moves; a robot needs at least one")
    return chosen


def lock_values(
    model: RobotModel, semantics: SemanticModel, active: Sequence[str], given: Mapping[str, float]
) -> dict[str, float]:
    """The value of every actuated joint that is not in the configuration."""
    rest = [name for name in model.actuated if name not in active]
    unknown = sorted(set(given) - set(rest))
    if unknown:
        raise RobotError(f"locked names {unknown}; joints that can be locked here: {rest}")
    values = {}
    for name in rest:
        joint = model.joint_map[name]
        value = float(given[name]) if name in given else semantics.state_value(name)
        nearest = min(max(0.0 if value is None else value, joint.lower), joint.upper)
        if value is None or joint.kind != "continuous" or not math.isfinite(value):
            excess = 0.0 if value is None else abs(value - nearest)
            if not excess <= LIMIT_TOLERANCE:
                limits = f"[{joint.lower:.6g}, {joint.upper:.6g}]"
                said = f"its limits are {limits}, which it leaves by {excess:.3g}"
                raise RobotError(f"joint '{name}' is locked at {value}; {said}")
            value = nearest
        values[name] = value
    return values


def write_srdf(path: str | Path, robot: Any) -> None:
    """See :meth:`Robot.write_srdf`."""
    disabled = {
        pair: why
        for pair, why in robot.disabled_pairs.items()
        if why != RIGID and not pair & set(robot.attached)
    }
    passing = [pair for pair in disabled if robot._sampled_pairs.get(pair)]
    if passing:
        _logger.warning(
            "not written to '%s', as they were found for these values of locked joints only "
            "(%s): %s; to write them, read the robot with all joints in joints=",
            *(path, robot.locked, sorted(map(sorted, passing))),
        )
    root = ET.Element("robot", {"name": robot.name})
    of_joints = {"arm": robot.joint_names}
    named = robot.named_states.items()
    states = [("arm", name, dict(zip(robot.joint_names, q, strict=True))) for name, q in named]
    if robot.locked:
        of_joints["locked"] = tuple(robot.locked)
        states.append(("locked", "locked", robot.locked))
    groups = [(group, "joint", joints) for group, joints in of_joints.items()]
    groups += [(g, "link", links) for g, links in robot.groups.items() if g not in of_joints]
    for group, kind, members in groups:
        element = ET.SubElement(root, "group", {"name": group})
        for member in members:
            ET.SubElement(element, kind, {"name": member})
    for group, state, values in states:
        element = ET.SubElement(root, "group_state", {"name": state, "group": group})
        for joint, value in values.items():
            ET.SubElement(element, "joint", {"name": joint, "value": repr(float(value))})
    for pair in sorted(disabled.keys() - set(passing), key=sorted):
        ends = {"link1": min(pair), "link2": max(pair), "reason": disabled[pair]}
        ET.SubElement(root, "disable_collisions", ends)
    ET.indent(root)
    write_text(path, '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n")
