# SPDX-License-Identifier: BSD-3-Clause
"""One search with OMPL: numpy in, numpy out.

Every OMPL object lives and dies inside `search`; nothing of it outlives the call, so
nothing can leak and no planner is ever used twice.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from ompl import base as ob

from vprism_plan.planning._clock import clock_named, time_is_up
from vprism_plan.planning._contain import ContainedMotions, ContainedStates, Containment
from vprism_plan.planning._guide import GuidedGoal, guide
from vprism_plan.planning._planners import (
    CostConvergence,
    Improvements,
    PlannerKind,
    length_objective,
    make_planner,
    planner_kind,
)
from vprism_plan.planning._protocol import CheckerLike
from vprism_plan.planning._runtime import quiet_ompl, seed_ompl
from vprism_plan.planning._spaces import StateReader, state_space, to_state
from vprism_plan.planning.objectives import PathCost, make_objective
from vprism_plan.planning.ompl_adapter import (
    VPrismMotionValidator,
    VPrismStateValidityChecker,
    nearest_turns,
)
from vprism_plan.planning.result import Improvement

_GOAL_TOLERANCE = 1e-9
_NOTICEABLE = 0.02  # relative fall of the cost that is worth a look at the path


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
    """What a search found; `path` (T, dof) begins at the start as given and is not yet verified.

    `history` has the best path each time it had become noticeably better.
    """

    status: Literal["exact", "approximate", "timeout"]
    path: np.ndarray | None
    goal_index: int | None
    planning_time: float
    state_checks: int
    motion_checks: int
    history: tuple[Improvement, ...] = ()


def search(
    checker: CheckerLike,
    start: Float[np.ndarray, " dof"],
    goals: Float[np.ndarray, "g dof"],
    request: SearchRequest,
    cost: PathCost | None = None,
    lead: Float[np.ndarray, "t dof"] | None = None,
) -> SearchOutcome:
    """Search for a path from start to any of the goals. Exceptions of the checker propagate.

    Args:
        checker: whose robot moves.
        start: (dof,) radians or metres.
        goals: (g, dof).
        request: how to search.
        cost: what to make small; length if None.
        lead: a valid path to one of the goals, for planners with a goal bias: their first
            solution.
    """
    kind = planner_kind(request.planner)
    with quiet_ompl():
        seed_ompl(request.seed)
        space = state_space(checker.robot)
        si = ob.SpaceInformation(space)
        held = Containment() if kind.starts_thread else None
        states: Any
        motions: Any
        if held is None:
            states, motions = (
                VPrismStateValidityChecker(si, checker),
                VPrismMotionValidator(si, checker),
            )
        else:
            states, motions = (
                ContainedStates(si, checker, held),
                ContainedMotions(si, checker, held),
            )
        si.setStateValidityChecker(states)
        si.setMotionValidator(motions)
        si.setup()
        problem = ob.ProblemDefinition(si)
        problem.addStartState(to_state(space, start))
        planner = make_planner(kind, si, request.step)
        _set_objective(problem, si, checker, request, kind, cost)
        guided: GuidedGoal | None = None
        problem.setGoal(_plain_goal(si, space, goals))
        if lead is not None:
            planner.setProblemDefinition(problem)
            planner.setup()  # settles the planner's steps
            guided = GuidedGoal(si, goals, request.seed, planner.getRange())
            guided.lead(lead)
            problem.setGoal(guided)
            guide(planner)
        planner.setProblemDefinition(problem)
        planner.setup()

        reader = StateReader(space, len(start))
        now = clock_named(request.clock)
        began = now()
        status, history = _solve(planner, problem, reader, start, request, kind, guided, held)
        planned = now()

        verdict: Literal["exact", "approximate", "timeout"] = "timeout"
        path, goal_index = None, None
        if problem.hasSolution():
            solution = problem.getSolutionPath()
            goal_index = _reached(reader, solution, goals)
            claimed = status == ob.PlannerStatus.EXACT_SOLUTION and problem.hasExactSolution()
            # OMPL calls approximate solutions "solved"; the last state decides.
            verdict = "exact" if claimed and goal_index is not None else "approximate"
            path = _waypoints(reader, solution, start)
        return SearchOutcome(
            status=verdict,
            path=path,
            goal_index=goal_index,
            planning_time=planned - began,
            state_checks=states.checks,
            motion_checks=motions.checks,
            history=history,
        )


def _plain_goal(si: Any, space: Any, goals: Float[np.ndarray, "g dof"]) -> Any:
    if len(goals) == 1:
        single = ob.GoalState(si)
        single.setState(to_state(space, goals[0]))
        return single
    goal = ob.GoalStates(si)
    for q in goals:
        goal.addState(to_state(space, q))
    return goal


def _set_objective(
    problem: Any,
    si: Any,
    checker: CheckerLike,
    request: SearchRequest,
    kind: PlannerKind,
    cost: PathCost | None,
) -> None:
    if cost is not None and kind.honours_objective:
        objective = make_objective(si, checker, cost)
    elif kind.starts_thread:
        objective = ob.PathLengthOptimizationObjective(si)  # the only one that is no Python
    elif kind.optimising or kind.honours_objective:
        objective = length_objective(si)
    else:
        return
    if request.stop == "first" and kind.obeys_threshold:
        # Any finite cost satisfies the objective.
        objective.setCostThreshold(objective.infiniteCost())
    problem.setOptimizationObjective(objective)


def _solve(
    planner: Any,
    problem: Any,
    reader: StateReader,
    start: Float[np.ndarray, " dof"],
    request: SearchRequest,
    kind: PlannerKind,
    guided: GuidedGoal | None,
    held: Containment | None,
) -> tuple[Any, tuple[Improvement, ...]]:
    """Run the planner until it is done or has to stop; note every better path on the way."""
    now = clock_named(request.clock)
    began = now()
    end = began + request.time_limit
    timed = time_is_up(request.clock, request.time_limit)
    if held is not None:
        held.stop = timed.terminate
        status = planner.solve(timed)
        held.release()
        return status, ()
    if not (kind.optimising and kind.reports_cost):
        return planner.solve(timed), ()
    settled: CostConvergence | None = None
    if request.stop == "converged" or (request.stop == "first" and not kind.obeys_threshold):
        tolerance, patience = request.convergence
        patience = patience if request.stop == "converged" else 0
        settled = CostConvergence(planner, tolerance, patience)
    improved = Improvements(planner, _NOTICEABLE if kind.resumes else 2.0)
    history: list[Improvement] = []
    idle = 0
    try:
        while True:
            # A condition that has held once holds for ever: each round has its own.
            timed = time_is_up(request.clock, max(end - now(), 0.0))
            status = planner.solve(_any_of(timed, settled, improved))
            if not (kind.resumes and problem.hasExactSolution()):
                break
            value = planner.bestCost().value()
            better = not history or value < history[-1].cost
            idle = 0 if better else idle + 1
            if better:
                path = _waypoints(reader, problem.getSolutionPath(), start)
                history.append(Improvement(now() - began, value, path))
                if guided is not None:
                    guided.follow(path)
            over = settled is not None and settled.done
            # A planner that returns again and again has nothing left to improve: a cost of 0.
            if over or idle > 1 or now() >= end or request.stop == "first":
                break
        return status, tuple(history)
    finally:
        improved.release()
        if settled is not None:
            settled.release()


def _any_of(timed: Any, settled: CostConvergence | None, improved: Improvements) -> Any:
    stop = ob.plannerOrTerminationCondition(timed, ob.PlannerTerminationCondition(improved))
    if settled is None:
        return stop
    return ob.plannerOrTerminationCondition(stop, ob.PlannerTerminationCondition(settled))


def _reached(reader: StateReader, solution: Any, goals: Float[np.ndarray, "g dof"]) -> int | None:
    last = reader.read(solution.getState(solution.getStateCount() - 1))
    worst = np.max(np.abs(nearest_turns(goals, last, np.array(reader.wraps)) - last), axis=1)
    best = int(np.argmin(worst))
    return best if worst[best] <= _GOAL_TOLERANCE else None


def _waypoints(
    reader: StateReader, path: Any, start: Float[np.ndarray, " dof"]
) -> Float[np.ndarray, "t dof"]:
    """Copy a path to numpy, wrapping coordinates continued from row to row, from the start's
    own turns on."""
    wraps = np.array(reader.wraps)
    rows = [start]
    for state in path.getStates()[1:]:
        rows.append(nearest_turns(reader.read(state).copy(), rows[-1], wraps))
    return np.stack(rows)
