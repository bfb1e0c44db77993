# SPDX-License-Identifier: BSD-3-Clause
"""Asks another judge about a path that was verified; what it says is reported, not obeyed."""

import logging
import time
from dataclasses import replace
from typing import Any

from vprism_plan.errors import PlanningError
from vprism_plan.planning._clock import Now
from vprism_plan.planning._protocol import CheckerLike, SecondOpinion
from vprism_plan.planning.result import PlanResult

_log = logging.getLogger(__name__)


def refuse_unfit(judge: Any, checker: CheckerLike) -> None:
    """Raise PlanningError before any search if the judge cannot be asked about its paths."""
    if judge is None:
        return
    if not isinstance(judge, SecondOpinion):
        raise PlanningError(
            f"second_opinion is a {type(judge).__name__} without 'robot' and 'review'; give a "
            "MeshChecker, or None"
        )
    ours, theirs = tuple(checker.robot.joint_names), tuple(judge.robot.joint_names)
    if ours != theirs:
        raise PlanningError(
            f"second_opinion is about a robot with joints {theirs}; the checker's are {ours}"
        )


def reviewed(
    result: PlanResult,
    checker: CheckerLike,
    judge: SecondOpinion | None,
    now: Now = time.perf_counter,
) -> PlanResult:
    """Return the result with what the judge says of its path; unchanged without a path or judge."""
    if judge is None or result.path is None:
        return result
    began = now()
    opinion = judge.review(checker, result.path)
    report = replace(
        result.report,
        second_opinion=opinion,
        second_opinion_time=now() - began,
    )
    if opinion.valid:
        return replace(result, report=report)
    says = " ".join(opinion.text().split())
    _log.warning("second opinion on the verified path: %s", says)
    return replace(result, report=report, message=f"{result.message}; but {says}")
