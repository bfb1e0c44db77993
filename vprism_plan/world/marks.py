# SPDX-License-Identifier: BSD-3-Clause
"""Obstacles that no object of the map accounts for: what nobody saw, and seen surfaces."""

from collections.abc import Collection, Iterator
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, UInt8

from vprism_plan._kernels import world as kernels
from vprism_plan._threads import run_chunked
from vprism_plan.world import visibility
from vprism_plan.world.config import OccludedPolicy, WorldConfig
from vprism_plan.world.distance import Lattice
from vprism_plan.world.grid import Grid
from vprism_plan.world.seen import (
    Cone,
    Surface,
    lost_cones,
    lost_objects,
    lost_points,
    off_level_set,
    surface_points,
)

CELLS = 2  # cells per grid step for everything that is seen or not seen
# Marks on that lattice; where several apply the largest wins.
UNOBSERVED, OCCLUDED, BACKGROUND = 1, 2, 3  # and 3 + k: seen surface of class k


class Evidence:
    """What the views of a map say of space: what was seen, what hides, where nobody looked.

    Args:
        map_: the map.
        config: policies, and what counts as seen.

    Attributes:
        views: ready to be asked of cells.
        below: the same for which the support plane hides things, too; None if it never ends.
        without_depth: labels without any return, sorted: no class of the map. Their marks follow
            those of the classes, BACKGROUND + C + 1 and on.
    """

    def __init__(self, map_: Any, config: WorldConfig) -> None:
        self._map, self._config = map_, config
        self.bounded = config.support == "seen" and map_.plane is not None
        tolerance = config.occlusion_tolerance
        self.views = visibility.make_views(map_.views, tolerance, map_.plane)
        self.below = visibility.make_views(map_.views, tolerance) if self.bounded else None
        found = {i for view in map_.views for i in lost_objects(view)}
        self.without_depth = tuple(sorted(found - set(map_.object_ids)))

    @cached_property
    def _clutter(self) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
        config, m = self._config, self._map
        return visibility.background_points(
            m.views, m.plane, config.background_height, config.lone_share, self.bounded
        )

    @cached_property
    def _surfaces(self) -> list[Surface]:
        m = self._map
        return surface_points(m.views, m.object_ids, m.plane, self.bounded)

    @cached_property
    def _cones(self) -> list[list[Cone]]:
        return [lost_cones(view, self._map.plane) for view in self._map.views]

    def marks(
        self,
        occluded: OccludedPolicy,
        grid: Grid,
        objects: Float32[np.ndarray, "nx ny nz"] | None,
        inner: Grid | None = None,
    ) -> Lattice:
        """Mark occluded and unobserved cells, as the policies say, and seen surfaces that no
        object of the map holds.

        Args:
            occluded: what to do with occluded space.
            grid: nodes of the field; the marks are `CELLS` times finer.
            objects: distance from its nodes to the level set, metres; None marks all that was
                seen of the objects.
            inner: another grid whose box is not to be marked.
        """
        spacing = grid.spacing / CELLS
        cells = tuple(CELLS * (n - 1) for n in grid.shape)
        shape = (cells[0], cells[1], cells[2])
        nodes = np.zeros(tuple(n + 1 for n in shape), dtype=np.uint8)
        if occluded != "free" or self._config.unobserved != "free":
            status = self._status(occluded, grid.origin, spacing, shape)
            if inner is not None:
                status[_cells_within(inner, grid.origin, spacing, shape)] = kernels.FREE
            marks = self._marks_of_status(occluded)
            run_chunked(
                lambda s: kernels.mark_corners(status, marks, nodes, s.start, s.stop),
                len(nodes),
                16,
            )
        for label, points, half in self._seen(grid, objects, 0.5 * spacing):
            kept: Any = slice(None)
            if inner is not None:
                kept = ((points < inner.origin) | (points > inner.upper)).any(axis=1)
            kernels.mark_boxes(
                points[kept], half[kept], grid.origin, spacing, np.uint8(label), nodes
            )
        return Lattice(nodes, grid.first * CELLS, CELLS)

    def _status(
        self,
        occluded: OccludedPolicy,
        origin: Float[np.ndarray, " 3"],
        spacing: float,
        shape: tuple[int, int, int],
    ) -> UInt8[np.ndarray, "nx ny nz"]:
        """What the views say of cells, and, where it decides, the posterior."""
        place = self._map.plane, origin, spacing, shape
        if self.below is None:
            status = visibility.classify_cells(self.views, *place)
        else:
            status = visibility.classify_cells_around(self.views, self.below, *place)
        if occluded == "posterior":
            _trust_posterior(self._map, self._config, status, origin, spacing)
        return status

    def _marks_of_status(self, occluded: OccludedPolicy) -> UInt8[np.ndarray, " 4"]:
        shadow = 0 if occluded == "free" else OCCLUDED
        unseen = 0 if self._config.unobserved == "free" else UNOBSERVED
        marks = np.zeros(4, dtype=np.uint8)
        marks[kernels.OCCLUDED] = shadow
        marks[kernels.PARTLY] = shadow or unseen
        marks[kernels.UNOBSERVED] = unseen
        return marks

    def _seen(
        self, grid: Grid, objects: Float32[np.ndarray, "nx ny nz"] | None, step: float
    ) -> Iterator[Surface]:
        """Marks, points and half the widths of what was seen, the less important first."""
        yield BACKGROUND, *self._clutter
        for k, points, half in self._surfaces:
            kept: Any = slice(None)
            if objects is not None:
                kept = off_level_set(points, objects, grid)
            yield BACKGROUND + k, points[kept], half[kept]
        ids = (*self._map.object_ids, *self.without_depth)
        for view, cones in zip(self._map.views, self._cones, strict=True):
            for object_id, points, half in lost_points(view, cones, grid.origin, grid.upper, step):
                yield BACKGROUND + 1 + ids.index(object_id), points, half


