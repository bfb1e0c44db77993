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

# Pieces of about this size protrude by about half of it.
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

    A box is cut into box cells, a cylinder into slices of rings of sectors; each
    piece gets a ball through its corners. Over a piece the distance to the ball's
    centre is largest at a corner, so each ball holds its piece and the union holds
    the solid.

    Args:
        solid: A box, cylinder or sphere.

    Returns:
        (n, 4) rows (x, y, z, radius) in the link's frame, metres.
    """
    if solid.kind == "sphere":
        return np.array([[*solid.T_link[:3, 3], solid.size[0] + solid.padding]])
    local = _tile_cylinder(*solid.size) if solid.kind == "cylinder" else _tile_box(solid.size)
    local[:, :3] = local[:, :3] @ solid.T_link[:3, :3].T + solid.T_link[:3, 3]
    # Rounding in the transform must not open a gap at the corners.
    local[:, 3] = local[:, 3] * (1.0 + 1e-9) + solid.padding
    return local


def _tile_cylinder(radius: float, length: float) -> Float[np.ndarray, "n 4"]:
    """A ball on the axis and rings of balls around it, repeated along the axis."""
    edge = _TILE_EDGE
    while True:
        rings = math.ceil(radius / edge)
        # A slender cylinder gains nothing from slices much thinner than it is wide.
        slices = math.ceil(length / max(0.5 * edge, min(edge, radius)))
        disc = _tile_disc(radius, rings, edge)
        if len(disc) * slices <= _MAX_TILES or len(disc) == slices == 1:
            break
        edge *= 1.1
    step = length / slices
    heights = (np.arange(slices) + 0.5) * step - 0.5 * length
    rows = np.empty((slices, len(disc), 4))
    rows[..., :2] = disc[:, :2]
    rows[..., 2] = heights[:, None]
    rows[..., 3] = np.hypot(disc[:, 2], 0.5 * step)
    return rows.reshape(-1, 4)


def _tile_disc(radius: float, rings: int, edge: float) -> Float[np.ndarray, "n 3"]:
    """Circles (x, y, radius) whose union holds a disc."""
    width = radius / rings
    circles = [np.array([[0.0, 0.0, width]])]
    for ring in range(1, rings):
        inner, outer = ring * width, (ring + 1) * width
        n = max(4, math.ceil(2 * math.pi * outer / edge))
        half = math.pi / n
        # Equally far from the sector's inner and outer corners.
        middle = (inner + outer) / (2 * math.cos(half))
        reach = math.hypot(outer * math.cos(half) - middle, outer * math.sin(half))
        turn = 2 * math.pi * np.arange(n) / n
        circles.append(
            np.column_stack([middle * np.cos(turn), middle * np.sin(turn), np.full(n, reach)])
        )
    return np.vstack(circles)


def _tile_box(size: Sequence[float]) -> Float[np.ndarray, "n 4"]:
    edges = np.asarray(size)
    edge = min(_TILE_EDGE, float(edges.min()))
    counts = np.ceil(edges / edge).astype(int)
    while counts.prod() > _MAX_TILES:
        edge *= 1.1
        counts = np.ceil(edges / edge).astype(int)
    cell = edges / counts
    axes = [(np.arange(n) + 0.5) * c - 0.5 * e for n, c, e in zip(counts, cell, edges, strict=True)]
    centers = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.column_stack([centers, np.full(len(centers), 0.5 * np.linalg.norm(cell))])
