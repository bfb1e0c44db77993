# SPDX-License-Identifier: BSD-3-Clause
"""Whether spheres hold a surface, proved, and how far they stand out of it, measured."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from vprism_plan.robots._fit_surface import (
    Surface,
    halved_triangles,
    split_triangles,
    with_hull,
)
from vprism_plan.robots._geometry import PrimitiveGeometry

# Where a triangle's edges are shorter than this and it still is in no single sphere, the
# surface counts as bare, metres.
_FINEST = 2e-6
_SAMPLES = 4000
_ON_SPHERE = 200
_ROWS = 20_000


def enclosed(triangles: Float[np.ndarray, "f 3 3"], spheres: Float[np.ndarray, "n 4"]) -> bool:
    """Whether every point of a surface lies in the union of spheres: a proof, no sampling.

    A triangle whose corners lie in one sphere lies in it. Others are halved, until all do
    (proved) or a corner lies in none (refuted). A surface that touches the union's edge from
    inside, to within a few thousandths of a millimetre, counts as bare.

    Args:
        triangles: (f, 3, 3) corners, metres.
        spheres: (n, 4) rows (x, y, z, radius), same frame.
    """
    waiting = [triangles[i : i + _ROWS] for i in range(0, len(triangles), _ROWS)]
    while waiting:
        part = waiting.pop()
        away = np.linalg.norm(part[:, :, None] - spheres[None, None, :, :3], axis=3)
        inside = away <= spheres[:, 3]
        if not inside.any(axis=2).all():
            return False
        part = part[~inside.all(axis=1).any(axis=1)]
        if len(part) == 0:
            continue
        edges = np.linalg.norm(np.roll(part, -1, axis=1) - part, axis=2)
        if float(edges.max(axis=1).min()) < _FINEST:
            return False
        halves = halved_triangles(part, edges)
        waiting += [halves[i : i + _ROWS] for i in range(0, len(halves), _ROWS)]
    return True


def surface_samples(
    triangles: Float[np.ndarray, "f 3 3"], count: int = _SAMPLES, seed: int = 0
) -> Float[np.ndarray, "n 3"]:
    """Points of a surface: `count` uniform by area, and every corner."""
    points, _ = drawn_points(triangles, count, seed)
    return np.concatenate([points, triangles.reshape(-1, 3)])


def drawn_points(
    triangles: Float[np.ndarray, "f 3 3"], count: int, seed: int = 0
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Points of a surface, uniform by area, and the unit normals of their triangles."""
    rng = np.random.default_rng(seed)
    edges = triangles[:, 1:] - triangles[:, :1]
    normal = np.cross(edges[:, 0], edges[:, 1])
    area = np.linalg.norm(normal, axis=1)
    which = rng.choice(len(triangles), size=count, p=area / area.sum())
    share = rng.random((count, 2))
    share = np.where(share.sum(axis=1, keepdims=True) > 1.0, 1.0 - share, share)
    points = triangles[which, 0] + np.einsum("nk,nkj->nj", share, edges[which])
    return points, normal[which] / area[which, None]


def sphere_gap(
    points: Float[np.ndarray, "n 3"], spheres: Float[np.ndarray, "m 4"]
) -> Float[np.ndarray, "n"]:
    """Signed distance of points to the union of spheres, metres: negative inside."""
    gap = np.full(len(points), math.inf)
    for *centre, radius in spheres:
        gap = np.minimum(gap, np.linalg.norm(points - centre, axis=1) - radius)
    return gap


def protrusion(
    primitives: Sequence[PrimitiveGeometry],
    triangles: Float[np.ndarray, "f 3 3"] | None,
    spheres: Float[np.ndarray, "n 4"],
) -> tuple[float, float]:
    """How far the union of spheres stands out of a link.

    Measured at 200 points of each sphere that lie in no other: their distance to the link, 0
    inside it (an open shell is solid up to its convex hull). To a mesh the distance is taken
    to points of it so dense that it is too large by half a millimetre at most where it is two
    centimetres or more.

    Args:
        primitives: Solids of the link.
        triangles: Of its meshes, or None.
        spheres: (n, 4) rows (x, y, z, radius), link frame, metres.

    Returns:
        The largest and the mean distance, metres.
    """
    points = _outer_points(spheres)
    if len(points) == 0:
        return 0.0, 0.0
    away = np.full(len(points), math.inf)
    for solid in primitives:
        away = np.minimum(away, solid.signed_distance(points))
    if triangles is not None:
        away = np.minimum(away, _mesh_distance(triangles, points))
    away = np.maximum(away, 0.0)
    return float(away.max()), float(away.mean())


def _outer_points(spheres: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "m 3"]:
    """Points of the union's surface."""
    i = np.arange(_ON_SPHERE) + 0.5
    height, turn = 1.0 - 2.0 * i / _ON_SPHERE, math.pi * (1.0 + math.sqrt(5.0)) * i
    rim = np.sqrt(1.0 - height**2)
    unit = np.stack([rim * np.cos(turn), rim * np.sin(turn), height], axis=1)
    points = (spheres[:, None, :3] + spheres[:, None, 3:] * unit).reshape(-1, 3)
    return points[sphere_gap(points, spheres) > -1e-9]


def _mesh_distance(
    triangles: Float[np.ndarray, "f 3 3"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n"]:
    """Distance to a surface, 0 where the surface encloses the point."""
    from scipy.spatial import cKDTree

    triangles = with_hull(triangles)
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    edge = max(0.003, float((high - low).max()) / 60.0)
    dense = split_triangles(triangles, edge)
    samples = np.concatenate([dense.reshape(-1, 3), dense.mean(axis=1)])
    away = np.asarray(cKDTree(samples).query(points)[0])
    away[_enclosed_by(triangles, points)] = 0.0
    return away


def _enclosed_by(
    triangles: Float[np.ndarray, "f 3 3"], points: Float[np.ndarray, "n 3"]
) -> Bool[np.ndarray, "n"]:
    """Points in cells that the surface encloses, as the fit sees it."""
    surface = Surface.of(triangles, math.inf)
    at = np.floor((points - surface.lower) / surface.cell).astype(np.int64)
    there = ((at >= 0) & (at < surface.inner.shape)).all(axis=1)
    result = np.zeros(len(points), dtype=bool)
    result[there] = surface.inner[tuple(at[there].T)]
    return result
