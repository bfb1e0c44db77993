# SPDX-License-Identifier: BSD-3-Clause
"""The kernel transform of equation (1), kept sparse, and where its matrices are stored.

phi(x) = [k(x, h_1), ..., k(x, h_H), 1] with k(x, h) = exp(-gamma |x - h|^2), exactly 0
beyond the cutoff radius r. Two hinges more than 2 r apart are never both active, so with
hinges sorted along their longest axis every Gram matrix fills only an envelope around
the diagonal (plus the bias, which is last). Cholesky factors stay inside the envelope.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, Int64
from scipy.spatial import cKDTree

from vprism_plan._kernels import mapping as kernels
from vprism_plan._threads import run_chunked

_MAX_CELLS = 2_000_000


def sorted_hinges(hinges: Float[np.ndarray, "h 3"]) -> Float[np.ndarray, "h 3"]:
    """Return the hinges ordered along their longest extent, so that envelopes are narrow."""
    extent = np.ptp(hinges, axis=0) if len(hinges) else np.zeros(3)
    axes = np.argsort(-extent, kind="stable")
    order = np.lexsort((hinges[:, axes[2]], hinges[:, axes[1]], hinges[:, axes[0]]))
    return np.ascontiguousarray(hinges[order])


@dataclass(frozen=True, eq=False)
class FeatureSpace:
    """Hinge points (sorted, m), kernel and cutoff; M = H + 1 features, the bias last."""

    hinges: Float[np.ndarray, "h 3"]
    gamma: float
    radius: float

    @property
    def size(self) -> int:
        """Number of features M, bias included."""
        return len(self.hinges) + 1

    def part(self, members: Int64[np.ndarray, " m"]) -> "FeatureSpace":
        """Return the space of some of the features, in their order; the bias is the last."""
        if len(members) == self.size:
            return self
        return FeatureSpace(self.hinges[members[:-1]], self.gamma, self.radius)

    def _near(self) -> Int64[np.ndarray, "p 2"]:
        """Pairs of hinges that some point may see both of, the later one first."""
        if len(self.hinges) == 0:
            return np.zeros((0, 2), np.int64)
        # The slack covers hinges exactly two radii apart, up to rounding.
        reach = 2.0 * self.radius * (1.0 + 1e-9)
        found = cKDTree(self.hinges).query_pairs(reach, output_type="ndarray")
        return found[:, ::-1].astype(np.int64)  # scipy gives i < j

    @property
    def pairs(self) -> Int64[np.ndarray, "p 2"]:
        """Rows and columns of the lower triangle in which any Gram matrix is not 0, in order."""
        every = np.arange(self.size)
        bias = np.column_stack([np.full(self.size - 1, self.size - 1), every[:-1]])
        found = np.concatenate([self._near(), np.column_stack([every, every]), bias])
        key = np.sort(found @ [self.size, 1])
        return np.column_stack([key // self.size, key % self.size])

    @cached_property
    def row_first(self) -> Int64[np.ndarray, " m"]:
        """First column of each envelope row."""
        first = np.arange(self.size)
        rows, columns = self._near().T
        np.minimum.at(first, rows, columns)
        first[-1] = 0
        return first

    @cached_property
    def base(self) -> Int64[np.ndarray, " m"]:
        """Entry (i, j), j <= i, of the envelope is at base[i] + j."""
        lengths = np.arange(self.size) - self.row_first + 1
        return np.concatenate(([0], np.cumsum(lengths)[:-1])) - self.row_first

    @cached_property
    def envelope_size(self) -> int:
        """Stored entries of one symmetric matrix."""
        return int(self.base[-1]) + self.size

    @property
    def diagonal(self) -> Int64[np.ndarray, " m"]:
        """Positions of the diagonal entries."""
        return self.base + np.arange(self.size)

    @cached_property
    def cells(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, float, np.ndarray, float]:
        """Cell list of the hinges as the kernels take it: starts, items, origin, edge, shape, r."""
        if len(self.hinges) == 0:
            return (
                np.zeros(2, np.int64), np.zeros(0, np.int64), np.zeros(3), 1.0,
                np.ones(3, np.int64), self.radius,
            )  # fmt: skip
        lower = self.hinges.min(axis=0)
        edge = self.radius / 2.0
        shape = np.floor(np.ptp(self.hinges, axis=0) / edge) + 1.0
        while shape.prod() > _MAX_CELLS:
            edge *= 2.0
            shape = np.floor(np.ptp(self.hinges, axis=0) / edge) + 1.0
        shape = shape.astype(np.int64)
        index = np.minimum(((self.hinges - lower) / edge).astype(np.int64), shape - 1)
        key = (index[:, 0] * shape[1] + index[:, 1]) * shape[2] + index[:, 2]
        items = np.argsort(key, kind="stable").astype(np.int64)
        start = np.searchsorted(key[items], np.arange(shape.prod() + 1)).astype(np.int64)
        return start, items, lower, edge, shape, self.radius

    @property
    def kernel_arguments(self) -> tuple[Any, Any, Any, Any, Any, Any, Any]:
        """What every kernel that finds neighbours takes, after the points and blocks."""
        return (self.hinges, *self.cells)

    @cached_property
    def bounds(self) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
        """Box (m) outside which every kernel feature is exactly 0."""
        if len(self.hinges) == 0:
            return np.full(3, np.inf), np.full(3, -np.inf)
        return self.hinges.min(axis=0) - self.radius, self.hinges.max(axis=0) + self.radius


def make_blocks(
    points: Float[np.ndarray, "n 3"], extent: float
) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " b"]]:
    """Group near points: their order along a Morton curve, and where each block starts.

    A block holds at most `kernels.BLOCK` points and is at most `extent` (m) wide; the
    starts end with n.
    """
    if len(points) == 0:
        return np.zeros(0, np.int64), np.zeros(1, np.int64)
    lower = points.min(axis=0)
    widest = float((points.max(axis=0) - lower).max())
    # 20 bits per axis fit the key; cells much smaller than a block's width are enough.
    edge = max(0.2 * extent, widest / 2**20, 1e-12)
    order = np.argsort(kernels.morton_keys(points, lower, edge), kind="stable").astype(np.int64)
    return order, kernels.cut_blocks(points, order, extent)


@dataclass(frozen=True, eq=False)
class BlockFeatures:
    """Features of training points, block by block.

    Attributes:
        order: the points in block order.
        block_start: where each block starts in `order`, then n.
        near_start: where each block's hinges start in `near` and `phi`.
        near: hinge indices, sorted within a block, the bias last.
        phi: features of the block's points, zero-padded.
    """

    order: Int64[np.ndarray, " n"]
    block_start: Int64[np.ndarray, " b1"]
    near_start: Int64[np.ndarray, " b1"]
    near: Int64[np.ndarray, " e"]
    phi: Float[np.ndarray, "e p"]

    def part(self, members: Int64[np.ndarray, " m"]) -> "BlockFeatures":
        """Return some of the features, in their order, of all points."""
        size = int(members[-1]) + 1
        if len(members) == size:
            return self
        place = np.full(size, -1)
        place[members] = np.arange(len(members))
        near = place[self.near]
        kept = near >= 0
        near_start = np.concatenate(([0], np.cumsum(kept)))[self.near_start]
        return BlockFeatures(self.order, self.block_start, near_start, near[kept], self.phi[kept])

    @property
    def arguments(self) -> tuple[Any, Any, Any, Any]:
        """What the learning kernels take: starts, hinge lists and features."""
        return self.block_start, self.near_start, self.near, self.phi


def block_extent(space: FeatureSpace) -> float:
    """Return the width of a block (m) that balances shared hinges against padding."""
    return 0.5 * space.radius


def block_features(space: FeatureSpace, points: Float[np.ndarray, "n 3"]) -> BlockFeatures:
    """Transform points (m)."""
    points = np.ascontiguousarray(points, dtype=np.float64)
    order, block_start = make_blocks(points, block_extent(space))
    blocks = len(block_start) - 1
    count = np.zeros(blocks, np.int64)
    cells = space.kernel_arguments

    def count_chunk(piece: slice) -> None:
        kernels.count_neighbours(points, order, block_start, piece.start, piece.stop, *cells, count)

    run_chunked(count_chunk, blocks, 512)
    near_start = np.concatenate(([0], np.cumsum(count + 1)))
    near = np.empty(near_start[-1], np.int64)
    phi = np.empty((near_start[-1], kernels.BLOCK))
    reach = space.radius**2

    def fill_chunk(piece: slice) -> None:
        kernels.block_features(
            points, order, block_start, piece.start, piece.stop, *cells,
            space.gamma, reach, near_start, near, phi,
        )  # fmt: skip

    run_chunked(fill_chunk, blocks, 512)
    return BlockFeatures(order, block_start, near_start, near, phi)