def _cells_within(
    inner: Grid, origin: Float[np.ndarray, " 3"], spacing: float, shape: tuple[int, int, int]
) -> tuple[slice, slice, slice]:
    """Cells that lie wholly inside another grid's box."""
    low = np.clip(np.ceil((inner.origin - origin) / spacing - 1e-9), 0, shape).astype(int)
    high = np.clip(np.floor((inner.upper - origin) / spacing + 1e-9), low, shape).astype(int)
    x, y, z = (slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
    return x, y, z


def _trust_posterior(
    map_: Any,
    config: WorldConfig,
    status: UInt8[np.ndarray, "nx ny nz"],
    origin: Float[np.ndarray, " 3"],
    spacing: float,
) -> None:
    """Call occluded cells free where the map has support: the posterior decides there.

    Not behind unlabelled clutter: the map has no class for that.
    """
    lower, upper = (np.asarray(c) for c in map_.support_bounds())
    first = np.clip(np.floor((lower - origin) / spacing).astype(int), 0, status.shape)
    last = np.clip(np.ceil((upper - origin) / spacing).astype(int), first, status.shape)
    hidden = status[tuple(slice(a, b) for a, b in zip(first, last, strict=True))]
    hidden = (hidden == kernels.OCCLUDED) | (hidden == kernels.PARTLY)
    if not hidden.any():
        return
    corner, size = origin + spacing * first, hidden.shape
    for view in map_.views:
        start = visibility.clutter_depth(view, map_.plane, config)
        if np.isfinite(start).any():
            plane = None if config.support == "seen" else map_.plane
            hidden &= ~visibility.behind(view, start, plane, corner, spacing, size)
    for x in range(size[0]):
        index = np.argwhere(hidden[x])
        if len(index) == 0:
            continue
        index = np.column_stack([np.full(len(index), x), index])
        known = np.asarray(map_.support(corner + spacing * (index + 0.5))) >= config.min_support
        where = tuple((index[known] + first).T)
        whole = status[where] == kernels.OCCLUDED
        status[where] = np.where(whole, kernels.FREE, kernels.UNOBSERVED)


def unmark(marks: Lattice, classes: Collection[int], inside: Lattice | None) -> Lattice:
    """Return the marks less some objects' seen surfaces, and less occluded nodes inside their
    level set (`inside`, on a finer lattice)."""
    labels = marks.labels.copy()
    labels[np.isin(labels, [BACKGROUND + k for k in classes])] = 0
    if inside is None:
        return Lattice(labels, marks.corner, CELLS)
    ratio = inside.factor // CELLS
    first = -(-inside.corner // ratio)  # first unseen node not below the fine corner
    skip = first * ratio - inside.corner
    fine = inside.labels[skip[0] :: ratio, skip[1] :: ratio, skip[2] :: ratio]
    start = first - marks.corner
    low = np.maximum(start, 0)
    high = np.minimum(start + np.array(fine.shape), labels.shape)
    window = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    part = fine[tuple(slice(a, b) for a, b in zip(low - start, high - start, strict=True))]
    target = labels[window]
    target[(part != 0) & (target == OCCLUDED)] = 0
    return Lattice(labels, marks.corner, CELLS)
