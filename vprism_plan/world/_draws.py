# SPDX-License-Identifier: BSD-3-Clause
"""Joint draws of a map's weights, evaluated at the voxels that draws can disagree about."""

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Int32, UInt8
from scipy.special import ndtr

from vprism_plan._kernels import risk as kernels
from vprism_plan._kernels.risk import BLOCK
from vprism_plan.errors import WorldError

_MAX_VOXELS = 40_000_000
_GEMM_ROWS = 1024  # points per matrix product: their logits stay in the cache


@dataclass(frozen=True, eq=False)
class Verdicts:
    """What every draw is taken to say of each voxel before any is drawn.

    Attributes:
        first: index of voxel (0, 0, 0); voxel i has its centre at resolution * (first + i).
        row: (nx, ny, nz) int32: -1 free in every draw; k - 1 < C class k in every draw;
            from C on, the voxels that have to be drawn.
        voxels: (n, 3) the latter, in the order of their rows.
        error_free: bound on the probability that a draw occupies any voxel called free.
        error_occupied: bound on the probability that a draw frees, or gives to another
            object, any voxel called occupied.
    """

    first: Int[np.ndarray, " 3"]
    row: Int32[np.ndarray, "nx ny nz"]
    voxels: Int[np.ndarray, "n 3"]
    error_free: float
    error_occupied: float


def judge(map_: Any, resolution: float, tolerance: float) -> Verdicts:
    """Find the voxels whose draws are certain, so that nobody has to draw them.

    With Gaussian logits z of mean m and variance v, and C objects, a draw occupies a
    voxel only if some z_k - z_0 > -ln C: by the union bound its probability is at most
    sum_k Phi(-(m_0 - m_k - ln C) / sqrt(v_0 + v_k)). It does not give the voxel to class k
    only if z_k < z_0 or z_k < z_j for another object j: a sum of the same form. The voxels
    with the smallest bounds are skipped, as many as sum up to half the tolerance each
    way; the sum bounds the probability that any of them is wrong, so it bounds the error
    of the probability of any event, a path's collision included.
    """
    lower, upper = (np.asarray(corner) for corner in map_.support_bounds())
    n_objects = len(map_.object_ids)
    if n_objects == 0 or not np.isfinite(lower).all() or not (lower < upper).all():
        nothing = np.full((1, 1, 1), -1, np.int32)
        return Verdicts(np.zeros(3, np.int64), nothing, np.zeros((0, 3), np.int64), 0.0, 0.0)
    first = np.ceil(lower / resolution).astype(np.int64)
    shape = np.floor(upper / resolution).astype(np.int64) - first + 1
    if np.prod(shape, dtype=np.float64) > _MAX_VOXELS:
        raise WorldError(
            f"the map's support spans {' x '.join(map(str, shape))} voxels of {resolution} m "
            f"(at most {_MAX_VOXELS:,}); use a coarser resolution"
        )
    occupied, lost, owner = _tails(map_, first, shape, resolution)
    free = _skippable(occupied, 0.5 * tolerance)
    certain = _skippable(lost, 0.5 * tolerance) & ~free
    row = np.full(len(free), -1, np.int32)
    row[certain] = owner[certain] - 1
    drawn = np.flatnonzero(~free & ~certain)
    row[drawn] = n_objects + np.arange(len(drawn), dtype=np.int32)
    voxels = np.column_stack(np.unravel_index(drawn, tuple(shape)))
    return Verdicts(
        first,
        row.reshape(tuple(shape)),
        voxels.astype(np.int64),
        float(occupied[free].sum()),
        float(lost[certain].sum()),
    )


