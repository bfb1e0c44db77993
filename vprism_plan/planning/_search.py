# SPDX-License-Identifier: BSD-3-Clause
"""One search with OMPL: numpy in, numpy out.

Every OMPL object lives and dies inside `search`; nothing of it outlives the call, so
nothing can leak and no planner is ever used twice.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from ompl import base as ob

from vprism_plan.planning._clock import clock_named, time_is_up
from vprism_plan.planning._planners import (
    CostConvergence,
    PlannerKind,
    length_objective,
    make_planner,
    planner_kind,
)
from vprism_plan.planning._protocol import CheckerLike
from vprism_plan.planning._runtime import quiet_ompl, seed_ompl
from vprism_plan.planning._spaces import StateReader, state_space, to_state
from vprism_plan.planning.ompl_adapter import (
    VPrismMotionValidator,
    VPrismStateValidityChecker,
    shortest_step,
)

_GOAL_TOLERANCE = 1e-9


@dataclass(frozen=True)
class SearchRequest:
    """How to search; see `vprism_plan.planning.plan` for the meaning of the fields."""

    planner: str
    time_limit: float
    seed: int
    stop: str
    step: float | None
    convergence: tuple[float, int]
    clock: str = "wall"


@dataclass(frozen=True)
class SearchOutcome:
    """What a search found; `path` (T, dof) is unwrapped but not yet verified."""

    status: Literal["exact", "approximate", "timeout"]
    path: np.ndarray | None
    goal_index: int | None
    planning_time: float
    state_checks: int
    motion_checks: int


def search(
    checker: CheckerLike,
    start: Float[np.ndarray, " dof"],
    goals: Float[np.ndarray, "g dof"],
    request: SearchRequest,
) -> SearchOutcome:
    """Search for a path from start to any of the goals. Exceptions of the checker propagate."""
    kind = planner_kind(request.planner)
    with quiet_ompl():
        seed_ompl(request.seed)
        space = state_space(checker.robot)
        si = ob.SpaceInformation(space)
        states = VPrismStateValidityChecker(si, checker)
        motions = VPrismMotionValidator(si, checker)
        si.setStateValidityChecker(states)
        si.setMotionValidator(motions)
        si.setup()
        first = request.stop == "first" and kind.obeys_threshold
        problem = _problem(si, space, start, goals, kind.optimising, first)
        planner = make_planner(kind, si, request.step)
        planner.setProblemDefinition(problem)
        planner.setup()

        now = clock_named(request.clock)
        began = now()
        status = _solve(planner, request, kind)
        planned = now()

        reader = StateReader(space, len(start))
        verdict: Literal["exact", "approximate", "timeout"] = "timeout"
        path, goal_index = None, None
        if problem.hasSolution():
            solution = problem.getSolutionPath()
            goal_index = _reached(reader, solution, goals)
            claimed = status == ob.PlannerStatus.EXACT_SOLUTION and problem.hasExactSolution()
            # OMPL calls approximate solutions "solved"; the last state decides.
            verdict = "exact" if claimed and goal_index is not None else "approximate"
            path = _waypoints(reader, solution)
        return SearchOutcome(
            status=verdict,
            path=path,
            goal_index=goal_index,
            planning_time=planned - began,
            state_checks=states.checks,
            motion_checks=motions.checks,
        )


def _problem(
    si: Any,
    space: Any,
    start: Float[np.ndarray, " dof"],
    goals: Float[np.ndarray, "g dof"],
    optimising: bool,
    stop_at_first: bool,
) -> Any:
    problem = ob.ProblemDefinition(si)
    problem.addStartState(to_state(space, start))
    if len(goals) == 1:
        problem.setGoalState(to_state(space, goals[0]))
    else:
        goal = ob.GoalStates(si)
        for q in goals:
            goal.addState(to_state(space, q))
        problem.setGoal(goal)
    if optimising:
        objective = length_objective(si)
        if stop_at_first:
            # Any finite cost satisfies the objective.
            objective.setCostThreshold(objective.infiniteCost())
        problem.setOptimizationObjective(objective)
    return problem


def _solve(planner: Any, request: SearchRequest, kind: PlannerKind) -> Any:
    timed = time_is_up(request.clock, request.time_limit)
    watch_cost = request.stop == "converged" or (
        request.stop == "first" and not kind.obeys_threshold
    )
    if not (kind.optimising and watch_cost):
        return planner.solve(timed)
    tolerance, patience = request.convergence
    settled = CostConvergence(planner, tolerance, patience if request.stop == "converged" else 0)
    try:
        return planner.solve(
            ob.plannerOrTerminationCondition(timed, ob.PlannerTerminationCondition(settled))
        )
    finally:
        settled.release()


def _reached(reader: StateReader, solution: Any, goals: Float[np.ndarray, "g dof"]) -> int | None:
    last = reader.read(solution.getState(solution.getStateCount() - 1))
    gaps = np.abs(goals - last)
    # Whole turns of a wrapping joint are the same state.
    turns = np.array(reader.wraps) * 2.0 * np.pi * np.round(gaps / (2.0 * np.pi))
    worst = np.max(np.abs(gaps - turns), axis=1)
    best = int(np.argmin(worst))
    return best if worst[best] <= _GOAL_TOLERANCE else None


def _waypoints(reader: StateReader, path: Any) -> Float[np.ndarray, "t dof"]:
    """Copy a path to numpy, wrapping coordinates continued from row to row."""
    raw = np.array([reader.read(state).copy() for state in path.getStates()])
    wraps = np.array(reader.wraps)
    if wraps.any():
        steps = [shortest_step(a, b, wraps) for a, b in pairwise(raw)]
        raw[1:] = raw[0] + np.cumsum(steps, axis=0).reshape(-1, raw.shape[1])
    return raw
