# SPDX-License-Identifier: BSD-3-Clause
"""Balls inside a robot's own solids that fill them: nothing of them stands out.

Collision spheres hold a link and stand out of it; these are held by it. What they hold is
the robot, and nothing else can be there.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from vprism_plan.errors import RobotError
from vprism_plan.robots.geometry import Points, Pose, PrimitiveGeometry, Spheres, Triangles, Values
from vprism_plan.robots.surfaces import Surface, split_triangles

# Metres between centres, and by how much balls may fall short of such a point. Together: some
# thousand balls for an arm, which fall short of its edges by 7 mm at most.
_STEP, _SHORT = 0.01, 0.002
# Deep inside, where the largest balls are in any case, one point in so many is looked after.
_INNER_SHARE = 8


@dataclass(frozen=True, eq=False)
class SolidBalls:
    """What a robot fills in one configuration, world frame, metres.

    Attributes:
        inner: rows (x, y, z, radius): balls inside the solids that fill them; points of
            their surface have radius 0.
        spheres: the collision spheres of links that have no solids to go by, which may stand
            out of what they stand for.
        without: names of these links.
    """

    inner: Spheres
    spheres: Spheres
    without: tuple[str, ...]


def solid_balls(robot: Any, q: Any) -> SolidBalls:
    """See :meth:`Robot.solid_balls`."""
    inner, spheres, without = [np.empty((0, 4))], [np.empty((0, 4))], []
    for name, pose in robot.link_poses(q).items():
        solids, meshes = robot.geometry_as_read.get(name, ()), robot.meshes_as_read.get(name, ())
        bare, held = robot.link_spheres.get(name), robot.held.get(name)
        if held is not None:
            bare, meshes = held.spheres, () if held.surface is None else (held,)
        complete = bool(solids or meshes)
        try:
            rows = inner_balls(solids, meshes)
        except RobotError:  # the file of a mesh is missing or broken
            rows, complete = inner_balls(solids, ()), False
        inner.append(_placed(rows, pose))
        if bare is not None and not complete:
            spheres.append(_placed(bare, pose))
            without.append(name)
    return SolidBalls(np.concatenate(inner), np.concatenate(spheres), tuple(without))


def _placed(rows: Spheres, pose: Pose) -> np.ndarray:
    return np.column_stack([rows[:, :3] @ pose[:3, :3].T + pose[:3, 3], rows[:, 3]])


@lru_cache(maxsize=256)
def inner_balls(solids: tuple[PrimitiveGeometry, ...], meshes: tuple[Any, ...]) -> Spheres:
    """Balls inside a link's solids that together fill their union.

    Inside a mesh is what its surface encloses, cracks narrower than a cell (a fortieth to an
    eighteenth of its length) being closed. Of a shell with larger holes only the surface is
    known: balls of radius 0.

    Args:
        solids: primitives without padding.
        meshes: `MeshFile`s, or what else has their `triangles`.

    Returns:
        (n, 4) rows (x, y, z, radius), link frame, metres. Read-only.
    """
    exact, parts = [np.empty((0, 4))], [np.empty((0, 4))]
    for solid in solids:
        if solid.kind == "sphere":
            exact.append(np.array([[*solid.T_link[:3, 3], solid.size[0]]]))
            continue
        rows = _of_primitive(solid)
        # What lies deeper in another solid is that one's to fill.
        for other in solids:
            if other is not solid:
                rows = rows[-other.signed_distance(rows[:, :3]) <= rows[:, 3] + 1e-9]
        parts.append(rows)
    parts += [_of_mesh(mesh.triangles()) for mesh in meshes]
    found = np.concatenate([*exact, _cover(np.concatenate(parts))])
    found.setflags(write=False)
    return found


def _of_primitive(solid: PrimitiveGeometry) -> Spheres:
    """A lattice along the solid's own axes: faces, edges and corners are on it."""
    places = _lattice(solid.kind, solid.size) @ solid.T_link[:3, :3].T + solid.T_link[:3, 3]
    return np.column_stack([places, np.maximum(-solid.signed_distance(places), 0.0)])


def _lattice(kind: str, size: Sequence[float]) -> Points:
    if kind == "box":
        axes = [_steps(-0.5 * edge, 0.5 * edge) for edge in size]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    radius, length = size
    disc = [np.zeros((1, 2))]
    for ring in _steps(0.0, radius)[1:]:
        count = max(math.ceil(2.0 * math.pi * ring / _STEP), 6)
        angles = 2.0 * math.pi * np.arange(count) / count
        disc.append(ring * np.column_stack([np.cos(angles), np.sin(angles)]))
    flat, heights = np.concatenate(disc), _steps(-0.5 * length, 0.5 * length)
    return np.concatenate([np.insert(flat, 2, height, axis=1) for height in heights])


def _steps(first: float, last: float) -> Values:
    return np.linspace(first, last, max(math.ceil((last - first) / _STEP), 1) + 1)


def _of_mesh(triangles: Triangles) -> Spheres:
    """Points of the surface, and the middles of cells that it encloses.

    In triangles without an edge longer than `_STEP` every point is at most that over sqrt(3)
    from a corner. That way is square to the one from the middle to the nearest point (along
    an edge or face of its triangle), so the latter is at least the cathetus.
    """
    from scipy.spatial import cKDTree

    surface = Surface.of(triangles, math.inf)
    corners = split_triangles(triangles, _STEP).reshape(-1, 3)
    middles = surface.lower + surface.cell * (np.argwhere(surface.whole) + 0.5)
    away, _ = cKDTree(corners).query(middles)
    radius = np.sqrt(np.maximum(away**2 - _STEP**2 / 3.0, 0.0))
    _, first = np.unique(np.round(corners / _SHORT), axis=0, return_index=True)
    rim = np.insert(corners[first], 3, 0.0, axis=1)
    return np.concatenate([rim, np.column_stack([middles, radius])])


def _cover(rows: Spheres) -> Spheres:
    """The balls that, up to `_SHORT`, hold all middles near the surface and a share of others.

    Chosen greedily: each time the ball that holds most of what is not held yet.
    """
    from scipy.spatial import cKDTree

    near = rows[:, 3] < _STEP
    aimed = np.concatenate([rows[near, :3], rows[~near, :3][::_INNER_SHARE]])
    if not len(aimed):
        return rows
    balls = cKDTree(aimed).query_ball_point(rows[:, :3], rows[:, 3] + _SHORT)
    held = [np.array(points, dtype=np.int64) for points in balls]
    left, missing = np.ones(len(aimed), dtype=bool), len(aimed)
    # What a ball would add only falls, so the best by old counts is counted again.
    waiting = [(-len(points), index) for index, points in enumerate(held)]
    heapq.heapify(waiting)
    chosen = []
    while missing:
        _, index = heapq.heappop(waiting)
        gain = int(left[held[index]].sum())
        if waiting and gain < -waiting[0][0]:
            heapq.heappush(waiting, (-gain, index))
            continue
        chosen.append(index)
        left[held[index]] = False
        missing -= gain
    return rows[chosen]
