# SPDX-License-Identifier: BSD-3-Clause
"""Signed distances to the obstacles of every drawn world."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int16

from vprism_plan.errors import ConfigError
from vprism_plan.world import PosteriorWorlds
from vprism_plan.world.distance import Lattice, NodeDistances, distance_to_lattice, finish
from vprism_plan.world.grid import Grid

_STEPS = 512.0  # stored per voxel: 64 voxels either way fit 16 bits
_MOST = 2 << 30  # bytes
_AROUND = 2.6  # steps from a point to the farthest node that its spline reads


@dataclass(frozen=True, eq=False)
class DrawField:
    """Signed distance to the union of a draw's voxels and what is certain, for every draw.

    A voxel that a draw occupies counts as the ball inscribed in it, as in `PosteriorWorlds`.
    The nodes cover all that is nearer than `reach` to any voxel that any draw may occupy.
    Distances are cut off so far beyond it that the spline is itself up to there.

    Attributes:
        steps: (rules, nx, ny, nz, S) int16: distance in multiples of `unit`, one table per
            contact rule.
        blocks: (rules, bx, by, bz) least distance of any draw in blocks of 4 x 4 x 4 cells.
        grid: origin and spacing, metres.
        unit: metres.
        reach: metres.
    """

    steps: Int16[np.ndarray, "g nx ny nz s"]
    blocks: Float32[np.ndarray, "g bx by bz"]
    grid: Float[np.ndarray, " 4"]
    unit: float
    reach: float


def draw_field(
    worlds: PosteriorWorlds,
    rules: Sequence[frozenset[int]],
    certain: Sequence[Any],
    planes: Float[np.ndarray, "p 4"],
    reach: float,
) -> DrawField:
    """Bake the draws.

    Args:
        worlds: the draws.
        rules: ids of objects that may be touched, one set per contact rule.
        certain: distance field of what is an obstacle in every draw, per rule; empty if nothing.
        planes: half-spaces.
        reach: distances up to this are told apart, metres.

    Raises:
        ConfigError: that would take more than 2 GB, or `reach` is more than 57 voxels.
    """
    h = worlds.resolution
    unit = h / _STEPS
    row, _, first = worlds.owner_tables
    possible = np.argwhere(row >= 0)
    if len(possible) == 0:
        possible = np.zeros((1, 3), dtype=np.int64)
    whole = int(np.ceil(reach / h)) + 2
    low = possible.min(axis=0) + first - whole
    shape = tuple(int(n) for n in possible.max(axis=0) + first + whole + 1 - low)
    if reach + _AROUND * h > 60.0 * h:
        raise ConfigError(
            f"contacts up to {reach:.3f} m matter, but {60.0 * h:.3f} m is as far as voxels of "
            f"{h} m tell; lower the temperature, or use a coarser resolution"
        )
    size = 2 * len(rules) * int(np.prod(shape)) * worlds.n_worlds
    if size > _MOST:
        raise ConfigError(
            f"n_worlds is {worlds.n_worlds}: {len(rules)} tables of {' x '.join(map(str, shape))} "
            f"nodes would take {size / 2**30:.1f} GB (at most 2); use fewer worlds, or a coarser "
            "resolution of the world"
        )
    grid = Grid(h, low, (shape[0], shape[1], shape[2]))
    nodes = grid.slab(0, shape[0])
    inner = tuple(slice(whole, n - whole) for n in shape)
    index = np.moveaxis(np.indices([s.stop - s.start for s in inner]), 0, -1).reshape(-1, 3)
    owners = worlds.owners(index + low + whole)
    ids = [0, *worlds.map.object_ids]
    steps = np.empty((len(rules), *shape, worlds.n_worlds), dtype=np.int16)
    for g, gone in enumerate(rules):
        counts = np.array([k > 0 and ids[k] not in gone for k in range(len(ids))])
        floor = np.full(len(nodes), np.inf)
        for plane in planes:
            np.minimum(floor, nodes @ plane[:3] - plane[3], out=floor)
        if certain:
            np.minimum(floor, certain[g].lower_bound(nodes), out=floor)
        fixed = np.maximum(floor, 0.0).astype(np.float32).reshape(shape)
        for s in range(worlds.n_worlds):
            marks = np.zeros(shape, dtype=np.uint8)
            marks[inner] = counts[owners[:, s]].reshape(marks[inner].shape)
            away, _ = distance_to_lattice(Lattice(marks, low, 1), grid)
            away = np.minimum(np.maximum(away - np.float32(0.5 * h), 0.0), fixed)
            none = np.zeros(shape, dtype=np.int16)
            signed = finish(NodeDistances(away, none), grid, (), solid_outside=False).distance
            steps[g, ..., s] = np.floor(np.clip(signed, -60.0 * h, reach + _AROUND * h) / unit)
    lowest = steps.min(axis=4) * np.float32(unit)
    return DrawField(steps, _block_least(lowest), np.array([*grid.origin, h]), unit, reach)


def _block_least(
    values: Float32[np.ndarray, "g nx ny nz"],
) -> Float32[np.ndarray, "g bx by bz"]:
    for axis, n in enumerate(values.shape[1:], start=1):
        starts = 4 * np.arange((n - 1) // 4 + 1)[:, None]
        # A point between nodes i and i + 1 hears of i - 1 to i + 2.
        rows = np.clip(starts + np.arange(-1, 6), 0, n - 1)
        values = np.take(values, rows, axis=axis).min(axis=axis + 1)
    return np.ascontiguousarray(values, dtype=np.float32)
