# SPDX-License-Identifier: BSD-3-Clause
"""A URDF file as a validated tree of links and joints."""

from __future__ import annotations

import functools
import math
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vprism_plan._files import reading
from vprism_plan.errors import RobotError
from vprism_plan.robots.geometry import MeshFile, PackageDirs, PrimitiveGeometry, find_mesh
from vprism_plan.robots.plain_xml import MOST_BYTES, robot_element

MOVING_TYPES = ("revolute", "continuous", "prismatic")
# Radians or metres beyond a limit that count as on it: encoders and copies in single precision.
LIMIT_TOLERANCE = 1e-5


@dataclass(frozen=True)
class Joint:
    """A joint of the tree; limits are narrowed by mimicking ones, and -pi, pi where continuous."""

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
    """A link with its collision geometry: primitives, and meshes that are not read yet."""

    name: str
    primitives: tuple[PrimitiveGeometry, ...] = ()
    meshes: tuple[MeshFile, ...] = ()
    seen: bool = False  # it has a <visual>


@dataclass(frozen=True)
class RobotModel:
    """A tree of links: ``joints`` are ordered so that parents come first."""

    name: str
    root: str
    links: dict[str, Link]
    joints: tuple[Joint, ...]

    @functools.cached_property
    def joint_map(self) -> dict[str, Joint]:
        """The joints by name."""
        return {joint.name: joint for joint in self.joints}

    @functools.cached_property
    def joint_above(self) -> dict[str, Joint]:
        """The joint that each link but the root hangs on."""
        return {joint.child: joint for joint in self.joints}

    def above(self, link: str) -> list[str]:
        """The links from one up to the root, itself first."""
        links = [link]
        while links[-1] in self.joint_above:
            links.append(self.joint_above[links[-1]].parent)
        return links

    @property
    def actuated(self) -> tuple[str, ...]:
        """Names of the joints that move and do not mimic another."""
        return tuple(j.name for j in self.joints if j.moves and j.mimic is None)

    @property
    def movable(self) -> tuple[str, ...]:
        """Those of them with any room between their limits; the others are locked."""
        joints = self.joint_map
        return tuple(n for n in self.actuated if joints[n].lower < joints[n].upper)

    @functools.cached_property
    def moved(self) -> frozenset[str]:
        """Names of the links with a joint that moves, locked or not, between them and the root."""
        found: set[str] = set()
        for joint in self.joints:
            if joint.moves or joint.parent in found:
                found.add(joint.child)
        return frozenset(found)

    def resolve_mimic(self, name: str) -> tuple[str, float, float]:
        """Follow mimic joints to (driver, multiplier, offset): multiplier * driver + offset."""
        multiplier, offset = 1.0, 0.0
        mimic = self.joint_map[name].mimic
        while mimic is not None:
            name, factor, shift = mimic
            offset += multiplier * shift
            multiplier *= factor
            mimic = self.joint_map[name].mimic
        return name, multiplier, offset


_FARTHEST_LIMIT = 1e4  # radians or metres; SDF writes 1e16 for "none"
_SMALLEST, _LARGEST = 1e-6, 1e3  # metres of a solid, which is cut into tiles
_MOST_LINKS = 1000  # tables of a robot grow with the square of its links; PR2 has 90
_TO_THE_WORLD = ("floating", "planar")
_ALL_TYPES = (*MOVING_TYPES, "fixed", *_TO_THE_WORLD)
# Of each solid, the attributes of its size, and how many numbers these hold.
_SIZES = {
    "box": (("size",), 3),
    "cylinder": (("radius", "length"), 2),
    "capsule": (("radius", "length"), 2),
    "sphere": (("radius",), 1),
}


def load_model(path: str | Path, package_dirs: PackageDirs = None) -> RobotModel:
    """Read a URDF file; mistakes in what neither kinematics nor collision needs are passed over.

    Raises:
        RobotError: The file is missing or malformed, or describes something that is not a tree
            of links joined by revolute, continuous, prismatic and fixed joints (floating and
            planar ones may join the root to the world).
    """
    path = Path(path)
    if not path.is_file():
        raise RobotError(f"no URDF file at '{path}'; give the path of an existing .urdf file")
    with reading(path, "a usable URDF (check_urdf may say more)", RobotError, MOST_BYTES):
        root = robot_element(path, "a URDF")
        if any("xacro" in element.tag for element in root.iter()):
            raise RobotError(f"'{path}' holds xacro macros; expand it first: xacro IN > OUT.urdf")
        links = root.findall("link")
        if len(links) > _MOST_LINKS:
            raise RobotError(f"'{path}' has {len(links):,} links; at most {_MOST_LINKS:,} are read")
        return build_tree(
            root.get("name", path.stem),
            [_named(_link, element, path, path, package_dirs) for element in links],
            [_named(_joint, element, path) for element in root.findall("joint")],
            path,
        )


