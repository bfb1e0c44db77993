# SPDX-License-Identifier: BSD-3-Clause
"""The planners on offer, how each is set up for one query, and led along a known path."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float
from ompl import base as ob
from ompl import geometric as og

from vprism_plan._arguments import choice
from vprism_plan.errors import PlanningError
from vprism_plan.planning.ompl_adapter import StateReader, nearest_turns, write_state
from vprism_plan.planning.protocols import Configuration, Waypoints


@dataclass(frozen=True)
class PlannerKind:
    """One OMPL planner: its class, what it needs and what it honours.

    Attributes:
        make: the OMPL class.
        optimising: whether it keeps improving its path until it is told to stop.
        honours_objective: whether it minimises what it is given, not length or nothing.
        obeys_threshold: whether it stops at a path that satisfies the objective.
        reports_cost: whether it says, while it searches, what its best path costs.
        resumes: whether it goes on where it stopped when it is asked to solve once more.
        goal_bias: whether it asks its goal for samples all along (and so can be guided).
        informed: whether it samples only where a path could be better than its best; with
            length on spaces without continuous joints directly, otherwise by rejection.
        has_range: whether the length of its steps can be set.
        needs_projection: whether it needs a projection of the state space.
        starts_thread: whether it has a second thread, which deadlocks as soon as it needs
            Python: for an objective, a goal region, a further goal or a termination condition.
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


_IMPROVES: dict[str, Any] = {"optimising": True, "reports_cost": True, "informed": True}
_STAR: dict[str, Any] = {**_IMPROVES, "honours_objective": True, "resumes": True}
_TREE_STAR: dict[str, Any] = {**_STAR, "goal_bias": True}
_LENGTH = "reads the length of its paths, never an objective"
_ONE_BATCH = "draws its samples once: one path, or none, whatever time is left"
_ROADMAP = "one goal configuration, wall clock, length only: anything else would deadlock"
_KEEPS_NOTHING = "keeps nothing of a motion that is blocked halfway (see `last_valid`)"

PLANNERS: dict[str, PlannerKind] = {
    "RRTConnect": PlannerKind(og.RRTConnect, note="grows two trees, usually the quickest"),
    "RRT": PlannerKind(og.RRT, note="grows one tree"),
    "RRTstar": PlannerKind(og.RRTstar, **{**_TREE_STAR, "informed": False}),
    "InformedRRTstar": PlannerKind(og.InformedRRTstar, **_TREE_STAR),
    "SORRTstar": PlannerKind(og.SORRTstar, **_TREE_STAR),
    "BITstar": PlannerKind(og.BITstar, has_range=False, **_STAR),
    "AORRTC": PlannerKind(og.AORRTC, obeys_threshold=False, note=_LENGTH, **_IMPROVES),
    "FMT": PlannerKind(og.FMT, honours_objective=True, has_range=False, note=_ONE_BATCH),
    "BFMT": PlannerKind(og.BFMT, honours_objective=True, has_range=False, note=_ONE_BATCH),
    "PRM": PlannerKind(og.PRM, has_range=False, starts_thread=True, note=_ROADMAP),
    "PRMstar": PlannerKind(og.PRMstar, True, has_range=False, starts_thread=True, note=_ROADMAP),
    "KPIECE1": PlannerKind(og.KPIECE1, needs_projection=True, note=_KEEPS_NOTHING),
    "BKPIECE1": PlannerKind(og.BKPIECE1, needs_projection=True, note=_KEEPS_NOTHING),
    "LBKPIECE1": PlannerKind(og.LBKPIECE1, needs_projection=True, note=_KEEPS_NOTHING),
}


def planners() -> dict[str, PlannerKind]:
    """Return the planners that `plan` accepts, by name, with what each honours."""
    return dict(PLANNERS)


def planner_kind(name: str) -> PlannerKind:
    """Look a planner up; raise PlanningError listing the valid names."""
    return PLANNERS[choice("planner", name, PLANNERS, error=PlanningError)]


