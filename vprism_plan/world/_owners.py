# SPDX-License-Identifier: BSD-3-Clause
"""Which object occupies which voxel in each draw, drawn block by block when somebody asks."""

import copy
from typing import Any

import numpy as np
from jaxtyping import Int

from vprism_plan._kernels.risk import BLOCK
from vprism_plan.world._draws import Draws, Verdicts


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