def _named(read: Callable[..., Any], element: ET.Element, path: Path, *others: Any) -> Any:
    """Read a link or a joint; what is wrong in it is said with its name."""
    name = element.get("name")
    if not name:
        raise RobotError(f"a <{element.tag}> in '{path}' has no 'name'")
    whose = f"{element.tag} '{name}' in '{path}'"
    try:
        return read(element, name, whose, *others)
    except (KeyError, ValueError, TypeError) as error:
        what = f"no {error}" if isinstance(error, KeyError) else str(error)
        raise RobotError(f"{whose}: {what}") from error


def _numbers(text: str) -> list[float]:
    return [float(word) for word in text.replace(",", " ").split()]


def _number(element: ET.Element | None, key: str) -> float | None:
    text = None if element is None else element.get(key)
    return None if text is None else float(text)


def _origin(owner: ET.Element, whose: str) -> np.ndarray:
    """Where an <origin> puts its owner, (4, 4)."""
    import trimesh.transformations

    element = owner.find("origin")
    if element is None:
        return np.eye(4)
    parts = {}
    for key in ("xyz", "rpy"):
        text = element.get(key, "0 0 0")
        try:
            parts[key] = [float(word) for word in text.split()]
        except ValueError:
            parts[key] = []
        if len(parts[key]) != 3 or not all(map(math.isfinite, parts[key])):
            wanted = "write finite numbers, three of them"
            raise RobotError(f"{whose} has an <origin> with {key}={text!r}; {wanted}")
    T = trimesh.transformations.compose_matrix(translate=parts["xyz"], angles=parts["rpy"])
    return np.array(T, dtype=np.float64)


def _link(
    element: ET.Element, name: str, whose: str, path: Path, package_dirs: PackageDirs
) -> Link:
    primitives, meshes = [], []
    for collision in element.findall("collision"):
        T = _origin(collision, whose)
        shape = collision.find("geometry/*")
        if shape is None:
            raise RobotError(f"{whose} has a <collision> without a shape")
        if shape.tag != "mesh":
            primitives += _primitives(shape, T, whose)
            continue
        filename = shape.get("filename")
        if not filename:
            raise RobotError(f"{whose} has a <mesh> without a filename; name a file")
        found, searched = find_mesh(filename, path, package_dirs)
        meshes.append(MeshFile(name, filename, _scale(shape, whose), T, found, tuple(searched)))
    return Link(name, tuple(primitives), tuple(meshes), element.find("visual") is not None)


def _scale(mesh: ET.Element, whose: str) -> np.ndarray:
    scale = np.array(_numbers(mesh.get("scale", "")) or [1.0])
    scale = np.full(3, scale[0]) if len(scale) == 1 else scale
    if scale.shape != (3,) or not np.isfinite(scale).all() or (scale == 0.0).any():
        wanted = "write three finite numbers other than 0"
        raise RobotError(f"{whose} has a mesh with scale {scale.tolist()}; {wanted}")
    return scale


def _primitives(shape: ET.Element, T: np.ndarray, whose: str) -> list[PrimitiveGeometry]:
    """A shape as solids: a capsule is a cylinder, of its length, between two spheres."""
    kind: Any = shape.tag
    if kind not in _SIZES:
        raise RobotError(f"{whose} has a collision shape <{kind}>; read are {[*_SIZES, 'mesh']}")
    keys, expected = _SIZES[kind]
    size = tuple(_numbers(" ".join(shape.attrib[key] for key in keys)))
    if len(size) != expected or not all(_SMALLEST <= v <= _LARGEST for v in size):
        valid = f"sizes must be positive and finite, from {_SMALLEST:g} to {_LARGEST:g} m"
        raise RobotError(f"{whose} has a {kind} of size {size}; {valid}")
    if kind != "capsule":
        return [PrimitiveGeometry(kind, size, T)]
    ends = []
    for side in (-0.5, 0.5):
        at = T.copy()
        at[:3, 3] += side * size[1] * T[:3, 2]
        ends.append(PrimitiveGeometry("sphere", size[:1], at))
    return [PrimitiveGeometry("cylinder", size, T), *ends]


