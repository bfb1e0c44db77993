# SPDX-License-Identifier: BSD-3-Clause
"""One search with OMPL: numpy in, numpy out.

Every OMPL object lives and dies inside `search`; nothing of it outlives the call, so
nothing can leak and no planner is ever used twice.
"""

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from ompl import base as ob
from ompl import util as ou

from vprism_plan._arguments import choice, number, whole
from vprism_plan.errors import PlanningError
from vprism_plan.planning.objectives import (
    PathCost,
    VPrismMinimaxRiskObjective,
    VPrismRiskObjective,
)
from vprism_plan.planning.ompl_adapter import (
    StateReader,
    VPrismMotionValidator,
    VPrismStateValidityChecker,
    nearest_turns,
    state_space,
    to_state,
)
from vprism_plan.planning.planners import (
    GOAL_BIAS,
    GuidedGoal,
    PlannerKind,
    SpaceLengthObjective,
    make_planner,
    planner_kind,
)
from vprism_plan.planning.protocols import CheckerLike, Configuration, Now, Waypoints
from vprism_plan.planning.result import Improvement

MAX_SEED = 2**32 - 2
# Times the limit after which a search by processor time ends by the wall clock: OMPL sleeps
# while it waits for goals, which spends none. A machine that busy would be no help anyway.
PATIENCE = 50.0
# Processor time is that of the whole process, worker threads included.
CLOCKS: dict[str, Now] = {"wall": time.perf_counter, "process": time.process_time}
_GOAL_TOLERANCE = 1e-9
_NOTICEABLE = 0.02  # relative fall of the cost that is worth a look at the path


@dataclass(frozen=True)
class SearchRequest:
    """How to search: the arguments of `plan`, checked (PlanningError names the first bad one)."""

    planner: str
    time_limit: float | int
    seed: int
    stop: str
    convergence: tuple[float, int]
    step: float | None
    clock: str
    most_checks: int | None = None  # motions after which RRTConnect gives up, in time or not

    def __post_init__(self) -> None:
        kind = planner_kind(self.planner)
        choice("clock", self.clock, CLOCKS, error=PlanningError)
        if kind.starts_thread and self.clock != "wall":
            why = f"{self.planner}'s second thread would wait for ever"
            raise PlanningError(f"clock is {self.clock!r}: {why}; use clock='wall'")
        if self.stop == "converged" and kind.optimising and not kind.reports_cost:
            who = self.planner
            raise PlanningError(f"{who} does not say what its path costs; use stop='limit'")
        set_ = object.__setattr__
        limit = number("time_limit", self.time_limit, 0.0, above=True, error=PlanningError)
        set_(self, "time_limit", limit)
        choice("stop", self.stop, ("limit", "first", "converged"), error=PlanningError)
        tolerance, patience = self.convergence
        if not (0.0 < tolerance < 1.0 and patience >= 1):
            needed = "(tolerance in (0, 1), patience of at least 1 iteration)"
            raise PlanningError(f"convergence is {self.convergence!r}; it must be {needed}")
        set_(self, "convergence", (float(tolerance), int(patience)))
        if self.step is not None:
            set_(self, "step", number("step", self.step, 0.0, above=True, error=PlanningError))
        set_(self, "seed", checked_seed(self.seed))

    @property
    def now(self) -> Now:
        """Reads the clock, seconds."""
        return CLOCKS[self.clock]


@dataclass(frozen=True)
class SearchOutcome:
    """What a search found; `path` (T, dof) begins at the start as given and is not yet verified."""

    status: Literal["exact", "approximate", "timeout"]
    path: np.ndarray | None
    goal_index: int | None
    planning_time: float
    state_checks: int
    motion_checks: int
    history: tuple[Improvement, ...] = ()


