# SPDX-License-Identifier: BSD-3-Clause
"""From a query to a verified path: search, shorten, verify, and search again where that fails.

A verification may refuse what the search accepted (`searched`), and a whole path may be too
risky although each of its edges is within the bound (`within_risk`): then it is tried again.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import count, pairwise
from typing import Any

import numpy as np

from vprism_plan.planning.objectives import PathCost
from vprism_plan.planning.ompl_adapter import nearest_turns
from vprism_plan.planning.path import (
    MotionCheck,
    cheapen,
    drop_waypoints,
    interpolated,
    resample,
    shorten,
    verified,
)
from vprism_plan.planning.planners import planner_kind
from vprism_plan.planning.protocols import CheckerLike, Now, Waypoints
from vprism_plan.planning.result import Improvement, PlanReport, PlanResult
from vprism_plan.planning.search import MAX_SEED, SearchOutcome, SearchRequest, search

# Plans with a checker within some seconds; the attempt's number makes its seed.
Attempt = Callable[[CheckerLike, float, int], PlanResult]
# The goal that a valid path leads to, and the path; it was not to be taken at once.
Lead = tuple[int | None, np.ndarray]

_SEARCHES = 5
_LEAD_SHARE = 0.1  # of the time limit that shortening a leading path may take
_RETREAT = 0.05  # joint space; how finely a place with room for a margin is looked for
_RETREAT_CHECKS = 200  # motions between such places, all margins together; 3 to 23 found a way
_SEED_STRIDE = 0x9E3779B1


def within_risk(
    checker: CheckerLike, attempt: Attempt, time_limit: float, now: Now = time.perf_counter
) -> PlanResult:
    """Plan until the joint risk of the whole path is within the checker's `max_risk`.

    The estimate comes from worlds that the search has not seen, by its upper confidence
    bound. While it exceeds the bound and time is left, the edges between its ends are held to a
    stricter one (`checker.tightened`). A checker without a bound is asked once. No further attempt
    starts after `time_limit` seconds, those spent on estimates (the first draws the worlds)
    left out. Returns the first path within the bound; otherwise the least risky one as
    "too_risky", or the refusal of the first attempt.
    """
    bounded: Any = checker if hasattr(checker, "tightened") else None
    max_risk = getattr(bounded, "max_risk", None)
    if max_risk is None:
        return attempt(checker, time_limit, 0)
    began, spent = now(), 0.0
    best: PlanResult | None = None
    ends: np.ndarray | None = None
    for level in count():
        judge = bounded.tightened(level, ends) if level else checker
        left = time_limit - (now() - began - spent) if level else time_limit
        if judge is None or (level and left <= 0.0):
            break
        result, tried = attempt(judge, left, level), level
        spent += result.report.risk_time
        if not result.solved:
            if best is None:
                return result
            break
        if result.report.risk is None:
            result = _with_risk(bounded, result, now)
            spent += result.report.risk_time
        assert result.path is not None
        risk, ends = result.report.risk, result.path[[0, -1]]
        report = replace(result.report, risk_levels=level, risk_time=spent)
        if risk.upper <= max_risk:
            return replace(result, report=report, message=f"{result.message}; {risk.text()}")
        if best is None or risk.upper < best.report.risk.upper:
            best = replace(result, report=report)
    assert best is not None
    return replace(
        best,
        path=None,
        approximate_path=best.path,
        status="too_risky",
        report=replace(best.report, risk_levels=tried, risk_time=spent),
        message=f"every edge is within max_risk {max_risk:g}, the whole path is not; the least "
        f"risky one, with the bound tightened {tried} times: {best.report.risk.text()}",
    )


def _with_risk(bounded: Any, result: PlanResult, now: Now) -> PlanResult:
    """Return the result with the risk of its path by worlds that the search has not seen."""
    asked = now()
    risk = bounded.collision_probability(result.path, held_out=True)
    report = replace(result.report, risk=risk, risk_time=result.report.risk_time + now() - asked)
    return replace(result, report=report)


@dataclass(frozen=True)
class Query:
    """What is looked for, and what is done to a path that is found; see `plan`."""

    start: np.ndarray  # (dof,) valid
    goals: np.ndarray  # (g, dof) valid
    request: SearchRequest
    cost: PathCost | None  # None: length
    warm_start: bool
    simplify: bool
    simplify_time: float
    interpolate: float | None
    clearance_step: float
    wider: tuple[float, ...] = ()  # metres beyond the checker's margin to keep between the ends

    def finished(self, checker: CheckerLike, path: Waypoints, report: PlanReport) -> PlanResult:
        """Return the verdict on a path that was found, shortened.

        Where an end is too near to something for a wider margin, that is kept between the ends,
        unless the path is riskier then.
        """
        away = self.widened(checker, path, report) if self.simplify and self.cost is None else None
        wide = None if away is None else self.verified(checker, *away)
        if wide is None or not wide.solved:
            return self.verified(checker, *self.shortened(checker, path, report))
        if getattr(checker, "max_risk", None) is None:
            return wide
        wide = _with_risk(checker, wide, self.request.now)
        if wide.risk.probability == 0.0:  # no other can be less risky
            return wide
        result = self.verified(checker, *self.shortened(checker, path, report))
        if result.solved:
            result = _with_risk(checker, result, self.request.now)
        least = not result.solved or wide.risk.probability <= result.risk.probability
        best, other = (wide, result) if least else (result, wide)
        spent = best.report.risk_time + other.report.risk_time
        return replace(best, report=replace(best.report, risk_time=spent))

    def widened(
        self, checker: Any, path: Waypoints, report: PlanReport
    ) -> tuple[Waypoints, PlanReport] | None:
        """Return a path that keeps a wider margin between its tight ends, and the report.

        From each end the path is followed to where there is room; between these places another
        is searched for, that keeps the margin. None if there is no such place, or no such path.
        """
        now, seed = self.request.now, report.seed
        began, spent = now(), report.planning_time
        end = began + self.simplify_time
        check = MotionCheck(checker)
        checks, most = report.motion_checks, _RETREAT_CHECKS
        rows: np.ndarray | None = None
        for extra in self.wider:
            judge = checker.with_extra_margin(extra)
            if most <= 0 or (judge.is_valid(path[0]) and judge.is_valid(path[-1])):
                break  # the ends are not what is in the way
            if rows is None:
                rows = interpolated(drop_waypoints(path, check, end, now), _RETREAT)
            first = next((i for i, q in enumerate(rows) if judge.is_valid(q)), len(rows))
            last = next((i for i in reversed(range(len(rows))) if judge.is_valid(rows[i])), 0)
            if first >= last:
                continue
            quick = replace(
                self.request, planner="RRTConnect", stop="first", step=None, seed=seed,
                most_checks=most,
            )  # fmt: skip
            middle, keeps = rows[[first, last]], MotionCheck(judge)
            if not keeps(*middle):
                found = search(judge, rows[first], rows[last:][:1], quick)
                spent, checks = spent + found.planning_time, checks + found.motion_checks
                most -= found.motion_checks
                if found.status != "exact" or found.path is None:
                    continue
                middle = shorten(found.path, keeps, seed, end, now)
            kept = all(keeps(a, b) for a, b in pairwise(middle))
            checks += keeps.count
            if not kept:
                continue
            head, tail = (
                drop_waypoints(q, check, end, now) for q in (rows[: first + 1], rows[last:])
            )
            # The middle may have gone round the other way.
            turns = np.round((middle[-1] - rows[last]) / (2.0 * np.pi))
            whole = np.concatenate([head[:-1], middle, tail[1:] + 2.0 * np.pi * turns])
            took = report.simplification_time + now() - began - (spent - report.planning_time)
            report = replace(
                report, direct=False, planning_time=spent, simplification_time=took,
                motion_checks=checks + check.count,
                middle=(extra, len(head) - 1, len(head) + len(middle) - 2),
            )  # fmt: skip
            return whole, report
        return None

    def shortened(
        self, checker: CheckerLike, path: Waypoints, report: PlanReport
    ) -> tuple[Waypoints, PlanReport]:
        """Return the path with fewer detours, and the report with what that took."""
        if not self.simplify:
            return path, report
        now = self.request.now
        began = now()
        check = MotionCheck(checker)
        end = began + self.simplify_time
        path = shorten(path, check, report.seed, end, now, self.cost)
        if self.cost is not None:
            path = cheapen(path, check, report.seed, end, now, self.cost)
            path = shorten(path, check, report.seed, end, now, self.cost)
        took = report.simplification_time + now() - began
        checks = report.motion_checks + check.count
        return path, replace(report, simplification_time=took, motion_checks=checks)

    def verified(self, checker: CheckerLike, path: Waypoints, report: PlanReport) -> PlanResult:
        """Return the verdict on a path with the waypoints that were asked for."""
        if self.interpolate is not None:
            bends = path
            path = resample(path, MotionCheck(checker), self.interpolate)
            if report.middle is not None:
                extra, *ends = report.middle
                first, last = (int((path == bends[i]).all(axis=1).argmax()) for i in ends)
                report = replace(report, middle=(extra, first, last))
        return verified(checker, path, self.clearance_step, report, self.request.now)


def attempt(
    checker: CheckerLike, query: Query, report: PlanReport, time_limit: float, number: int
) -> PlanResult:
    """Plan once: the straight way if that will do, else by searches with seeds of `number`."""
    # A stricter checker may refuse an end, and OMPL waits for goals that do not come.
    if number and not (checker.is_valid(query.start) and any(map(checker.is_valid, query.goals))):
        return not_found("timeout", None, report)
    turns = np.asarray(checker.robot.continuous, dtype=bool)
    ends = nearest_turns(query.goals, query.start, turns)
    straight = (
        (index, np.stack([query.start, q]))
        for index, q in enumerate(ends)
        if checker.check_motion(query.start, q)
    )
    lead = next(straight, None)
    # Nothing is shorter. Only if it risks nothing, nothing is cheaper.
    if lead is not None and (query.cost is None or query.cost.risk.motion(*lead[1]) == 0.0):
        return query.finished(checker, lead[1], replace(report, direct=True, goal_index=lead[0]))
    seed = _other_seed(query.request.seed, 64 * number)
    query = replace(query, request=replace(query.request, time_limit=time_limit, seed=seed))
    return searched(checker, query, report, lead)


def searched(
    checker: CheckerLike, query: Query, report: PlanReport, lead: Lead | None
) -> PlanResult:
    """Search, shorten and verify; search again with another seed if verification fails.

    A checker that samples at its finest step can accept an edge in one direction and
    refuse it in the other, by microns. Bidirectional planners turn edges round.
    """
    refused: PlanResult | None = None
    for number in range(_SEARCHES):
        left = query.request.time_limit - report.planning_time
        if left <= 0.0:
            break
        seed = _other_seed(query.request.seed, number)
        request = replace(query.request, seed=seed, time_limit=left)
        found = _led(checker, query, request, lead)
        report = replace(
            report,
            searches=number + 1,
            planning_time=report.planning_time + found.planning_time,
            state_checks=report.state_checks + found.state_checks,
            motion_checks=report.motion_checks + found.motion_checks,
            history=found.history,
        )
        if found.status != "exact" or found.path is None:
            return refused or not_found(found.status, found.path, report)
        result = query.finished(checker, found.path, replace(report, goal_index=found.goal_index))
        if result.solved:
            return result
        refused, report = result, result.report
    assert refused is not None, "the time limit is more than 0"
    return refused


def _led(
    checker: CheckerLike, query: Query, request: SearchRequest, lead: Lead | None
) -> SearchOutcome:
    """Search, led along a known path if that is wanted: the given one, or RRTConnect's."""
    start, goals, cost, now = query.start, query.goals, query.cost, request.now
    if cost is None or not query.warm_start or not planner_kind(request.planner).goal_bias:
        found = search(checker, start, goals, request, cost)
        if found.status == "exact" or lead is None:
            return found
        # The planner failed; that a straight motion is valid was known before.
        return replace(found, status="exact", path=lead[1], goal_index=lead[0])
    spent, quick = 0.0, None
    if lead is None:
        first = replace(request, planner="RRTConnect", stop="first", step=None)
        quick = search(checker, start, goals, first)
        if quick.status != "exact" or quick.path is None:
            return quick
        began = now()
        end = began + _LEAD_SHARE * request.time_limit
        lead = quick.goal_index, shorten(quick.path, MotionCheck(checker), request.seed, end, now)
        spent = quick.planning_time + now() - began
        if request.time_limit - spent <= 0.0:
            return quick
    rest = replace(request, time_limit=request.time_limit - spent)
    goal_index, path = lead
    found = search(checker, start, goals, rest, cost, path)
    known = cost.path(path)
    whole = replace(
        found,
        planning_time=spent + found.planning_time,
        state_checks=found.state_checks + (quick.state_checks if quick else 0),
        motion_checks=found.motion_checks + (quick.motion_checks if quick else 0),
        history=(
            Improvement(spent, known, path),
            *(replace(better, time=spent + better.time) for better in found.history),
        ),
    )
    if found.status == "exact" and found.path is not None and cost.path(found.path) <= known:
        return whole
    return replace(whole, status="exact", path=path, goal_index=goal_index)


def _other_seed(seed: int, number: int) -> int:
    """Return the seed of a further search; number 0 is the given one."""
    return (seed + number * _SEED_STRIDE) % (MAX_SEED + 1)


def not_found(status: str, path: np.ndarray | None, report: PlanReport) -> PlanResult:
    """Return what is answered where a search reached no goal."""
    who, limit = report.planner, f"within {report.time_limit:g} s"
    if status != "approximate":
        return PlanResult(None, "timeout", report, f"{who} found no path {limit}")
    message = f"{who} came near the goal but did not reach it {limit}"
    return PlanResult(None, "approximate", report, message, path)
