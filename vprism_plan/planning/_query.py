# SPDX-License-Identifier: BSD-3-Clause
"""What a query must be before a search is worth while."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from vprism_plan._numbers import is_number
from vprism_plan.errors import PlanningError, RobotError
from vprism_plan.planning._clock import clock_named
from vprism_plan.planning._planners import planner_kind
from vprism_plan.planning._protocol import CheckerLike
from vprism_plan.planning._runtime import checked_seed
from vprism_plan.planning._search import SearchRequest
from vprism_plan.planning._verify import one_line
from vprism_plan.planning.goals import (
    GoalSolutions,
    PoseGoalConfig,
    ReachRegion,
    solve_pose,
    solve_region,
)
from vprism_plan.planning.result import PlanReport, PlanResult, RefusedGoal
from vprism_plan.robots.kinematics import joint_values


def search_request(
    planner: str,
    time_limit: float | int,
    seed: int,
    stop: str,
    convergence: tuple[float, int],
    step: float | None,
    clock: str,
) -> SearchRequest:
    """Check the parameters of the search; raise PlanningError naming the first bad one."""
    kind = planner_kind(planner)
    clock_named(clock)
    if kind.starts_thread and clock != "wall":
        raise PlanningError(
            f"clock is {clock!r} with {planner}: its second thread would wait for ever for a "
            "termination condition that is Python; use clock='wall'"
        )
    if stop == "converged" and kind.optimising and not kind.reports_cost:
        raise PlanningError(f"{planner} does not say what its path costs; use stop='limit'")
    if not (is_number(time_limit) and math.isfinite(time_limit) and time_limit > 0):
        raise PlanningError(f"time_limit is {time_limit!r} s; it must be finite and more than 0")
    if stop not in ("limit", "first", "converged"):
        raise PlanningError(f"stop is {stop!r}; valid values are 'limit', 'first', 'converged'")
    tolerance, patience = convergence
    if not (0.0 < tolerance < 1.0 and patience >= 1):
        raise PlanningError(
            f"convergence is {convergence!r}; it must be (tolerance in (0, 1), patience of "
            "at least 1 iteration)"
        )
    if step is not None and not (is_number(step) and math.isfinite(step) and step > 0.0):
        raise PlanningError(f"step is {step!r}; it must be finite and more than 0, or None")
    return SearchRequest(
        planner=planner,
        time_limit=float(time_limit),
        seed=checked_seed(seed),
        stop=stop,
        step=None if step is None else float(step),
        convergence=(float(tolerance), int(patience)),
        clock=clock,
    )


def configuration(q: Any, robot: Any, what: str) -> Float[np.ndarray, " dof"]:
    """Return a fresh float64 copy of q, or raise PlanningError naming what is wrong."""
    array = _numbers(q, robot, what)
    if array.shape != (robot.dof,):
        raise PlanningError(
            f"{what} has shape {array.shape}; it must be ({robot.dof},), one value per joint: "
            f"{', '.join(robot.joint_names)}"
        )
    if not np.isfinite(array).all():
        raise PlanningError(f"{what} is {array}; every joint value must be finite")
    return array


def _numbers(values: Any, robot: Any, what: str) -> Float[np.ndarray, "..."]:
    """Return a fresh float64 copy, or raise PlanningError naming what cannot be read."""
    try:
        return joint_values(values, robot, what)
    except RobotError as error:
        raise PlanningError(str(error)) from error


def _outside_limits(robot: Any, q: Float[np.ndarray, " dof"]) -> str:
    """Name the joints of q that are outside their limits, empty if none is."""
    bad = ~np.asarray(robot.continuous, dtype=bool) & ((q < robot.lower) | (q > robot.upper))
    return ", ".join(
        f"joint {robot.joint_names[i]} is {q[i]:.6g}, outside [{robot.lower[i]:.6g}, "
        f"{robot.upper[i]:.6g}]"
        for i in np.flatnonzero(bad)
    )


def refuse(
    checker: CheckerLike, q: Float[np.ndarray, " dof"], what: str, report: PlanReport
) -> PlanResult | None:
    """Return the refusal if q must not be used as start or goal, None if it may."""
    outside = _outside_limits(checker.robot, q)
    if not outside and checker.is_valid(q):
        return None
    explanation = checker.explain(q)
    # The limits are checked here too: outside them OMPL would refuse without a reason.
    reasons = outside if explanation.valid else one_line(explanation)
    status: Any = f"invalid_{what}"
    return PlanResult(
        path=None,
        status=status,
        report=report,
        message=f"{what} is invalid: {reasons}",
        explanation=explanation,
    )


def valid_goals(
    checker: CheckerLike,
    goal: Any,
    start: Float[np.ndarray, " dof"],
    pose_goal: PoseGoalConfig,
    report: PlanReport,
) -> tuple[Float[np.ndarray, "g dof"], PlanReport] | PlanResult:
    """Return valid goal configurations (g, dof) and the report of the others, or the refusal."""
    robot = checker.robot
    if isinstance(goal, ReachRegion):
        found = solve_region(robot, goal, start, report.seed, pose_goal)
        return _accepted(checker, found, "region", pose_goal, report)
    array = _numbers(goal, robot, "goal")
    if array.shape == (4, 4) and (robot.dof != 4 or array[3].tolist() == [0.0, 0.0, 0.0, 1.0]):
        found = solve_pose(robot, array, start, report.seed, pose_goal)
        return _accepted(checker, found, "pose", pose_goal, report)
    if array.ndim == 2 and len(array) > 0 and array.shape[1] == robot.dof:
        rows = np.stack([configuration(q, robot, f"goal {k}") for k, q in enumerate(array)])
        return _accepted(checker, GoalSolutions(rows, len(rows)), "", pose_goal, report)
    q = configuration(array, robot, "goal")
    refusal = refuse(checker, q, "goal", report)
    return (q[None], report) if refusal is None else refusal


def _accepted(
    checker: CheckerLike,
    found: GoalSolutions,
    what: str,
    pose_goal: PoseGoalConfig,
    report: PlanReport,
) -> tuple[Float[np.ndarray, "g dof"], PlanReport] | PlanResult:
    """Keep what the checker accepts and note why it refuses the others.

    what: "pose", "region", or "" for configurations that the caller gave, all of which are
    kept if they are valid.
    """
    if len(found.reached) == 0:
        return PlanResult(
            path=None,
            status="invalid_goal",
            report=report,
            message="goal is invalid: no configuration within the joint limits reaches the "
            f"{what} ({found.attempts} attempts)",
        )
    good: list[np.ndarray] = []
    refused: list[PlanResult] = []
    notes: list[RefusedGoal] = []
    most = pose_goal.max_goals if what else len(found.reached)
    for q in found.reached:
        refusal = refuse(checker, q, "goal", report)
        if refusal is None:
            good.append(q)
        else:
            refused.append(refusal)
            reason = refusal.message.removeprefix("goal is invalid: ")
            notes.append(RefusedGoal(tuple(q.tolist()), reason))
        if len(good) == most:
            break
    report = replace(report, refused_goals=tuple(notes))
    if good:
        return np.array(good), report
    said = f"found for the goal {what}" if what else "given as goals"
    return replace(
        refused[0],
        report=report,
        message=f"all {len(found.reached)} configurations {said} are invalid, the first: "
        f"{notes[0].reason}",
    )


def refuse_deadlock(planner: str, goals: Float[np.ndarray, "g dof"]) -> None:
    """Raise PlanningError if a planner would wait for ever for a lock with these goals.

    A second thread of PRM and PRMstar asks whether further goals are valid. The checker is
    Python, whose lock the first thread holds.
    """
    if planner_kind(planner).starts_thread and len(goals) > 1:
        raise PlanningError(
            f"{planner} deadlocks with more than one goal configuration, here {len(goals)}; give "
            "one, or use RRTConnect, or another of `planners()` that starts no thread"
        )