def _joint(element: ET.Element, name: str, whose: str) -> Joint:
    kind, ends = element.get("type", ""), {}
    for part in ("parent", "child"):
        end = element.find(part)
        ends[part] = "" if end is None else end.get("link", "")
        if not ends[part]:
            raise RobotError(f"{whose} names no {part} link")
    if kind not in _ALL_TYPES:
        raise RobotError(f"{whose} has type {kind!r}; valid: {_ALL_TYPES}")
    T = _origin(element, whose)
    mimic, copied = None, element.find("mimic")
    if copied is not None and kind in MOVING_TYPES:
        factors = float(copied.get("multiplier", 1.0)), float(copied.get("offset", 0.0))
        mimic = (copied.get("joint", ""), *factors)
        if not all(map(math.isfinite, factors)):
            raise RobotError(f"{whose} has a non-finite mimic factor: {mimic}")
    lower, upper, velocity = _limits(element, whose, kind)
    axis = _axis(element, whose, kind) if kind in MOVING_TYPES else np.array([1.0, 0.0, 0.0])
    return Joint(name, kind, ends["parent"], ends["child"], T, axis, lower, upper, velocity, mimic)


def _axis(joint: ET.Element, whose: str, kind: str) -> np.ndarray:
    element = joint.find("axis")
    text = "1 0 0" if element is None else element.get("xyz", "1 0 0")
    axis = np.array([float(word) for word in text.split()])
    norm = float(np.linalg.norm(axis)) if axis.shape == (3,) else math.nan
    if not (math.isfinite(norm) and norm > 1e-9):
        wanted = "an axis needs three finite numbers, not all zero"
        raise RobotError(f"{whose} has axis {axis.tolist()}; {wanted}")
    # Tools disagree on whether the travel is scaled by the axis length.
    if kind == "prismatic" and abs(norm - 1.0) > 1e-3:
        raise RobotError(f"prismatic {whose} has an axis of length {norm:.6g}; write a unit axis")
    return axis / norm


def _limits(joint: ET.Element, whose: str, kind: str) -> tuple[float, float, float]:
    """Lower, upper and velocity limit (none or 0: inf); soft limits narrow it, as in MoveIt."""
    limit, soft = joint.find("limit"), joint.find("safety_controller")
    velocity = _number(limit, "velocity") or math.inf
    if not velocity >= 0.0:
        raise RobotError(f"{whose} has velocity limit {velocity}; it must be positive")
    if kind == "continuous":
        return -math.pi, math.pi, velocity
    if kind not in MOVING_TYPES:
        return 0.0, 0.0, velocity
    lower, upper = _number(limit, "lower"), _number(limit, "upper")
    if lower is None and upper is None and joint.find("mimic") is not None:
        return -math.inf, math.inf, velocity  # the joint that it follows has some
    if lower is None or upper is None:
        remedy = "state both, or make it continuous"
        raise RobotError(f"{kind} {whose} has no lower and upper <limit>; {remedy}")
    if not (math.isfinite(lower) and math.isfinite(upper)) or lower > upper:
        wanted = "they must be finite with lower <= upper"
        raise RobotError(f"{whose} has limits [{lower}, {upper}]; {wanted}")
    if max(abs(lower), abs(upper)) > _FARTHEST_LIMIT:
        raise RobotError(
            f"{whose} has limits [{lower:g}, {upper:g}], beyond {_FARTHEST_LIMIT:g}; no search "
            "covers that: make it continuous, or state real limits"
        )
    low, high = _number(soft, "soft_lower_limit"), _number(soft, "soft_upper_limit")
    low, high = (lower if low is None else low), (upper if high is None else high)
    lower, upper = max(lower, low), min(upper, high)
    if not (math.isfinite(low) and math.isfinite(high) and lower <= upper):
        raise RobotError(
            f"{whose} has a <safety_controller> whose soft limits [{low:g}, {high:g}] leave "
            "nothing of its range; correct them, or take it out"
        )
    return lower, upper, velocity


