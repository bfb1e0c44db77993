# SPDX-License-Identifier: BSD-3-Clause
"""Obstacles that no object of the map accounts for: what nobody saw, and seen surfaces."""

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from vprism_plan._kernels import world as kernels
from vprism_plan.world import visibility
from vprism_plan.world.config import OccludedPolicy, WorldConfig
from vprism_plan.world.distance import Lattice
from vprism_plan.world.forgotten import forgotten_points
from vprism_plan.world.grid import Grid

CELLS = 2  # cells per grid step for everything that is seen or not seen
# Marks on that lattice; where several apply the largest wins.
UNOBSERVED, OCCLUDED, BACKGROUND = 1, 2, 3  # and 3 + k: seen surface of class k


def mark_unseen(
    map_: Any,
    views: Sequence[Any],
    config: WorldConfig,
    occluded: OccludedPolicy,
    grid: Grid,
    objects: Float32[np.ndarray, "nx ny nz"],
) -> Lattice:
    """Mark occluded and unobserved cells, as the policies say, and seen surfaces that no
    object of the map holds.

    Args:
        map_: the map.
        views: its views, made ready by `visibility.make_view`.
        config: policies; that for occluded space is given apart.
        occluded: what to do with occluded space.
        grid: nodes of the field; the marks are `CELLS` times finer.
        objects: distance from its nodes to the level set, metres.
    """
    spacing = grid.spacing / CELLS
    cells = tuple(CELLS * (n - 1) for n in grid.shape)
    shape = (cells[0], cells[1], cells[2])
    nodes = np.zeros(tuple(n + 1 for n in shape), dtype=np.uint8)
    if occluded != "free" or config.unobserved != "free":
        status = visibility.classify_cells(views, map_.plane, grid.origin, spacing, shape)
        shadow = 0 if occluded == "free" else OCCLUDED
        unseen = 0 if config.unobserved == "free" else UNOBSERVED
        marks = np.zeros(4, dtype=np.uint8)
        marks[kernels.OCCLUDED] = shadow
        marks[kernels.PARTLY] = shadow or unseen
        marks[kernels.UNOBSERVED] = unseen
        if occluded == "posterior":
            _trust_posterior(map_, config.min_support, status, grid, spacing)
        _mark_corners(marks[status], nodes)
    points, half = visibility.background_points(
        map_.views, map_.plane, config.background_height, config.lone_share
    )
    kernels.mark_boxes(points, half, grid.origin, spacing, np.uint8(BACKGROUND), nodes)
    for k, points, half in forgotten_points(
        map_.views, map_.object_ids, map_.plane, config.background_height, objects, grid
    ):
        kernels.mark_boxes(points, half, grid.origin, spacing, np.uint8(BACKGROUND + k), nodes)
    return Lattice(nodes, grid.first * CELLS, CELLS)


def _trust_posterior(
    map_: Any, min_support: float, status: UInt8[np.ndarray, "nx ny nz"], grid: Grid, spacing: float
) -> None:
    """Call occluded cells free where the map has support: the posterior decides there."""
    lower, upper = (np.asarray(c) for c in map_.support_bounds())
    first = np.clip(np.floor((lower - grid.origin) / spacing).astype(int), 0, status.shape)
    last = np.clip(np.ceil((upper - grid.origin) / spacing).astype(int), 0, status.shape)
    for x in range(int(first[0]), int(last[0])):
        part = status[x, first[1] : last[1], first[2] : last[2]]
        hidden = np.argwhere((part == kernels.OCCLUDED) | (part == kernels.PARTLY))
        if len(hidden) == 0:
            continue
        index = np.column_stack([np.full(len(hidden), x), hidden + first[1:]])
        centers = grid.origin + spacing * (index + 0.5)
        known = np.asarray(map_.support(centers)) >= min_support
        where = tuple(hidden[known].T)
        whole = part[where] == kernels.OCCLUDED
        part[where] = np.where(whole, kernels.FREE, kernels.UNOBSERVED)


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
    """Give every node the largest mark of the eight cells around it."""
    x, y, z = cells.shape
    grown = np.zeros((x + 1, y, z), dtype=np.uint8)
    grown[:-1] = cells
    np.maximum(grown[1:], cells, out=grown[1:])
    wider = np.zeros((x + 1, y + 1, z), dtype=np.uint8)
    wider[:, :-1] = grown
    np.maximum(wider[:, 1:], grown, out=wider[:, 1:])
    nodes[:, :, :-1] = wider
    np.maximum(nodes[:, :, 1:], wider, out=nodes[:, :, 1:])
