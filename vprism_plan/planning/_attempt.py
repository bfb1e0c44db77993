# SPDX-License-Identifier: BSD-3-Clause
"""From a query to a verified path: search, shorten, resample, verify, and search again."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from vprism_plan.errors import PlanningError
from vprism_plan.planning._clock import Now
from vprism_plan.planning._protocol import CheckerLike
from vprism_plan.planning._runtime import MAX_SEED
from vprism_plan.planning._search import SearchOutcome, SearchRequest, search
from vprism_plan.planning._shortcut import cheapen, shorten
from vprism_plan.planning._verify import MotionCheck, resample, verified
from vprism_plan.planning.objectives import PathCost
from vprism_plan.planning.result import Improvement, PlanReport, PlanResult

_ATTEMPTS = 5
_LEAD_SHARE = 0.1  # of the time limit that shortening a leading path may take
_SEED_STRIDE = 0x9E3779B1


@dataclass(frozen=True)
class Begin:
    """Where a search begins.

    Attributes:
        warm: whether the planner is to be led along a path that is known.
        lead: such a path, or None: then it has to be searched for.
        goal_index: the goal that it leads to.
    """

    warm: bool
    lead: np.ndarray | None
    goal_index: int | None


@dataclass(frozen=True)
class Finish:
    """What happens to a path between the search and its verification."""

    simplify: bool
    simplify_time: float
    interpolate: float | None
    clearance_step: float
    now: Now
    cost: PathCost | None

    def shortened(
        self, checker: CheckerLike, path: Float[np.ndarray, "t dof"], report: PlanReport
    ) -> tuple[Float[np.ndarray, "n dof"], PlanReport]:
        """Return the path with fewer detours, and the report with what that took."""
        if not self.simplify:
            return path, report
        began = self.now()
        check = MotionCheck(checker)
        end = began + self.simplify_time
        path = shorten(path, check, report.seed, end, self.now, self.cost)
        if self.cost is not None:
            path = cheapen(path, check, report.seed, end, self.now, self.cost)
            path = shorten(path, check, report.seed, end, self.now, self.cost)
        return path, replace(
            report,
            simplification_time=report.simplification_time + self.now() - began,
            motion_checks=report.motion_checks + check.count,
        )

    def resampled(
        self, checker: CheckerLike, path: Float[np.ndarray, "t dof"]
    ) -> Float[np.ndarray, "n dof"]:
        """Return the path with the waypoints that were asked for."""
        if self.interpolate is None:
            return path
        return resample(path, MotionCheck(checker), self.interpolate)


def searched(
    checker: CheckerLike,
    start: Float[np.ndarray, " dof"],
    goals: Float[np.ndarray, "g dof"],
    request: SearchRequest,
    finish: Finish,
    report: PlanReport,
    begin: Begin,
) -> PlanResult:
    """Search, shorten and verify; search again with another seed if verification fails.

    A checker that samples at its finest step can accept an edge in one direction and
    refuse it in the other, by microns. Bidirectional planners turn edges round.
    """
    refused: PlanResult | None = None
    for attempt in range(_ATTEMPTS):
        left = request.time_limit - report.planning_time
        if left <= 0.0:
            break
        seed = other_seed(request.seed, attempt)
        query = replace(request, seed=seed, time_limit=left)
        found = _led(checker, start, goals, query, finish, begin)
        report = replace(
            report,
            searches=attempt + 1,
            planning_time=report.planning_time + found.planning_time,
            state_checks=report.state_checks + found.state_checks,
            motion_checks=report.motion_checks + found.motion_checks,
            history=found.history,
        )
        if found.status != "exact" or found.path is None:
            return refused or not_found(found.status, found.path, report)
        path, report = finish.shortened(checker, found.path, report)
        path = finish.resampled(checker, path)
        found_report = replace(report, goal_index=found.goal_index)
        result = verified(checker, path, finish.clearance_step, found_report, finish.now)
        if result.solved:
            return result
        refused, report = result, result.report
    if refused is None:
        raise PlanningError(f"time_limit {request.time_limit} s left no time for a search")
    return refused


def _led(
    checker: CheckerLike,
    start: Float[np.ndarray, " dof"],
    goals: Float[np.ndarray, "g dof"],
    request: SearchRequest,
    finish: Finish,
    begin: Begin,
) -> SearchOutcome:
    """Search, led along a known path if that is wanted: given, or RRTConnect's."""
    if not begin.warm:
        found = search(checker, start, goals, request, finish.cost)
        if found.status == "exact" or begin.lead is None:
            return found
        # The planner failed; that a straight motion is valid was known before.
        return replace(found, status="exact", path=begin.lead, goal_index=begin.goal_index)
    lead, spent = begin.lead, 0.0
    quick: SearchOutcome | None = None
    if lead is None:
        quick = search(
            checker, start, goals, replace(request, planner="RRTConnect", stop="first", step=None)
        )
        if quick.status != "exact" or quick.path is None:
            return quick
        began = finish.now()
        end = began + _LEAD_SHARE * request.time_limit
        lead = shorten(quick.path, MotionCheck(checker), request.seed, end, finish.now)
        spent = quick.planning_time + finish.now() - began
    left = request.time_limit - spent
    if left <= 0.0 and quick is not None:
        return quick
    found = search(checker, start, goals, replace(request, time_limit=left), finish.cost, lead)
    index = begin.goal_index if quick is None else quick.goal_index
    return _better(found, lead, finish, spent, quick, index)


def _better(
    found: SearchOutcome,
    lead: Float[np.ndarray, "t dof"],
    finish: Finish,
    spent: float,
    quick: SearchOutcome | None,
    index: int | None,
) -> SearchOutcome:
    """Return the cheaper of what was found and what led there, with the effort of both."""
    assert finish.cost is not None
    whole = replace(
        found,
        planning_time=spent + found.planning_time,
        state_checks=found.state_checks + (quick.state_checks if quick else 0),
        motion_checks=found.motion_checks + (quick.motion_checks if quick else 0),
        history=(
            Improvement(spent, finish.cost.path(lead), lead),
            *(replace(better, time=spent + better.time) for better in found.history),
        ),
    )
    cheaper = (
        found.status == "exact"
        and found.path is not None
        and finish.cost.path(found.path) <= finish.cost.path(lead)
    )
    if cheaper:
        return whole
    return replace(whole, status="exact", path=lead, goal_index=index)


def other_seed(seed: int, number: int) -> int:
    """Return the seed of a further search; number 0 is the given one."""
    return (seed + number * _SEED_STRIDE) % (MAX_SEED + 1)


def not_found(status: str, path: np.ndarray | None, report: PlanReport) -> PlanResult:
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
