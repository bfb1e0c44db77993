# SPDX-License-Identifier: BSD-3-Clause
"""Possible worlds: joint draws from a map's posterior, ready to be asked for collisions."""

import copy
import threading
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int, Int8, Int32, UInt8
from scipy import ndimage
from scipy.special import logit, logsumexp, ndtr, ndtri

from vprism_plan._arguments import number, whole
from vprism_plan._kernels import risk as kernels
from vprism_plan._kernels.risk import BLOCK
from vprism_plan._threads import run_chunked
from vprism_plan.errors import WorldError
from vprism_plan.world.distance import checked_points
from vprism_plan.world.grid import Chosen, Index, Points, Shape3, Slices, Values, window
from vprism_plan.world.unseen_objects import UnseenObjects

MAX_REACH = 31  # voxels; squared distances of three axes then fit the 16 bits of the kernels
_FINEST = 16.0  # stored steps per voxel, at most
_MAX_VOXELS = 40_000_000
_LEAST = 1.0 / 512.0  # P(occupied) below which no threshold makes a draw occupy a place
_MOST = float(logit(1.0 - _LEAST))
APART = 0.05  # m between the nodes of thresholds, over which a guess errs alike
_NODES = 2**32  # of the lattice of thresholds along an axis
_STREAM = 0x10617  # other random numbers than the weights'


@dataclass(frozen=True)
class Tables:
    """What the kernels read: see `vprism_plan._kernels.risk`. One consistent snapshot."""

    distance_row: Int32[np.ndarray, "g ex ey ez"]
    rows: UInt8[np.ndarray, "r s"]
    lowest: UInt8[np.ndarray, " r"]


