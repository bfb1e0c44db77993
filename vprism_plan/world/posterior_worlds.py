# SPDX-License-Identifier: BSD-3-Clause
"""Possible worlds: joint draws from a map's posterior, ready to be asked for collisions."""

import copy
import threading
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Int32, UInt8

from vprism_plan._kernels import risk as kernels
from vprism_plan._threads import run_chunked
from vprism_plan.errors import WorldError
from vprism_plan.world._draws import Owners, judge
from vprism_plan.world.distance import checked_points

_MAX_REACH = 31  # voxels; squared distances of three axes then fit the 16 bits of the kernels
_FINEST = 16.0  # stored steps per voxel, at most
_B = kernels.BLOCK


@dataclass(frozen=True)
class Tables:
    """What the kernels read: see `vprism_plan._kernels.risk`. One consistent snapshot."""

    distance_row: Int32[np.ndarray, "g ex ey ez"]
    rows: UInt8[np.ndarray, "r s"]
    lowest: UInt8[np.ndarray, " r"]


class PosteriorWorlds:
    """S joint draws of a map's weights: S worlds that the camera's view does not tell apart.

    In draw s a voxel is occupied where 1 - softmax(phi(x) W_s)_0 > 1/2 at its centre x,
    the level of the mesh, and belongs to the object of the largest logit. The same draw
    holds everywhere, so what hides in one place is correlated with what hides next to it.

    Per voxel and draw one byte holds the distance to the nearest occupied voxel centre,
    rounded down. A ball is compared with it at the nodes of the cell around its centre; what
    they leave open is looked up voxel by voxel. An occupied voxel counts as the ball
    inscribed in it: a draw is touched if the centre of a voxel it occupies is within
    radius + resolution / 2 of a ball's centre.

    Nothing is baked before somebody asks: a block of 16^3 voxels is drawn and baked when
    the first ball lies in it (`bake` does it ahead). Memory: 4 bytes per voxel of the
    map's support grown by `reach`, S bytes per drawn voxel and S bytes per baked voxel
    within `reach` of anything that any draw may occupy.

    Args:
        map: a `VPrismMap`.
        n_worlds: number of draws S, a multiple of 64.
        seed: of the draws; the same seed, the same worlds.
        resolution: edge of a voxel, metres; centres are whole multiples of it.
        reach: distances up to this are known, metres: two and a half voxels more than the
            largest ball that will be asked about. At most 31 voxels.
        tolerance: how probable it may be that skipping the draws of nearly certain voxels
            changes any answer (see `error_free`, `error_occupied`).

    Attributes:
        error_free: bound on the probability that a draw differs in a voxel that was called
            free without drawing: how much a probability of collision may be too low.
        error_occupied: the same for voxels called occupied: how much it may be too high.

    Raises:
        WorldError: a value outside its range; the map's support is too large.
    """

    def __init__(
        self,
        map: Any,
        n_worlds: int = 256,
        seed: int = 0,
        resolution: float = 0.01,
        reach: float = 0.2,
        tolerance: float = 1e-3,
    ) -> None:
        if n_worlds < 64 or n_worlds % 64:
            raise WorldError(f"n_worlds is {n_worlds}; it must be a positive multiple of 64")
        if not (np.isfinite(resolution) and resolution > 0.0):
            raise WorldError(f"resolution is {resolution}; it must be a positive length in metres")
        if not 2.0 <= reach / resolution <= _MAX_REACH:
            raise WorldError(
                f"reach is {reach} m, {reach / resolution:.1f} voxels of {resolution} m; it must "
                f"be 2 to {_MAX_REACH} voxels: use a coarser resolution for larger balls"
            )
        if not 0.0 <= tolerance <= 0.1:
            raise WorldError(f"tolerance is {tolerance}; it must be a probability up to 0.1")
        self.map = map
        self.n_worlds = n_worlds
        self.seed = seed
        self.resolution = float(resolution)
        self.reach = float(reach)
        verdicts = judge(map, self.resolution, tolerance)
        self.error_free = verdicts.error_free
        self.error_occupied = verdicts.error_occupied
        self._owners = Owners(map, n_worlds, seed, self.resolution, verdicts)

        self._reach = reach / self.resolution  # voxels
        self._whole = int(self._reach)
        self._scale = min(_FINEST, 254.0 / self._reach)
        squares = np.arange(3 * self._whole**2 + 2, dtype=np.float64)
        self._lut = np.floor(self._scale * np.sqrt(squares)).clip(max=254).astype(np.uint8)
        self._lut[squares > self._reach**2] = kernels.NOTHING
        self._grown = self._grow()
        self._first_table = self._owners.first - self._whole
        self._rules: list[frozenset[int]] = [frozenset()]
        self._tables = Tables(
            self._grown[None].copy(),
            np.empty((0, n_worlds), np.uint8),
            np.empty(0, np.uint8),
        )
        self._lock = threading.RLock()

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the lock; nobody fills the tables of a copy but the copy."""
        with self._lock:
            state = {**self.__dict__, "_owners": self._owners.snapshot()}
        del state["_lock"]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._lock = threading.RLock()

    def __repr__(self) -> str:
        return (
            f"PosteriorWorlds(n_worlds={self.n_worlds}, seed={self.seed}, "
            f"drawn_voxels={len(self._owners.voxels)}, nbytes={self.nbytes})"
        )

    def redrawn(self, seed: int) -> "PosteriorWorlds":
        """Return as many other worlds of the same map, with nothing baked yet.

        Shares what does not depend on the draws. A path that was chosen because few of these
        worlds object to it is judged fairly only by worlds that had no say in the choice.
        """
        other = copy.copy(self)
        other.seed = seed
        other._owners = self._owners.redrawn(seed)
        with self._lock:
            other._rules = list(self._rules)
        other._tables = Tables(
            np.repeat(self._grown[None], len(other._rules), axis=0),
            np.empty((0, self.n_worlds), np.uint8),
            np.empty(0, np.uint8),
        )
        return other

    def sample(self) -> None:
        """Draw the weights and bake a first block now, seconds that the first question saves."""
        with self._lock:
            self._owners.sample()
        needed = np.argwhere(self._grown == kernels.UNBAKED)
        self._bake(0, needed[:1] // _B)

    # --- what is where ---------------------------------------------------------------
    def owners(self, index: Int[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "n s"]:
        """Return which object occupies each voxel in each draw.

        Args:
            index: (n, 3) voxel indices: centres are `resolution * index`, metres.

        Returns:
            (n, S): 0 free, k the object `map.object_ids[k - 1]`.

        Raises:
            WorldError: index is not (n, 3) integers.
        """
        index = np.asarray(index)
        if index.ndim != 2 or index.shape[1] != 3 or not np.issubdtype(index.dtype, np.integer):
            raise WorldError(
                f"index has shape {index.shape} and dtype {index.dtype}; it must be (n, 3) integers"
            )
        local = index - self._owners.first
        rows = self._owners.rows_of(local)
        with self._lock:
            self._owners.draw(np.unique(self._owners.block_of(local[rows >= 0])))
        out = np.zeros((len(index), self.n_worlds), np.uint8)
        out[rows >= 0] = self._owners.table[rows[rows >= 0]]
        return out

    def touched(
        self,
        centers: Float[np.ndarray, "n 3"],
        radii: Any,
        without: Collection[int] = (),
    ) -> Bool[np.ndarray, "n s"]:
        """Return in which draws each ball touches an occupied voxel.

        Never misses a voxel centre inside a ball. The probability that a body swept along
        a path touches anything is `touched(...).any(axis=0).mean()`.

        Args:
            centers: (n, 3) world coordinates, metres.
            radii: of all balls, or of each (n,), metres.
            without: ids of objects that may be touched.

        Raises:
            WorldError: not finite, a radius that `reach` does not cover, an unknown object.
        """
        centers = checked_points(centers)
        radii = np.array(np.broadcast_to(radii, len(centers)), dtype=np.float64)
        self.require_reach(radii)
        rule = self.rule(without)
        out = np.empty((len(centers), self.n_worlds), np.bool_)
        while True:
            tables = self._tables
            wanted = self.new_marks()
            missing = kernels.touch_each(
                centers, radii, rule, tables.distance_row, tables.rows, tables.lowest,
                self.first, self.resolution, self._scale, self._reach, out, wanted,
            )  # fmt: skip
            if not missing:
                return out
            self.bake_marked(wanted)

    def bake(self, lower: Any = None, upper: Any = None, without: Collection[int] = ()) -> None:
        """Draw and bake every block that a box (corners, world, metres) meets; None is all."""
        rule = self.rule(without)
        shape = np.array(self._blocks_of_table())
        corners = []
        for corner, default in ((lower, 0), (upper, None)):
            if corner is None:
                corners.append(np.zeros(3, int) if default == 0 else shape)
            else:
                point = checked_points(np.reshape(np.asarray(corner, dtype=np.float64), (1, -1)))[0]
                step = np.floor((point / self.resolution - self.first + 0.5) / _B).astype(int)
                corners.append(np.clip(step + (default is None), 0, shape))
        sizes = np.maximum(corners[1] - corners[0], 0)
        blocks = np.moveaxis(np.indices(tuple(sizes)), 0, -1).reshape(-1, 3) + corners[0]
        table = self._tables.distance_row[rule]
        open_blocks = [
            block for block in blocks if (table[_block_slices(block)] == kernels.UNBAKED).any()
        ]
        self._bake(rule, np.array(open_blocks, dtype=np.int64).reshape(-1, 3))

    @property
    def nbytes(self) -> int:
        """Bytes held now, by voxel indices, owners and distances."""
        tables = self._tables
        parts = (self._owners, self._grown, tables.distance_row, tables.rows)
        return sum(int(p.nbytes) for p in parts)

    # --- for the risk of robots ----------------------------------------------------------
    @property
    def first(self) -> Int[np.ndarray, " 3"]:
        """Index of the tables' first voxel."""
        return self._first_table

    @property
    def tables(self) -> Tables:
        """Everything baked so far."""
        return self._tables

    @property
    def owner_tables(self) -> tuple[Any, Any, Any]:
        """Rows of the owners per voxel, the owners (S innermost), and the first voxel."""
        return self._owners.row, self._owners.table, self._owners.first

    @property
    def scale(self) -> tuple[float, float]:
        """Stored steps per voxel, and the reach in voxels."""
        return self._scale, self._reach

    def new_marks(self) -> Bool[np.ndarray, "g bx by bz"]:
        """Return unset marks for blocks that have to be baked, per rule."""
        return np.zeros((len(self._rules), *self._blocks_of_table()), np.bool_)

    def bake_marked(self, wanted: Bool[np.ndarray, "g bx by bz"]) -> None:
        """Bake the marked blocks."""
        for rule in range(len(wanted)):
            if wanted[rule].any():
                self._bake(rule, np.argwhere(wanted[rule]))

    def rule(self, without: Collection[int]) -> int:
        """Return the index of the table that leaves out some objects; makes it if needed.

        Raises:
            WorldError: the map has no such object.
        """
        valid = list(self.map.object_ids)
        unknown = sorted(set(without) - set(valid))
        if unknown:
            raise WorldError(f"no object {unknown[0]} in the map; it has {valid}")
        gone = frozenset(valid.index(i) + 1 for i in without)
        with self._lock:
            if gone not in self._rules:
                old = self._tables
                rows = np.concatenate([old.distance_row, self._grown[None]])
                self._tables = Tables(rows, old.rows, old.lowest)
                self._rules = [*self._rules, gone]
            return self._rules.index(gone)

    def counting(self) -> Bool[np.ndarray, "g 256"]:
        """Return which object classes count as occupied under each rule."""
        counts = np.ones((len(self._rules), 256), np.bool_)
        counts[:, 0] = False
        for rule, gone in enumerate(self._rules):
            counts[rule, sorted(gone)] = False
        return counts

    def require_reach(self, radii: Any) -> None:
        """Raise WorldError unless balls of these radii (m) are covered by `reach`."""
        largest = float(np.max(radii, initial=0.0))
        if not (np.isfinite(radii).all() and np.min(radii, initial=0.0) >= 0.0):
            raise WorldError("radii must be finite and at least 0 metres")
        if largest / self.resolution + 2.2321 >= self._reach:
            raise WorldError(
                f"a ball of radius {largest} m is beyond reach={self.reach} m; build the worlds "
                f"with reach of at least {largest + 2.5 * self.resolution:.3f} m"
            )

    # --- drawing and baking ----------------------------------------------------------
    def _grow(self) -> Int32[np.ndarray, "ex ey ez"]:
        """Mark the voxels within reach of any that a draw may occupy: they need a row."""
        from scipy import ndimage

        possible = np.pad(self._owners.row >= 0, self._whole)
        grown = np.full(possible.shape, kernels.FREE, np.int32)
        if possible.any():
            near = ndimage.distance_transform_edt(~possible) <= self._reach
            grown[near] = kernels.UNBAKED
        return grown

    def _blocks_of_table(self) -> tuple[int, int, int]:
        x, y, z = (-(-n // _B) for n in self._grown.shape)
        return x, y, z

    def _bake(self, rule: int, blocks: Int[np.ndarray, "b 3"]) -> None:
        """Fill the distances of some blocks of the table (block coordinates)."""
        with self._lock:
            old = self._tables
            table = old.distance_row[rule]
            todo, wanted, start = [], [], len(old.rows)
            for block in blocks:
                window = table[_block_slices(block)]
                where = np.nonzero(window == kernels.UNBAKED)
                if len(where[0]) == 0:
                    continue
                rows = np.full((_B, _B, _B), -1, np.int64)
                rows[where] = start + np.arange(len(where[0]))
                start += len(where[0])
                todo.append(block)
                wanted.append(rows)
            if not todo:
                return
            corners = np.array(todo) * _B - self._whole  # in voxels of the owners
            reached = corners - self._whole, corners + _B - 1 + self._whole
            self._owners.draw(self._owners.blocks_within(*reached))
            fresh = np.empty((start - len(old.rows), self.n_worlds), np.uint8)
            counts = self.counting()[rule]

            def work(piece: slice) -> None:
                for n in range(piece.start, piece.stop):
                    cx, cy, cz = (int(c) for c in todo[n] * _B - self._whole)
                    shifted = np.where(wanted[n] >= 0, wanted[n] - len(old.rows), -1)
                    kernels.bake_block(
                        self._owners.row, self._owners.table, counts, cx, cy, cz,
                        self._whole, self._lut, shifted, fresh,
                    )  # fmt: skip

            run_chunked(work, len(todo), 1)
            updated = old.distance_row.copy()
            for block, rows in zip(todo, wanted, strict=True):
                window = updated[rule][_block_slices(block)]
                part = rows[: window.shape[0], : window.shape[1], : window.shape[2]]
                np.copyto(window, part.astype(np.int32), where=part >= 0)
            self._tables = Tables(
                updated,
                np.concatenate([old.rows, fresh]),
                np.concatenate([old.lowest, fresh.min(axis=1)]),
            )


def _block_slices(block: Int[np.ndarray, " 3"]) -> tuple[slice, slice, slice]:
    x, y, z = (slice(int(b) * _B, (int(b) + 1) * _B) for b in block)
    return x, y, z
