# SPDX-License-Identifier: BSD-3-Clause
"""Collision spheres of links: read from a file, or tiled over primitives."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from vprism_plan.errors import RobotError
from vprism_plan.robots._geometry import PrimitiveGeometry
from vprism_plan.robots._model import RobotModel

# Cells of at most this edge keep the tiles' protrusion under 2.2 cm.
_TILE_EDGE = 0.06
_MAX_TILES = 64

LinkSpheres = dict[str, np.ndarray]
"""Link name -> (n, 4) rows (x, y, z, radius) in the link's frame, metres."""


def link_spheres(
    model: RobotModel, urdf_path: Path, spheres: str | Path | Mapping[str, Any] | None
) -> LinkSpheres:
    """Choose and validate the collision spheres of a robot.

    Args:
        model: The robot.
        urdf_path: Where it was read from; ``<stem>_spheres.yml`` beside it is used
            when ``spheres`` is None.
        spheres: A YAML file, a mapping ``{link: [{center, radius}, ...]}``, or None:
            the file beside the URDF, else the URDF's own shapes (spheres as they
            are, boxes and cylinders enclosed by tiles).

    Raises:
        RobotError: A sphere is malformed, names an unknown link, or a link with
            collision geometry would be left without any.
    """
    if spheres is None:
        beside = urdf_path.with_name(f"{urdf_path.stem}_spheres.yml")
        spheres = beside if beside.is_file() else None
    if spheres is None:
        return _from_geometry(model)
    if isinstance(spheres, str | Path):
        source = f"'{spheres}'"
        table = _read_yaml(Path(spheres))
    else:
        source, table = "spheres", spheres
    parsed: LinkSpheres = {}
    for link, entries in table.items():
        if link not in model.links:
            raise RobotError(
                f"{source} gives spheres for the unknown link '{link}'; links: {list(model.links)}"
            )
        parsed[link] = _rows(link, entries, source)
    bare = [
        name
        for name, link in model.links.items()
        if name not in parsed and (link.primitives or link.meshes)
    ]
    if bare:
        raise RobotError(
            f"{source} gives no spheres for the links {bare}, which have collision geometry and "
            "would go unchecked; add spheres, or an empty list to leave a link out on purpose"
        )
    return {name: parsed[name] for name in model.links if len(parsed.get(name, ()))}


def _read_yaml(path: Path) -> Mapping[str, Any]:
    import yaml  # type: ignore[import-untyped]

    if not path.is_file():
        raise RobotError(f"no sphere file at '{path}'; give an existing YAML file")
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise RobotError(f"'{path}' is not valid YAML: {error}") from error
    for key in ("robot_cfg", "kinematics", "collision_spheres"):
        if isinstance(content, Mapping) and key in content:
            content = content[key]
    if not isinstance(content, Mapping):
        raise RobotError(
            f"'{path}' holds no sphere table; expected 'collision_spheres: "
            "{link: [{center: [x, y, z], radius: r}, ...]}'"
        )
    return content


def _rows(link: str, entries: Any, source: str) -> Float[np.ndarray, "n 4"]:
    if entries is None:
        entries = []
    if isinstance(entries, str | Mapping) or not isinstance(entries, Sequence):
        raise RobotError(f"{source}: the spheres of '{link}' are {entries!r}; expected a list")
    rows = np.empty((len(entries), 4))
    for row, entry in zip(rows, entries, strict=True):
        try:
            row[:3] = entry["center"]
            row[3] = entry["radius"]
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise RobotError(
                f"{source}: a sphere of '{link}' is {entry!r}; expected "
                "{center: [x, y, z], radius: r} in metres"
            ) from error
        if not np.isfinite(row).all() or row[3] <= 0:
            raise RobotError(
                f"{source}: a sphere of '{link}' is {entry!r}; centre and radius must be finite "
                "and the radius positive"
            )
    return rows


def _from_geometry(model: RobotModel) -> LinkSpheres:
    result: LinkSpheres = {}
    for name, link in model.links.items():
        if link.meshes:
            raise RobotError(
                f"link '{name}' has the mesh '{link.meshes[0]}' as collision geometry and no "
                "spheres are given; pass spheres= (a YAML file or {link: [{center, radius}]}), "
                "or use boxes, cylinders and spheres in the URDF"
            )
        if link.primitives:
            result[name] = np.vstack([enclosing_spheres(solid) for solid in link.primitives])
    if not result:
        raise RobotError(
            "the robot has no collision geometry; pass spheres={link: [{center, radius}]}"
        )
    return result


def enclosing_spheres(solid: PrimitiveGeometry) -> Float[np.ndarray, "n 4"]:
    """Spheres whose union holds a solid.

    The solid is cut into box cells (cylinders: into the cells of their bounding
    box that reach the disc); each cell gets the ball through its corners, which
    holds the cell, so the union holds the solid.

    Args:
        solid: A box, cylinder or sphere.

    Returns:
        (n, 4) rows (x, y, z, radius) in the link's frame, metres.
    """
    if solid.kind == "sphere":
        return np.array([[*solid.T_link[:3, 3], solid.size[0]]])
    if solid.kind == "cylinder" and solid.size[0] <= _TILE_EDGE:
        local = _slender_cylinder(*solid.size)
    else:
        radius = solid.size[0]
        edges = solid.size if solid.kind == "box" else (2 * radius, 2 * radius, solid.size[1])
        local = _tile_box(np.asarray(edges))
        if solid.kind == "cylinder":
            half = 0.5 * np.asarray(edges[:2]) / _cell_counts(np.asarray(edges))[:2]
            nearest = np.maximum(np.abs(local[:, :2]) - half, 0.0)
            local = local[np.linalg.norm(nearest, axis=1) <= radius]
    local[:, :3] = local[:, :3] @ solid.T_link[:3, :3].T + solid.T_link[:3, 3]
    # Rounding in the transform must not open a gap at the corners.
    local[:, 3] *= 1.0 + 1e-9
    return local


def _slender_cylinder(radius: float, length: float) -> Float[np.ndarray, "n 4"]:
    """One row of spheres along the axis; each holds its slice of the cylinder."""
    n = min(_MAX_TILES, max(1, math.ceil(length / max(radius, 0.5 * _TILE_EDGE))))
    step = length / n
    rows = np.zeros((n, 4))
    rows[:, 2] = (np.arange(n) + 0.5) * step - 0.5 * length
    rows[:, 3] = math.hypot(radius, 0.5 * step)
    return rows


def _cell_counts(edges: Float[np.ndarray, "3"]) -> np.ndarray:
    edge = min(_TILE_EDGE, float(edges.min()))
    counts = np.ceil(edges / edge).astype(int)
    while counts.prod() > _MAX_TILES:
        edge *= 1.1
        counts = np.ceil(edges / edge).astype(int)
    return counts


def _tile_box(edges: Float[np.ndarray, "3"]) -> Float[np.ndarray, "n 4"]:
    counts = _cell_counts(edges)
    cell = edges / counts
    axes = [(np.arange(n) + 0.5) * c - 0.5 * e for n, c, e in zip(counts, cell, edges, strict=True)]
    centers = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.column_stack([centers, np.full(len(centers), 0.5 * np.linalg.norm(cell))])
