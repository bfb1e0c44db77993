# SPDX-License-Identifier: BSD-3-Clause
"""The set {P(occupied) >= level} of a map, covered by small cells.

An octree over the box in which the map has any support: a cell is dropped when the log-odds cannot
reach the level in it, kept whole when they cannot fall below it, and divided otherwise. On a cell
of edge h the log-odds g differ from the trilinear interpolation of their corners by at most sum_a
h^2/8 max|g_aa|; the second derivatives come from the 27 points that dividing the parent evaluates
anyway. They are finite differences of a smooth function, counted twice: not a proof for an
arbitrary one. A guess of the map's prior is not smooth: in a cell it counts as its largest, or
least, value there, until cells resolve it.
"""

import math
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from vprism_plan._kernels import world as kernels
from vprism_plan._threads import run_chunked
from vprism_plan.errors import WorldError
from vprism_plan.world.distance import Lattice, lattice_nodes
from vprism_plan.world.grid import Chosen, Index, Points, Values

# How far the second derivatives may exceed their finite-difference estimate.
_CURVATURE_SAFETY = 2.0
# Of a guess, whose slope changes by s at a voxel's face: half way between nodes at a distance h
# it lies off a parabola by 3 s h / 16; the second difference is s h / 2.
_KINKS = 12.0
_RESOLVED = 0.9  # distance of nodes, in voxels of a guess, that steps over none of them
# Log-odds: covers the jump where a kernel is cut off, and rounding.
_SLACK = 1e-3
_CHUNK = 1 << 16
# Cells of a surface, a kilobyte each: about 3 square metres at a resolution of 1 mm.
_MOST_CELLS = 8_000_000

_OFFSETS = np.indices((3, 3, 3)).reshape(3, 27).T
_CHILDREN = np.indices((2, 2, 2)).reshape(3, 8).T
# Values of the parabola through three nodes at the nodes and half way between them.
_HALVES = np.array(
    [[1, 0, 0], [0.375, 0.75, -0.125], [0, 1, 0], [-0.125, 0.75, 0.375], [0, 0, 1]], dtype=float
)


@dataclass(frozen=True)
class Cells:
    """Cells of one size of the octree."""

    index: Int[np.ndarray, "n 3"]  # lowest corner, in units of the finest lattice spacing
    size: int  # edge length in the same units
    # most probable object (class 1..C) at the most occupied corner of the evaluated cell that
    # contains it
    label: UInt8[np.ndarray, " n"]
    # the same at each corner of that cell, 0 where it is not occupied
    around: UInt8[np.ndarray, "n 8"]

    def select(self, chosen: Chosen) -> "Cells":
        """Return only the chosen cells."""
        return Cells(self.index[chosen], self.size, self.label[chosen], self.around[chosen])


@dataclass(frozen=True)
class LevelSet:
    """A cover of the level set, on a lattice whose node (0, 0, 0) is the world origin."""

    spacing: float  # of the lattice, metres
    # those that lie wholly inside, by size, and last those of one lattice step in which the level
    # may be reached
    cells: tuple[Cells, ...]
    evaluations: int  # how many points of the map were evaluated

    def box(self) -> tuple[Index, Index] | None:
        """First and last lattice node of the cover, or None if it is empty."""
        parts = [cells for cells in self.cells if len(cells.index)]
        if not parts:
            return None
        lower = np.min([cells.index.min(axis=0) for cells in parts], axis=0)
        upper = np.max([cells.index.max(axis=0) + cells.size for cells in parts], axis=0)
        return lower, upper


def log_odds(probabilities: Float[np.ndarray, "n k"]) -> Values:
    """log P(occupied) / P(empty) from class probabilities (class 0 is empty)."""
    empty = np.clip(probabilities[:, 0], 1e-18, 1.0)
    return np.log(np.clip(probabilities[:, 1:].sum(axis=1), 1e-18, None)) - np.log(empty)


