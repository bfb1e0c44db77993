# SPDX-License-Identifier: BSD-3-Clause
"""Obstacles that no object of the map accounts for, as marked nodes of a lattice: what nobody
saw, seen surfaces, known meshes."""

import math
from collections.abc import Collection, Iterator
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from vprism_plan._kernels import world as kernels
from vprism_plan._threads import run_chunked
from vprism_plan.world import visibility
from vprism_plan.world.config import KnownMesh, OccludedPolicy, WorldConfig
from vprism_plan.world.distance import Lattice, bounding, lattice_nodes
from vprism_plan.world.grid import Grid, Nodes, Points, Shape3, Values, Vector, corners, window
from vprism_plan.world.seen import (
    Cone,
    Surface,
    lost_cones,
    lost_objects,
    lost_points,
    off_level_set,
    surface_points,
)
from vprism_plan.world.sources import LAST_MARK, MARKED
from vprism_plan.world.unseen_objects import OpenSides, UnseenObjects, open_sides

CELLS = 2  # cells per grid step for everything that is seen or not seen
_FINEST, _MESH_CELLS = 16, 8_000_000  # cells per grid step of a known mesh, and of all of it
_CHUNK = 1 << 17  # cells whose logits are in memory at once


class Evidence:
    """What the views of a map say of space: what was seen, what hides, where nobody looked.

    Attributes:
        views: ready to be asked of cells.
        below: the same for which the support plane hides things, too; None if it never ends.
        without_depth: labels without any return, sorted: no class of the map. Their marks follow
            those of the classes, LAST_MARK + C + 1 and on.
        unseen: objects that may stand in hidden space which `marks` has left to them; None before,
            and if there is no such space.
    """

    def __init__(self, map_: Any, config: WorldConfig) -> None:
        self._map, self._config = map_, config
        self.bounded = config.support == "seen" and map_.plane is not None
        tolerance = config.occlusion_tolerance
        self.views = visibility.make_views(map_.views, tolerance, map_.plane)
        self.below = visibility.make_views(map_.views, tolerance) if self.bounded else None
        found = {i for view in map_.views for i in lost_objects(view)}
        self.without_depth = tuple(sorted(found - set(map_.object_ids)))
        self.unseen: UnseenObjects | None = None

    @cached_property
    def _sides(self) -> OpenSides | None:
        return open_sides(self._map, self._config, self.views)

    @cached_property
    def _clutter(self) -> tuple[Points, Values]:
        config = self._config
        return visibility.background_points(
            self._map.views, self._map.plane, config.background_height, config.lone_share,
            self.bounded,
        )  # fmt: skip

    @cached_property
    def _surfaces(self) -> list[Surface]:
        return surface_points(self._map, self.bounded)

    @cached_property
    def _cones(self) -> list[list[Cone]]:
        return [lost_cones(view, self._map.plane) for view in self._map.views]

    def hidden(self, occluded: OccludedPolicy, grid: Grid, inner: Grid | None = None) -> Lattice:
        """Mark, `CELLS` times finer than the grid, occluded (by that policy) and unobserved cells
        outside the box of `inner`."""
        spacing = grid.spacing / CELLS
        cells = tuple(CELLS * (n - 1) for n in grid.shape)
        shape = (cells[0], cells[1], cells[2])
        nodes = np.zeros(tuple(n + 1 for n in shape), dtype=np.uint8)
        if occluded != "free" or self._config.unobserved != "free":
            place = self._map.plane, grid.origin, spacing, shape
            if self.below is None:
                status = visibility.classify_cells(self.views, *place)
            else:
                status = visibility.classify_cells_around(self.views, self.below, *place)
            if occluded == "posterior":
                left = _trust_posterior(
                    self._map, self._config, status, grid.origin, spacing, self._sides
                )
                if self._sides is not None:
                    self.unseen = UnseenObjects.among(
                        left, grid, self._map.plane, self._config.hidden_objects
                    )
            if inner is not None:
                # Cells that lie wholly inside the other box.
                low = np.ceil((inner.origin - grid.origin) / spacing - 1e-9)
                high = np.floor((inner.upper - grid.origin) / spacing + 1e-9)
                low = np.clip(low, 0, shape)
                status[window(low, np.clip(high, low, shape))] = kernels.FREE
            shadow = 0 if occluded == "free" else MARKED["occluded"]
            unseen = 0 if self._config.unobserved == "free" else MARKED["unobserved"]
            marks = np.zeros(4, dtype=np.uint8)
            marks[kernels.OCCLUDED], marks[kernels.UNOBSERVED] = shadow, unseen
            marks[kernels.PARTLY] = shadow or unseen
            run_chunked(
                lambda s: kernels.mark_corners(status, marks, nodes, s.start, s.stop),
                len(nodes),
                16,
            )
        return Lattice(nodes, grid.first * CELLS, CELLS)

    def with_seen(
        self, marks: Lattice, grid: Grid, objects: Nodes | None = None, inner: Grid | None = None
    ) -> Lattice:
        """Return marks of the grid with the seen surfaces outside the box of `inner` that no object
        of the map holds, by the distance of the grid's nodes to the level set (metres); all that
        was seen of the objects, if that is not given."""
        nodes = marks.labels.copy()
        spacing = grid.spacing / CELLS
        for label, points, half in self._seen(grid, objects, 0.5 * spacing):
            kept: Any = slice(None)
            if inner is not None:
                kept = ((points < inner.origin) | (points > inner.upper)).any(axis=1)
            kernels.mark_boxes(
                points[kept], half[kept], grid.origin, spacing, np.uint8(label), nodes
            )
        return Lattice(nodes, marks.corner, CELLS)

    def _seen(self, grid: Grid, objects: Nodes | None, step: float) -> Iterator[Surface]:
        """Marks, points and half the widths of what was seen, the less important first: an
        object's own marks go where its contact is allowed, and what they cover with them."""
        yield MARKED["background"], *self._clutter
        for k, points, half in self._surfaces:
            kept: Any = slice(None)
            if objects is not None:
                kept = off_level_set(points, objects, grid)
            yield LAST_MARK + k, points[kept], half[kept]
        ids = (*self._map.object_ids, *self.without_depth)
        for view, cones in zip(self._map.views, self._cones, strict=True):
            for object_id, points, half in lost_points(view, cones, grid.origin, grid.upper, step):
                yield LAST_MARK + 1 + ids.index(object_id), points, half