def search(
    checker: CheckerLike,
    start: Configuration,
    goals: Float[np.ndarray, "g dof"],
    request: SearchRequest,
    cost: PathCost | None = None,
    lead: Waypoints | None = None,
) -> SearchOutcome:
    """Search for a path from start to any of the goals. Exceptions of the checker propagate.

    `cost` is made small, length if it is None. `lead`, a valid path to one of the goals, is
    for planners with a goal bias: their first solution.
    """
    kind = planner_kind(request.planner)
    with quiet_ompl():
        # 0 would mean "from the clock". Only generators made from now on have this seed, so it
        # comes first; a second time in a process OMPL logs an error that does not hold for them.
        ou.RNG.setSeed(request.seed + 1)
        space = state_space(checker.robot)
        si = ob.SpaceInformation(space)
        held = _HeldErrors(checker) if kind.starts_thread else None
        judge: Any = held or checker
        states = VPrismStateValidityChecker(si, judge)
        motions = VPrismMotionValidator(si, judge)
        si.setStateValidityChecker(states)
        si.setMotionValidator(motions)
        si.setup()
        problem = ob.ProblemDefinition(si)
        problem.addStartState(to_state(space, start))
        planner = make_planner(kind, si, request.step)
        _set_objective(problem, si, checker, request, cost)
        guided: GuidedGoal | None = None
        goal = ob.GoalState(si) if len(goals) == 1 else ob.GoalStates(si)
        for q in goals:
            (goal.setState if len(goals) == 1 else goal.addState)(to_state(space, q))
        problem.setGoal(goal)
        if lead is not None:
            planner.setProblemDefinition(problem)
            planner.setup()  # settles the planner's steps
            guided = GuidedGoal(si, goals, request.seed, planner.getRange(), lead)
            problem.setGoal(guided)
            planner.setGoalBias(GOAL_BIAS)
        planner.setProblemDefinition(problem)
        planner.setup()

        reader = StateReader(space, len(start))
        began = request.now()
        if held is None:
            status, history = _solve(planner, problem, reader, start, request, guided, motions)
        else:
            status, history = held.solve(planner, time_is_up(request.clock, request.time_limit)), ()
        took = request.now() - began

        verdict: Literal["exact", "approximate", "timeout"] = "timeout"
        path, goal_index = None, None
        if problem.hasSolution():
            solution = problem.getSolutionPath()
            last = reader.read(solution.getState(solution.getStateCount() - 1))
            away = np.abs(nearest_turns(goals, last, reader.wraps) - last).max(axis=1)
            nearest = int(np.argmin(away))
            goal_index = nearest if away[nearest] <= _GOAL_TOLERANCE else None
            claimed = status == ob.PlannerStatus.EXACT_SOLUTION and problem.hasExactSolution()
            # OMPL calls approximate solutions "solved"; the last state decides.
            verdict = "exact" if claimed and goal_index is not None else "approximate"
            path = _waypoints(reader, solution, start)
        return SearchOutcome(
            verdict, path, goal_index, took, states.checks, motions.checks, history
        )


def _set_objective(
    problem: Any, si: Any, checker: CheckerLike, request: SearchRequest, cost: PathCost | None
) -> None:
    kind = planner_kind(request.planner)
    if cost is not None and kind.honours_objective:
        risk = VPrismMinimaxRiskObjective if cost.worst else VPrismRiskObjective
        objective = risk(si, checker, cost=cost)
    elif kind.starts_thread:
        objective = ob.PathLengthOptimizationObjective(si)  # the only one that is no Python
    elif kind.optimising or kind.honours_objective:
        compound = si.getStateSpace().isCompound()
        objective = (SpaceLengthObjective if compound else ob.PathLengthOptimizationObjective)(si)
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
    start: Configuration,
    request: SearchRequest,
    guided: GuidedGoal | None,
    motions: VPrismMotionValidator,
) -> tuple[Any, tuple[Improvement, ...]]:
    """Run the planner until it is done or has to stop; note every better path on the way."""
    kind = planner_kind(request.planner)
    now = request.now
    began = now()
    end = began + request.time_limit
    if not (kind.optimising and kind.reports_cost):
        timed, most = time_is_up(request.clock, request.time_limit), request.most_checks
        if most is not None:
            enough = ob.PlannerTerminationCondition(lambda: motions.checks >= most)
            timed = ob.plannerOrTerminationCondition(timed, enough)
        return planner.solve(timed), ()
    progress = _Progress(planner, request, kind)
    history: list[Improvement] = []
    idle = 0
    try:
        while True:
            # A condition that has held once holds for ever: each round has its own.
            timed = time_is_up(request.clock, max(end - now(), 0.0))
            either = ob.PlannerTerminationCondition(progress)
            status = planner.solve(ob.plannerOrTerminationCondition(timed, either))
            if not (kind.resumes and problem.hasExactSolution()):
                break
            value = planner.bestCost().value()
            better = not history or value < history[-1].cost
            idle = 0 if better else idle + 1
            if better:
                path = _waypoints(reader, problem.getSolutionPath(), start)
                history.append(Improvement(now() - began, value, path))
                if guided is not None:
                    guided.path = path
            # A planner that returns again and again has a cost of 0: nothing is left to improve.
            if progress.settled or idle > 1 or now() >= end or request.stop == "first":
                break
        return status, tuple(history)
    finally:
        del progress.best_cost  # AORRTC keeps its termination condition: a cycle


