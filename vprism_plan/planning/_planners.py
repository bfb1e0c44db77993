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
    """One OMPL planner: its class, what it needs and what it honours.

    Attributes:
        make: the OMPL class.
        optimising: whether it keeps improving its path until it is told to stop.
        honours_objective: whether it minimises what it is given; the others minimise length,
            or nothing.
        obeys_threshold: whether it stops at a path that satisfies the objective.
        reports_cost: whether it says, while it searches, what its best path costs.
        resumes: whether it goes on where it stopped when it is asked to solve once more.
        goal_bias: whether it asks its goal for samples all along (and so can be guided).
        informed: whether it samples only where a path could be better than its best; with
            length on spaces without continuous joints directly, otherwise by rejection.
        has_range: whether the length of its steps can be set.
        needs_projection: whether it needs a projection of the state space.
        starts_thread: whether it searches for solutions in a second thread. That thread
            deadlocks as soon as it needs Python: for an objective, a goal region, a further
            goal state or a termination condition.
        note: what else one should know.
    """

    make: Callable[[Any], Any]
    optimising: bool = False
    honours_objective: bool = False
    obeys_threshold: bool = True
    reports_cost: bool = False
    resumes: bool = False
    goal_bias: bool = False
    informed: bool = False
    has_range: bool = True
    needs_projection: bool = False
    starts_thread: bool = False
    note: str = ""


def _star(make: Any, informed: bool) -> PlannerKind:
    return PlannerKind(
        make,
        optimising=True,
        honours_objective=True,
        reports_cost=True,
        resumes=True,
        goal_bias=True,
        informed=informed,
    )


def _piece(make: Any, note: str) -> PlannerKind:
    return PlannerKind(make, needs_projection=True, note=note)


_KEEPS_NOTHING = "keeps nothing of a motion that is blocked halfway (see `last_valid`)"
_ONE_BATCH = "draws its samples once: one path, or none, whatever time is left"
_ROADMAP = "one goal configuration, wall clock, length only: anything else would deadlock"

PLANNERS: dict[str, PlannerKind] = {
    "RRTConnect": PlannerKind(og.RRTConnect, note="grows two trees, usually the quickest"),
    "RRT": PlannerKind(og.RRT, note="grows one tree"),
    "RRTstar": _star(og.RRTstar, informed=False),
    "InformedRRTstar": _star(og.InformedRRTstar, informed=True),
    "SORRTstar": _star(og.SORRTstar, informed=True),
    "BITstar": PlannerKind(
        og.BITstar,
        optimising=True,
        honours_objective=True,
        reports_cost=True,
        resumes=True,
        informed=True,
        has_range=False,
    ),
    "AORRTC": PlannerKind(
        og.AORRTC,
        optimising=True,
        obeys_threshold=False,
        reports_cost=True,
        informed=True,
        note="reads the length of its paths, never an objective",
    ),
    "FMT": PlannerKind(og.FMT, honours_objective=True, has_range=False, note=_ONE_BATCH),
    "BFMT": PlannerKind(og.BFMT, honours_objective=True, has_range=False, note=_ONE_BATCH),
    "PRM": PlannerKind(og.PRM, has_range=False, starts_thread=True, note=_ROADMAP),
    "PRMstar": PlannerKind(
        og.PRMstar, optimising=True, has_range=False, starts_thread=True, note=_ROADMAP
    ),
    "KPIECE1": _piece(og.KPIECE1, _KEEPS_NOTHING),
    "BKPIECE1": _piece(og.BKPIECE1, _KEEPS_NOTHING),
    "LBKPIECE1": _piece(og.LBKPIECE1, _KEEPS_NOTHING),
}


def planners() -> dict[str, PlannerKind]:
    """Return the planners that `plan` accepts, by name, with what each honours."""
    return dict(PLANNERS)


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
        self.done = False
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
        self.done = found and self._calls - self._reference_call >= self._patience
        return self.done

    def release(self) -> None:
        """Let go of the planner: AORRTC keeps its termination condition, a cycle."""
        del self._best_cost


class Improvements:
    """A termination condition: stop when the best cost has become noticeably better.

    Between two calls of `solve` the best path can be read; while it runs, it cannot. Costs
    decide, not clocks, so the same seed stops at the same iterations.
    """

    def __init__(self, planner: Any, least: float) -> None:
        """Stop at the first solution, then whenever the cost falls by the fraction `least`."""
        self._best_cost = planner.bestCost
        self._least = least
        self._reference = float("inf")

    def __call__(self) -> bool:
        cost = self._best_cost().value()
        if not cost < float("inf"):
            return False
        first = self._reference == float("inf")
        if not first and not cost < self._reference * (1.0 - self._least):
            return False
        self._reference = cost
        return True

    def release(self) -> None:
        """Let go of the planner."""
        del self._best_cost
