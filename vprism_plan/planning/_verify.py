# SPDX-License-Identifier: BSD-3-Clause
"""The last word on a path: every edge of the array that is handed out, checked again."""

import logging
import math
import time
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from vprism_plan.planning._clock import Now
from vprism_plan.planning._protocol import CheckerLike
from vprism_plan.planning._shortcut import Check
from vprism_plan.planning.result import PlanReport, PlanResult

_log = logging.getLogger(__name__)

_ROUNDING = 1e-9  # radians or metres beyond a joint limit that count as on it


class MotionCheck:
    """Counts and answers `checker.check_motion` for edges that may become part of a path.

    An edge that turns a continuous joint by half a turn or more is refused: it means what it
    says, but others who follow the path could take it for the shorter way round. So is one
    that leaves the joint limits, which not every checker knows.
    """

    def __init__(self, checker: CheckerLike) -> None:
        self._check = checker.check_motion
        self._robot = checker.robot
        self._turns = np.asarray(checker.robot.continuous, dtype=bool)
        self.count = 0

    def __call__(self, qa: Float[np.ndarray, " dof"], qb: Float[np.ndarray, " dof"]) -> bool:
        self.count += 1
        if np.any(np.abs(qb - qa)[self._turns] >= np.pi):
            return False
        if outside_limits(self._robot, np.stack([qa, qb])).any():
            return False
        return bool(self._check(qa, qb))


def outside_limits(robot: Any, path: Float[np.ndarray, "t dof"]) -> Bool[np.ndarray, " t"]:
    """Return which rows have a limited joint outside its limits by more than rounding."""
    low = path < np.asarray(robot.lower) - _ROUNDING
    high = path > np.asarray(robot.upper) + _ROUNDING
    return np.asarray(np.any((low | high) & ~np.asarray(robot.continuous, dtype=bool), axis=1))


def resample(
    path: Float[np.ndarray, "t dof"], check: Check, spacing: float
) -> Float[np.ndarray, "n dof"]:
    """Insert equally spaced waypoints on edges longer than `spacing`.

    The pieces of an edge that was accepted within a tolerance may not all pass by
    themselves; such an edge stays whole.
    """
    rows = [path[0]]
    for edge in pairwise(path):
        pieces = interpolated(np.stack(edge), spacing)
        split = all(check(a, b) for a, b in pairwise(pieces))
        rows += list(pieces[1:]) if split else [edge[1]]
    return np.stack(rows)


def interpolated(path: Float[np.ndarray, "t dof"], spacing: float) -> Float[np.ndarray, "n dof"]:
    """Return the path with points at most `spacing` apart."""
    pieces = [path[:1]]
    for a, b in pairwise(path):
        n = max(1, math.ceil(float(np.linalg.norm(b - a)) / spacing))
        inner = a + (b - a) * (np.arange(1, n)[:, None] / n)
        pieces += [inner, b[None]]
    return np.concatenate(pieces)


def verified(
    checker: CheckerLike,
    path: Float[np.ndarray, "t dof"],
    clearance_step: float,
    report: PlanReport,
    now: Now = time.perf_counter,
) -> PlanResult:
    """Check every edge of the final waypoints again, and measure the path."""
    began = now()
    verdicts: list[Any] = []
    failed = _first_bad_edge(checker, path, verdicts)
    report = replace(
        report,
        verification_time=now() - began,
        motion_checks=report.motion_checks + len(verdicts),
    )
    if failed is not None:
        _log.warning("edge %d of the final path failed its verification", failed)
        outside = outside_limits(checker.robot, path[failed : failed + 2]).any()
        reason = "it leaves the joint limits" if outside else one_line(verdicts[-1])
        return PlanResult(
            path=None,
            status="verification_failed",
            report=replace(report, goal_index=None),
            message=f"edge {failed} of {len(path) - 1} of the final path was refused when checked "
            f"again: {reason}",
            approximate_path=path,
            explanation=verdicts[-1],
        )
    clearances = [checker.clearance(q) for q in interpolated(path, clearance_step)]
    report = replace(
        report,
        path_length=float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()),
        waypoints=len(path),
        min_clearance=float(min(clearances)),
        clearance_samples=len(clearances),
        certified=all(verdict.certified for verdict in verdicts),
        tolerance=float(max(verdict.tolerance for verdict in verdicts)),
        shares=_largest_shares(checker, path),
    )
    return PlanResult(
        path=path,
        status="exact",
        report=report,
        message=f"path of {len(path)} waypoints, length {report.path_length:.3g}, smallest "
        f"clearance {report.min_clearance:.3g} m in {len(clearances)} samples",
    )


def _first_bad_edge(
    checker: CheckerLike, path: Float[np.ndarray, "t dof"], verdicts: list[Any]
) -> int | None:
    """Append a report per checked motion; return the first refused edge, None if all pass."""
    outside = outside_limits(checker.robot, path)
    for edge, (a, b) in enumerate(pairwise(path)):
        verdicts.append(checker.check_motion_report(a, b))
        free = verdicts[-1].valid and checker.check_motion(a, b)
        if not free or outside[edge : edge + 2].any():
            return edge
    return None


def _largest_shares(checker: CheckerLike, path: Float[np.ndarray, "t dof"]) -> dict[str, float]:
    """Return the largest share of each kind of unseen space at the waypoints."""
    largest: dict[str, float] = {}
    for q in path:
        for kind, share in checker.explain(q).shares.items():
            largest[kind] = max(largest.get(kind, 0.0), float(share))
    return largest


def one_line(report: Any) -> str:
    """Return a report's text without line breaks."""
    return " ".join(report.text().split())
