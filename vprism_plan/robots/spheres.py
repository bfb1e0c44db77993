# SPDX-License-Identifier: BSD-3-Clause
"""Collision spheres of links: from a file, of the URDF itself, or made to hold its geometry."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from vprism_plan.errors import RobotError
from vprism_plan.robots.geometry import Points, PrimitiveGeometry, Spheres
from vprism_plan.robots.sphere_files import LinkSpheres, read_spheres
from vprism_plan.robots.sphere_fit import SphereFit, fit_spheres
from vprism_plan.robots.surfaces import link_triangles
from vprism_plan.robots.urdf import RobotModel

# Pieces of about this size protrude by about half of it.
_TILE_EDGE = 0.06
_MAX_TILES = 64

# So many tiles are taken as they are; what needs more is fitted, which needs fewer.
_FEW_TILES = 12
_logger = logging.getLogger(__name__)
FIT = "fit"


@dataclass(frozen=True)
class ChosenSpheres:
    """The spheres of a robot's links, and where they are from.

    Attributes:
        rows: Link -> (n, 4) rows (x, y, z, radius), link frame, metres; never empty.
        sources: Link -> "file", "urdf" (spheres of its own), "tiled" (over its boxes and
            cylinders) or "fitted".
        padding: Link -> metres by which a foreign file wants them to grow.
    """

    rows: LinkSpheres
    sources: dict[str, str]
    padding: dict[str, float] = field(default_factory=dict)


def link_spheres(
    model: RobotModel,
    urdf_path: Path,
    spheres: str | Path | Mapping[str, Any] | None,
    fit: SphereFit,
) -> ChosenSpheres:
    """Choose and validate the collision spheres of a robot.

    The arguments are those of :meth:`Robot.from_urdf`.

    Raises:
        RobotError: A sphere is malformed, names an unknown link, or a link with
            collision geometry would be left without any.
    """
    named = set(fit.max_spheres) if isinstance(fit.max_spheres, Mapping) else set()
    if named - model.links.keys():
        raise RobotError(
            f"max_spheres names the links {sorted(named - model.links.keys())}, which the robot "
            f"does not have; links: {list(model.links)}"
        )
    if spheres is None:
        beside = urdf_path.with_name(f"{urdf_path.stem}_spheres.yml")
        spheres = beside if beside.is_file() else FIT
    if isinstance(spheres, str) and spheres == FIT:
        chosen = _from_geometry(model, tuple(model.links), fit)
        if not chosen.rows:
            raise RobotError(
                f"'{urdf_path}': no link has collision geometry; add <collision> elements, or pass "
                "spheres={link: [{center, radius}]}"
            )
        return chosen
    table = read_spheres(spheres)
    known = {name: rows for name, rows in table.spheres.items() if name in model.links}
    for link, rows in table.spheres.items():
        if link not in model.links and (len(rows) or not table.foreign):
            raise RobotError(
                f"{table.source} gives spheres for the unknown link '{link}'; "
                f"links: {list(model.links)}"
            )
    bare = tuple(name for name in model.links if name not in known and _has_geometry(model, name))
    if bare and not table.foreign:
        raise RobotError(
            f"{table.source} gives no spheres for the links {list(bare)}, which have collision "
            "geometry and would go unchecked; add spheres, or an empty list to leave a link out "
            "on purpose"
        )
    emptied = [name for name, rows in known.items() if not len(rows) and _has_geometry(model, name)]
    if emptied and table.foreign:
        _logger.warning(
            "%s leaves the links %s without spheres; they have collision geometry and are not "
            "checked",
            *(table.source, emptied),
        )
    rest = _from_geometry(model, bare, fit)
    if rest.rows:
        _logger.info("%s leaves out %s; their spheres are fitted", table.source, list(rest.rows))
    everything, sources = known | rest.rows, dict.fromkeys(known, "file") | rest.sources
    held = {name: everything[name] for name in model.links if len(everything.get(name, ()))}
    if not held:
        raise RobotError(f"{table.source} gives no link a sphere; a robot needs at least one")
    return ChosenSpheres(held, {name: sources[name] for name in held}, table.padding)


def _has_geometry(model: RobotModel, name: str) -> bool:
    return bool(model.links[name].primitives or model.links[name].meshes)


def _from_geometry(model: RobotModel, links: tuple[str, ...], fit: SphereFit) -> ChosenSpheres:
    """Spheres that hold the collision geometry of the URDF."""
    rows: LinkSpheres = {}
    sources: dict[str, str] = {}
    for name in links:
        link = model.links[name]
        own = [solid for solid in link.primitives if solid.kind == "sphere"]
        rest = [solid for solid in link.primitives if solid.kind != "sphere"]
        parts = [enclosing_spheres(solid) for solid in own]
        tiles = [enclosing_spheres(solid) for solid in rest]
        if link.meshes or sum(map(len, tiles)) > _FEW_TILES:
            surface = link_triangles(rest, link.meshes)
            tolerance, most = fit.allowed(surface), fit.most(name, surface)
            parts.append(fit_spheres(surface, tolerance, most))
            sources[name] = "fitted"
        elif tiles:
            parts += tiles
            sources[name] = "tiled"
        elif own:
            sources[name] = "urdf"
        if parts:
            rows[name] = np.vstack(parts)
    return ChosenSpheres(rows, sources)


def enclosing_spheres(solid: PrimitiveGeometry) -> Spheres:
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
    # Rounding must not open a gap at the corners, nor must a proof of enclosure, which sees a
    # prism of many sides for a cylinder, find one.
    local[:, 3] = local[:, 3] * (1.0 + 1e-3) + solid.padding
    return local


def _tile_cylinder(radius: float, length: float) -> Spheres:
    """A ball on the axis and rings of balls around it, repeated along the axis."""
    edge = _TILE_EDGE
    while True:
        rings = math.ceil(radius / edge)
        # A slender cylinder gains nothing from slices much thinner than it is wide.
        slices = math.ceil(length / max(0.5 * edge, min(edge, radius)))
        count = 1 + int(_sectors(radius, rings, edge).sum())
        if count * slices <= _MAX_TILES or count == slices == 1:
            break
        edge *= 1.1
    disc = _tile_disc(radius, rings, edge)
    step = length / slices
    heights = (np.arange(slices) + 0.5) * step - 0.5 * length
    rows = np.empty((slices, len(disc), 4))
    rows[..., :2] = disc[:, :2]
    rows[..., 2] = heights[:, None]
    rows[..., 3] = np.hypot(disc[:, 2], 0.5 * step)
    return rows.reshape(-1, 4)


def _sectors(radius: float, rings: int, edge: float) -> Int[np.ndarray, "rings"]:
    """Into how many sectors each ring of a disc but the innermost is cut."""
    outer = np.arange(2, rings + 1) * (radius / rings)
    return np.maximum(4, np.ceil(2 * math.pi * outer / edge)).astype(np.int64)


def _tile_disc(radius: float, rings: int, edge: float) -> Points:
    """Circles (x, y, radius) whose union holds a disc."""
    width = radius / rings
    circles = [np.array([[0.0, 0.0, width]])]
    for ring, n in enumerate(_sectors(radius, rings, edge).tolist(), start=1):
        inner, outer = ring * width, (ring + 1) * width
        half = math.pi / n
        # Equally far from the sector's inner and outer corners.
        middle = (inner + outer) / (2 * math.cos(half))
        reach = math.hypot(outer * math.cos(half) - middle, outer * math.sin(half))
        turn = 2 * math.pi * np.arange(n) / n
        circles.append(
            np.column_stack([middle * np.cos(turn), middle * np.sin(turn), np.full(n, reach)])
        )
    return np.vstack(circles)


def _tile_box(size: Sequence[float]) -> Spheres:
    edges = np.asarray(size)
    edge = min(_TILE_EDGE, float(edges.min()))
    while (counts := np.ceil(edges / edge).astype(int)).prod() > _MAX_TILES:
        edge *= 1.1
    cell = edges / counts
    axes = [(np.arange(n) + 0.5) * c - 0.5 * e for n, c, e in zip(counts, cell, edges, strict=True)]
    centers = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.column_stack([centers, np.full(len(centers), 0.5 * np.linalg.norm(cell))])
