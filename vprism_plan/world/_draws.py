# SPDX-License-Identifier: BSD-3-Clause
"""Joint draws of a map's weights, evaluated at the voxels that draws can disagree about."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Int32, UInt8
from scipy.special import ndtr

from vprism_plan._kernels import risk as kernels
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
