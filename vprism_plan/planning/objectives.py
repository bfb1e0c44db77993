# SPDX-License-Identifier: BSD-3-Clause
"""What an optimising planner should make small: risk, by OMPL's own interface.

    problem.setOptimizationObjective(VPrismRiskObjective(si, checker, kind="joint"))

Both classes derive from `ob.OptimizationObjective` and integrate motions themselves: in the
bindings of OMPL 2.0.1 a Python `stateCost` of a `StateCostIntegralObjective` is never called.
Neither keeps `si`, which would close a reference cycle through the binding.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise, product
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float, Int
from ompl import base as ob

from vprism_plan._arguments import choice, number
from vprism_plan._kernels import objectives as kernels
from vprism_plan.errors import PlanningError
from vprism_plan.planning.ompl_adapter import StateReader, nearest_turns
from vprism_plan.planning.protocols import Configuration, Waypoints

# Rates (n,) per metre at configurations (n, dof).
Rates = Callable[[np.ndarray], np.ndarray]
KINDS: tuple[str, ...] = ("survival", "joint", "occupancy", "entropy")
_OF_FIELDS = ("occupancy", "entropy")

_PAD = 0.25  # metres around what is uncertain in which distances to it are known
_LEAST = 1e-3  # probability, or nats, below which a field counts as 0
_MOST_KEPT = 200_000  # motions whose cost is remembered
# The middle of a ball, and its surface towards the faces and the corners of a cube.
_AXES = np.concatenate([np.eye(3), -np.eye(3)])
_CORNERS = np.array(list(product((-1.0, 1.0), repeat=3))) / np.sqrt(3.0)
_POINTS = np.concatenate([np.zeros((1, 3)), _AXES, _CORNERS])


@dataclass(frozen=True)
class RiskObjective:
    """Asks `plan` for little risk in place of a short path.

    Attributes:
        kind: "joint", "survival", "occupancy", "entropy" or a function; see
            `VPrismRiskObjective`.
        spacing: metres of sphere motion between samples of a motion.
        length_weight: cost of a unit of path length (the state space's distance, radians and
            metres alike), beside the risk; the bound that informed sampling and pruning use.
        worst: make the largest rate of any state on the path small in place of the sum
            (`VPrismMinimaxRiskObjective`); length then does not count.
    """

    kind: str | Rates = "joint"
    spacing: float = 0.02
    length_weight: float = 1e-3
    worst: bool = False

    def __post_init__(self) -> None:
        if not callable(self.kind):
            choice("kind, if no function,", self.kind, KINDS, error=PlanningError)
        number("length_weight", self.length_weight, 0.0, error=PlanningError)
        number("spacing", self.spacing, 0.0, unit="metres", above=True, error=PlanningError)

    @property
    def name(self) -> str:
        """The kind, and whether the worst state counts alone."""
        kind = self.kind if isinstance(self.kind, str) else "function"
        return f"worst {kind}" if self.worst else kind

    def preparation(self, checker: Any) -> tuple[Callable[[], Any], ...]:
        """The long parts of `cost`, in turn; each keeps what it has done."""
        return preparation(checker, self.kind) if isinstance(self.kind, str) else ()

    def cost(self, checker: Any) -> "PathCost":
        """Return what paths of a checker's robot cost; draws worlds if nobody has."""
        return PathCost(checker, self)


class MotionRisk:
    """The risk of motions and configurations of one checker's robot, by one of the kinds.

    Motions are sampled so that no sphere centre moves more than `spacing` between samples;
    stretches that are far from anything uncertain are skipped. All samples of a motion are
    worked through in one compiled call, and its cost is remembered.

    `VPrismRiskObjective` says what the kinds are. p of "survival" is a bound from above of the
    marginal that `checker.collision_probability(q)` gives. Integrals are by the trapezoidal
    rule. "joint", summed over a path's edges, bounds -log(1 - risk) of the path if touching on
    one edge does not make touching on another less likely.
    """

    def __init__(self, checker: Any, kind: str, spacing: float) -> None:
        choice("kind", kind, KINDS, error=PlanningError)
        number("spacing", spacing, 1e-3, 0.5, "metres", error=PlanningError)
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
        """Return the cost of the straight motion, either way."""
        a, b = qa.tobytes(), qb.tobytes()
        if a > b:  # in one order, so that both directions cost the same to the last bit
            a, b, qa, qb = b, a, qb, qa
        cost = self._kept.get((a, b))
        if cost is None:
            if len(self._kept) >= _MOST_KEPT:
                self._kept.clear()
            rates, cost, way = self._sweep(qa, qb)
            if self.kind != "joint":
                cost = 0.0
                if len(rates) > 1 and rates.any():
                    inner = rates.sum() - 0.5 * (rates[0] + rates[-1])
                    cost = float(way * (inner / (len(rates) - 1)))
            self._kept[a, b] = cost
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
    """The long parts of making a `MotionRisk`, in turn; what one has done is kept."""
    if not hasattr(checker, "risk_setting"):
        other = "a CollisionChecker over a World, or a function as the kind of risk"
        raise PlanningError(f"a {type(checker).__name__} has no posterior; give {other}")

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
            alone = row[tuple(drawn.T)] >= worlds.unseen_row
            values[alone] = (worlds.owners(drawn[alone] + first) > 0).mean(axis=1)
        else:
            values = np.asarray(world.map.entropy(points))
            values[np.asarray(world.map.support(points)) < world.config.min_support] = 0.0
        field[tuple(drawn.T)] = np.where(values < _LEAST, 0.0, values)
        kept[kind] = field, first
    return kept[kind]


