# SPDX-License-Identifier: BSD-3-Clause
"""A URDF file as a validated kinematic tree.

yourdfpy reads the elements; what it leaves unchecked (broken XML that it repairs
in silence, several roots, cycles, reversed limits, unknown parents) is checked
here, because each of these would otherwise place a link where it is not.
"""

from __future__ import annotations

import io
import math
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np

from vprism_plan._files import reading
from vprism_plan.errors import RobotError
from vprism_plan.robots._geometry import PrimitiveGeometry
from vprism_plan.robots._mesh_files import MeshFile, PackageDirs, find_mesh
from vprism_plan.robots._model import MOVING_TYPES, Joint, Link, RobotModel
from vprism_plan.robots._tree import build_tree
from vprism_plan.robots._xml import robot_element

_FARTHEST_LIMIT = 1e4  # radians or metres; SDF writes 1e16 for "none"
_SMALLEST, _LARGEST = 1e-6, 1e3  # metres of a solid, which is cut into tiles
# Tables of a robot grow with the square of its links; PR2 has 90.
_MOST_LINKS = 1000
_ALL_TYPES = (*MOVING_TYPES, "fixed", "floating", "planar")


def load_model(path: str | Path, package_dirs: PackageDirs = None) -> RobotModel:
    """Read a URDF file.

    Args:
        path: The URDF. xacro files have to be expanded first.
        package_dirs: Where ``package://`` leads to; see :func:`find_mesh`.

    Raises:
        RobotError: The file is missing or malformed, or describes something that
            is not a tree of links joined by revolute, continuous, prismatic and
            fixed joints.
    """
    path = Path(path)
    if not path.is_file():
        raise RobotError(f"no URDF file at '{path}'; give the path of an existing .urdf file")
    import yourdfpy

    with reading(path, "a usable URDF (check_urdf may say more)", RobotError):
        cleaned = _clean_xml(path)
        urdf = yourdfpy.URDF.load(
            io.BytesIO(cleaned), build_scene_graph=False, load_meshes=False
        ).robot
        links = [_link(element, path, package_dirs) for element in urdf.links]
        joints = [_joint(element, path) for element in urdf.joints]
        return build_tree(str(urdf.name), links, joints, path)


def _clean_xml(path: Path) -> bytes:
    """Keep only what kinematics and collision need, refusing broken XML.

    Visuals, inertias, transmissions and simulator tags are dropped: they vary
    most between files and a mistake in them must not stop a planner.
    """
    root = robot_element(path, "a URDF")
    if any("xacro" in element.tag for element in root.iter()):
        raise RobotError(f"'{path}' holds xacro macros; expand it first: xacro IN > OUT.urdf")
    count = len(root.findall("link"))
    if count > _MOST_LINKS:
        raise RobotError(f"'{path}' has {count:,} links; at most {_MOST_LINKS:,} are read")
    kept = ET.Element("robot", {"name": root.get("name", path.stem)})
    for link in root.findall("link"):
        _require(link, "name", path)
        copy = ET.SubElement(kept, "link", {"name": link.attrib["name"]})
        copy.extend(link.findall("collision"))
        for origin in copy.iterfind("collision/origin"):
            _check_origin(origin, f"link '{link.get('name')}'", path)
    for joint in root.findall("joint"):
        _require(joint, "name", path)
        for part in ("parent", "child"):
            element = joint.find(part)
            if element is None or not element.get("link"):
                raise RobotError(f"joint '{joint.get('name')}' in '{path}' names no {part} link")
        for origin in joint.iterfind("origin"):
            _check_origin(origin, f"joint '{joint.get('name')}'", path)
        kept.append(joint)
    return ET.tostring(kept)


