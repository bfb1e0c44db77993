# SPDX-License-Identifier: BSD-3-Clause
"""A URDF as a validated kinematic tree.

yourdfpy reads the elements; what it leaves unchecked (broken XML that it repairs
in silence, several roots, cycles, reversed limits, unknown parents) is checked
here, because each of these would otherwise place a link where it is not.
"""

from __future__ import annotations

import io
import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vprism_plan.errors import RobotError
from vprism_plan.robots._geometry import PrimitiveGeometry

MOVING_TYPES = ("revolute", "continuous", "prismatic")
_ALL_TYPES = (*MOVING_TYPES, "fixed", "floating", "planar")


@dataclass(frozen=True)
class Joint:
    """A joint of the tree; ``lower``/``upper`` are -pi/pi for continuous joints."""

    name: str
    kind: str
    parent: str
    child: str
    T_origin: np.ndarray
    axis: np.ndarray
    lower: float
    upper: float
    velocity: float
    mimic: tuple[str, float, float] | None = None

    @property
    def moves(self) -> bool:
        """Whether the joint has a degree of freedom (its own or a mimicked one)."""
        return self.kind in MOVING_TYPES


@dataclass(frozen=True)
class Link:
    """A link with its primitive collision shapes and the meshes that were skipped."""

    name: str
    primitives: tuple[PrimitiveGeometry, ...] = ()
    meshes: tuple[str, ...] = ()


@dataclass(frozen=True)
class RobotModel:
    """A tree of links: ``joints`` are ordered so that parents come first."""

    name: str
    root: str
    links: dict[str, Link]
    joints: tuple[Joint, ...]
    joint_map: dict[str, Joint] = field(repr=False)

    @property
    def actuated(self) -> tuple[str, ...]:
        """Names of the joints that move and do not mimic another."""
        return tuple(j.name for j in self.joints if j.moves and j.mimic is None)

    def resolve_mimic(self, name: str) -> tuple[str, float, float]:
        """Follow a chain of mimic joints to its driver.

        Returns:
            (driver, multiplier, offset): value = multiplier * driver + offset.
        """
        multiplier, offset = 1.0, 0.0
        mimic = self.joint_map[name].mimic
        while mimic is not None:
            name, factor, shift = mimic
            offset += multiplier * shift
            multiplier *= factor
            mimic = self.joint_map[name].mimic
        return name, multiplier, offset


def load_model(path: str | Path) -> RobotModel:
    """Read a URDF file.

    Args:
        path: The URDF. xacro files have to be expanded first.

    Raises:
        RobotError: The file is missing or malformed, or describes something that
            is not a tree of links joined by revolute, continuous, prismatic and
            fixed joints.
    """
    path = Path(path)
    if not path.is_file():
        raise RobotError(f"no URDF file at '{path}'; give the path of an existing .urdf file")
    import yourdfpy

    cleaned = _clean_xml(path)
    try:
        urdf = yourdfpy.URDF.load(
            io.BytesIO(cleaned), build_scene_graph=False, load_meshes=False
        ).robot
        links = [_link(element, path) for element in urdf.links]
        joints = [_joint(element, path) for element in urdf.joints]
    except RobotError:
        raise
    except (ValueError, KeyError, IndexError, AttributeError, TypeError) as error:
        raise RobotError(
            f"'{path}' is not a usable URDF: {type(error).__name__}: {error}; "
            "check the file with check_urdf"
        ) from error
    return _tree(str(urdf.name), links, joints, path)


def _clean_xml(path: Path) -> bytes:
    """Keep only what kinematics and collision need, refusing broken XML.

    Visuals, inertias, transmissions and simulator tags are dropped: they vary
    most between files and a mistake in them must not stop a planner.
    """
    try:
        root = ET.fromstring(path.read_bytes())
    except ET.ParseError as error:
        raise RobotError(f"'{path}' is not well-formed XML: {error}") from error
    if root.tag != "robot":
        raise RobotError(f"the root element of '{path}' is <{root.tag}>, a URDF has <robot>")
    if any("xacro" in element.tag for element in root.iter()):
        raise RobotError(f"'{path}' holds xacro macros; expand it first: xacro IN > OUT.urdf")
    kept = ET.Element("robot", {"name": root.get("name", path.stem)})
    for link in root.findall("link"):
        _require(link, "name", path)
        copy = ET.SubElement(kept, "link", {"name": link.attrib["name"]})
        copy.extend(link.findall("collision"))
    for joint in root.findall("joint"):
        _require(joint, "name", path)
        for part in ("parent", "child"):
            element = joint.find(part)
            if element is None or not element.get("link"):
                raise RobotError(f"joint '{joint.get('name')}' in '{path}' names no {part} link")
        kept.append(joint)
    return ET.tostring(kept)


def _require(element: ET.Element, attribute: str, path: Path) -> None:
    if not element.get(attribute):
        raise RobotError(f"a <{element.tag}> in '{path}' has no '{attribute}'")


