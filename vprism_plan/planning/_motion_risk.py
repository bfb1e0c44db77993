# SPDX-License-Identifier: BSD-3-Clause
"""What a straight motion risks, as a number that planners can add up."""

import math
from collections.abc import Callable
from itertools import product
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float, Int

from vprism_plan._kernels import objectives as kernels
from vprism_plan.errors import PlanningError
from vprism_plan.planning.protocols import Configuration

KINDS: tuple[str, ...] = ("survival", "joint", "occupancy", "entropy")
_OF_FIELDS = ("occupancy", "entropy")

_PAD = 0.25  # metres around what is uncertain in which distances to it are known
_LEAST = 1e-3  # probability, or nats, below which a field counts as 0
_MOST_KEPT = 200_000  # motions whose cost is remembered
# The middle of a ball, and its surface towards the faces and the corners of a cube.
_AXES = np.concatenate([np.eye(3), -np.eye(3)])
_CORNERS = np.array(list(product((-1.0, 1.0), repeat=3))) / np.sqrt(3.0)
_POINTS = np.concatenate([np.zeros((1, 3)), _AXES, _CORNERS])


class MotionRisk:
    """The risk of motions and configurations of one checker's robot, by one of the kinds.

    Motions are sampled so that no sphere centre moves more than `spacing` between samples;
    stretches that are far from anything uncertain are skipped. All samples of a motion are
    worked through in one compiled call, and its cost is remembered.

    `VPrismRiskObjective` says what the kinds are. p of "survival" is a bound from above of the
    marginal that `checker.collision_probability(q)` gives. Integrals are over the way of the
    sphere that moves farthest (a bound on it, metres), by the trapezoidal rule. "joint",
    summed over a path's edges, bounds -log(1 - risk) of the path if touching on one edge does
    not make touching on another less likely.

    Raises:
        PlanningError: an unknown kind, a spacing out of range, or no posterior.
    """

    def __init__(self, checker: Any, kind: str, spacing: float) -> None:
        if kind not in KINDS:
            raise PlanningError(f"kind is {kind!r}; valid kinds of risk are {', '.join(KINDS)}")
        if not (math.isfinite(spacing) and 1e-3 <= spacing <= 0.5):
            raise PlanningError(f"spacing is {spacing!r}; it must be 0.001 to 0.5 metres")
        for step in preparation(checker, kind):
            step()
        self.kind = kind
        self.spacing = float(spacing)
        self._at = checker.risk_setting()
        worlds = self._at.worlds
        self._possible, self._corner = _possible(worlds)
        self._rates = np.empty(self._at.ints[2])
        self._delta = np.empty(self._at.ints[4])
        self._kept: dict[tuple[bytes, bytes], float] = {}
        self._ceiling = 1.0 - 0.5 / worlds.n_worlds  # p = 1 must stay finite
        self._touched = np.zeros(worlds.n_worlds, np.uint8)
        if kind in _OF_FIELDS:
            self._field = _field(worlds, self._at.world, kind)
            # 1 per sphere of the moving links, or its share of their volume.
            self._weights = (self._at.sphere_tables >= 0).astype(np.float64)
            if kind == "entropy":
                self._weights *= self._at.radii**3
                self._weights /= max(float(self._weights.sum()), 1e-300)
            self._directions = _POINTS if kind == "occupancy" else 0.8 * _POINTS
        self._marks = worlds.new_marks()
        # Asked once without a sphere, so that nothing compiles inside a planner's time limit.
        q, self._tables = np.zeros(len(self._delta)), np.full_like(self._at.sphere_tables, -1)
        self._sweep(q, q)
        self._tables = self._at.sphere_tables

    def motion(self, qa: Configuration, qb: Configuration) -> float:
        """Return the cost of the straight motion between two configurations, either way."""
        a, b = qa.tobytes(), qb.tobytes()
        if a > b:  # in one order, so that both directions cost the same to the last bit
            a, b, qa, qb = b, a, qb, qa
        cost = self._kept.get((a, b))
        if cost is None:
            if len(self._kept) >= _MOST_KEPT:
                self._kept.clear()
            cost = self._kept[a, b] = self._cost(qa, qb)
        return cost

    def state(self, q: Configuration) -> float:
        """Return the rate at one configuration."""
        rates, joint, _ = self._sweep(q, q)
        return joint if self.kind == "joint" else float(rates[0])

    def worst(self, qa: Configuration, qb: Configuration) -> float:
        """Return the largest rate at the samples of the straight motion, either way."""
        if self.kind == "joint":
            return self.motion(qa, qb)
        a, b = (qa, qb) if qa.tobytes() <= qb.tobytes() else (qb, qa)
        return float(self._sweep(a, b)[0].max())

    def _cost(self, qa: np.ndarray, qb: np.ndarray) -> float:
        rates, joint, way = self._sweep(qa, qb)
        if self.kind == "joint":
            return joint
        if len(rates) == 1 or not rates.any():
            return 0.0
        mean = (rates.sum() - 0.5 * (rates[0] + rates[-1])) / (len(rates) - 1)
        return float(way * mean)

    def _sweep(self, qa: np.ndarray, qb: np.ndarray) -> tuple[np.ndarray, float, float]:
        """Rates at the samples, -log of the share of worlds touched nowhere, bound on the way."""
        at, worlds = self._at, self._at.worlds
        steps, way, turned = kernels.plan_steps(
            qa, qb, at.floats, at.ints, self.spacing, self._delta, self._rates
        )
        if self.kind in _OF_FIELDS:
            values = np.empty(steps + 1)
            kernels.sweep_field(
                qa, self._delta, steps, self._rates, at.floats, at.ints, at.radii, self._weights,
                self._possible, self._corner, worlds.resolution, self._field[0], self._field[1],
                self._directions, self.kind == "occupancy", values,
            )  # fmt: skip
            return values, 0.0, way
        counts = np.empty(steps + 1, np.int64)
        scale, reach = worlds.scale
        while True:
            tables = worlds.tables
            missing = kernels.sweep_draws(
                qa, self._delta, steps, self._rates, turned, at.floats, at.ints, at.radii,
                self._tables, self._possible, self._corner, worlds.resolution,
                tables.distance_row, tables.rows, tables.lowest, worlds.first, scale, reach,
                counts, self._touched, self._marks,
            )  # fmt: skip
            if not missing:
                break
            worlds.bake_marked(self._marks)
            self._marks = worlds.new_marks()
        n = len(self._touched)
        joint = -math.log1p(-min(int(self._touched.sum()) / n, self._ceiling))
        return -np.log1p(-np.minimum(counts / n, self._ceiling)), joint, way


