# SPDX-License-Identifier: BSD-3-Clause
"""A link's surface: its triangles, small ones and points of them, and what is inside."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from vprism_plan.robots.geometry import (
    MeshFile,
    Points,
    PrimitiveGeometry,
    Triangles,
    Values,
    Vector,
)

# Cells along the edge of a cube as large as a link's box, and along its longest edge.
_CELLS, _FEWEST, _MOST_CELLS = 14, 18, 40
# Longest edge of the triangles that spheres hold, in cells, and in tolerances if these are
# smaller: a sphere cannot be finer than what it must hold.
_EDGE, _FINE, _FINEST = 1.5, 2.0, 0.5
_NEXT_TO_NONE = 0.15
_SAMPLES = 4000


@dataclass(frozen=True, eq=False)
class Surface:
    """Small triangles, and a lattice of signed distances to them.

    Attributes:
        points: (v, 3) corners, each once.
        faces: (t, 3) indices into them; (t, 8) for boxes around triangles.
        lower: outer corner of the lattice's first cell.
        cell: edge of a cell.
        filled: cells with surface in them or enclosed by such cells.
        inner: those without a corner.
        whole: those that no surface reaches: they lie inside.
        lattice: signed distance at the cells' centres, to within half a cell.
    """

    points: Points
    faces: Int[np.ndarray, "t corners"]
    lower: Vector
    cell: float
    filled: Bool[np.ndarray, "x y z"]
    inner: Bool[np.ndarray, "x y z"]
    whole: Bool[np.ndarray, "x y z"]
    lattice: Float[np.ndarray, "x y z"] = field(repr=False)

    @classmethod
    def of(cls, triangles: Triangles, tolerance: float, most: int | None = None) -> Surface:
        """Cut a surface so that spheres which stand out by the tolerance can hold its parts:
        triangles, or boxes around them where there would be more than so many."""
        from scipy import ndimage
        from scipy.spatial import cKDTree

        low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
        longest = float((high - low).max())
        cell = float(np.cbrt((high - low).prod())) / _CELLS
        cell = min(max(cell, longest / _MOST_CELLS), longest / _FEWEST)
        edge = min(_EDGE * cell, max(_FINE * tolerance, _FINEST * cell))
        parts = split_triangles(triangles, edge)
        # No path from cell to cell passes between corners so near to each other.
        small = split_triangles(parts, 0.8 * cell)
        many = most is not None and len(parts) > most
        points, faces = _merged(_boxes(parts, 0.5 * edge) if many else parts)
        dense, _ = _merged(small)
        lower = low - 1.5 * cell
        touched = np.zeros(tuple(np.ceil((high - low) / cell + 3.0).astype(np.int64)), dtype=bool)
        touched[tuple(np.floor((dense - lower) / cell).astype(np.int64).T)] = True
        filled = np.asarray(ndimage.binary_fill_holes(touched))
        inner = filled & ~touched
        # A triangle reaches into no other cells than those of its box's corners.
        ends = np.floor((np.stack([small.min(axis=1), small.max(axis=1)]) - lower) / cell)
        for corner in np.ndindex(2, 2, 2):
            touched[tuple(ends[corner, :, [0, 1, 2]].astype(np.int64))] = True
        whole = filled & ~touched
        middles = lower + cell * (np.argwhere(np.ones_like(filled)) + 0.5)
        distance = np.asarray(cKDTree(dense).query(middles)[0]).reshape(filled.shape)
        lattice = np.where(inner, -distance, distance)
        return cls(points, faces, lower, cell, filled, inner, whole, lattice)

    def reach(self, centres: Points) -> Float[np.ndarray, "c t"]:
        """Distance from each centre to the farthest corner of each triangle."""
        from scipy.spatial.distance import cdist

        away = cdist(centres, self.points)
        corners = (away[:, corner] for corner in self.faces.T)
        return np.asarray(functools.reduce(np.maximum, corners))

    def signed(self, x: Points) -> Values:
        """Signed distance, interpolated between cells; negative inside."""
        from scipy.ndimage import map_coordinates

        at = (x - self.lower) / self.cell - 0.5
        return np.asarray(map_coordinates(self.lattice, at.T, order=1, mode="nearest"))


def with_hull(triangles: Triangles) -> Triangles:
    """A surface, and its convex hull if it is a shell whose openings a fill runs out of.

    Published meshes are often shells with holes, their faces turned either way: nothing says
    what is inside. Where next to none of what the hull holds is enclosed, the link counts as
    solid up to its hull: all of that is held, and none of it counts as standing out.
    """
    import trimesh
    from scipy.spatial import ConvexHull, QhullError

    if trimesh.Trimesh(**trimesh.triangles.to_kwargs(triangles), process=True).is_watertight:
        return triangles
    points = triangles.reshape(-1, 3)
    try:
        hull = ConvexHull(points)
    except QhullError:  # flat: nothing is inside
        return triangles
    surface = Surface.of(triangles, math.inf)
    if surface.inner.sum() * surface.cell**3 > _NEXT_TO_NONE * hull.volume:
        return triangles
    return np.concatenate([triangles, points[hull.simplices]])


def _boxes(triangles: Triangles, edge: float) -> Float[np.ndarray, "b 8 3"]:
    """Corners of boxes, each around the triangles whose middles are in one cell of a lattice."""
    cells = np.floor(triangles.mean(axis=1) / edge).astype(np.int64)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    order = np.argsort(cell, kind="stable")
    first = np.flatnonzero(np.diff(cell[order], prepend=-1))
    low = np.minimum.reduceat(triangles.min(axis=1)[order], first)
    high = np.maximum.reduceat(triangles.max(axis=1)[order], first)
    corners = np.array(list(np.ndindex(2, 2, 2)), dtype=bool)
    return np.where(corners, high[:, None], low[:, None])


def _merged(parts: Float[np.ndarray, "t corners 3"]) -> tuple[Points, Int[np.ndarray, "t corners"]]:
    """Corners, each once, and the parts' indices into them."""
    flat = parts.reshape(-1, 3)
    # As bytes, which sort faster than rows; 0.0 + x turns -0.0 into 0.0.
    keys = np.ascontiguousarray(0.0 + flat).view(np.dtype((np.void, 24))).ravel()
    _, which, faces = np.unique(keys, return_index=True, return_inverse=True)
    return flat[which], faces.reshape(parts.shape[:2])