def build_tree(name: str, links: list[Link], joints: list[Joint], path: Path) -> RobotModel:
    """Order joints parents first, refusing anything that is not one tree."""
    link_map = {link.name: link for link in links}
    for what, named in (("link", links), ("joint", joints)):
        counts = Counter(item.name for item in named)
        duplicates = sorted(name for name, count in counts.items() if count > 1)
        if duplicates:
            raise RobotError(f"{what} names {duplicates} occur more than once in '{path}'")
    if not links:
        raise RobotError(f"'{path}' has no links")
    parent_joint: dict[str, Joint] = {}
    for joint in joints:
        for link in (joint.parent, joint.child):
            if link not in link_map:
                found = f"joint '{joint.name}' in '{path}' refers to unknown link '{link}'"
                raise RobotError(f"{found}; links: {sorted(link_map)}")
        if joint.child in parent_joint:
            both = f"'{parent_joint[joint.child].name}' and '{joint.name}'"
            found = f"link '{joint.child}' in '{path}' has two parent joints: {both}"
            raise RobotError(f"{found}; a URDF is a tree")
        parent_joint[joint.child] = joint
    roots = [link.name for link in links if link.name not in parent_joint]
    if len(roots) != 1:
        what = f"several roots {roots}" if roots else "no root: its joints form a cycle"
        raise RobotError(f"'{path}' has {what}; a URDF has exactly one link without a parent")
    # Parents first: what hangs below each link, link by link.
    ordered: list[Joint] = []
    queue = list(roots)
    for link in queue:
        below = [joint for joint in joints if joint.parent == link]
        ordered += below
        queue += [joint.child for joint in below]
    if len(ordered) != len(joints):
        lost = sorted({joint.name for joint in joints} - {joint.name for joint in ordered})
        raise RobotError(f"joints {lost} in '{path}' form a cycle; a URDF is a tree")
    model = RobotModel(name, roots[0], link_map, tuple(ordered))
    hanging = [j.name for j in ordered if j.kind in _TO_THE_WORLD and j.parent in model.moved]
    if hanging:
        wanted = "only what stands still may be joined to the world so: make them fixed"
        raise RobotError(f"joints {hanging} in '{path}' are floating or planar; {wanted}")
    _check_mimics(model, path)
    narrowed = _narrowed(model, path)
    return replace(model, joints=tuple(narrowed.get(joint.name, joint) for joint in ordered))


def _check_mimics(model: RobotModel, path: Path) -> None:
    for joint in model.joints:
        seen, current = {joint.name}, joint
        while current.mimic is not None:
            driver = current.mimic[0]
            if driver not in model.joint_map or not model.joint_map[driver].moves:
                found = f"joint '{current.name}' in '{path}' mimics '{driver}'"
                valid = [j.name for j in model.joints if j.moves]
                raise RobotError(f"{found}, which is no moving joint; valid: {valid}")
            if driver in seen:
                raise RobotError(f"joint '{joint.name}' in '{path}' mimics itself through {seen}")
            seen.add(driver)
            current = model.joint_map[driver]


def _narrowed(model: RobotModel, path: Path) -> dict[str, Joint]:
    """The joints that others mimic, with limits that keep these in their own.

    A continuous joint becomes a revolute one if a limited joint follows it, or a continuous one
    by a factor that is no integer: that is elsewhere after a whole turn.
    """
    result: dict[str, Joint] = {}
    followers = [joint for joint in model.joints if joint.moves and joint.mimic is not None]
    for joint in sorted(followers, key=lambda joint: joint.kind == "continuous"):
        name, factor, offset = model.resolve_mimic(joint.name)
        driver = result.get(name, model.joint_map[name])
        turns = driver.kind == "continuous"
        if joint.kind == "continuous":
            if turns and abs(factor - round(factor)) > 1e-9:
                result[name] = replace(driver, kind="revolute")
            continue
        if factor == 0.0:
            within = joint.lower <= offset <= joint.upper
            low, high = (-math.inf, math.inf) if within else (1.0, 0.0)
        else:
            low, high = sorted((end - offset) / factor for end in (joint.lower, joint.upper))
        lower = low if turns else max(driver.lower, low)
        upper = high if turns else min(driver.upper, high)
        if lower > upper + 1e-9:
            raise RobotError(
                f"joint '{joint.name}' in '{path}' mimics '{name}' ({factor:g} * value + "
                f"{offset:g}) and stays in its limits [{joint.lower:g}, {joint.upper:g}] for no "
                f"value of '{name}' in [{driver.lower:g}, {driver.upper:g}]; correct the limits, "
                "the multiplier or the offset"
            )
        if not (turns and math.isinf(lower)):
            kind = "revolute" if turns else driver.kind
            result[name] = replace(driver, kind=kind, lower=lower, upper=max(lower, upper))
    return result
