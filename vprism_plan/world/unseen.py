# SPDX-License-Identifier: BSD-3-Clause
"""Obstacles that no object of the map accounts for: what nobody saw, and seen surfaces."""

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, UInt8

from vprism_plan._kernels import world as kernels
from vprism_plan.world import visibility
from vprism_plan.world.config import OccludedPolicy, WorldConfig
from vprism_plan.world.distance import Lattice
from vprism_plan.world.grid import Grid
from vprism_plan.world.lost_depth import lost_objects, lost_points
from vprism_plan.world.seen_surfaces import surface_points

CELLS = 2  # cells per grid step for everything that is seen or not seen
# Marks on that lattice; where several apply the largest wins.
UNOBSERVED, OCCLUDED, BACKGROUND = 1, 2, 3  # and 3 + k: seen surface of class k


def ids_without_depth(map_: Any) -> tuple[int, ...]:
    """Labels of the map's views that have no return at all, sorted: no class of the map.

    Their marks follow those of the classes, BACKGROUND + C + 1 and on.
    """
    found = {i for view in map_.views for i in lost_objects(view)}
    return tuple(sorted(found - set(map_.object_ids)))


def mark_unseen(
    map_: Any,
    views: Sequence[visibility.View],
    config: WorldConfig,
    occluded: OccludedPolicy,
    grid: Grid,
    objects: Float32[np.ndarray, "nx ny nz"] | None,
    inner: Grid | None = None,
    below: Sequence[visibility.View] | None = None,
) -> Lattice:
    """Mark occluded and unobserved cells, as the policies say, and seen surfaces that no
    object of the map holds.

    Args:
        map_: the map.
        views: its views, made ready by `visibility.make_view`.
        config: policies; that for occluded space is given apart.
        occluded: what to do with occluded space.
        grid: nodes of the field; the marks are `CELLS` times finer.
        objects: distance from its nodes to the level set, metres; None marks all that was
            seen of the objects.
        inner: another grid whose box is not to be marked.
        below: the views once more, made ready without a plane, if the support surface ends.
    """
    spacing = grid.spacing / CELLS
    cells = tuple(CELLS * (n - 1) for n in grid.shape)
    shape = (cells[0], cells[1], cells[2])
    nodes = np.zeros(tuple(n + 1 for n in shape), dtype=np.uint8)
    hole = None if inner is None else _cells_within(inner, grid.origin, spacing, shape)
    if occluded != "free" or config.unobserved != "free":
        place = grid.origin, spacing, shape
        if below is None:
            status = visibility.classify_cells(views, map_.plane, *place)
        else:
            status = visibility.classify_cells_around(views, below, map_.plane, *place)
        shadow = 0 if occluded == "free" else OCCLUDED
        unseen = 0 if config.unobserved == "free" else UNOBSERVED
        marks = np.zeros(4, dtype=np.uint8)
        marks[kernels.OCCLUDED] = shadow
        marks[kernels.PARTLY] = shadow or unseen
        marks[kernels.UNOBSERVED] = unseen
        if occluded == "posterior":
            _trust_posterior(map_, config, status, grid.origin, spacing)
        marked = marks[status]
        if hole is not None:
            marked[hole] = 0
        _mark_corners(marked, nodes)

    def mark(points: Float[np.ndarray, "n 3"], half: Float[np.ndarray, " n"], label: int) -> None:
        if inner is not None:
            kept = ((points < inner.origin) | (points > inner.upper)).any(axis=1)
            points, half = points[kept], half[kept]
        kernels.mark_boxes(points, half, grid.origin, spacing, np.uint8(label), nodes)

    points, half = visibility.background_points(
        map_.views, map_.plane, config.background_height, config.lone_share, below is not None
    )
    mark(points, half, BACKGROUND)
    for k, points, half in surface_points(
        map_.views, map_.object_ids, map_.plane, objects, grid, below is not None
    ):
        mark(points, half, BACKGROUND + k)
    ids = (*map_.object_ids, *ids_without_depth(map_))
    for view in map_.views:
        for object_id, points, half in lost_points(
            view, map_.plane, grid.origin, grid.upper, 0.5 * spacing
        ):
            mark(points, half, BACKGROUND + 1 + ids.index(object_id))
    return Lattice(nodes, grid.first * CELLS, CELLS)


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


def _mark_corners(cells: UInt8[np.ndarray, "x y z"], nodes: UInt8[np.ndarray, "x1 y1 z1"]) -> None:
    """Raise every node to the largest mark of the eight cells around it."""
    x, y, z = cells.shape
    grown = np.zeros((x + 1, y, z), dtype=np.uint8)
    grown[:-1] = cells
    np.maximum(grown[1:], cells, out=grown[1:])
    wider = np.zeros((x + 1, y + 1, z), dtype=np.uint8)
    wider[:, :-1] = grown
    np.maximum(wider[:, 1:], grown, out=wider[:, 1:])
    np.maximum(nodes[:, :, :-1], wider, out=nodes[:, :, :-1])
    np.maximum(nodes[:, :, 1:], wider, out=nodes[:, :, 1:])