def _tails(
    map_: Any, first: Int[np.ndarray, " 3"], shape: Int[np.ndarray, " 3"], resolution: float
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], UInt8[np.ndarray, " n"]]:
    """Bounds on P(occupied) and P(not the likeliest object's) of each voxel, and that object."""
    n = int(np.prod(shape))
    occupied, lost, owner = np.empty(n), np.empty(n), np.empty(n, np.uint8)
    n_objects = len(map_.object_ids)
    slab = int(shape[1] * shape[2])
    step = max(1, 200_000 // slab)
    for start in range(0, int(shape[0]), step):
        stop = min(start + step, int(shape[0]))
        index = np.moveaxis(np.indices((stop - start, int(shape[1]), int(shape[2]))), 0, -1)
        points = resolution * (index.reshape(-1, 3) + first + [start, 0, 0])
        mean, variance = map_.logit_moments(points)
        piece = slice(start * slab, stop * slab)
        gap = mean[:, 1:] - mean[:, :1]
        spread = np.sqrt(variance[:, 1:] + variance[:, :1])
        occupied[piece] = ndtr((gap + np.log(n_objects)) / spread).sum(axis=1)
        best = gap.argmax(axis=1)
        rows = np.arange(len(mean))
        miss = ndtr(-gap[rows, best] / spread[rows, best])
        lead = (gap[rows, best, None] - gap) / np.sqrt(
            variance[rows, 1 + best, None] + variance[:, 1:]
        )
        others = ndtr(-lead)
        others[rows, best] = 0.0
        lost[piece] = miss + others.sum(axis=1)
        owner[piece] = best + 1
    return occupied, lost, owner


def _skippable(bound: Float[np.ndarray, " n"], budget: float) -> Bool[np.ndarray, " n"]:
    """Mark the entries with the smallest bounds, as many as sum up to at most the budget."""
    order = np.argsort(bound, kind="stable")
    count = int(np.searchsorted(np.cumsum(bound[order]), budget, side="right"))
    skip = np.zeros(len(bound), np.bool_)
    skip[order[:count]] = True
    return skip


class Draws:
    """Owners of voxels in S draws of one map's weights; immutable but for its cache.

    Args:
        map_: a `VPrismMap`.
        n_worlds: S.
        seed: of `map_.sample_weights`.
    """

    def __init__(self, map_: Any, n_worlds: int, seed: int) -> None:
        weights = map_.sample_weights(n_worlds, seed)
        self._hinges = map_.space.hinges
        self._gamma = map_.space.gamma
        self._radius = map_.space.radius
        self._n_worlds = n_worlds
        self._n_classes = weights.shape[2]
        # Features first, so that a product over the hinges near a block reads whole rows.
        flat = np.moveaxis(weights, 0, 1).reshape(weights.shape[1], -1)
        self._weights = np.ascontiguousarray(flat[:-1])
        self._bias = flat[-1].copy()

    def owners(self, points: Float[np.ndarray, "n 3"], out: UInt8[np.ndarray, "n s"]) -> None:
        """Fill out (n, S) with the class that occupies each point (m) in each draw; 0 is none.

        Points should be near each other: the cost is O(points x hinges near any x S x K).
        """
        for start in range(0, len(points), _GEMM_ROWS):
            part = points[start : start + _GEMM_ROWS]
            low, high = part.min(axis=0) - self._radius, part.max(axis=0) + self._radius
            near = np.flatnonzero(((self._hinges > low) & (self._hinges < high)).all(axis=1))
            away = ((part[:, None] - self._hinges[near]) ** 2).sum(axis=2)
            phi = np.where(away <= self._radius**2, np.exp(-self._gamma * away), 0.0)
            logits = phi @ self._weights[near] + self._bias
            kernels.classify(
                logits, self._n_worlds, self._n_classes, out[start : start + _GEMM_ROWS]
            )


class Owners:
    """Owners of the voxels of a map's support in S draws.

    One thread at a time may `draw`.

    Args:
        map_: a `VPrismMap`.
        n_worlds: S.
        seed: of the draws.
        resolution: edge of a voxel, metres.
        verdicts: what needs no drawing.

    Attributes:
        first: index of voxel (0, 0, 0): the centre of voxel i is resolution * (first + i).
        row: (nx, ny, nz) int32: -1 free in every draw, else a row of `table`.
        voxels: (n, 3) those that have to be drawn, in the order of their rows.
        table: (r, S) uint8: one row per object, then one per voxel: 0 free, k the object
            `map.object_ids[k - 1]`; not filled before its block is drawn.
    """

    def __init__(
        self, map_: Any, n_worlds: int, seed: int, resolution: float, verdicts: Verdicts
    ) -> None:
        self.first, self.row, self.voxels = verdicts.first, verdicts.row, verdicts.voxels
        self._map, self._n_worlds, self._resolution = map_, n_worlds, resolution
        self._seed = seed
        self._draws: Draws | None = None
        n_objects = len(map_.object_ids)
        self.table = np.empty((n_objects + len(self.voxels), n_worlds), np.uint8)
        self.table[:n_objects] = np.arange(1, n_objects + 1, dtype=np.uint8)[:, None]
        self._shape = tuple(-(-n // BLOCK) for n in self.row.shape)
        key = self.block_of(self.voxels)
        self._by_block = np.argsort(key, kind="stable").astype(np.int64)
        starts = np.arange(int(np.prod(self._shape)) + 1)
        self._block_start = np.searchsorted(key[self._by_block], starts).astype(np.int64)
        self._drawn = np.diff(self._block_start) == 0

    def redrawn(self, seed: int) -> "Owners":
        """Return the owners in as many other draws, none of them drawn yet."""
        other = copy.copy(self)
        other._seed, other._draws = seed, None
        other.table = self.table.copy()
        other._drawn = np.diff(self._block_start) == 0
        return other

    def snapshot(self) -> "Owners":
        """Return the same with tables of their own, which `draw` here does not change."""
        other = copy.copy(self)
        other.table, other._drawn = self.table.copy(), self._drawn.copy()
        return other

    @property
    def nbytes(self) -> int:
        """Bytes held."""
        return sum(int(p.nbytes) for p in (self.row, self.table, self.voxels, self._by_block))

    def rows_of(self, local: Int[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
        """Return the row of `table` of each voxel, -1 for free ones and outside the support."""
        inside = ((local >= 0) & (local < self.row.shape)).all(axis=1)
        rows = np.full(len(local), -1, np.int64)
        rows[inside] = self.row[tuple(local[inside].T)]
        return rows

    def block_of(self, local: Int[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
        """Return the flat index of the block that holds each voxel."""
        return np.ravel_multi_index(tuple((local // BLOCK).T), self._shape).astype(np.int64)

    def blocks_within(
        self, low: Int[np.ndarray, "b 3"], high: Int[np.ndarray, "b 3"]
    ) -> Int[np.ndarray, " n"]:
        """Return the blocks that boxes of voxels, the upper corners included, meet."""
        shape = np.array(self._shape)
        near = np.zeros(self._shape, np.bool_)
        for first, last in zip(low // BLOCK, high // BLOCK + 1, strict=True):
            corners = np.clip(first, 0, shape), np.clip(last, 0, shape)
            near[tuple(slice(a, b) for a, b in zip(*corners, strict=True))] = True
        return np.flatnonzero(near).astype(np.int64)

    def sample(self) -> Draws:
        """Return the draws of the weights, made when first asked for: seconds for a large map."""
        if self._draws is None:
            self._draws = Draws(self._map, self._n_worlds, self._seed)
        return self._draws

    def draw(self, blocks: Int[np.ndarray, " b"]) -> None:
        """Fill the rows of all voxels of some blocks."""
        first_row = len(self._map.object_ids)
        for block in blocks[~self._drawn[blocks]]:
            piece = slice(int(self._block_start[block]), int(self._block_start[block + 1]))
            members = self._by_block[piece]
            points = self._resolution * (self.voxels[members] + self.first)
            found = np.empty((len(members), self._n_worlds), np.uint8)
            self.sample().owners(points, found)
            self.table[first_row + members] = found
            self._drawn[block] = True
