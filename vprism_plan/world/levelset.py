# SPDX-License-Identifier: BSD-3-Clause
"""The set {P(occupied) >= level} of a map, covered by small cells.

An octree over the box in which the map has any support: a cell is dropped when the log-odds cannot
reach the level in it, kept whole when they cannot fall below it, and divided otherwise. On a cell
of edge h the log-odds g differ from the trilinear interpolation of their corners by at most sum_a
h^2/8 max|g_aa|; the second derivatives come from the 27 points that dividing the parent evaluates
anyway. They are finite differences of a smooth function, counted twice: not a proof for an
arbitrary one. A guess of the map's prior is not smooth: in a cell it counts as its largest, or
least, value there, until cells resolve it; then its voxels say how far it lies over a plane. The
smallest cells have planes as well, which the level set does not cross in them.
"""

import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from vprism_plan._kernels import world as kernels
from vprism_plan._threads import run_chunked
from vprism_plan.errors import WorldError
from vprism_plan.world.distance import Lattice, Planed, lattice_nodes
from vprism_plan.world.grid import Chosen, Index, Points, Values

# How far the second derivatives may exceed their finite-difference estimate.
_CURVATURE_SAFETY = 2.0
_RESOLVED = 0.9  # distance of nodes, in voxels of a guess, that steps over none of them
# Log-odds: covers the jump where a kernel is cut off, and rounding.
_SLACK = 1e-3
_CHUNK = 1 << 16
# Cells of a surface, a kilobyte each: about 0.8 square metres at a resolution of 1 mm.
_MOST_CELLS = 8_000_000
_LAST = 1  # edge of the smallest cells, lattice steps

_OFFSETS = np.indices((3, 3, 3)).reshape(3, 27).T
_CHILDREN = np.indices((2, 2, 2)).reshape(3, 8).T


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
    # (nx, ny, nz, c): in the cell of twice the edge that it is a child of, with its lowest corner
    # at x0, the level set lies in n . (x - x0) <= c, in the same units; 0 if unknown
    plane: Float32[np.ndarray, "n 4"]

    def select(self, chosen: Chosen) -> "Cells":
        """Return only the chosen cells."""
        columns = (self.index, self.label, self.around, self.plane)
        index, label, around, plane = (column[chosen] for column in columns)
        return Cells(index, self.size, label, around, plane)


