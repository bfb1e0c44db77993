# SPDX-License-Identifier: BSD-3-Clause
"""A link's surface: its triangles, small ones and points of them, and what is inside: balls."""

from __future__ import annotations

import functools
import heapq
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError, cKDTree
from scipy.spatial.distance import cdist

from vprism_plan._shapes import Points, Pose, Spheres, Triangles, Values, Vector
from vprism_plan.errors import RobotError
from vprism_plan.robots.geometry import MeshFile, PrimitiveGeometry

# Cells along the edge of a cube as large as a link's box, and along its longest edge.
_CELLS, _FEWEST, _MOST_CELLS = 14, 18, 40
# Longest edge of the triangles that spheres hold, in cells, and in tolerances if these are
# smaller: a sphere cannot be finer than what it must hold.
_EDGE, _FINE, _FINEST = 1.5, 2.0, 0.5
_NEXT_TO_NONE = 0.15
_SAMPLES = 4000


@dataclass(frozen=True, eq=False)
class Surface:
    """Small triangles, and a lattice of signed distances to them."""

    points: Points  # corners, each once
    faces: Int[np.ndarray, "t corners"]  # indices into them: 3, or 8 for boxes around triangles
    lower: Vector  # outer corner of the lattice's first cell
    cell: float  # edge of a cell
    filled: Bool[np.ndarray, "x y z"]  # cells with surface in them or enclosed by such cells
    inner: Bool[np.ndarray, "x y z"]  # those without a corner
    whole: Bool[np.ndarray, "x y z"]  # those that no surface reaches: they lie inside
    # Signed distance at the cells' centres, to within half a cell.
    lattice: Float[np.ndarray, "x y z"] = field(repr=False)

    @classmethod
    def of(cls, triangles: Triangles, tolerance: float, most: int | None = None) -> Surface:
        """Cut a surface so that spheres which stand out by the tolerance can hold its parts:
        triangles, or boxes around them where there would be more than so many."""
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
        away = cdist(centres, self.points)
        corners = (away[:, corner] for corner in self.faces.T)
        return np.asarray(functools.reduce(np.maximum, corners))

    def signed(self, x: Points) -> Values:
        """Signed distance, interpolated between cells; negative inside."""
        at = (x - self.lower) / self.cell - 0.5
        return np.asarray(ndimage.map_coordinates(self.lattice, at.T, order=1, mode="nearest"))


def with_hull(triangles: Triangles) -> Triangles:
    """A surface, and its convex hull if it is a shell whose openings a fill runs out of.

    Published meshes often have holes: where next to none of what the hull holds is enclosed,
    the link counts as solid up to its hull.
    """
    import trimesh

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
    """All surfaces of a link in its frame, metres; see :meth:`PrimitiveGeometry.triangles`."""
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
    import trimesh

    mesh = trimesh.Trimesh(**trimesh.triangles.to_kwargs(triangles), process=False)
    points, which = trimesh.sample.sample_surface(mesh, count, seed=seed)
    return np.asarray(points), np.asarray(mesh.face_normals[which])


# ------------------------------------------------------------------------ balls inside solids
# Metres between centres, and by how much balls may fall short of such a point: some thousand
# balls for an arm, which fall short of its edges by 7 mm at most.
_APART, _SHORT = 0.01, 0.002
_INNER_SHARE = 8  # one in so many points deep inside is looked after: the largest balls are there


@dataclass(frozen=True, eq=False)
class SolidBalls:
    """What a robot fills in one configuration, world frame, metres.

    Collision spheres hold a link and stand out of it; balls inside its solids are held by it.
    What they hold is the robot, and nothing else can be there.
    """

    inner: Spheres  # balls inside the solids that fill them; points of their surface: radius 0
    spheres: Spheres  # collision spheres of links without solids, which may stand out of them
    without: tuple[str, ...]  # names of these links


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


@functools.lru_cache(maxsize=256)
def inner_balls(solids: tuple[PrimitiveGeometry, ...], meshes: tuple[Any, ...]) -> Spheres:
    """Balls inside a link's solids that together fill their union.

    Inside a mesh is what its surface encloses, cracks narrower than a cell (a fortieth to an
    eighteenth of its length) being closed. Of a shell with larger holes only the surface is
    known: balls of radius 0. Solids are without padding; meshes are `MeshFile`s, or what else
    has their `triangles`. Returns read-only rows (x, y, z, radius), link frame, metres.
    """
    exact, parts = [np.empty((0, 4))], [np.empty((0, 4))]
    for solid in solids:
        if solid.kind == "sphere":
            exact.append(np.array([[*solid.T_link[:3, 3], solid.size[0]]]))
            continue
        # A lattice along the solid's own axes: faces, edges and corners are on it.
        places = _lattice(solid.kind, solid.size) @ solid.T_link[:3, :3].T + solid.T_link[:3, 3]
        rows = np.column_stack([places, np.maximum(-solid.signed_distance(places), 0.0)])
        # What lies deeper in another solid is that one's to fill.
        for other in solids:
            if other is not solid:
                rows = rows[-other.signed_distance(rows[:, :3]) <= rows[:, 3] + 1e-9]
        parts.append(rows)
    parts += [_of_mesh(mesh.triangles()) for mesh in meshes]
    found = np.concatenate([*exact, _cover(np.concatenate(parts))])
    found.setflags(write=False)
    return found


def _lattice(kind: str, size: Sequence[float]) -> Points:
    if kind == "box":
        axes = [_steps(-0.5 * edge, 0.5 * edge) for edge in size]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    radius, length = size
    disc = [np.zeros((1, 2))]
    for ring in _steps(0.0, radius)[1:]:
        count = max(math.ceil(2.0 * math.pi * ring / _APART), 6)
        angles = 2.0 * math.pi * np.arange(count) / count
        disc.append(ring * np.column_stack([np.cos(angles), np.sin(angles)]))
    flat, heights = np.concatenate(disc), _steps(-0.5 * length, 0.5 * length)
    return np.concatenate([np.insert(flat, 2, height, axis=1) for height in heights])


def _steps(first: float, last: float) -> Values:
    return np.linspace(first, last, max(math.ceil((last - first) / _APART), 1) + 1)


def _of_mesh(triangles: Triangles) -> Spheres:
    """Points of the surface, and the middles of cells that it encloses.

    In triangles without an edge longer than `_APART` every point is at most that over sqrt(3)
    from a corner, square to the way from the middle to the nearest point: a cathetus at least.
    """
    surface = Surface.of(triangles, math.inf)
    corners = split_triangles(triangles, _APART).reshape(-1, 3)
    middles = surface.lower + surface.cell * (np.argwhere(surface.whole) + 0.5)
    away, _ = cKDTree(corners).query(middles)
    radius = np.sqrt(np.maximum(away**2 - _APART**2 / 3.0, 0.0))
    _, first = np.unique(np.round(corners / _SHORT), axis=0, return_index=True)
    rim = np.insert(corners[first], 3, 0.0, axis=1)
    return np.concatenate([rim, np.column_stack([middles, radius])])


def _cover(rows: Spheres) -> Spheres:
    """Balls, chosen greedily, that hold (up to `_SHORT`) middles near the surface and others."""
    near = rows[:, 3] < _APART
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