class _FunctionRisk:
    """`MotionRisk` for a user's rates; "metres" are those of joint space."""

    def __init__(self, rates: Rates, spacing: float) -> None:
        self._rates, self._spacing = rates, spacing

    def _samples(self, qa: np.ndarray, qb: np.ndarray) -> tuple[np.ndarray, float]:
        """Return rates at equal steps of a motion, and its length."""
        way = float(np.linalg.norm(qb - qa))
        t = np.linspace(0.0, 1.0, max(1, math.ceil(way / self._spacing)) + 1)[:, None]
        return self._checked(qa + t * (qb - qa)), way

    def motion(self, qa: np.ndarray, qb: np.ndarray) -> float:
        values, way = self._samples(qa, qb)
        return way * float(np.mean(0.5 * (values[1:] + values[:-1])))

    def worst(self, qa: np.ndarray, qb: np.ndarray) -> float:
        return float(np.max(self._samples(qa, qb)[0]))

    def state(self, q: np.ndarray) -> float:
        return float(self._checked(q[None])[0])

    def _checked(self, Q: np.ndarray) -> np.ndarray:
        """Return the rates at rows of Q; planners crash the process over negative costs."""
        rates = np.asarray(self._rates(Q), dtype=np.float64)
        wrong = ""
        if rates.shape != (len(Q),):
            wrong = f"shape {rates.shape} for {Q.shape}; it must be ({len(Q)},), one rate each"
        elif (bad := ~(np.isfinite(rates) & (rates >= 0.0))).any():
            k = int(np.argmax(bad))
            wrong = f"{rates[k]} at {Q[k].tolist()}; rates must be finite and at least 0"
        if wrong:
            raise PlanningError(f"the function of the objective returned {wrong}")
        return rates


class PathCost:
    """What motions, and the paths they make up, cost by a risk objective; without OMPL.

    `checker` is a `CollisionChecker` over a `World`, with a function anything with `robot`.
    """

    def __init__(self, checker: Any, objective: RiskObjective) -> None:
        kind, spacing = objective.kind, objective.spacing
        self.risk: MotionRisk | _FunctionRisk
        if isinstance(kind, str):
            self.risk = MotionRisk(checker, kind, spacing)
        else:
            self.risk = _FunctionRisk(kind, spacing)
        self.length_weight, self.worst = float(objective.length_weight), objective.worst
        self._wraps = np.asarray(checker.robot.continuous, dtype=bool)

    def edge(self, qa: Configuration, qb: Configuration) -> float:
        """Return the cost of a straight motion; continuous joints turn as the difference says."""
        if self.worst:
            return float(self.risk.worst(qa, qb))
        return float(self.risk.motion(qa, qb)) + self.length_weight * self._distance(qb - qa)

    def path(self, path: Waypoints) -> float:
        """Return the cost of a path: the sum, or the largest, of its edges'."""
        return self.combined([self.edge(a, b) for a, b in pairwise(path)])

    def combined(self, costs: list[float]) -> float:
        """Return what motions in a row cost together."""
        return max(costs, default=0.0) if self.worst else float(sum(costs))

    def _distance(self, step: Configuration) -> float:
        """Length in `state_space`, which says how."""
        wraps, step = self._wraps, np.abs(step)
        if not wraps.any():
            return float(np.linalg.norm(step))
        total = float(step[wraps].sum())
        ends = np.flatnonzero(np.diff(np.concatenate([[True], wraps, [True]]).astype(int)))
        for begin, end in zip(ends[::2], ends[1::2], strict=True):
            total += float(np.linalg.norm(step[begin:end]))
        return total


