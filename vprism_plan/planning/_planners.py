# SPDX-License-Identifier: BSD-3-Clause
"""The planners on offer, and how each is set up for one query."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ompl import base as ob
from ompl import geometric as og

from vprism_plan.errors import PlanningError


@dataclass(frozen=True)
class PlannerKind:
    """One OMPL planner: its class and what it needs.

    Attributes:
        make: the OMPL class.
        optimising: whether it keeps improving its path until it is told to stop.
        obeys_threshold: whether it stops at a path that satisfies the objective.
        has_range: whether the length of its steps can be set.
        needs_projection: whether it needs a projection of the state space.
    """

    make: Callable[[Any], Any]
    optimising: bool = False
    obeys_threshold: bool = True
    has_range: bool = True
    needs_projection: bool = False


PLANNERS: dict[str, PlannerKind] = {
    "RRTConnect": PlannerKind(og.RRTConnect),
    "RRTstar": PlannerKind(og.RRTstar, optimising=True),
    "InformedRRTstar": PlannerKind(og.InformedRRTstar, optimising=True),
    "BITstar": PlannerKind(og.BITstar, optimising=True, has_range=False),
    "KPIECE1": PlannerKind(og.KPIECE1, needs_projection=True),
    "AORRTC": PlannerKind(og.AORRTC, optimising=True, obeys_threshold=False),
}


def planner_kind(name: str) -> PlannerKind:
    """Look a planner up; raise PlanningError listing the valid names."""
    if name not in PLANNERS:
        raise PlanningError(f"unknown planner {name!r}; valid planners are {', '.join(PLANNERS)}")
    return PLANNERS[name]


def make_planner(kind: PlannerKind, si: Any, step: float | None) -> Any:
    """Return a fresh planner.

    Never reuse one: a second solve of AORRTC after clear() crashes the process.
    """
    planner = kind.make(si)
    if step is not None:
        if not kind.has_range:
            raise PlanningError(f"{planner.getName()} has no step length; leave `step` at None")
        planner.setRange(step)
    space = si.getStateSpace()
    if kind.needs_projection and space.isCompound():
        # A compound space has no default projection. The largest part has one.
        sizes = [part.getDimension() for part in space.getSubspaces()]
        largest = sizes.index(max(sizes))
        planner.setProjectionEvaluator(ob.SubspaceProjectionEvaluator(space, largest))
    return planner


class SpaceLengthObjective(ob.OptimizationObjective):
    """Path length measured by the distance of the state space.

    OMPL's own path length objective brings an informed sampler that exists for
    RealVector, SE2 and SE3 only; on compound spaces BITstar, AORRTC and
    InformedRRTstar raise with it. With this one they sample by rejection.
    """

    def __init__(self, si: Any) -> None:
        super().__init__(si)
        self._distance = si.getStateSpace().distance

    def stateCost(self, state: Any) -> Any:  # noqa: N802 - OMPL's name
        """Return zero: only motion costs."""
        return ob.Cost(0.0)

    def motionCost(self, s1: Any, s2: Any) -> Any:  # noqa: N802 - OMPL's name
        """Return the distance between the states."""
        return ob.Cost(self._distance(s1, s2))

    def motionCostHeuristic(self, s1: Any, s2: Any) -> Any:  # noqa: N802 - OMPL's name
        """Return the distance between the states, which no path undercuts."""
        return ob.Cost(self._distance(s1, s2))


def length_objective(si: Any) -> Any:
    """Return the path length objective that works on this space."""
    if si.getStateSpace().isCompound():
        return SpaceLengthObjective(si)
    return ob.PathLengthOptimizationObjective(si)


class CostConvergence:
    """A termination condition: stop when the best cost has settled.

    Called once per iteration of the planner. It counts calls, not seconds, so the same
    seed stops at the same iteration.
    """

    def __init__(self, planner: Any, tolerance: float, patience: int) -> None:
        """Stop once `patience` calls bring less than the relative `tolerance`.

        A patience of 0 stops at the first solution.
        """
        self._best_cost = planner.bestCost
        self._tolerance = tolerance
        self._patience = patience
        self._calls = 0
        self._reference = float("inf")
        self._reference_call = 0

    def __call__(self) -> bool:
        self._calls += 1
        cost = self._best_cost().value()
        if cost < self._reference * (1.0 - self._tolerance):
            self._reference, self._reference_call = cost, self._calls
        found = self._reference < float("inf")
        return found and self._calls - self._reference_call >= self._patience

    def release(self) -> None:
        """Let go of the planner: AORRTC keeps its termination condition, a cycle."""
        del self._best_cost