def preparation(checker: Any, kind: str) -> tuple[Callable[[], Any], ...]:
    """The long parts of making a `MotionRisk`, in turn; what one has done is kept.

    Raises:
        PlanningError: the checker has no posterior.
    """
    if not hasattr(checker, "risk_setting"):
        raise PlanningError(
            f"a {type(checker).__name__} has no posterior to take risks from; give a "
            "CollisionChecker over a World, or a function as the kind of risk"
        )

    def worlds() -> Any:
        return checker.risk_setting().worlds

    if kind in _OF_FIELDS:
        return worlds, lambda: _possible(worlds()), lambda: _field(worlds(), checker.world, kind)
    return worlds, lambda: worlds().sample(), lambda: _possible(worlds())


Grid = tuple[Float[np.ndarray, "x y z"], Int[np.ndarray, " 3"]]  # values, first index
# Baking takes longer than many a search, so objectives over one map share it.
_baked: WeakKeyDictionary[Any, dict[str, Grid]] = WeakKeyDictionary()


def _possible(worlds: Any) -> Grid:
    """Distance, voxels, from voxel centres to the nearest that any draw may occupy; first index."""
    kept = _baked.setdefault(worlds, {})
    if "possible" not in kept:
        from scipy import ndimage

        row, _, first = worlds.owner_tables
        filled = np.argwhere(row >= 0)
        if len(filled) == 0:
            kept["possible"] = np.full((1, 1, 1), 1e6, np.float32), np.zeros(3, np.int64)
        else:
            low, high = filled.min(axis=0), filled.max(axis=0) + 1
            pad = math.ceil(_PAD / worlds.resolution)
            inside = row[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] >= 0
            away = ndimage.distance_transform_edt(~np.pad(inside, pad))
            corner = np.asarray(first + low - pad, dtype=np.int64)
            kept["possible"] = away.astype(np.float32), corner
    return kept["possible"]


def _field(worlds: Any, world: Any, kind: str) -> Grid:
    """P(occupied), or entropy in nats, at the voxel centres of the posterior worlds."""
    kept = _baked.setdefault(worlds, {})
    if kind not in kept:
        row, _, first = worlds.owner_tables
        first = np.asarray(first, dtype=np.int64)
        drawn = np.argwhere(row >= len(world.map.object_ids))
        points = worlds.resolution * (drawn + first)
        field = np.zeros(row.shape, np.float32)
        if kind == "occupancy":
            field[row >= 0] = 1.0
            values = np.asarray(world.map.occupancy(points))
        else:
            values = np.asarray(world.map.entropy(points))
            values[np.asarray(world.map.support(points)) < world.config.min_support] = 0.0
        field[tuple(drawn.T)] = np.where(values < _LEAST, 0.0, values)
        kept[kind] = field, first
    return kept[kind]