def _evaluate(map_: Any, points: Points, level: float) -> tuple[Values, UInt8[np.ndarray, " n"]]:
    """Log-odds less those of the level, and the most probable object class, at points."""
    values = np.empty(len(points))
    labels = np.empty(len(points), dtype=np.uint8)
    for start in range(0, len(points), _CHUNK):
        piece = slice(start, start + _CHUNK)
        probabilities = np.asarray(map_.predict_proba(points[piece]))
        values[piece] = log_odds(probabilities)
        labels[piece] = 1 + np.argmax(probabilities[:, 1:], axis=1)
    if not np.isfinite(values).all():
        raise WorldError("the map's probabilities are not finite; refit or reload the map")
    return values - math.log(level / (1.0 - level)), labels


def _unique_nodes(
    nodes: Int[np.ndarray, "n 27 3"],
) -> tuple[Int[np.ndarray, "m 3"], Int[np.ndarray, "n 27"]]:
    """Distinct lattice nodes, and where each given one is among them."""
    low = nodes.reshape(-1, 3).min(axis=0)
    extent = nodes.reshape(-1, 3).max(axis=0) - low + 1
    keys = np.ravel_multi_index(tuple(np.moveaxis(nodes - low, -1, 0)), tuple(extent))
    unique, inverse = np.unique(keys.reshape(-1), return_inverse=True)
    found = np.stack(np.unravel_index(unique, tuple(extent)), axis=1)
    return found + low, inverse.reshape(keys.shape)


def _curvature(g: Float[np.ndarray, "n 3 3 3"]) -> Values:
    """Sum over the axes of the largest second difference."""
    second = (np.abs(np.diff(g, n=2, axis=axis)) for axis in (1, 2, 3))
    return np.sum([part.max(axis=(1, 2, 3), initial=0.0) for part in second], axis=0)


def lattice_refinement(resolution: float, map_: Any) -> int:
    """How many lattice steps a grid step has: 4, or more for a coarse grid; a power of 2."""
    finest = min(0.25 * map_.kernel_length, 0.5 * _RESOLVED * _detail(map_))
    refinement = 4
    while resolution / refinement > finest:
        refinement *= 2
    return refinement


def _detail(map_: Any) -> float:
    return getattr(map_, "detail", map_.kernel_length)