def _link(element: Any, path: Path) -> Link:
    primitives, meshes = [], []
    for collision in element.collisions:
        T = np.eye(4) if collision.origin is None else np.array(collision.origin, dtype=np.float64)
        geometry = collision.geometry
        if geometry.mesh is not None:
            meshes.append(str(geometry.mesh.filename))
            continue
        kind: Any
        if geometry.box is not None:
            kind, size = "box", tuple(float(v) for v in geometry.box.size)
        elif geometry.cylinder is not None:
            kind, size = "cylinder", (geometry.cylinder.radius, geometry.cylinder.length)
        else:
            kind, size = "sphere", (geometry.sphere.radius,)
        expected = {"box": 3, "cylinder": 2, "sphere": 1}[kind]
        if len(size) != expected or not all(math.isfinite(v) and v > 0 for v in size):
            raise RobotError(
                f"link '{element.name}' in '{path}' has a {kind} of size {size}; "
                "sizes must be positive and finite"
            )
        if not np.isfinite(T).all():
            raise RobotError(f"link '{element.name}' in '{path}' has a non-finite <origin>")
        primitives.append(PrimitiveGeometry(kind, size, T))
    return Link(element.name, tuple(primitives), tuple(meshes))


def _joint(element: Any, path: Path) -> Joint:
    name, kind = element.name, element.type
    if kind not in _ALL_TYPES:
        raise RobotError(f"joint '{name}' in '{path}' has type {kind!r}; valid: {_ALL_TYPES}")
    if kind in ("floating", "planar"):
        raise RobotError(
            f"joint '{name}' is {kind}; supported are revolute, continuous, prismatic and "
            "fixed. Replace it by a fixed joint and place the robot with base_pose"
        )
    T = np.eye(4) if element.origin is None else np.array(element.origin, dtype=np.float64)
    if not np.isfinite(T).all():
        raise RobotError(f"joint '{name}' in '{path}' has a non-finite <origin>")
    mimic = None
    if element.mimic is not None and kind != "fixed":
        mimic = (element.mimic.joint, element.mimic.multiplier, element.mimic.offset)
        if not all(math.isfinite(v) for v in mimic[1:]):
            raise RobotError(f"joint '{name}' in '{path}' has a non-finite mimic factor: {mimic}")
    lower, upper, velocity = _limits(element, path)
    axis = _axis(element, path) if kind != "fixed" else np.array([1.0, 0.0, 0.0])
    return Joint(name, kind, element.parent, element.child, T, axis, lower, upper, velocity, mimic)


def _axis(element: Any, path: Path) -> np.ndarray:
    axis = np.asarray(element.axis, dtype=np.float64)
    norm = float(np.linalg.norm(axis)) if axis.shape == (3,) else math.nan
    if not (math.isfinite(norm) and norm > 1e-9):
        raise RobotError(
            f"joint '{element.name}' in '{path}' has axis {axis.tolist()}; "
            "an axis needs three finite numbers, not all zero"
        )
    if element.type == "prismatic" and abs(norm - 1.0) > 1e-3:
        # Tools disagree on whether the travel is scaled by the axis length.
        raise RobotError(
            f"prismatic joint '{element.name}' in '{path}' has an axis of length {norm:.6g}; "
            "write a unit axis"
        )
    return axis / norm


def _limits(element: Any, path: Path) -> tuple[float, float, float]:
    """Lower, upper and velocity limit; a velocity of 0 or none stated becomes inf."""
    limit, name = element.limit, element.name
    velocity = math.inf
    if limit is not None and limit.velocity is not None:
        if math.isnan(limit.velocity) or limit.velocity < 0:
            raise RobotError(
                f"joint '{name}' in '{path}' has velocity limit {limit.velocity}; "
                "it must be positive"
            )
        velocity = limit.velocity or math.inf
    if element.type == "continuous":
        return -math.pi, math.pi, velocity
    if element.type == "fixed":
        return 0.0, 0.0, velocity
    if limit is None or limit.lower is None or limit.upper is None:
        raise RobotError(
            f"{element.type} joint '{name}' in '{path}' has no lower and upper <limit>; "
            "state both, or make it continuous"
        )
    lower, upper = limit.lower, limit.upper
    if not (math.isfinite(lower) and math.isfinite(upper)) or lower > upper:
        raise RobotError(
            f"joint '{name}' in '{path}' has limits [{lower}, {upper}]; "
            "they must be finite with lower <= upper"
        )
    return lower, upper, velocity


def _tree(name: str, links: list[Link], joints: list[Joint], path: Path) -> RobotModel:
    """Order joints parents first, refusing anything that is not one tree."""
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
    ordered, queue = [], [roots[0]]
    while queue:
        link = queue.pop(0)
        below = [joint for joint in joints if joint.parent == link]
        ordered += below
        queue += [joint.child for joint in below]
    if len(ordered) != len(joints):
        lost = sorted(set(joint_map) - {joint.name for joint in ordered})
        raise RobotError(f"joints {lost} in '{path}' form a cycle; a URDF is a tree")
    _check_mimics(joint_map, path)
    return RobotModel(name, roots[0], link_map, tuple(ordered), joint_map)


def _refuse_duplicates(names: list[str], what: str, path: Path) -> None:
    duplicates = sorted({name for name in names if names.count(name) > 1})
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
