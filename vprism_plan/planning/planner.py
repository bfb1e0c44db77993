# SPDX-License-Identifier: BSD-3-Clause
"""`plan`: one query, one honest answer."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from vprism_plan._numbers import is_number
from vprism_plan.errors import PlanningError
from vprism_plan.planning._attempt import Begin, Finish, not_found, other_seed, searched
from vprism_plan.planning._clock import Now, clock_named
from vprism_plan.planning._planners import planner_kind, planners
from vprism_plan.planning._protocol import CheckerLike, SecondOpinion
from vprism_plan.planning._query import (
    configuration,
    refuse,
    refuse_deadlock,
    search_request,
    valid_goals,
)
from vprism_plan.planning._risk import with_allowed_contacts, within_risk
from vprism_plan.planning._second_opinion import refuse_unfit, reviewed
from vprism_plan.planning._verify import verified
from vprism_plan.planning.goals import PoseGoalConfig, ReachRegion
from vprism_plan.planning.objectives import PathCost, RiskObjective
from vprism_plan.planning.ompl_adapter import nearest_turns
from vprism_plan.planning.result import PlanReport, PlanResult


def plan(
    checker: CheckerLike,
    start: ArrayLike | Sequence[float],
    goal: ArrayLike | Sequence[float] | ReachRegion,
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
    second_opinion: SecondOpinion | None = None,
    clock: str = "wall",
    objective: str | RiskObjective = "length",
    warm_start: bool = True,
) -> PlanResult:
    """Plan a motion from `start` to `goal` and verify it.

    Start and goal are checked first. The path found is shortened, optionally resampled,
    and then every edge of the returned array is checked again with
    `checker.check_motion`. If the checker bounds the probability of collision
    (`max_risk`), the whole path is then judged at once, by worlds the search has not seen;
    a path that is too risky as a whole is searched for again under a tighter bound on its
    edges, as long as the time limit allows. Exceptions raised by the checker propagate.

    Args:
        checker: a `CollisionChecker`, or anything with the members of `CheckerLike`.
        start: start configuration (dof,), radians or metres.
        goal: goal configuration (dof,); or several, (g, dof), of which any will do; or the
            pose (4, 4) of the end effector in the world frame; or a `ReachRegion`. Where
            some configurations are refused, `report.refused_goals` says why. (A robot of
            four joints: a (4, 4) array is a pose if its last row is 0 0 0 1.)
        planner: one of `planners()`: RRTConnect, RRT, RRTstar, InformedRRTstar, SORRTstar,
            BITstar, AORRTC, FMT, BFMT, PRM, PRMstar, KPIECE1, BKPIECE1 or LBKPIECE1.
        time_limit: time for the search in seconds, more than 0; on `clock`. Preparing an
            objective (worlds drawn, the first time) counts; where it alone takes as long, the
            status is "timeout".
        seed: an integer from 0. The same seed gives the same path as long as the search
            ends by itself before the limit. OMPL's generator is global: this seeds it.
        stop: when the optimising planners (RRTstar, InformedRRTstar, SORRTstar, BITstar,
            AORRTC, PRMstar) stop: "limit", at the time limit (their path then depends on the
            machine's speed); "first", at the first solution; "converged", when the cost
            has settled. The others stop at their first solution in any case.
        convergence: for stop="converged": (tolerance, patience), stop when `patience`
            iterations have lowered the cost by less than the fraction `tolerance`.
        simplify: whether to shorten the path after the search.
        simplify_time: seconds after which no further round of shortening starts.
        step: length of the planner's steps in the metric of the space; OMPL's choice
            (a fifth of the space's extent) if None.
        interpolate: largest distance between waypoints of the result, Euclidean in
            joint space; no waypoints are added if None. An edge whose pieces do not all
            pass the check by themselves stays whole.
        clearance_step: distance between the samples of the reported clearance.
        pose_goal: how a pose, or a region, is turned into configurations.
        second_opinion: a `MeshChecker`, asked about the verified path. Where it disagrees,
            the path is still handed out: the report and the message say so.
        clock: what limits, and all times of the report, are measured by: "wall", or
            "process", the processor time of this process, which makes measurements on a
            busy machine comparable (a search that waits for nothing takes the same; one
            that waits, as for a slow checker, ends by the wall clock after fifty times the limit).
        objective: "length", or a `RiskObjective`. With a risk, only planners that honour an
            objective are accepted; shortening then never raises the cost, and afterwards
            waypoints are moved, within `simplify_time`, where that lowers it. A straight
            motion to the goal is taken at once only if it runs no risk.
        warm_start: with a risk, whether RRTstar, InformedRRTstar and SORRTstar are given the
            path of a quick RRTConnect to begin with, out of the time limit, and draw half of
            their samples around the best path so far.

    Returns:
        A `PlanResult`; `result.solved` is True only for a verified path to the goal.

    Raises:
        PlanningError: for a malformed query, naming the value and the valid ones.
    """
    request = search_request(planner, time_limit, seed, stop, convergence, step, clock)
    for name, value in (("interpolate", interpolate), ("clearance_step", clearance_step)):
        if value is not None and not (is_number(value) and value > 0.0):
            raise PlanningError(f"{name} is {value!r}; it must be more than 0")
    if not (is_number(simplify_time) and simplify_time >= 0.0):
        raise PlanningError(f"simplify_time is {simplify_time!r} s; it must be at least 0")
    refuse_unfit(second_opinion, checker)
    q_start = configuration(start, checker.robot, "start")
    now = clock_named(clock)
    report = PlanReport(
        planner=planner, seed=request.seed, time_limit=request.time_limit, clock=clock
    )

    warnings = tuple(getattr(checker, "warnings", ()))
    refusal = refuse(checker, q_start, "start", report)
    if refusal is not None:
        return replace(refusal, warnings=warnings)
    ends = valid_goals(checker, goal, q_start, pose_goal or PoseGoalConfig(), report)
    if isinstance(ends, PlanResult):
        return replace(ends, warnings=warnings)
    goals, report = ends
    refuse_deadlock(planner, goals)
    report = replace(
        report, state_checks=1 + len(goals) + len(report.refused_goals), motion_checks=len(goals)
    )
    cost, report = _prepared(checker, objective, now, report)
    left = request.time_limit - report.objective_time
    if left <= 0.0:
        return replace(_unprepared(report), warnings=warnings)
    finish = Finish(simplify, float(simplify_time), interpolate, clearance_step, now, cost)

    def attempt(judge: CheckerLike, limit: float, number: int) -> PlanResult:
        # A stricter judge may refuse an end, and OMPL waits for goals that do not come.
        if number and not (judge.is_valid(q_start) and any(map(judge.is_valid, goals))):
            return not_found("timeout", None, report)
        direct = _direct(judge, q_start, goals)
        if direct is not None and (cost is None or _riskless(cost, direct[1])):
            path = finish.resampled(judge, direct[1])
            found = replace(report, direct=True, goal_index=direct[0])
            return verified(judge, path, clearance_step, found, now)
        other = replace(request, time_limit=limit, seed=other_seed(request.seed, 64 * number))
        index, lead = (None, None) if direct is None else direct
        warm = warm_start and cost is not None and stop != "first"
        begin = Begin(warm and planner_kind(planner).goal_bias, lead, index)
        return searched(judge, q_start, goals, other, finish, report, begin)

    result = within_risk(checker, attempt, left, now)
    if result.path is not None:
        found = result.report.path_length if cost is None else cost.path(result.path)
        result = replace(result, report=replace(result.report, cost=found))
    result = replace(result, warnings=warnings)
    return reviewed(with_allowed_contacts(result, checker), checker, second_opinion, now)


def _prepared(
    checker: CheckerLike, objective: str | RiskObjective, now: Now, report: PlanReport
) -> tuple[PathCost | None, PlanReport]:
    """Return what paths cost, None for length, and the report with the time that took.

    Between its parts the time is looked at; where it is up, there is no cost.
    """
    if objective == "length":
        return None, report
    if not isinstance(objective, RiskObjective):
        raise PlanningError(
            f"objective is {objective!r}; it must be 'length' or a RiskObjective, for example "
            "RiskObjective(kind='joint')"
        )
    kind = planner_kind(report.planner)
    if not kind.honours_objective:
        able = ", ".join(name for name, k in planners().items() if k.honours_objective)
        raise PlanningError(
            f"{report.planner} does not honour an objective{': it ' if kind.note else ''}"
            f"{kind.note}; planners that do are {able}"
        )
    began, cost = now(), None
    for step in objective.preparation(checker):
        step()
        if now() - began >= report.time_limit:
            break
    else:
        cost = objective.cost(checker)
    return cost, replace(report, objective=objective.name, objective_time=now() - began)


def _unprepared(report: PlanReport) -> PlanResult:
    return PlanResult(
        path=None,
        status="timeout",
        report=report,
        message=f"preparing the objective '{report.objective}' took {report.objective_time:.2f} s "
        f"of the {report.time_limit:g} s allowed; what was prepared is kept: allow more time, plan "
        "again, or prepare it ahead by objective.cost(checker)",
    )


def _riskless(cost: PathCost, path: Float[np.ndarray, "t dof"]) -> bool:
    return all(cost.risk.motion(a, b) == 0.0 for a, b in pairwise(path))


def _direct(
    checker: CheckerLike, start: Float[np.ndarray, " dof"], goals: Float[np.ndarray, "g dof"]
) -> tuple[int, np.ndarray] | None:
    """Return the first goal that a straight, hence shortest, motion reaches, and that path."""
    turns = np.asarray(checker.robot.continuous, dtype=bool)
    for index, end in enumerate(nearest_turns(goals, start, turns)):
        if checker.check_motion(start, end):
            return index, np.stack([start, end])
    return None
