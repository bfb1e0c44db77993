# SPDX-License-Identifier: BSD-3-Clause
"""Links and joints as one tree, with limits that hold for joints that mimic others, too."""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import replace
from pathlib import Path

from vprism_plan.errors import RobotError
from vprism_plan.robots._model import Joint, Link, RobotModel


def build_tree(name: str, links: list[Link], joints: list[Joint], path: Path) -> RobotModel:
    """Order joints parents first, refusing anything that is not one tree.

    Raises:
        RobotError: Names are not unique or unknown, the joints do not make one tree, or a
            joint mimics what it cannot.
    """
    link_map = {link.name: link for link in links}
    joint_map = {joint.name: joint for joint in joints}
    _refuse_duplicates([link.name for link in links], "link", path)
    _refuse_duplicates([joint.name for joint in joints], "joint", path)
    if not links:
        raise RobotError(f"'{path}' has no links")
    parent_joint: dict[str, Joint] = {}
    for joint in joints:
        for link in (joint.parent, joint.child):
            if link not in link_map:
                raise RobotError(
                    f"joint '{joint.name}' in '{path}' refers to unknown link '{link}'; "
                    f"links: {sorted(link_map)}"
                )
        if joint.child in parent_joint:
            raise RobotError(
                f"link '{joint.child}' in '{path}' has two parent joints: "
                f"'{parent_joint[joint.child].name}' and '{joint.name}'; a URDF is a tree"
            )
        parent_joint[joint.child] = joint
    roots = [link.name for link in links if link.name not in parent_joint]
    if len(roots) != 1:
        what = f"several roots {roots}" if roots else "no root: its joints form a cycle"
        raise RobotError(f"'{path}' has {what}; a URDF has exactly one link without a parent")
    children: dict[str, list[Joint]] = {}
    for joint in joints:
        children.setdefault(joint.parent, []).append(joint)
    ordered: list[Joint] = []
    queue = deque([roots[0]])
    while queue:
        link = queue.popleft()
        below = children.get(link, [])
        ordered += below
        queue.extend(joint.child for joint in below)
    if len(ordered) != len(joints):
        lost = sorted(set(joint_map) - {joint.name for joint in ordered})
        raise RobotError(f"joints {lost} in '{path}' form a cycle; a URDF is a tree")
    _check_mimics(joint_map, path)
    model = RobotModel(name, roots[0], link_map, tuple(ordered), joint_map)
    narrowed = joint_map | _narrowed(model, path)
    return replace(
        model, joints=tuple(narrowed[joint.name] for joint in ordered), joint_map=narrowed
    )


def _refuse_duplicates(names: list[str], what: str, path: Path) -> None:
    duplicates = sorted(name for name, count in Counter(names).items() if count > 1)
    if duplicates:
        raise RobotError(f"{what} names {duplicates} occur more than once in '{path}'")


def _check_mimics(joint_map: dict[str, Joint], path: Path) -> None:
    for joint in joint_map.values():
        seen, current = {joint.name}, joint
        while current.mimic is not None:
            driver = current.mimic[0]
            if driver not in joint_map or not joint_map[driver].moves:
                raise RobotError(
                    f"joint '{current.name}' in '{path}' mimics '{driver}', which is no moving "
                    f"joint; valid: {[j.name for j in joint_map.values() if j.moves]}"
                )
            if driver in seen:
                raise RobotError(f"joint '{joint.name}' in '{path}' mimics itself through {seen}")
            seen.add(driver)
            current = joint_map[driver]


def _narrowed(model: RobotModel, path: Path) -> dict[str, Joint]:
    """The joints that others mimic, with limits that keep these in their own.

    A continuous joint becomes a revolute one if a limited joint follows it: where it may
    turn without end, what follows it may not. So it does, within [-pi, pi], if a continuous
    joint follows it by a factor that is no integer: that is elsewhere after a whole turn.
    """
    result: dict[str, Joint] = {}
    for joint in model.joints:
        if joint.mimic is None or joint.kind == "continuous" or not joint.moves:
            continue
        name, factor, offset = model.resolve_mimic(joint.name)
        driver = result.get(name, model.joint_map[name])
        if factor == 0.0:
            low, high = (
                (-math.inf, math.inf) if joint.lower <= offset <= joint.upper else (1.0, 0.0)
            )
        else:
            low, high = sorted((end - offset) / factor for end in (joint.lower, joint.upper))
        turns = driver.kind == "continuous"
        lower = low if turns else max(driver.lower, low)
        upper = high if turns else min(driver.upper, high)
        if lower > upper + 1e-9:
            raise RobotError(
                f"joint '{joint.name}' in '{path}' mimics '{name}' ({factor:g} * value + "
                f"{offset:g}) and stays in its limits [{joint.lower:g}, {joint.upper:g}] for no "
                f"value of '{name}' in [{driver.lower:g}, {driver.upper:g}]; correct the limits, "
                "the multiplier or the offset"
            )
        upper = max(lower, upper)
        if turns and math.isinf(lower):
            continue
        kind = "revolute" if turns else driver.kind
        result[name] = replace(driver, kind=kind, lower=lower, upper=upper)
    for joint in model.joints:
        if joint.mimic is None or joint.kind != "continuous":
            continue
        name, factor, _ = model.resolve_mimic(joint.name)
        driver = result.get(name, model.joint_map[name])
        if driver.kind == "continuous" and abs(factor - round(factor)) > 1e-9:
            result[name] = replace(driver, kind="revolute")
    return result