def _check_origin(origin: ET.Element, whose: str, path: Path) -> None:
    """Refuse what yourdfpy takes: one number for all three, and more than three."""
    for key in ("xyz", "rpy"):
        text = origin.get(key, "0 0 0")
        try:
            values = [float(word) for word in text.split()]
        except ValueError:
            values = []
        if len(values) != 3 or not all(map(math.isfinite, values)):
            raise RobotError(
                f"{whose} in '{path}' has an <origin> with {key}={text!r}; write finite numbers, "
                "three of them"
            )


def _require(element: ET.Element, attribute: str, path: Path) -> None:
    if not element.get(attribute):
        raise RobotError(f"a <{element.tag}> in '{path}' has no '{attribute}'")


def _link(element: Any, path: Path, package_dirs: PackageDirs) -> Link:
    primitives, meshes = [], []
    for collision in element.collisions:
        T = np.eye(4) if collision.origin is None else np.array(collision.origin, dtype=np.float64)
        if collision.geometry.mesh is not None:
            meshes.append(_mesh(element.name, collision.geometry.mesh, T, path, package_dirs))
        else:
            primitives.append(_primitive(element.name, collision.geometry, T, path))
    return Link(element.name, tuple(primitives), tuple(meshes))


def _mesh(link: str, mesh: Any, T: np.ndarray, path: Path, package_dirs: PackageDirs) -> MeshFile:
    if not mesh.filename:
        raise RobotError(f"link '{link}' in '{path}' has a <mesh> without a filename; name a file")
    scale = np.ones(3) if mesh.scale is None else np.asarray(mesh.scale, dtype=np.float64)
    scale = np.full(3, float(scale)) if scale.shape in ((), (1,)) else scale
    if scale.shape != (3,) or not np.isfinite(scale).all() or (scale == 0.0).any():
        raise RobotError(
            f"link '{link}' in '{path}' has a mesh with scale {scale.tolist()}; write three finite "
            "numbers other than 0"
        )
    found, searched = find_mesh(str(mesh.filename), path, package_dirs)
    return MeshFile(link, str(mesh.filename), scale, T, found, tuple(searched))


def _primitive(link: str, geometry: Any, T: np.ndarray, path: Path) -> PrimitiveGeometry:
    kind: Any
    if geometry.box is not None:
        kind, size = "box", tuple(float(v) for v in geometry.box.size)
    elif geometry.cylinder is not None:
        kind, size = "cylinder", (geometry.cylinder.radius, geometry.cylinder.length)
    else:
        kind, size = "sphere", (geometry.sphere.radius,)
    expected = {"box": 3, "cylinder": 2, "sphere": 1}[kind]
    if len(size) != expected or not all(_SMALLEST <= v <= _LARGEST for v in size):
        raise RobotError(
            f"link '{link}' in '{path}' has a {kind} of size {size}; "
            f"sizes must be positive and finite, from {_SMALLEST:g} to {_LARGEST:g} m"
        )
    return PrimitiveGeometry(kind, size, T)


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
    """Lower, upper and velocity limit; a velocity of 0 or none stated becomes inf.

    Soft limits of a <safety_controller> narrow the range, as MoveIt has it: beyond them a
    controller pushes back. Continuous joints have none.
    """
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
    if max(abs(lower), abs(upper)) > _FARTHEST_LIMIT:
        raise RobotError(
            f"joint '{name}' in '{path}' has limits [{lower:g}, {upper:g}], beyond "
            f"{_FARTHEST_LIMIT:g}; no search covers that: make it continuous, or state real limits"
        )
    soft = element.safety_controller
    low = getattr(soft, "soft_lower_limit", None)
    high = getattr(soft, "soft_upper_limit", None)
    low, high = (lower if low is None else low), (upper if high is None else high)
    lower, upper = max(lower, low), min(upper, high)
    if not (math.isfinite(low) and math.isfinite(high) and lower <= upper):
        raise RobotError(
            f"joint '{name}' in '{path}' has a <safety_controller> whose soft limits "
            f"[{low:g}, {high:g}] leave nothing of its range; correct them, or take it out"
        )
    return lower, upper, velocity