class _RiskBase(ob.OptimizationObjective):
    """What both objectives share: reading states, and motions as the space interpolates them."""

    def __init__(self, si: Any, checker: Any, cost: PathCost) -> None:
        super().__init__(si)
        self._cost = cost
        self._reader = StateReader(si.getStateSpace(), checker.robot.dof)
        self._distance = si.getStateSpace().distance

    def _ends(self, s1: Any, s2: Any) -> tuple[np.ndarray, np.ndarray]:
        qa, qb = self._reader.read_pair(s1, s2)
        return qa, nearest_turns(qb, qa, self._reader.wraps)

    def stateCost(self, state: Any) -> Any:  # noqa: N802 - OMPL's name
        """Return the rate at a state."""
        return ob.Cost(self._cost.risk.state(self._reader.read(state)))


class VPrismRiskObjective(_RiskBase):
    """Risk summed along the path, and length beside it.

    cost(path) = sum over its motions of (risk of the motion + length_weight * length).

    Kinds of risk; p is a share of the checker's posterior worlds:
        "joint": -log(1 - p), p that the motion touches anything, in the same world all along.
            Closest to the risk of the whole path: the sum over the path counts twice only
            what touches on two of its motions.
        "survival": integral along the motion, per metre, of -log(1 - p(q)), p(q) that the
            robot touches anything at q. An object touched over 10 cm costs ten times as much
            as over 1 cm, although the risk may be the same.
        "occupancy": integral of the sum over spheres of the largest P(occupied) in each.
        "entropy": integral of the mean entropy in the robot's volume, nats. Both know no
            allowed contacts, and are 0 (occupancy: or 1) where all posterior worlds agree.
        a function: integral of its values, (n, dof) -> (n,), over joint-space length.

    Metres are those of the sphere that moves farthest (an upper bound). `MotionRisk` says how
    it is computed. p counts from above, never past 1 - 1 / (2 n_worlds), so costs are finite.

    Args:
        si: the space information; one dimension per joint, flat order.
        checker: a `CollisionChecker` over a `World`; with a function anything with `robot`.
        kind, spacing, length_weight: as in `RiskObjective`.
        cost: in place of these, something prepared by `RiskObjective.cost`.

    Raises:
        PlanningError: a value out of range, or a checker without a posterior.

    Not for PRM and PRMstar: their second thread deadlocks with any objective in Python.
    """

    def __init__(
        self,
        si: Any,
        checker: Any,
        *,
        kind: str | Rates = "joint",
        spacing: float = 0.02,
        length_weight: float = 1e-3,
        cost: PathCost | None = None,
    ) -> None:
        cost = cost or PathCost(checker, RiskObjective(kind, spacing, length_weight))
        super().__init__(si, checker, cost)
        self._length_weight = cost.length_weight

    def motionCost(self, s1: Any, s2: Any) -> Any:  # noqa: N802 - OMPL's name
        """Return the cost of the straight motion between two states."""
        risk = self._cost.risk.motion(*self._ends(s1, s2))
        return ob.Cost(risk + self._length_weight * self._distance(s1, s2))

    def motionCostHeuristic(self, s1: Any, s2: Any) -> Any:  # noqa: N802 - OMPL's name
        """Return what no path between the states undercuts: length, since risk is not negative."""
        return ob.Cost(self._length_weight * self._distance(s1, s2))


class VPrismMinimaxRiskObjective(_RiskBase):
    """The largest rate of any state on the path.

    cost(path) = max over the samples of its motions of the rate at the sample (kinds as in
    `VPrismRiskObjective`; for "joint" of -log(1 - p) of each whole motion). Many paths share
    one worst state, so the rest of the path is left to chance.

    Args and errors as `VPrismRiskObjective`, without a weight of length.
    """

    def __init__(
        self,
        si: Any,
        checker: Any,
        *,
        kind: str | Rates = "survival",
        spacing: float = 0.02,
        cost: PathCost | None = None,
    ) -> None:
        cost = cost or PathCost(checker, RiskObjective(kind, spacing, 0.0, True))
        super().__init__(si, checker, cost)

    def motionCost(self, s1: Any, s2: Any) -> Any:  # noqa: N802 - OMPL's name
        """Return the largest rate on the straight motion between two states."""
        return ob.Cost(self._cost.risk.worst(*self._ends(s1, s2)))

    def motionCostHeuristic(self, s1: Any, s2: Any) -> Any:  # noqa: N802 - OMPL's name
        """Return zero: some path may run no risk."""
        return ob.Cost(0.0)

    def combineCosts(self, c1: Any, c2: Any) -> Any:  # noqa: N802 - OMPL's name
        """Return the larger cost."""
        return ob.Cost(max(c1.value(), c2.value()))

    def identityCost(self) -> Any:  # noqa: N802 - OMPL's name
        """Return zero, which no rate is below."""
        return ob.Cost(0.0)
