# SPDX-License-Identifier: BSD-3-Clause
"""`plan`: one query, one honest answer."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vprism_plan._arguments import choice, number
from vprism_plan.errors import PlanningError
from vprism_plan.planning.attempts import Query, attempt, within_risk
from vprism_plan.planning.goals import (
    PoseGoalConfig,
    ReachRegion,
    configuration,
    free_start,
    numbers,
    refuse,
    valid_goals,
)
from vprism_plan.planning.objectives import PathCost, RiskObjective
from vprism_plan.planning.path import one_line
from vprism_plan.planning.planners import planner_kind, planners
from vprism_plan.planning.protocols import CheckerLike, Configuration, Now, SecondOpinion
from vprism_plan.planning.result import PlanReport, PlanResult
from vprism_plan.planning.search import CLOCKS, SearchRequest
from vprism_plan.robots.kinematics import Named

_log = logging.getLogger(__name__)

# Answers by a checker within some seconds; in the middle of a path keeping one of more margins.
Answer = Callable[[CheckerLike, float, tuple[float, ...]], PlanResult]

MARGINS = (0.02, 0.01, 0.005, 0.0)  # metres beyond the checker's own, in turn
_BEYOND = " beyond the checker's margin"
_WIDER = 0.1  # of the time limit for each that is not the last
_RISKIER = 0.2  # of the time limit to find out how risky what is too risky is, ...
_BOUNDS = (0.25, 0.5, 0.75, 0.95)  # ... by these bounds, in turn


def plan(
    checker: CheckerLike,
    start: ArrayLike | Sequence[float] | Named,
    goal: ArrayLike | Sequence[float] | Named | ReachRegion,
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
    margins: Sequence[float] | str | None = "auto",
    nudge: float | int = 0.005,
) -> PlanResult:
    """Plan a motion from `start` to `goal` and verify it.

    Start and goal are checked first. The path found is shortened, optionally resampled, and
    then every edge of the returned array is checked again with `checker.check_motion_report`.
    If the checker bounds the probability of collision (`max_risk`), the whole path is then
    judged by worlds the search has not seen: `result.risk`. One that is too risky is searched for
    again under a tighter bound on its edges, within the time limit. If nothing is within the
    bound, a fifth of the limit goes to the safest motion that is not: it is handed out as
    `approximate_path` of a result that is "too_risky". Exceptions of the checker propagate.

    Args:
        checker: a `CollisionChecker`, or anything with the members of `CheckerLike`.
        start: start configuration (dof,), radians or metres, or joint values by name.
        goal: goal configuration (dof,); or several, (g, dof), of which any will do; or the
            pose (4, 4) of the end effector in the world frame (for a robot of four joints: if
            its last row is 0 0 0 1); or a `ReachRegion`. `report.refused_goals` says which
            were refused and why.
        planner: one of `planners()`.
        time_limit: time for the search in seconds, more than 0; on `clock`. Preparing an
            objective (worlds drawn, the first time) counts; where it alone takes as long, the
            status is "timeout".
        seed: an integer from 0. The same seed gives the same path as long as the search
            ends by itself before the limit. OMPL's generator is global: this seeds it.
        stop: when the planners that are `optimising` stop: "limit", at the time limit (their
            path then depends on the machine's speed); "first", at the first solution;
            "converged", when the cost has settled. The others stop at their first solution.
        convergence: for stop="converged": (tolerance, patience), stop when `patience`
            iterations have lowered the cost by less than the fraction `tolerance`.
        simplify: whether to shorten the path after the search.
        simplify_time: seconds after which no further round of shortening starts.
        step: length of the planner's steps in the metric of the space; OMPL's choice
            (a fifth of the space's extent) if None.
        interpolate: largest distance between waypoints of the result, Euclidean in joint space;
            none are added if None, or to an edge whose pieces do not all pass by themselves.
        clearance_step: distance between the samples of the reported clearance.
        pose_goal: how a pose, or a region, is turned into configurations.
        second_opinion: a `MeshChecker`, asked about the verified path. Where it disagrees,
            the path is still handed out: the report and the message say so.
        clock: what limits and times of the report are measured by: "wall", or "process", the
            processor time of this process, comparable on a busy machine (a search that waits,
            as for a slow checker, ends after fifty times the limit).
        objective: "length", or a `RiskObjective`. With a risk, only planners that honour an
            objective are accepted; shortening then never raises the cost, and afterwards
            waypoints are moved, within `simplify_time`, where that lowers it. A straight
            motion to the goal is taken at once only if it runs no risk.
        warm_start: with a risk, whether RRTstar, InformedRRTstar and SORRTstar are given the
            path of a quick RRTConnect to begin with, out of the time limit, and draw half of
            their samples around the best path so far.
        margins: metres beyond the checker's own margin, decreasing, such as (0.02, 0.01,
            0.005, 0.0): with room to spare the path keeps away, in a narrow place it goes
            through. The widest comes first, each wider one with a tenth of the time limit, the last
            with what is left. The first path is returned, else the last answer. Where only an end
            is too near for a wider margin, that is kept between the ends if it makes the path no
            riskier; `message` and `report.middle` say what was kept where. Without 0 at the end,
            problems that only the checker's own margin allows stay unsolved. The checker needs
            `with_extra_margin`. "auto": those, if the checker has it, for a short path by a planner
            that stops at its first; else none. None: none.
        nudge: radians or metres. A start that is refused, as the arm touches something by a hair
            or its encoders are off, may have a free configuration beside it, no joint farther
            than this: then the path begins there, and `message` and `warnings` say so. 0: never.

    Returns:
        A `PlanResult`; `result.solved` is True only for a verified path to the goal.

    Raises:
        PlanningError: for a malformed query, naming the value and the valid ones.
    """
    request = SearchRequest(planner, time_limit, seed, stop, convergence, step, clock)
    for name, length in (("interpolate", interpolate), ("clearance_step", clearance_step)):
        if length is not None or name == "clearance_step":
            number(name, length, 0.0, above=True, finite=False, error=PlanningError)
    number("simplify_time", simplify_time, 0.0, unit="s", finite=False, error=PlanningError)
    if second_opinion is not None:
        _require_same_robot(second_opinion, checker)
    number("nudge", nudge, 0.0, 0.1, error=PlanningError)
    q_start = configuration(start, checker.robot, "start")
    q_start, moved = free_start(checker, q_start, nudge, request.seed)
    now = CLOCKS[clock]

    def answer(judge: CheckerLike, limit: float, wider: tuple[float, ...] = ()) -> PlanResult:
        asked = replace(request, time_limit=limit)
        found = _prepared(judge, q_start, goal, pose_goal, asked, objective, now)
        if not isinstance(found, PlanResult):
            goals, cost, report = found
            query = Query(
                q_start, goals, asked, cost, warm_start and stop != "first", simplify,
                float(simplify_time), interpolate, clearance_step, wider,
            )  # fmt: skip
            found = within_risk(
                judge,
                lambda strict, left, number: attempt(strict, query, report, left, number),
                asked.time_limit - report.objective_time,
                now,
            )
            if found.path is not None:
                paid = found.report.path_length if cost is None else cost.path(found.path)
                found = replace(found, report=replace(found.report, cost=paid))
        found = replace(found, warnings=tuple(getattr(judge, "warnings", ())))
        return _annotated(found, judge, second_opinion, now)

    if isinstance(margins, str):
        choice("margins", margins, ("auto",), error=PlanningError)
        first = stop == "first" or not planner_kind(planner).optimising
        turns = objective == "length" and first and hasattr(checker, "with_extra_margin")
        margins = MARGINS if turns else None
    steps = [0.0] if margins is None else _checked_margins(checker, margins)
    bounded = getattr(checker, "max_risk", None) is not None and hasattr(checker, "relaxed")
    limit = request.time_limit
    ends = [q_start]
    if not isinstance(goal, ReachRegion):
        values = numbers(goal, checker.robot, "goal")
        ends += [configuration(values, checker.robot, "goal")] if values.ndim == 1 else []
    result = _widest(checker, steps, ends, answer, (1.0 - bounded * _RISKIER) * limit, now)
    if not (result.solved or not bounded or result.status == "too_risky"):
        result = _riskier(checker, result, ends, answer, _RISKIER * limit)
    if not moved:
        return result
    message, warnings = f"{result.message}; {moved}", (*result.warnings, moved)
    return replace(result, message=message, warnings=warnings)


def _checked_margins(checker: CheckerLike, margins: Sequence[float]) -> list[float]:
    steps = np.asarray(margins, dtype=np.float64)
    good = steps.ndim == 1 and len(steps) > 0 and steps[-1] >= 0.0 and steps[0] < np.inf
    if not (good and (np.diff(steps) < 0.0).all()):
        needed = "decreasing margins of at least 0 m, such as (0.02, 0.01, 0.005, 0.0)"
        raise PlanningError(f"margins is {margins!r}; it must hold {needed}")
    if not hasattr(checker, "with_extra_margin"):
        who = type(checker).__name__
        raise PlanningError(f"a {who} has no with_extra_margin; give a CollisionChecker")
    return [float(step) for step in steps]


def _widest(
    checker: Any,
    margins: Sequence[float],
    ends: Sequence[Configuration],
    answer: Answer,
    time_limit: float,
    now: Now,
) -> PlanResult:
    """Return the answer with the widest margin that has a path, else the last answer.

    As in `within_risk`, estimates (the first draws the worlds) do not count as time spent.
    """
    left = time_limit
    for step in margins:
        judge = checker.with_extra_margin(step) if step > 0.0 else checker
        if step != margins[-1] and not all(map(judge.is_valid, ends)):
            continue  # only the last refusal is told, and telling takes longer than a search
        least, began = _WIDER * time_limit, now()
        wider = tuple(other - step for other in margins if other > step)
        result = answer(judge, max(left, least) if step == margins[-1] else least, wider)
        left -= now() - began - result.report.risk_time
        if result.solved:
            break
    if not result.solved or len(margins) == 1:
        return result
    report, kept = result.report, f"{1000.0 * step:g} mm"
    if report.middle is None:
        return replace(result, message=f"{result.message}; kept {kept}{_BEYOND}")
    extra, first, last = report.middle
    where = "at both ends" if first > 0 else "at the end"
    where = "at the start" if last == report.waypoints - 1 else where
    wide = f"{1000.0 * (step + extra):g} mm{_BEYOND} between waypoints {first} and {last}"
    message = f"{result.message}; kept {wide}; {kept} {where}"
    return replace(
        result, report=replace(report, middle=(step + extra, first, last)), message=message
    )


def _riskier(
    checker: Any,
    refused: PlanResult,
    ends: Sequence[Configuration],
    answer: Answer,
    time_limit: float,
) -> PlanResult:
    """Return the safest motion that is not within the bound on risk as "too_risky"; the answer
    that is known, if there is none, or if what is in the way has been seen."""
    most = checker.max_risk
    bounds = [most, *(bound for bound in _BOUNDS if bound > most)]
    for bound in bounds:
        found = answer(checker.relaxed(bound), time_limit / len(bounds), ())
        # What is too risky as a whole for this bound is so for the one that was asked for.
        path = found.path if found.solved else found.approximate_path
        if path is not None and found.report.risk is not None:
            risk = found.report.risk
            said = f"only riskier motions were found than max_risk {most:g} allows"
            if risk.upper <= most:
                said = "the level set, rounded outward, is touched by less than it is unsure"
            return replace(
                found, status="too_risky", path=None, approximate_path=path,
                explanation=refused.explanation,
                message=f"{said}; the safest: {risk.text()}{_advice(risk)}",
            )  # fmt: skip
    if refused.status.startswith("invalid") and not found.status.startswith("invalid"):
        what = refused.status.removeprefix("invalid_")
        asked = ends[:1] if what == "start" else ends[1:]
        asked = asked or [np.array(goal.q) for goal in refused.report.refused_goals]
        known = [checker.collision_probability(q, held_out=True) for q in asked]
        risk = min(known, key=lambda estimate: estimate.upper)
        message = (
            f"{what} is too risky, {risk.text()}, and no motion to it was found; "
            f"{refused.message}{_advice(risk)}"
        )
        return replace(refused, status="too_risky", message=message)
    return refused


def _advice(risk: Any) -> str:
    """What would lower a risk, by what the worlds collide with first."""
    if not risk.first_contact:
        return ""
    cause = risk.first_contact[0]
    ways = "another view of it, or another goal,"
    if cause.body.startswith("object:"):
        allowed = f"{{{cause.link!r}: {{{cause.body.removeprefix('object:')}}}}}"
        ways = f"another view of it, another goal, or allowed_contacts {allowed}"
    return f"; {ways} would lower that"


def _prepared(
    checker: CheckerLike,
    start: Configuration,
    goal: Any,
    pose_goal: PoseGoalConfig | None,
    request: SearchRequest,
    objective: str | RiskObjective,
    now: Now,
) -> tuple[np.ndarray, PathCost | None, PlanReport] | PlanResult:
    """Return the goals, what paths cost (None for length) and the report, or a refusal."""
    report = PlanReport(request.planner, request.seed, request.time_limit, clock=request.clock)
    refusal = refuse(checker, start, "start", report)
    if refusal is not None:
        return refusal
    ends = valid_goals(checker, goal, start, pose_goal or PoseGoalConfig(), report)
    if isinstance(ends, PlanResult):
        return ends
    goals, report = ends
    kind = planner_kind(request.planner)
    # A second thread asks whether further goals are valid. The checker is Python, whose lock
    # the first thread holds.
    if kind.starts_thread and len(goals) > 1:
        raise PlanningError(
            f"{request.planner} deadlocks with more than one goal configuration, here "
            f"{len(goals)}; give one, or use RRTConnect"
        )
    asked = 1 + len(goals) + len(report.refused_goals)
    report = replace(report, state_checks=asked, motion_checks=len(goals))
    if objective == "length":
        return goals, None, report
    if not isinstance(objective, RiskObjective):
        needed = "'length' or a RiskObjective, for example RiskObjective(kind='joint')"
        raise PlanningError(f"objective is {objective!r}; it must be {needed}")
    if not kind.honours_objective:
        able = ", ".join(name for name, k in planners().items() if k.honours_objective)
        why = f": it {kind.note}" if kind.note else ""
        who = f"{request.planner} does not honour an objective{why}"
        raise PlanningError(f"{who}; planners that do are {able}")
    began, cost = now(), None
    for step in objective.preparation(checker):
        step()
        if now() - began >= request.time_limit:
            break
    else:
        cost = objective.cost(checker)
    took = now() - began
    report = replace(report, objective=objective.name, objective_time=took)
    if request.time_limit - took > 0.0:
        return goals, cost, report
    message = (
        f"preparing the objective '{objective.name}' took {took:.2f} s of the "
        f"{request.time_limit:g} s allowed; it is kept: plan again, or allow more time"
    )
    return PlanResult(None, "timeout", report, message)


def _require_same_robot(judge: Any, checker: CheckerLike) -> None:
    """Raise PlanningError before any search if the judge cannot be asked about its paths."""
    if not isinstance(judge, SecondOpinion):
        who = f"a {type(judge).__name__} without 'robot' and 'review'"
        raise PlanningError(f"second_opinion is {who}; give a MeshChecker, or None")
    ours, theirs = tuple(checker.robot.joint_names), tuple(judge.robot.joint_names)
    if ours != theirs:
        whose = f"{theirs}; the checker's are {ours}"
        raise PlanningError(f"second_opinion is about a robot with joints {whose}")


def _annotated(
    result: PlanResult, checker: CheckerLike, judge: SecondOpinion | None, now: Now
) -> PlanResult:
    """Say what a path ends touching because it may, and what another judge makes of it.

    That judge is not obeyed.
    """
    if result.path is None:
        return result
    report, message = result.report, result.message
    touching: tuple[Any, ...] = ()
    if getattr(getattr(checker, "config", None), "allowed_contacts", True):
        touching = tuple(getattr(checker.explain(result.path[-1]), "allowed", ()))
    if touching:
        named = ", ".join(f"{contact.link} on {contact.body}" for contact in touching)
        report = replace(report, allowed_contacts=touching)
        message = f"{message}; ends touching, as allowed: {named}"
    if judge is not None:
        began = now()
        opinion = judge.review(checker, result.path)
        report = replace(report, second_opinion=opinion, second_opinion_time=now() - began)
        if not opinion.valid:
            _log.warning("second opinion on the verified path: %s", one_line(opinion))
            message = f"{message}; but {one_line(opinion)}"
    return replace(result, report=report, message=message)
