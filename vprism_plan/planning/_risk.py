# SPDX-License-Identifier: BSD-3-Clause
"""The bound on a whole path's risk, where edges are checked one by one."""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from vprism_plan.planning._clock import Now
from vprism_plan.planning._protocol import CheckerLike, RiskChecker
from vprism_plan.planning.result import PlanResult

# Plans with a checker within some seconds; the attempt's number makes its seed.
Attempt = Callable[[CheckerLike, float, int], PlanResult]


def within_risk(
    checker: CheckerLike,
    attempt: Attempt,
    time_limit: float,
    now: Now = time.perf_counter,
) -> PlanResult:
    """Plan until the joint risk of the whole path is within the checker's `max_risk`.

    The estimate comes from worlds that the search has not seen, by its upper confidence
    bound. While it exceeds the bound and time is left, the edges are held to a stricter
    one (`checker.tightened`). A checker without a bound is asked once.

    Args:
        checker: whose `max_risk` holds.
        attempt: plans with a checker.
        time_limit: time in seconds after which no further attempt starts; the time
            spent on estimates (the first draws the worlds) does not count.
        now: reads the clock, seconds.

    Returns:
        The first path within the bound; otherwise the least risky one as "too_risky", or
        the refusal of the first attempt.
    """
    if not isinstance(checker, RiskChecker) or checker.max_risk is None:
        return attempt(checker, time_limit, 0)
    began = now()
    best: PlanResult | None = None
    level, tried, spent = 0, 0, 0.0
    current: Any = checker
    while current is not None:
        left = time_limit - (now() - began - spent)
        if level > 0 and left <= 0.0:
            break
        result, tried = attempt(current, left if level else time_limit, level), level
        if not result.solved:
            if best is None:
                return result
            break
        asked = now()
        risk = checker.collision_probability(result.path, held_out=True)
        spent += now() - asked
        report = replace(result.report, risk=risk, risk_levels=level, risk_time=spent)
        if risk.upper <= checker.max_risk:
            return replace(result, report=report, message=f"{result.message}; {risk.text()}")
        if best is None or risk.upper < best.report.risk.upper:
            best = replace(result, report=report)
        level += 1
        current = checker.tightened(level)
    assert best is not None
    return _too_risky(best, tried, spent, checker.max_risk)


def _too_risky(best: PlanResult, tried: int, spent: float, max_risk: float) -> PlanResult:
    return replace(
        best,
        path=None,
        approximate_path=best.path,
        status="too_risky",
        report=replace(best.report, risk_levels=tried, risk_time=spent),
        message=f"every edge is within max_risk {max_risk:g}, the whole path is not; the least "
        f"risky one, with the bound tightened {tried} times: {best.report.risk.text()}",
    )


def with_allowed_contacts(result: PlanResult, checker: CheckerLike) -> PlanResult:
    """Say in the report, and the message, what the robot ends touching because it may."""
    if result.path is None:
        return result
    touching = tuple(getattr(checker.explain(result.path[-1]), "allowed", ()))
    if not touching:
        return result
    named = ", ".join(f"{contact.link} on {contact.body}" for contact in touching)
    return replace(
        result,
        report=replace(result.report, allowed_contacts=touching),
        message=f"{result.message}; ends touching, as allowed: {named}",
    )