class PosteriorWorlds:
    """S joint draws of a map's weights: S worlds that the camera's view does not tell apart.

    In draw s a voxel is occupied where 1 - softmax(phi(x) W_s)_0 > 1 / (1 + exp(t_s(x))) at its
    centre x (for t_s = 0 the level of the mesh), and belongs to the object of the largest logit.
    The thresholds t_s are logistic: a map that says P(occupied) = 0.2, and is sure of that, is
    occupied in a fifth of the draws. They are independent at the nodes of a lattice 5 cm apart
    and vary slowly between them: what hides in one place is correlated with what hides next to
    it, and says little of what hides behind the other end of an object. Where no prior has looked,
    and the map only says that nobody knows, and where it was seen to be empty, they are 0
    (`VPrismMap.doubts`).

    The surface of a draw lies between voxels, where its log-odds, linear between centres, are 0.
    An occupied voxel stands for the ball around its centre that reaches to the surface (at most a
    voxel wide, rounded up to a sixteenth of one): a draw is touched if such a ball meets the one
    that is asked about. Per voxel and draw one byte holds that depth, or the distance to the
    nearest occupied voxel centre, rounded down; it is compared with a ball at the nodes of the
    cell around its centre; what they leave open is looked up voxel by voxel.

    Nothing is baked before somebody asks: a block of 16^3 voxels is drawn and baked when the first
    ball lies in it (`bake` does it ahead). Memory: 4 bytes per voxel of the map's support grown by
    `reach`, 2 S bytes per drawn voxel and S bytes per baked voxel within `reach` of anything that
    any draw may occupy.

    Args:
        map: a `VPrismMap`.
        n_worlds: number of draws S, a multiple of 64.
        seed: of the draws; the same seed, the same worlds.
        resolution: edge of a voxel, metres; centres are whole multiples of it.
        reach: distances up to this are known, metres: three voxels more than the largest
            ball that will be asked about. At most 31 voxels.
        tolerance: how probable it may be that skipping the draws of nearly certain voxels changes
            any answer.
        unseen: objects that nobody saw, on voxels of the same resolution; each draw holds some.

    Attributes:
        error_free: bound on the probability that a draw differs in a voxel that was called free
            without drawing: how much a probability of collision may be too low.
        error_occupied: the same for voxels called occupied: how much it may be too high.
        first: index of the first voxel of the tables.
        tables: everything baked so far.
        scale: stored steps per voxel, and the reach in voxels.

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
        unseen: UnseenObjects | None = None,
    ) -> None:
        if whole("n_worlds", n_worlds, 64, error=WorldError) % 64:
            raise WorldError(f"n_worlds is {n_worlds}; it must be a multiple of 64")
        number("resolution", resolution, 0.0, unit="metres", above=True, error=WorldError)
        if not 2.0 <= reach / resolution <= MAX_REACH:
            raise WorldError(
                f"reach is {reach} m, {reach / resolution:.1f} voxels of {resolution} m; it must "
                f"be 2 to {MAX_REACH} voxels: use a coarser resolution for larger balls"
            )
        number("tolerance", tolerance, 0.0, 0.1, error=WorldError)
        self.map = map
        self.n_worlds = n_worlds
        self.seed = seed
        self.resolution = float(resolution)
        self.reach = float(reach)
        verdicts = judge(map, self.resolution, tolerance)
        self.error_free = verdicts.error_free
        self.error_occupied = verdicts.error_occupied
        if unseen is not None:
            verdicts = _left_to(unseen, verdicts, len(map.object_ids))
        self._owners = Owners(map, n_worlds, seed, self.resolution, verdicts, unseen)

        self._reach = reach / self.resolution  # voxels
        self._whole = int(self._reach)
        self.scale = min(_FINEST, (254.0 - kernels.DEEP) / self._reach), self._reach
        squares = np.arange(3 * self._whole**2 + 2, dtype=np.float64)
        steps = kernels.DEEP + np.floor(self.scale[0] * np.sqrt(squares))
        self._lut = steps.clip(max=254).astype(np.uint8)
        self._lut[squares > self._reach**2] = kernels.NOTHING
        self._grown = self._grow()
        self.first = self._owners.first - self._whole
        self._rules: list[frozenset[int]] = [frozenset()]
        self.tables = self._nothing_baked()
        self._lock = threading.RLock()

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the lock; nobody fills the tables of a copy but the copy."""
        with self._lock:
            state = {**self.__dict__, "_owners": self._owners.snapshot()}
        del state["_lock"], state["_room"]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._lock, self._room = threading.RLock(), self.tables.rows

    def __repr__(self) -> str:
        return (
            f"PosteriorWorlds(n_worlds={self.n_worlds}, seed={self.seed}, "
            f"drawn_voxels={len(self._owners.voxels)}, nbytes={self.nbytes})"
        )

    def redrawn(self, seed: int) -> "PosteriorWorlds":
        """Return as many other worlds of the same map, with nothing baked yet: a path that was
        chosen because few of these object to it is judged fairly only by worlds that had no say
        in the choice."""
        other = copy.copy(self)
        other.seed = seed
        other._owners = self._owners.redrawn(seed)
        with self._lock:
            other._rules = list(self._rules)
        other.tables = other._nothing_baked()
        return other

    def _nothing_baked(self) -> Tables:
        # More rows than there are: who asks again and again must not copy all that is baked.
        self._room = np.empty((0, self.n_worlds), np.uint8)
        rows = np.repeat(self._grown[None], len(self._rules), axis=0)
        return Tables(rows, np.empty((0, self.n_worlds), np.uint8), np.empty(0, np.uint8))

    def sample(self) -> None:
        """Draw the weights and bake a first block now, seconds that the first question saves."""
        with self._lock:
            self._owners.sample()
        needed = np.argwhere(self._grown == kernels.UNBAKED)
        self._bake(0, needed[:1] // BLOCK)

    def owners(self, index: Int[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "n s"]:
        """Return which object occupies each voxel (centres are `resolution * index`, metres) in
        each draw: 0 free, k the object `map.object_ids[k - 1]`, one more than there are classes an
        object that nobody saw; WorldError if index is not (n, 3) integers."""
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
        self, centers: Points, radii: Any, without: Collection[int] = ()
    ) -> Bool[np.ndarray, "n s"]:
        """Return in which draws each ball (centres in the world, one radius or each its own,
        metres) touches an object; objects `without` may be touched. Never misses a voxel centre
        inside a ball.

        The probability that a body swept along a path touches anything is
        `touched(...).any(axis=0).mean()`.

        Raises:
            WorldError: not finite, a radius that `reach` does not cover, an unknown object.
        """
        centers = checked_points(centers)
        radii = np.array(np.broadcast_to(radii, len(centers)), dtype=np.float64)
        self.require_reach(radii)
        rule = self.rule(without)
        out = np.empty((len(centers), self.n_worlds), np.bool_)
        while True:
            wanted = self.new_marks()
            missing = kernels.touch_each(centers, radii, rule, *self.baked(), out, wanted)
            if not missing:
                return out
            self.bake_marked(wanted)

    def bake(self, lower: Any = None, upper: Any = None, without: Collection[int] = ()) -> None:
        """Draw and bake every block that a box (corners, world, metres) meets; None is all."""
        shape = np.array(self._blocks_of_table())
        low = np.zeros(3, int) if lower is None else self._block_at(lower)
        high = shape if upper is None else self._block_at(upper) + 1
        low, high = np.clip(low, 0, shape), np.clip(high, 0, shape)
        blocks = np.moveaxis(np.indices(tuple(np.maximum(high - low, 0))), 0, -1).reshape(-1, 3)
        self._bake(self.rule(without), blocks + low)

    def _block_at(self, corner: Any) -> Index:
        point = checked_points(np.reshape(np.asarray(corner, dtype=np.float64), (1, -1)))[0]
        return np.floor((point / self.resolution - self.first + 0.5) / BLOCK).astype(int)

    @property
    def nbytes(self) -> int:
        """Bytes held now, by voxel indices, owners and distances."""
        parts = self._owners, self._grown, self.tables.distance_row, self.tables.rows
        return sum(int(p.nbytes) for p in parts)

    @property
    def unseen_row(self) -> int:
        """First row of the owners of voxels that only unseen objects may occupy."""
        return len(self.map.object_ids) + self._owners.judged

    @property
    def owner_tables(self) -> tuple[Any, Any, Any]:
        """Rows of the owners per voxel (below 0: free), the owners (S innermost), and the first
        voxel, which is that of the tables and a halo."""
        return self._owners.row, self._owners.table, self._owners.first

    def drawn(self) -> tuple[Any, Any, Any]:
        """Return the `owner_tables` with every voxel drawn."""
        blocks = np.arange(int(np.prod([-(-n // BLOCK) for n in self._owners.row.shape])))
        with self._lock:
            self._owners.draw(blocks)
        return self.owner_tables

    def baked(self) -> tuple[Any, ...]:
        """What the kernels read: one snapshot of the tables, where they begin, and the scale."""
        now = self.tables
        parts = now.distance_row, now.rows, now.lowest, self.first, self.resolution
        return (*parts, *self.scale)

    def new_marks(self) -> Bool[np.ndarray, "g bx by bz"]:
        """Return unset marks for blocks that have to be baked, per rule."""
        return np.zeros((len(self._rules), *self._blocks_of_table()), np.bool_)

    def bake_marked(self, wanted: Bool[np.ndarray, "g bx by bz"]) -> None:
        """Bake the marked blocks."""
        for rule in range(len(wanted)):
            if wanted[rule].any():
                self._bake(rule, np.argwhere(wanted[rule]))

    def rule(self, without: Collection[int]) -> int:
        """Return the index of the table that leaves out some objects; makes it if needed."""
        gone = frozenset(classes_of(self.map, without))
        with self._lock:
            if gone not in self._rules:
                old = self.tables
                rows = np.concatenate([old.distance_row, self._grown[None]])
                self.tables = Tables(rows, old.rows, old.lowest)
                self._rules = [*self._rules, gone]
            return self._rules.index(gone)

    @property
    def halo(self) -> int:
        """Voxels by which the tables begin before the owners."""
        return self._whole

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
        if largest / self.resolution + 2.7321 >= self._reach:
            raise WorldError(
                f"a ball of radius {largest} m is beyond reach={self.reach} m; build the worlds "
                f"with reach of at least {largest + 3.0 * self.resolution:.3f} m"
            )

    def _grow(self) -> Int32[np.ndarray, "ex ey ez"]:
        """Mark the voxels within reach of any that a draw may occupy: they need a row."""
        possible = np.pad(self._owners.row >= 0, self._whole)
        grown = np.full(possible.shape, kernels.FREE, np.int32)
        if possible.any():
            near = ndimage.distance_transform_edt(~possible) <= self._reach
            grown[near] = kernels.UNBAKED
        return grown

    def _blocks_of_table(self) -> Shape3:
        x, y, z = (-(-n // BLOCK) for n in self._grown.shape)
        return x, y, z

    def _bake(self, rule: int, blocks: Int[np.ndarray, "b 3"]) -> None:
        """Fill the distances of some blocks of the table (block coordinates)."""
        with self._lock:
            old = self.tables
            table = old.distance_row[rule]
            todo, wanted, count = [], [], 0
            for block in blocks:
                where = np.nonzero(table[_block_slices(block)] == kernels.UNBAKED)
                if len(where[0]) == 0:
                    continue
                rows = np.full((BLOCK, BLOCK, BLOCK), -1, np.int64)
                rows[where] = count + np.arange(len(where[0]))
                count += len(where[0])
                todo.append(block)
                wanted.append(rows)
            if not todo:
                return
            corners = np.array(todo) * BLOCK - self._whole  # in voxels of the owners
            reached = corners - self._whole, corners + BLOCK - 1 + self._whole
            self._owners.draw(self._owners.blocks_within(*reached))
            have = len(old.rows)
            if have + count > len(self._room):
                self._room = np.empty((max(have + count, 3 * have // 2), self.n_worlds), np.uint8)
                self._room[:have] = old.rows
            fresh = self._room[have : have + count]
            counts = self.counting()[rule]

            def work(piece: slice) -> None:
                for corner, rows in zip(corners[piece].tolist(), wanted[piece], strict=True):
                    kernels.bake_block(
                        self._owners.row, self._owners.table, self._owners.odds, counts, *corner,
                        self._whole, self._lut, rows, fresh,
                    )  # fmt: skip

            run_chunked(work, len(todo), 1)
            updated = old.distance_row.copy()
            for block, rows in zip(todo, wanted, strict=True):
                target = updated[rule][_block_slices(block)]
                part = rows[tuple(slice(n) for n in target.shape)]
                target[part >= 0] = part[part >= 0] + have
            lowest = np.concatenate([old.lowest, fresh.min(axis=1)])
            self.tables = Tables(updated, self._room[: have + count], lowest)


def _block_slices(block: Index) -> Slices:
    return window(BLOCK * block, BLOCK * (block + 1))


def classes_of(map_: Any, object_ids: Collection[int]) -> list[int]:
    """Return the classes 1, 2, ... of some objects of a map; WorldError if it lacks one."""
    valid = list(map_.object_ids)
    unknown = sorted(set(object_ids) - set(valid))
    if unknown:
        raise WorldError(f"no object {unknown[0]} in the map; it has {valid}")
    return [valid.index(i) + 1 for i in object_ids]


@dataclass(frozen=True, eq=False)
class Verdicts:
    """What every draw is taken to say of each voxel before any is drawn, as `Owners` keeps it;
    bounds on the probability that a draw differs in any voxel called free, or occupied. The map
    calls the last of the voxels free, at log-odds of -free / ODDS: only unseen objects may occupy
    them."""

    first: Index
    row: Int32[np.ndarray, "nx ny nz"]
    voxels: Int[np.ndarray, "n 3"]
    error_free: float
    error_occupied: float
    free: Int8[np.ndarray, " m"] = field(default_factory=lambda: np.empty(0, np.int8))


def _left_to(unseen: UnseenObjects, found: Verdicts, n_objects: int) -> Verdicts:
    """Have what unseen objects may occupy drawn as well."""
    ends = found.first + found.row.shape, unseen.first + unseen.mask.shape
    first = np.minimum(found.first, unseen.first)
    row = np.full(np.maximum(*ends) - first, -1 - kernels.MOST_ODDS, np.int32)
    row[window(found.first - first, ends[0] - first)] = found.row
    part = row[window(unseen.first - first, ends[1] - first)]
    added = unseen.mask & (part < 0)
    free = (-1 - part[added]).astype(np.int8)
    part[added] = n_objects + len(found.voxels) + np.arange(len(free), dtype=np.int32)
    voxels = [found.voxels + found.first - first, np.argwhere(added) + unseen.first - first]
    return replace(found, first=first, row=row, voxels=np.concatenate(voxels), free=free)


def judge(map_: Any, resolution: float, tolerance: float) -> Verdicts:
    """Find the voxels whose draws are certain, so that nobody has to draw them.

    With Gaussian logits z of mean m and variance v, C objects, and thresholds within +-t, a draw
    occupies a voxel only if some z_k - z_0 > -t - ln C: by the union bound its probability is at
    most sum_k Phi(-(m_0 - m_k - t - ln C) / sqrt(v_0 + v_k)). It does not give the voxel to class k
    only if z_k - z_0 < t or z_k < z_j for another object j: a sum of the same form. The
    voxels with the smallest bounds are skipped, as many as sum up to half the tolerance each way:
    that bounds the error of the probability of any event, a path's collision included.
    """
    lower, upper = (np.asarray(corner) for corner in map_.support_bounds())
    n_objects = len(map_.object_ids)
    if n_objects == 0 or not np.isfinite(lower).all() or not (lower < upper).all():
        nothing = np.full((1, 1, 1), -1 - kernels.MOST_ODDS, np.int32)
        return Verdicts(np.zeros(3, np.int64), nothing, np.zeros((0, 3), np.int64), 0.0, 0.0)
    first = np.ceil(lower / resolution).astype(np.int64)
    shape = np.floor(upper / resolution).astype(np.int64) - first + 1
    if np.prod(shape, dtype=np.float64) > _MAX_VOXELS:
        raise WorldError(
            f"the map's support spans {' x '.join(map(str, shape))} voxels of {resolution} m "
            f"(at most {_MAX_VOXELS:,}); use a coarser resolution"
        )
    occupied, lost, owner, odds = _tails(map_, first, shape, resolution)
    free = _skippable(occupied, 0.5 * tolerance)
    certain = _skippable(lost, 0.5 * tolerance) & ~free
    row = -1 - odds.astype(np.int32)
    row[certain] = owner[certain] - 1
    drawn = np.flatnonzero(~free & ~certain)
    row[drawn] = n_objects + np.arange(len(drawn), dtype=np.int32)
    voxels = np.column_stack(np.unravel_index(drawn, tuple(shape)))
    errors = float(occupied[free].sum()), float(lost[certain].sum())
    return Verdicts(first, row.reshape(tuple(shape)), voxels.astype(np.int64), *errors)


def _tails(
    map_: Any, first: Index, shape: Index, resolution: float
) -> tuple[Values, Values, UInt8[np.ndarray, " n"], UInt8[np.ndarray, " n"]]:
    """Bounds on P(occupied) and P(not the likeliest object's) of each voxel, that object, and
    the log-odds of being empty that nearly all draws exceed, in the kernels' steps."""
    n = int(np.prod(shape))
    occupied, lost = np.empty(n), np.empty(n)
    owner, odds = np.empty(n, np.uint8), np.empty(n, np.uint8)
    n_objects = len(map_.object_ids)
    slab = int(shape[1] * shape[2])

    def look(layers: slice) -> None:
        index = np.moveaxis(np.indices((layers.stop - layers.start, *shape[1:].tolist())), 0, -1)
        points = resolution * (index.reshape(-1, 3) + first + [layers.start, 0, 0])
        mean, variance = map_.logit_moments(points)
        piece, rows = slice(layers.start * slab, layers.stop * slab), np.arange(len(points))
        gap = mean[:, 1:] - mean[:, :1]
        spread = np.sqrt(variance[:, 1:] + variance[:, :1])
        most = np.where(map_.doubts(points), _MOST, 0.0) + np.log(n_objects)
        occupied[piece] = ndtr((gap + most[:, None]) / spread).sum(axis=1)
        best = gap.argmax(axis=1)
        apart = np.sqrt(variance[rows, 1 + best, None] + variance[:, 1:])
        others = ndtr((gap - gap[rows, best, None]) / apart)
        others[rows, best] = 0.0
        lost[piece] = ndtr((most - gap[rows, best]) / spread[rows, best]) + others.sum(axis=1)
        owner[piece] = best + 1
        surely = most - np.log(n_objects) + logsumexp(gap, axis=1) + 2.0 * spread[rows, best]
        steps = np.floor(-kernels.ODDS * surely)
        odds[piece] = steps.clip(1, kernels.MOST_ODDS)

    run_chunked(look, int(shape[0]), max(1, 40_000 // slab))
    return occupied, lost, owner, odds


def _skippable(bound: Values, budget: float) -> Chosen:
    """Mark the entries with the smallest bounds, as many as sum up to at most the budget."""
    order = np.argsort(bound, kind="stable")
    count = int(np.searchsorted(np.cumsum(bound[order]), budget, side="right"))
    skip = np.zeros(len(bound), np.bool_)
    skip[order[:count]] = True
    return skip


def threshold_nodes(
    lower: Index, shape: Shape3, n_worlds: int, seed: int
) -> Float32[np.ndarray, "nx ny nz s"]:
    """Standard normal numbers of S draws at the nodes `lower` + (0, ..., shape - 1) of the lattice
    of thresholds, independent between nodes: at each the middles of S equally probable parts, in
    an order that only the seed and the node decide."""
    middles = ndtri((np.arange(n_worlds) + 0.5) / n_worlds).astype(np.float32)
    out = np.empty((*shape, n_worlds), np.float32)
    for node in np.ndindex(shape):
        name = (lower + node + _NODES // 2).tolist()
        out[node] = middles[np.random.default_rng([seed, _STREAM, *name]).permutation(n_worlds)]
    return out


class Owners:
    """Owners of the voxels of a map's support in S draws. One thread at a time may `draw`.

    Attributes:
        first: index of voxel (0, 0, 0): the centre of voxel i is resolution * (first + i).
        row: (nx, ny, nz) int32: a row of `table`, or -1 - q: free in every draw, at
            log-odds of -q / ODDS in nearly all.
        voxels: (n, 3) those that have to be drawn, in the order of their rows.
        judged: how many of them, the first ones, the map has something to say of.
        table: (r, S) uint8: one row per object, then one per voxel: 0 free, k the object
            `map.object_ids[k - 1]`, one more an unseen one; not filled before its block is drawn.
        odds: (r, S) int8: log-odds of being occupied, times ODDS.
    """

    def __init__(
        self, map_: Any, n_worlds: int, seed: int, resolution: float, verdicts: Verdicts,
        unseen: UnseenObjects | None,
    ) -> None:  # fmt: skip
        self.first, self.row, self.voxels = verdicts.first, verdicts.row, verdicts.voxels
        self._map, self._n_worlds, self._resolution = map_, n_worlds, resolution
        self._free, self._unseen = verdicts.free, unseen
        self.judged = len(self.voxels) - len(self._free)
        self._seed = seed
        self._weights: np.ndarray | None = None
        n_objects = len(map_.object_ids)
        self.table = np.empty((n_objects + len(self.voxels), n_worlds), np.uint8)
        self.table[:n_objects] = np.arange(1, n_objects + 1, dtype=np.uint8)[:, None]
        self.odds = np.empty(self.table.shape, np.int8)
        self.odds[:n_objects] = kernels.MOST_ODDS
        self._shape = tuple(-(-n // BLOCK) for n in self.row.shape)
        key = self.block_of(self.voxels)
        self._by_block = np.argsort(key, kind="stable").astype(np.int64)
        starts = np.arange(int(np.prod(self._shape)) + 1)
        self._block_start = np.searchsorted(key[self._by_block], starts).astype(np.int64)
        self._drawn = np.diff(self._block_start) == 0
        self._stand()

    def _stand(self) -> None:
        """Draw the unseen objects."""
        if self._unseen is not None:
            self._cylinders = self._unseen.draw(self._n_worlds, self._seed)

    def redrawn(self, seed: int) -> "Owners":
        """Return the owners in as many other draws, none of them drawn yet."""
        other = copy.copy(self)
        other._seed, other._weights = seed, None
        other.table, other.odds = self.table.copy(), self.odds.copy()
        other._drawn = np.diff(self._block_start) == 0
        other._stand()
        return other

    def snapshot(self) -> "Owners":
        """Return the same with tables of their own, which `draw` here does not change."""
        other = copy.copy(self)
        other.table, other.odds = self.table.copy(), self.odds.copy()
        other._drawn = self._drawn.copy()
        return other

    @property
    def nbytes(self) -> int:
        """Bytes held."""
        parts = self.row, self.table, self.odds, self.voxels, self._by_block
        return sum(int(p.nbytes) for p in parts)

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

    def sample(self) -> np.ndarray:
        """Return the drawn weights (features, K, S), made when first asked for: seconds for a
        large map."""
        if self._weights is None:
            weights = self._map.sample_weights(self._n_worlds, self._seed)
            low = np.floor(self._resolution / APART * self.first).astype(np.int64)
            high = np.floor(self._resolution / APART * (self.first + self.row.shape))
            x, y, z = (high.astype(np.int64) - low + 2).tolist()
            self._doubts = APART * low, threshold_nodes(low, (x, y, z), self._n_worlds, self._seed)
            self._weights = np.ascontiguousarray(weights.transpose(1, 2, 0), np.float32)
            self._used = self._weights.any(axis=2)
        return self._weights

    def draw(self, blocks: Int[np.ndarray, " b"]) -> None:
        """Fill the rows of all voxels of some blocks."""
        blocks = blocks[~self._drawn[blocks]]
        pieces = [slice(*self._block_start[b : b + 2]) for b in blocks]
        members = np.concatenate([self._by_block[:0], *(self._by_block[p] for p in pieces)])
        if len(members) == 0:
            return
        index = self.voxels[members] + self.first
        found = np.zeros((len(members), self._n_worlds), np.uint8)
        odds = np.empty(found.shape, np.int8)
        known = members < self.judged
        odds[~known] = -self._free[members[~known] - self.judged, None]
        found[known], odds[known] = self._classify(self._resolution * index[known])
        first_row = len(self._map.object_ids)
        if self._unseen is not None:
            self._unseen.stand(index, self._cylinders, first_row + 1, found, odds)
        self.table[first_row + members] = found
        self.odds[first_row + members] = odds
        self._drawn[blocks] = True

    def _classify(self, points: Points) -> tuple[UInt8[np.ndarray, "n s"], Int8[np.ndarray, "n s"]]:
        """Return the class that occupies each point (m) in each draw, 0 is none, and the log-odds.
        O(points x hinges near each x S x K)."""
        space, weights = self._map.space, self.sample()
        owners = np.empty((len(points), self._n_worlds), np.uint8)
        odds = np.empty(owners.shape, np.int8)
        prior = np.zeros((len(points), weights.shape[1]))
        if self._map.prior is not None:
            prior = self._map.prior.at(points)
        own = self._map.doubts(points)

        def draw(piece: slice) -> None:
            kernels.draw_voxels(
                points, *space.kernel_arguments, space.gamma, prior, own, weights, self._used,
                *self._doubts, APART, _MOST, owners, odds, piece.start, piece.stop,
            )  # fmt: skip

        run_chunked(draw, len(points), 256)
        return owners, odds