def make_planner(kind: PlannerKind, si: Any, step: float | None) -> Any:
    """Return a fresh planner; a second solve of AORRTC after clear() crashes the process."""
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

    OMPL's own brings an informed sampler for RealVector, SE2 and SE3 only; on compound spaces
    BITstar, AORRTC and InformedRRTstar raise with it. With this one they sample by rejection.
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

    motionCostHeuristic = motionCost  # noqa: N815 - OMPL's name; no path undercuts it


GOAL_BIAS = 0.5  # share of the samples that a planner which is led asks its goal for
_FINEST, _WIDEST = 0.01, 0.5  # spread of samples around a path, as a share of the step
_LEAD_PART = 0.1  # of the planner's step, between states of the lead


class GuidedGoal(ob.GoalSampleableRegion):
    """Several goal configurations, and samples that lead there along a known path.

    The bindings let nobody replace the sampler of a state space. But RRTstar and its kin ask
    their goal for samples all along, with probability `goalBias`, and take the answers as
    states to grow towards. So the goal first hands out a known path, state by state, which
    makes that path the planner's first solution, and afterwards states around the best path.

    The tree reaches a goal by growing exactly to it; the last state of the lead is one.
    `sampleGoal` hands the lead out once, start left out, then only states around the best path:
    of goals the tree would collect copies. The tree grows to each state of the lead from its
    nearest node, which near a thin obstacle may be one on the other side: states much closer
    together than a step leave the last one nearest.

    `step` is how far the planner grows at once, in the metric of the space; `path` (t, dof) the
    lead, and to be replaced by better ones.
    """

    def __init__(
        self,
        si: Any,
        goals: Float[np.ndarray, "g dof"],
        seed: int,
        step: float,
        path: Waypoints,
    ) -> None:
        super().__init__(si)
        self.setThreshold(1e-9)
        self._space = si.getStateSpace()
        self._reader = StateReader(self._space, goals.shape[1])
        self._goals = goals
        self._rng = np.random.default_rng([seed, 0x601D])
        self._step = step
        self.path = path
        pieces = [path[:1]]
        compound = self._reader.wraps.any()
        for a, b in pairwise(path):
            # The distance of a compound space is at most sqrt(dof) times the Euclidean one.
            width = float(np.abs(b - a).sum() if compound else np.linalg.norm(b - a))
            n = max(1, int(np.ceil(width / (_LEAD_PART * self._step))))
            pieces.append(a + (b - a) * (np.arange(1, n + 1)[:, None] / n))
        self._queue = list(np.concatenate(pieces)[:0:-1])

    def distanceGoal(self, state: Any) -> float:  # noqa: N802 - OMPL's name
        """Return the distance to the nearest goal, largest over the joints."""
        q = self._reader.read(state)
        gap = np.abs(nearest_turns(self._goals, q, self._reader.wraps) - q)
        return float(gap.max(axis=1).min())

    def maxSampleCount(self) -> int:  # noqa: N802 - OMPL's name
        """Return a number that is never reached, so that samples are asked for all along."""
        return 2**31 - 1

    def sampleGoal(self, state: Any) -> None:  # noqa: N802 - OMPL's name
        """Write the next state to grow towards."""
        q = self._queue.pop() if self._queue else self._around()
        write_state(self._space, q, state)
        self._space.enforceBounds(state)  # OMPL takes a goal's samples as they are

    def _around(self) -> Configuration:
        """A state near a random place of the path."""
        path = self.path
        lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
        place = self._rng.uniform(0.0, float(lengths.sum()))
        edge = min(int(np.searchsorted(np.cumsum(lengths), place)), len(lengths) - 1)
        t = self._rng.uniform()
        q = path[edge] + t * (path[edge + 1] - path[edge])
        spread = self._step * np.exp(self._rng.uniform(np.log(_FINEST), np.log(_WIDEST)))
        return q + self._rng.normal(size=q.shape) * spread / np.sqrt(len(q))