def split_triangles(triangles: Triangles, longest: float) -> Triangles:
    """The same surface in triangles with no edge longer than `longest`, metres."""
    done = []
    while len(triangles):
        edges = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2)
        small = edges.max(axis=1) <= longest
        done.append(triangles[small])
        triangles = halved_triangles(triangles[~small], edges[~small])
    return np.concatenate(done)


def halved_triangles(triangles: Triangles, edges: Float[np.ndarray, "f 3"]) -> Triangles:
    """Each triangle as two, cut from the middle of its longest edge."""
    rows, start = np.arange(len(triangles)), edges.argmax(axis=1)
    a, b, c = (triangles[rows, (start + k) % 3] for k in range(3))
    middle = 0.5 * (a + b)
    return np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])


def link_triangles(
    solids: Sequence[PrimitiveGeometry], meshes: Sequence[MeshFile], sides: int = 32
) -> Triangles:
    """All surfaces of a link in its frame, metres; see :meth:`PrimitiveGeometry.triangles`.

    Raises:
        RobotError: A mesh is missing or cannot be used.
    """
    parts = [solid.triangles(sides) for solid in solids] + [mesh.triangles() for mesh in meshes]
    return np.concatenate([np.empty((0, 3, 3)), *parts])


def surface_samples(triangles: Triangles, count: int = _SAMPLES, seed: int = 0) -> Points:
    """Points of a surface: `count` uniform by area, and every corner."""
    if not len(triangles):
        return np.empty((0, 3))
    points, _ = drawn_points(triangles, count, seed)
    return np.concatenate([points, triangles.reshape(-1, 3)])


def drawn_points(triangles: Triangles, count: int, seed: int = 0) -> tuple[Points, Points]:
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