@dataclass(frozen=True)
class LevelSet:
    """A cover of the level set, on a lattice whose node (0, 0, 0) is the world origin."""

    spacing: float  # of the lattice, metres
    # those that lie wholly inside, by size, and last those of one lattice step in which the level
    # may be reached
    cells: tuple[Cells, ...]
    evaluations: int  # how many points of the map were evaluated

    def of(self, classes: Collection[int] | None) -> "LevelSet":
        """Return only, and the whole of, cells in which one of these classes is the most probable
        at some corner; all if None."""
        if classes is None:
            return self
        return replace(self, cells=tuple(_owned(part, classes) for part in self.cells))

    def planed(self, factor: int) -> Planed:
        """Return what distances near it are measured to."""
        parts = [(part.index, part.size, part.plane) for part in self.cells[:-1]]
        for last in self.cells[-1:]:
            size = 2 * last.size
            parents, first, _ = _distinct(last.index // size)
            parts.append((parents * size, size, last.plane[first]))
        return Planed(tuple(parts), factor)

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


def _evaluate(map_: Any, points: Points, level: float) -> tuple[Values, Float32[np.ndarray, "n c"]]:
    """Log-odds less those of the level, and what share each object has in P(occupied), at
    points."""
    values = np.empty(len(points))
    shares = np.empty((len(points), len(map_.object_ids)), dtype=np.float32)
    for start in range(0, len(points), _CHUNK):
        piece = slice(start, start + _CHUNK)
        probabilities = np.asarray(map_.predict_proba(points[piece]))
        values[piece] = log_odds(probabilities)
        occupied = np.maximum(probabilities[:, 1:].sum(axis=1, keepdims=True), 1e-300)
        shares[piece] = probabilities[:, 1:] / occupied
    if not np.isfinite(values).all():
        raise WorldError("the map's probabilities are not finite; refit or reload the map")
    return values - math.log(level / (1.0 - level)), shares


def _distinct(nodes: Int[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distinct lattice nodes (m, 3), the first row of each, and where each given one is among
    them."""
    low = nodes.min(axis=0, initial=2**31)
    extent = nodes.max(axis=0, initial=-(2**31)) - low + 1
    keys = nodes[:, 0]
    if len(nodes):
        keys = np.ravel_multi_index(tuple((nodes - low).T), tuple(extent))
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    return nodes[first], first, inverse


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
        expected = len(index) * (size // 2) ** 2
        if size * spacing < 0.25 * detail and expected > _MOST_CELLS:
            raise WorldError(
                f"the surfaces at level {level:g} would take {expected:,} cells of "
                f"{2 * spacing:g} m (at most {_MOST_CELLS:,}); use a coarser resolution"
            )
        size //= 2
        nodes, _, where = _distinct((index[:, None, :] + _OFFSETS * size).reshape(-1, 3))
        where = where.reshape(-1, 27)
        values, shares = _evaluate(map_, nodes * spacing, level)
        evaluations += len(nodes)
        g = values[where].reshape(-1, 3, 3, 3)
        owners = (1 + shares.argmax(axis=1)).astype(np.uint8)[where].reshape(-1, 3, 3, 3)
        step = spacing * size / map_.kernel_length
        guess = None
        if prior is not None and size * spacing > _RESOLVED * detail:
            guess = prior.at(nodes * spacing)
        bounds = _Bounds(prior, spacing, g.reshape(-1, 27), where, guess, shares)
        if size == _LAST:
            smallest = _border(index, size, g, owners, bounds, step)
            return LevelSet(spacing, (*inner, *smallest), evaluations)
        inside, border = _divide(index, size, g, owners, bounds, step)
        inner.append(inside)
        index = border.index
        if len(index) == 0:
            return LevelSet(spacing, tuple(inner), evaluations)


@dataclass(frozen=True)
class _Bounds:
    """Log-odds (n, 27) of cells at their nodes, and `where` these are among those with a guess
    (none once nodes resolve it) and shares of the objects."""

    prior: Any
    spacing: float
    g: Float[np.ndarray, "n 27"]
    where: Int[np.ndarray, "n 27"]
    guess: Float[np.ndarray, "m k"] | None
    shares: Float32[np.ndarray, "m c"]

    def slack(self, step: float) -> Values:
        """By how much log-odds may exceed those at the nodes, but for the guess's kinks."""
        # Second differences are the kinks' as well: enough for a part that is smooth.
        known = self.prior is not None and self.guess is None
        return _slack(self.g.reshape(-1, 3, 3, 3), step, 1.0 if known else _CURVATURE_SAFETY)

    def over(
        self, rows: Any, nodes: Any, middle: Float[np.ndarray, "r 3"], half: float, slack: Any = 0.0
    ) -> tuple[Float[np.ndarray, "r c"], Float[np.ndarray, "r c"]]:
        """Return log-odds at some nodes of some cells, as if the guess were what it is at the
        least, and at the most, in cubes of edge 2 `half` lattice steps; once nodes resolve it,
        less and more its kinks, if these matter beside some slack."""
        g, where = self.g[rows][:, nodes], self.where[rows][:, nodes]
        if self.prior is None:
            return g, g
        cubes = self.spacing * middle, self.spacing * half
        if self.guess is None:
            shares = np.max([self.shares[column] for column in where.T], axis=0)
            need = np.maximum(-g.max(axis=1), g.min(axis=1)) - slack
            over, under = self.prior.bulges(*cubes, shares, need).T[..., None]
            return g - under, g + over
        low, high = self.prior.bounds(*cubes)
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
    slack = bounds.slack(step)
    least, most = bounds.over(slice(None), slice(None), index + 1.0 * size, 1.0 * size, slack)
    below = above = slack
    if bounds.guess is not None:
        below, above = (_slack(part.reshape(g.shape), step) for part in (least, most))
    inside, border = [], []
    for child in _CHILDREN:
        nodes = (child + _CHILDREN) @ [9, 3, 1]
        rows = np.flatnonzero(most[:, nodes].max(axis=1) >= -above)
        corner = index[rows] + child * size
        low, high = bounds.over(rows, nodes, corner + 0.5 * size, 0.5 * size, above[rows])
        chosen = high.max(axis=1) >= -above[rows]
        rows = rows[chosen]
        values, owner = (part.reshape(-1, 27)[rows][:, nodes] for part in (g, owners))
        label, around = _ownership(values, high[chosen], owner, above[rows])
        cells = Cells(corner[chosen], size, label, around, np.zeros((len(label), 4), np.float32))
        whole = low[chosen].min(axis=1) >= below[rows]
        whole &= (around == around[:, :1]).all(axis=1)
        inside.append(cells.select(whole))
        border.append(cells.select(~whole))
    return _join(inside), _join(border)


def _slack(
    g: Float[np.ndarray, "n 3 3 3"], step: float, safety: float = _CURVATURE_SAFETY
) -> Values:
    """By how much log-odds in a cell may exceed those at the corners of its eighths."""
    # Second derivatives of a kernel of length l change by up to 3 |g'| / l^2 per metre.
    spread = np.ptp(g, axis=(1, 2, 3))
    return safety * _curvature(g) / 8.0 + 0.25 * step**2 * spread + _SLACK


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
    size: int,
    g: Float[np.ndarray, "n 3 3 3"],
    owners: UInt8[np.ndarray, "n 3 3 3"],
    bounds: _Bounds,
    step: float,
) -> tuple[Cells, Cells]:
    """Sort the children (edge `size`) into those inside and those to keep, each with a plane that
    the level set does not cross in it: by what log-odds differ from linear at its corners."""
    slack = bounds.slack(step)
    ends = ((g.take(2, axis) - g.take(0, axis)) / (2.0 * size) for axis in (1, 2, 3))
    normals = np.stack([-part.mean(axis=(1, 2)) for part in ends], axis=1)
    rough = bounds.over(slice(None), slice(None), index + 1.0 * size, 1.0 * size, slack)[1]
    inside, kept = [], []
    for child in _CHILDREN:
        nodes = (child + _CHILDREN) @ [9, 3, 1]
        rows = np.flatnonzero(rough[:, nodes].max(axis=1) >= -slack)
        corner = index[rows] + child * size
        middle, half = corner + 0.5 * size, 0.5 * size
        least, most = bounds.over(rows, nodes, middle, half, slack[rows])
        least, most = least - slack[rows, None], most + slack[rows, None]
        chosen = most.max(axis=1) >= 0.0
        rows, corner, least, most = rows[chosen], corner[chosen], least[chosen], most[chosen]
        values, owner = (part.reshape(-1, 27)[rows][:, nodes] for part in (g, owners))
        label, around = _ownership(values, most, owner, np.zeros(len(most)))
        normal = normals[rows]
        steep = np.linalg.norm(normal, axis=1)
        farthest = (most + normal @ (size * (child + _CHILDREN).T)).max(axis=1)
        plane = np.column_stack([normal, farthest]) / np.maximum(steep, 1e-9)[:, None]
        plane[steep < 1e-3] = 0.0  # as good as constant
        whole = (least.min(axis=1) >= 0.0) & (around == around[:, :1]).all(axis=1)
        plane[whole] = 0.0
        cells = Cells(corner, size, label, around, plane.astype(np.float32))
        inside.append(cells.select(whole))
        kept.append(cells.select(~whole))
    border = _join(kept)
    # The children of a cell have one normal: one plane holds for all of them.
    _, first, where = _distinct(border.index // (2 * size))
    farthest = np.full(len(first), -np.inf, dtype=np.float32)
    np.maximum.at(farthest, where, border.plane[:, 3])
    border.plane[:, 3] = farthest[where]
    return _join(inside), border


def _join(parts: list[Cells]) -> Cells:
    columns = zip(*((p.index, p.label, p.around, p.plane) for p in parts), strict=True)
    index, label, around, plane = (np.concatenate(column) for column in columns)
    return Cells(index, parts[0].size, label, around, plane)


def rasterize_level_set(level_set: LevelSet, factor: int) -> Lattice | None:
    """Mark the corners of the cells of a level set with the object class found there; None if there
    is no cell."""
    box = level_set.box()
    if box is None:
        return None
    lower, upper = box
    labels = lattice_nodes(upper - lower + 1, "the level set")
    for part in level_set.cells:
        kernels.fill_blocks(labels, part.index - lower, part.label, part.size)
    return Lattice(labels, lower, factor)


def _owned(cells: Cells, classes: Collection[int]) -> Cells:
    """Cells with one of the classes at some corner around them, relabelled with it."""
    mine = np.isin(cells.around, np.array(sorted(classes), dtype=cells.around.dtype))
    label = np.where(mine, cells.around, 0).max(axis=1, initial=0)
    return replace(cells, label=label).select(label > 0)
