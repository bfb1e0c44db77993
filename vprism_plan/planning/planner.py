# SPDX-License-Identifier: BSD-3-Clause
"""`plan`: one query, one honest answer."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from vprism_plan.errors import PlanningError
from vprism_plan.planning._planners import planner_kind
from vprism_plan.planning._protocol import CheckerLike
from vprism_plan.planning._runtime import checked_seed
from vprism_plan.planning._search import SearchRequest, search
from vprism_plan.planning._verify import interpolated, one_line, verified
from vprism_plan.planning.goals import PoseGoalConfig, configurations_at_pose
from vprism_plan.planning.ompl_adapter import check_straight, shortest_step
from vprism_plan.planning.result import PlanReport, PlanResult


def plan(
    checker: CheckerLike,
    start: ArrayLike | Sequence[float],
    goal: ArrayLike | Sequence[float],
    planner: str = "RRTConnect",
    time_limit: float | int = 5.0,
    seed: int = 0,
    *,
    stop: str = "limit",
    convergence: tuple[float, int] = (0.01, 1000),
    simplify: bool = True,
    simplify_time: float = 2.0,
    step: float | None = None,
    interpolate: float | None = None,
    clearance_step: float = 0.05,
    pose_goal: PoseGoalConfig | None = None,
) -> PlanResult:
    """Plan a motion from `start` to `goal` and verify it.

    Start and goal are checked first. The path found is shortened, optionally resampled,
    and then every edge of the returned array is checked again with
    `checker.check_motion`. Exceptions raised by the checker propagate.

    Args:
        checker: a `CollisionChecker`, or anything with the members of `CheckerLike`.
        start: start configuration (dof,), radians or metres.
        goal: goal configuration (dof,), or the pose (4, 4) of the end effector in the
            world frame (see `pose_goal`).
        planner: RRTConnect, RRTstar, InformedRRTstar, BITstar, KPIECE1 or AORRTC.
        time_limit: wall time for the search in seconds, more than 0.
        seed: an integer from 0. The same seed gives the same path as long as the search
            ends by itself before the limit. OMPL's generator is global: this seeds it.
        stop: when the optimising planners (RRTstar, InformedRRTstar, BITstar, AORRTC)
            stop: "limit", at the time limit (their path then depends on the machine's
            speed); "first", at the first solution; "converged", when the path length
            has settled. The others stop at their first solution in any case.
        convergence: for stop="converged": (tolerance, patience), stop when `patience`
            iterations have shortened the path by less than the fraction `tolerance`.
        simplify: whether to shorten the path after the search.
        simplify_time: seconds after which no further round of shortening starts.
        step: length of the planner's steps in the metric of the space; OMPL's choice
            (a fifth of the space's extent) if None.
        interpolate: largest distance between waypoints of the result, Euclidean in
            joint space; no waypoints are added if None.
        clearance_step: distance between the samples of the reported clearance.
        pose_goal: how a pose is turned into configurations.

    Returns:
        A `PlanResult`; `result.solved` is True only for a verified path to the goal.

    Raises:
        PlanningError: for a malformed query, naming the value and the valid ones.
    """
    request = _request(planner, time_limit, seed, stop, convergence, simplify, simplify_time, step)
    for name, value in (("interpolate", interpolate), ("clearance_step", clearance_step)):
        if value is not None and not value > 0.0:
            raise PlanningError(f"{name} is {value!r}; it must be more than 0")
    q_start = _configuration(start, checker.robot, "start")
    report = PlanReport(planner=planner, seed=request.seed, time_limit=request.time_limit)

    refusal = _refuse(checker, q_start, "start", report)
    if refusal is not None:
        return refusal
    goals = _goals(checker, goal, q_start, pose_goal or PoseGoalConfig(), report)
    if isinstance(goals, PlanResult):
        return goals
    report = replace(report, state_checks=1 + len(goals))

    direct = _direct(checker, q_start, goals)
    if direct is not None:
        index, path = direct
        report = replace(
            report, direct=True, goal_index=index, motion_checks=report.motion_checks + index + 1
        )
    else:
        found = search(checker, q_start, goals, request)
        report = replace(
            report,
            planning_time=found.planning_time,
            simplification_time=found.simplification_time,
            state_checks=report.state_checks + found.state_checks,
            motion_checks=report.motion_checks + len(goals) + found.motion_checks,
            goal_index=found.goal_index if found.status == "exact" else None,
        )
        if found.status != "exact" or found.path is None:
            return _not_found(found.status, found.path, report)
        path = found.path
    # Wrapping moved the start to [-pi, pi); give the caller's own turns back.
    path = path + (q_start - path[0])
    path[0] = q_start
    if interpolate is not None:
        path = interpolated(path, interpolate)
    return verified(checker, path, clearance_step, report)


def _request(
    planner: str,
    time_limit: float | int,
    seed: int,
    stop: str,
    convergence: tuple[float, int],
    simplify: bool,
    simplify_time: float,
    step: float | None,
) -> SearchRequest:
    planner_kind(planner)
    if not (math.isfinite(time_limit) and time_limit > 0):
        raise PlanningError(f"time_limit is {time_limit!r} s; it must be finite and more than 0")
    if stop not in ("limit", "first", "converged"):
        raise PlanningError(f"stop is {stop!r}; valid values are 'limit', 'first', 'converged'")
    tolerance, patience = convergence
    if not (0.0 < tolerance < 1.0 and patience >= 1):
        raise PlanningError(
            f"convergence is {convergence!r}; it must be (tolerance in (0, 1), patience of "
            "at least 1 iteration)"
        )
    if not simplify_time >= 0.0:
        raise PlanningError(f"simplify_time is {simplify_time!r} s; it must be at least 0")
    if step is not None and not (math.isfinite(step) and step > 0.0):
        raise PlanningError(f"step is {step!r}; it must be finite and more than 0, or None")
    return SearchRequest(
        planner=planner,
        time_limit=float(time_limit),
        seed=checked_seed(seed),
        stop=stop,
        simplify=simplify,
        simplify_time=float(simplify_time),
        step=None if step is None else float(step),
        convergence=(float(tolerance), int(patience)),
    )


def _configuration(q: Any, robot: Any, what: str) -> Float[np.ndarray, " dof"]:
    """Return a fresh float64 copy of q, or raise PlanningError naming what is wrong."""
    array = np.array(q, dtype=np.float64)
    if array.shape != (robot.dof,):
        raise PlanningError(
            f"{what} has shape {array.shape}; it must be ({robot.dof},), one value per joint: "
            f"{', '.join(robot.joint_names)}"
        )
    if not np.isfinite(array).all():
        raise PlanningError(f"{what} is {array}; every joint value must be finite")
    return array


def _outside_limits(robot: Any, q: Float[np.ndarray, " dof"]) -> str:
    """Name the joints of q that are outside their limits, empty if none is."""
    bad = ~np.asarray(robot.continuous, dtype=bool) & ((q < robot.lower) | (q > robot.upper))
    return ", ".join(
        f"joint {robot.joint_names[i]} is {q[i]:.6g}, outside [{robot.lower[i]:.6g}, "
        f"{robot.upper[i]:.6g}]"
        for i in np.flatnonzero(bad)
    )


def _refuse(
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


def _goals(
    checker: CheckerLike,
    goal: Any,
    start: Float[np.ndarray, " dof"],
    pose_goal: PoseGoalConfig,
    report: PlanReport,
) -> np.ndarray | PlanResult:
    """Return valid goal configurations (g, dof), or the refusal."""
    array = np.asarray(goal, dtype=np.float64)
    if array.shape != (4, 4):
        q = _configuration(array, checker.robot, "goal")
        refusal = _refuse(checker, q, "goal", report)
        return q[None] if refusal is None else refusal
    found = configurations_at_pose(checker, array, start, report.seed, pose_goal)
    if len(found.valid):
        return found.valid
    if found.example is None:
        return PlanResult(
            path=None,
            status="invalid_goal",
            report=report,
            message="goal is invalid: no configuration within the joint limits reaches the pose "
            f"({found.attempts} attempts)",
        )
    refusal = _refuse(checker, found.example, "goal", report)
    if refusal is None:
        raise PlanningError("the checker changed its verdict on a goal configuration")
    return replace(
        refusal,
        message=f"all {found.reached} configurations found for the goal pose are invalid, "
        f"the first: {refusal.message.removeprefix('goal is invalid: ')}",
    )


def _direct(
    checker: CheckerLike, start: Float[np.ndarray, " dof"], goals: Float[np.ndarray, "g dof"]
) -> tuple[int, np.ndarray] | None:
    """Return the first goal that a straight, hence shortest, motion reaches, and that path."""
    turns = np.asarray(checker.robot.continuous, dtype=bool)
    for index, goal in enumerate(goals):
        end = start + _turned(goal - start, turns)
        if check_straight(checker.check_motion, start, end, turns):
            return index, np.stack([start, end])
    return None


def _turned(step: Float[np.ndarray, " dof"], turns: Any) -> Float[np.ndarray, " dof"]:
    """Drop whole turns from the continuous coordinates of a step."""
    whole = np.where(turns, 2.0 * np.pi * np.round(step / (2.0 * np.pi)), 0.0)
    return shortest_step(np.zeros_like(step), step - whole, turns)


def _not_found(status: str, path: np.ndarray | None, report: PlanReport) -> PlanResult:
    if status == "approximate":
        return PlanResult(
            path=None,
            status="approximate",
            report=report,
            message=f"{report.planner} came near the goal but did not reach it within "
            f"{report.time_limit:g} s",
            approximate_path=path,
        )
    return PlanResult(
        path=None,
        status="timeout",
        report=report,
        message=f"{report.planner} found no path within {report.time_limit:g} s",
    )