def _trust_posterior(
    map_: Any,
    config: WorldConfig,
    status: UInt8[np.ndarray, "nx ny nz"],
    origin: Vector,
    spacing: float,
    sides: OpenSides | None,
) -> Bool[np.ndarray, "nx ny nz"]:
    """Call occluded cells free where the map has support: the posterior decides there. Not
    behind unlabelled clutter: the map has no class for that. With `sides`, also what lies beyond,
    but for what these keep: return those cells."""
    left = np.zeros(status.shape, dtype=bool)
    lower, upper = (np.asarray(c) for c in map_.support_bounds())
    first = np.clip(np.floor((lower - origin) / spacing).astype(int), 0, status.shape)
    last = np.clip(np.ceil((upper - origin) / spacing).astype(int), first, status.shape)
    if sides is not None:
        shadows = (status == kernels.OCCLUDED) | (status == kernels.PARTLY)
        box = bounding(shadows, 0) if shadows.any() else (slice(0, 0),) * 3
        first, last = np.array([[side.start, side.stop] for side in box]).T
    hidden = status[window(first, last)]
    hidden = (hidden == kernels.OCCLUDED) | (hidden == kernels.PARTLY)
    if not hidden.any():
        return left
    corner = origin + spacing * first
    hidden &= ~_behind_clutter(map_, config, corner, spacing, hidden.shape)
    flat = np.zeros(hidden.shape, dtype=bool)
    if sides is not None:  # the foot of clutter is no business of unseen objects, either
        low = replace(config, background_height=visibility.THIN)
        flat = _behind_clutter(map_, low, corner, spacing, hidden.shape)
    for index in np.array_split(np.argwhere(hidden), 1 + hidden.sum() // _CHUNK):
        points = corner + spacing * (index + 0.5)
        known = map_.judges(points, config.min_support)
        if sides is not None:
            beyond = np.flatnonzero(~known & ~flat[tuple(index.T)])
            beyond = beyond[~sides.reach(points[beyond])]
            left[tuple((index[beyond] + first).T)] = known[beyond] = True
        where = tuple((index[known] + first).T)
        whole = status[where] == kernels.OCCLUDED
        status[where] = np.where(whole, kernels.FREE, kernels.UNOBSERVED)
    return left


def _behind_clutter(
    map_: Any, config: WorldConfig, corner: Vector, spacing: float, size: Shape3
) -> Bool[np.ndarray, "nx ny nz"]:
    """Which cells unlabelled clutter hides in any view."""
    found = np.zeros(size, dtype=bool)
    plane = None if config.support == "seen" else map_.plane
    for view in map_.views:
        start = visibility.clutter_depth(view, map_.plane, config)
        if np.isfinite(start).any():
            shadow = [visibility.shadow_behind(view, start)]
            behind = visibility.classify_cells(shadow, plane, corner, spacing, size)
            found |= (behind == kernels.OCCLUDED) | (behind == kernels.PARTLY)
    return found


def unmark(marks: Lattice, classes: Collection[int], inside: Lattice | None = None) -> Lattice:
    """Return the marks less some objects' seen surfaces, and less occluded nodes inside their
    level set (`inside`, on a finer lattice)."""
    labels = marks.labels.copy()
    labels[np.isin(labels, [LAST_MARK + k for k in classes])] = 0
    if inside is None:
        return Lattice(labels, marks.corner, CELLS)
    ratio = inside.factor // CELLS
    first = -(-inside.corner // ratio)  # first unseen node not below the fine corner
    skip = first * ratio - inside.corner
    fine = inside.labels[skip[0] :: ratio, skip[1] :: ratio, skip[2] :: ratio]
    start = first - marks.corner
    low = np.maximum(start, 0)
    high = np.minimum(start + np.array(fine.shape), labels.shape)
    part, target = fine[window(low - start, high - start)], labels[window(low, high)]
    target[(part != 0) & (target == MARKED["occluded"])] = 0
    return Lattice(labels, marks.corner, CELLS)


def only(marks: Lattice, label: int) -> Lattice:
    """Keep one label, and the whole of every obstacle cell that it has a corner of: no part of
    an obstacle is lost between two names."""
    own = marks.labels == label
    if own.any():
        box = bounding(own, 1)
        near, marked = own[box], marks.labels[box] > 0
        cell = np.ones(tuple(n - 1 for n in near.shape), dtype=bool)
        touched = np.zeros_like(cell)
        for corner in corners(near.shape):
            cell &= marked[corner]
            touched |= near[corner]
        cell &= touched
        for corner in corners(near.shape):
            near[corner] |= cell
    return Lattice(own.view(np.uint8), marks.corner, marks.factor)


def rasterize_mesh(known: KnownMesh, grid: Grid) -> Lattice:
    """Mark every cell a mesh touches, and its inside if it is watertight; cells are as small as a
    few million of them allow, at least a sixteenth and at most half of a grid step.

    The surface is divided until its edges are no longer than a cell; every point of a triangle is
    then within edge / sqrt(3) of a corner, and the cells within that are marked.
    """
    import trimesh

    lower, upper = known.box()
    factor = _FINEST
    while factor > CELLS and np.prod((upper - lower) / grid.spacing * factor + 5) > _MESH_CELLS:
        factor //= 2
    spacing = grid.spacing / factor
    corner = np.floor(lower / spacing).astype(np.int64) - 2
    last = np.ceil(upper / spacing).astype(np.int64) + 2
    labels = lattice_nodes(last - corner + 1, f"known mesh {known.name!r}")
    vertices = np.asarray(known.mesh.vertices, dtype=np.float64)
    faces = np.asarray(known.mesh.faces)
    fine, fine_faces = trimesh.remesh.subdivide_to_size(vertices, faces, spacing, max_iter=40)
    samples = np.ascontiguousarray(fine[np.unique(fine_faces)], dtype=np.float64)
    half = np.full(len(samples), spacing / math.sqrt(3.0))
    kernels.mark_boxes(samples, half, spacing * corner, spacing, np.uint8(1), labels)
    if known.mesh.is_watertight:
        _fill_inside(labels, spacing * corner, spacing, vertices[faces])
    return Lattice(labels, corner, factor)


def _fill_inside(
    labels: np.ndarray, origin: Vector, spacing: float, triangles: Float[np.ndarray, "f 3 3"]
) -> None:
    """Mark the unmarked regions that lie inside a closed surface, one test per region."""
    regions, count = ndimage.label(labels == 0)
    outside = regions[0, 0, 0]
    first = ndimage.find_objects(regions)
    for region in range(1, count + 1):
        if region == outside:
            continue
        box = first[region - 1]
        where = np.argwhere(regions[box] == region)[0] + [s.start for s in box]
        if abs(winding_number(origin + spacing * where, triangles)) > 0.5:
            labels[regions == region] = 1


def winding_number(point: Vector, triangles: Float[np.ndarray, "f 3 3"]) -> float:
    """How often a closed surface winds round a point: its solid angle over 4 pi. Van Oosterom and
    Strackee, "The solid angle of a plane triangle" (1983), eq. 8."""
    a, b, c = (triangles[:, i] - point for i in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c))
    dots = la * lb * lc
    for (p, q), length in (((a, b), lc), ((b, c), la), ((c, a), lb)):
        dots = dots + np.einsum("ij,ij->i", p, q) * length
    return float(np.arctan2(volume, dots).sum() / (2.0 * math.pi))