def trace_level_set(map_: Any, spacing: float, level: float) -> LevelSet:
    """Cover {P(occupied) >= level} with cells, the finest of them `spacing` (metres) wide.

    `map_` has `predict_proba`, `support_bounds`, `unsupported_occupancy` and `kernel_length`,
    and may have a `prior` (`PriorField`), and then `detail`, the edge of its voxels.

    Raises:
        WorldError: the map says "occupied" where it has no evidence at all, or the cells would fill
            the memory.
    """
    if not map_.object_ids:
        return LevelSet(spacing, (), 0)
    detail = _detail(map_)
    prior = getattr(map_, "prior", None)
    if map_.unsupported_occupancy >= level:
        raise WorldError(
            f"P(occupied) is {map_.unsupported_occupancy:.3f} where the map has no evidence, at "
            f"or above level {level:g}: its level set has no end. Raise the level, or fit with "
            "a lower prior_occupancy"
        )
    lower, upper = (np.asarray(corner, dtype=np.float64) for corner in map_.support_bounds())
    size = 4
    while size * spacing <= 0.9 * map_.kernel_length:
        size *= 2
    first = np.floor(lower / (spacing * size)).astype(np.int64)
    last = np.ceil(upper / (spacing * size)).astype(np.int64)
    axes = [np.arange(a, b) * size for a, b in zip(first, last, strict=True)]
    index = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    inner: list[Cells] = []
    evaluations = 0
    while True:
        # Once cells resolve a surface, halves of them are four times as many.
        expected = len(index) * (size // 4) ** 2
        if size * spacing < 0.25 * detail and expected > _MOST_CELLS:
            raise WorldError(
                f"the surfaces at level {level:g} would take {expected:,} cells of "
                f"{4 * spacing:g} m (at most {_MOST_CELLS:,}); use a coarser resolution"
            )
        size //= 2
        nodes, where = _unique_nodes(index[:, None, :] + _OFFSETS * size)
        values, labels = _evaluate(map_, nodes * spacing, level)
        evaluations += len(nodes)
        g = values[where].reshape(-1, 3, 3, 3)
        owners = labels[where].reshape(-1, 3, 3, 3)
        step = spacing * size / map_.kernel_length
        if size == 2:
            safety = _CURVATURE_SAFETY if prior is None else _KINKS
            return LevelSet(spacing, (*inner, _border(index, g, owners, step, safety)), evaluations)
        guess = None if prior is None else prior.at(nodes * spacing)
        bounds = _Bounds(prior, spacing, g.reshape(-1, 27), where, guess)
        inside, border = _divide(index, size, g, owners, bounds, step)
        inner.append(inside)
        index = border.index
        if len(index) == 0:
            return LevelSet(spacing, tuple(inner), evaluations)


@dataclass(frozen=True)
class _Bounds:
    """Log-odds (n, 27) of cells at their nodes, and `where` these are among those with a guess."""

    prior: Any
    spacing: float
    g: Float[np.ndarray, "n 27"]
    where: Int[np.ndarray, "n 27"]
    guess: Float[np.ndarray, "m k"] | None

    def over(
        self, rows: Any, nodes: Any, middle: Float[np.ndarray, "r 3"], half: float
    ) -> tuple[Float[np.ndarray, "r c"], Float[np.ndarray, "r c"]]:
        """Return log-odds at some nodes of some cells, as if the guess were what it is at the
        least, and at the most, in cubes of edge 2 `half` lattice steps."""
        g, where = self.g[rows][:, nodes], self.where[rows][:, nodes]
        if self.guess is None:
            return g, g
        low, high = self.prior.bounds(self.spacing * middle, self.spacing * half)
        least, most = g.copy(), g.copy()
        run_chunked(
            lambda s: kernels.widen(self.guess, where, low, high, least, most, s.start, s.stop),
            len(g), 4096,
        )  # fmt: skip
        return least, most


def _divide(
    index: Int[np.ndarray, "n 3"],
    size: int,
    g: Float[np.ndarray, "n 3 3 3"],
    owners: UInt8[np.ndarray, "n 3 3 3"],
    bounds: _Bounds,
    step: float,
) -> tuple[Cells, Cells]:
    """Sort the children (edge `size`, `step` kernel lengths) into inside and to divide: also
    those with more than one object at their corners."""
    least, most = bounds.over(slice(None), slice(None), index + 1.0 * size, 1.0 * size)
    below, above = (_slack(part.reshape(g.shape), step) for part in (least, most))
    inside, border = [], []
    for child in _CHILDREN:
        nodes = (child + _CHILDREN) @ [9, 3, 1]
        rows = np.flatnonzero(most[:, nodes].max(axis=1) >= -above)
        corner = index[rows] + child * size
        low, high = bounds.over(rows, nodes, corner + 0.5 * size, 0.5 * size)
        chosen = high.max(axis=1) >= -above[rows]
        rows = rows[chosen]
        values, owner = (part.reshape(-1, 27)[rows][:, nodes] for part in (g, owners))
        label, around = _ownership(values, high[chosen], owner, above[rows])
        cells = Cells(corner[chosen], size, label, around)
        whole = low[chosen].min(axis=1) >= below[rows]
        whole &= (around == around[:, :1]).all(axis=1)
        inside.append(cells.select(whole))
        border.append(cells.select(~whole))
    return _join(inside), _join(border)


def _slack(g: Float[np.ndarray, "n 3 3 3"], step: float) -> Values:
    """By how much log-odds in a cell may exceed those at the corners of its eighths."""
    # Second derivatives of a kernel of length l change by up to 3 |g'| / l^2 per metre.
    spread = np.ptp(g, axis=(1, 2, 3))
    return _CURVATURE_SAFETY * _curvature(g) / 8.0 + 0.25 * step**2 * spread + _SLACK


def _ownership(
    corners: Float[np.ndarray, "n 8"],
    most: Float[np.ndarray, "n 8"],
    owners: UInt8[np.ndarray, "n 8"],
    slack: Values,
) -> tuple[UInt8[np.ndarray, " n"], UInt8[np.ndarray, "n 8"]]:
    """Owner at the most occupied corner, and at all corners that may be occupied: counted
    elsewhere, the skin of one object would belong to another."""
    best = corners.argmax(axis=1)
    rows = np.arange(len(corners))
    around = np.where(most >= -slack[:, None], owners, np.uint8(0))
    around[rows, best] = owners[rows, best]
    return owners[rows, best], around


def _border(
    index: Int[np.ndarray, "n 3"],
    g: Float[np.ndarray, "n 3 3 3"],
    owners: UInt8[np.ndarray, "n 3 3 3"],
    step: float,
    safety: float,
) -> Cells:
    """Divide cells of edge 4, known at every second node, into those of edge 1 that count. The map
    is not evaluated again: a parabola through three nodes at a distance h is off by at most h^3 /
    (9 sqrt 3) |g_aaa| per axis, and |g_aaa| is about 3 |g_a| / l^2."""
    fine = np.einsum("ai,bj,ck,nijk->nabc", _HALVES, _HALVES, _HALVES, g, optimize=True)
    # Second differences at half the spacing are a quarter of those in `g`.
    spread = np.ptp(g, axis=(1, 2, 3))
    slack = safety * _curvature(g) / 32.0 + 0.3 * step**2 * spread + _SLACK
    kept = []
    for child in np.ndindex(4, 4, 4):
        corners = fine[(slice(None), *(slice(c, c + 2) for c in child))].reshape(len(g), 8)
        chosen = corners.max(axis=1) >= -slack
        block = (chosen, *(slice(c // 2, c // 2 + 2) for c in child))
        evaluated, owner = g[block].reshape(-1, 8), owners[block].reshape(-1, 8)
        label, around = _ownership(evaluated, evaluated, owner, slack[chosen])
        kept.append(Cells(index[chosen] + np.array(child), 1, label, around))
    return _join(kept)


def _join(parts: list[Cells]) -> Cells:
    columns = zip(*((part.index, part.label, part.around) for part in parts), strict=True)
    index, label, around = (np.concatenate(column) for column in columns)
    return Cells(index, parts[0].size, label, around)


def rasterize_level_set(
    level_set: LevelSet, factor: int, classes: Collection[int] | None = None
) -> Lattice | None:
    """Mark the corners of the cells of a level set with the object class found there.

    With `classes`, only, and the whole of, cells in which one of these is the most probable at some
    corner. None if there is no cell.
    """
    cells = level_set.cells
    if classes is not None:
        cells = tuple(_owned(part, classes) for part in cells)
    box = LevelSet(level_set.spacing, cells, 0).box()
    if box is None:
        return None
    lower, upper = box
    labels = lattice_nodes(upper - lower + 1, "the level set")
    for part in cells:
        kernels.fill_blocks(labels, part.index - lower, part.label, part.size)
    return Lattice(labels, lower, factor)


def _owned(cells: Cells, classes: Collection[int]) -> Cells:
    """Cells with one of the classes at some corner around them, relabelled with it."""
    mine = np.isin(cells.around, np.array(sorted(classes), dtype=cells.around.dtype))
    label = np.where(mine, cells.around, 0).max(axis=1, initial=0)
    return Cells(cells.index, cells.size, label, cells.around).select(label > 0)