class _Progress:
    """A termination condition: the best cost has become noticeably better, or has settled.

    The best path can be read only between two calls of `solve`. Calls (one per iteration) and
    costs decide, not clocks: the same seed stops at the same ones. `settled`: `patience` calls
    brought less than the relative `tolerance`, if that is asked for (0: at the first solution).
    """

    def __init__(self, planner: Any, request: SearchRequest, kind: PlannerKind) -> None:
        self.settled = False
        self.best_cost = planner.bestCost
        # Of a planner that cannot resume only the first solution counts.
        self._least = _NOTICEABLE if kind.resumes else 2.0
        self._noted = self._reference = math.inf
        self._tolerance, self._patience = request.convergence
        self._settles = request.stop == "converged"
        if request.stop == "first" and not kind.obeys_threshold:
            self._settles, self._patience = True, 0
        self._calls = self._reference_call = 0

    def __call__(self) -> bool:
        cost = self.best_cost().value()
        first = cost < self._noted == math.inf
        if first or cost < self._noted * (1.0 - self._least):
            self._noted = cost
            return True
        if not self._settles:
            return False
        self._calls += 1
        if cost < self._reference * (1.0 - self._tolerance):
            self._reference, self._reference_call = cost, self._calls
        found = self._reference < math.inf
        self.settled = found and self._calls - self._reference_call >= self._patience
        return self.settled


def _waypoints(reader: StateReader, path: Any, start: Configuration) -> Waypoints:
    """Copy a path to numpy, wrapping coordinates continued from the start's own turns on."""
    rows = [start]
    for state in path.getStates()[1:]:
        rows.append(nearest_turns(reader.read(state).copy(), rows[-1], reader.wraps))
    return np.stack(rows)


class _HeldErrors:
    """A checker whose first exception waits until the search is over.

    PRM and PRMstar run a second C++ thread, which an exception that leaves `solve` destroys
    unjoined: the process ends with `std::terminate`. So the first one is held back, later
    questions are answered "invalid", the search is stopped, and `solve` raises it again.
    """

    def __init__(self, checker: CheckerLike) -> None:
        self.robot, self.clearance = checker.robot, checker.clearance
        self._checker = checker
        self._stop: Callable[[], None] | None = None
        self._error: BaseException | None = None

    def is_valid_buffer(self, q: Any) -> bool:
        return self._ask(self._checker.is_valid_buffer, q)

    def check_motion_buffer(self, qa: Any, qb: Any) -> bool:
        return self._ask(self._checker.check_motion_buffer, qa, qb)

    def _ask(self, question: Callable[..., bool], *configurations: Any) -> bool:
        if self._error is not None:
            return False
        try:
            return question(*configurations)
        except BaseException as error:  # KeyboardInterrupt would end the process, too
            self._error = error
            if self._stop is not None:
                self._stop()
            return False

    def solve(self, planner: Any, timed: Any) -> Any:
        """Return the planner's status, or raise what was held back."""
        self._stop = timed.terminate
        status = planner.solve(timed)
        self._stop = None
        error, self._error = self._error, None
        try:
            if error is not None:
                raise error
        finally:
            del error  # its traceback holds this frame: a cycle that would keep the search alive
        return status


def time_is_up(name: str, seconds: float) -> Any:
    """Return an OMPL termination condition that holds `seconds` from now on a clock.

    With processor time it also holds after `PATIENCE` times as much time has passed.
    """
    if name == "wall":
        # The form without an interval reads the clock itself: no extra thread, no overshoot.
        return ob.timedPlannerTerminationCondition(seconds)
    now = CLOCKS[name]
    end = now() + seconds
    asleep = time.perf_counter() + PATIENCE * seconds
    return ob.PlannerTerminationCondition(lambda: now() >= end or time.perf_counter() >= asleep)


_lock = threading.Lock()
_quiet_depth = 0
_saved_level: Any = None


@contextmanager
def quiet_ompl() -> Iterator[None]:
    """Silence OMPL's console log inside the block and restore its level afterwards.

    The level is global to the process; blocks may nest or overlap between threads.
    """
    global _quiet_depth, _saved_level  # noqa: PLW0603 - OMPL's level is global itself
    with _lock:
        if _quiet_depth == 0:
            _saved_level = ou.getLogLevel()
            ou.setLogLevel(ou.LogLevel.LOG_NONE)
        _quiet_depth += 1
    try:
        yield
    finally:
        with _lock:
            _quiet_depth -= 1
            if _quiet_depth == 0:
                ou.setLogLevel(_saved_level)


def checked_seed(seed: Any) -> int:
    """Return the seed as an int; raise PlanningError unless it is one from 0 to `MAX_SEED`."""
    return whole("seed", seed, 0, MAX_SEED, error=PlanningError)
