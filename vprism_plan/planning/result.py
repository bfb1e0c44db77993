# SPDX-License-Identifier: BSD-3-Clause
"""What a planning query answers: a verdict with its numbers, never an exception."""

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from vprism_plan.collision.reports import Answer

Status = Literal[
    "exact", "approximate", "timeout", "invalid_start", "invalid_goal", "verification_failed",
    "too_risky",
]  # fmt: skip


@dataclass(frozen=True, eq=False)
class Improvement(Answer):
    """The best path at some time of a search.

    Attributes:
        time: seconds since the search began, on the query's clock.
        cost: by the objective; the planner's own value.
        path: (T, dof) radians and metres, as the search found and checked it: neither
            shortened nor verified again.
    """

    time: float
    cost: float
    path: np.ndarray


@dataclass(frozen=True)
class RefusedGoal(Answer):
    """A configuration q (dof,) that reaches the goal but is invalid; why, by the checker."""

    q: tuple[float, ...]
    reason: str


@dataclass(frozen=True)
class PlanReport(Answer):
    """The numbers behind a `PlanResult`.

    Attributes:
        planner: name of the planner that was asked for.
        seed: the seed of the query.
        time_limit: seconds the search was allowed.
        planning_time: seconds spent searching.
        simplification_time: seconds spent shortening the path.
        verification_time: seconds spent re-checking the final waypoints.
        state_checks: states whose validity was asked for, start and goal included.
        motion_checks: motions that were checked, verification included.
        path_length: Euclidean, in joint space (radians and metres alike), NaN without a path.
        waypoints: number of rows of the path, 0 without one.
        min_clearance: smallest `checker.clearance` at `clearance_samples` along the path,
            metres, NaN without a path; the path's safety rests on its verification, not on it.
        clearance_samples: their number.
        searches: how often the planner ran; again, with another seed, where a path failed
            verification.
        direct: whether the straight motion to the goal was valid, so that no search ran.
        goal_index: which of several goal configurations (given, or solutions of a pose or a
            region; without those refused) was reached, None if none was.
        refused_goals: which were refused, and why; of a pose or region until enough were valid.
        certified: whether computed clearances cover every edge, with nothing left to sampling.
        tolerance: largest motion, metres, between a point of the path and a
            configuration known to be free (0 when certified), NaN without a path.
        shares: largest share of the robot's volume, at the waypoints, in each kind of unseen
            space ("occluded", "unobserved", ...) that the checker reports.
        second_opinion: what another judge says of the verified path (`valid`, `text()`); None
            if nobody was asked or there is no path.
        second_opinion_time: seconds that took.
        risk: joint probability that the path collides, by worlds the search has not seen
            (a `RiskEstimate`); None if the checker has no `max_risk`, or without any path.
        risk_levels: how often the bound was tightened: edges were within it, the path was not.
        risk_time: seconds spent on those estimates.
        allowed_contacts: permitted `Contact`s at the last waypoint.
        middle: a wider margin (metres beyond the checker's) than near an end, and the waypoints
            between which the path keeps it; None if it is the same all along.
        clock: what all these seconds were measured by: "wall" or "process" (processor time).
        objective: what the search made small: "length", or the kind of risk.
        objective_time: seconds that preparing it took: worlds drawn and baked, the first time.
        cost: of the path by that objective (`path_length` for "length"); NaN without a path.
        history: the best path each time it had become noticeably better, not yet shortened;
            only of planners that report their cost and resume (see `planners`).
    """

    planner: str
    seed: int
    time_limit: float
    planning_time: float = 0.0
    simplification_time: float = 0.0
    verification_time: float = 0.0
    state_checks: int = 0
    motion_checks: int = 0
    path_length: float = float("nan")
    waypoints: int = 0
    min_clearance: float = float("nan")
    clearance_samples: int = 0
    searches: int = 0
    direct: bool = False
    goal_index: int | None = None
    refused_goals: tuple[RefusedGoal, ...] = ()
    certified: bool = False
    tolerance: float = float("nan")
    shares: dict[str, float] = field(default_factory=dict)
    second_opinion: Any = None
    second_opinion_time: float = 0.0
    risk: Any = None
    risk_levels: int = 0
    risk_time: float = 0.0
    allowed_contacts: tuple[Any, ...] = ()
    middle: tuple[float, int, int] | None = None
    clock: str = "wall"
    objective: str = "length"
    objective_time: float = 0.0
    cost: float = float("nan")
    history: tuple[Improvement, ...] = ()


@dataclass(frozen=True, eq=False)
class PlanResult:
    """The verdict on a planning query.

    Attributes:
        path: verified waypoints (T, dof), radians and metres, start first (or a free configuration
            beside it: `nudge` of `plan`); None unless the status is "exact". Consecutive rows
            differ by the motion that was checked, so the last row equals the goal up to whole
            turns of continuous joints.
        status: "exact" (path reaches the goal and every edge was re-verified),
            "approximate" (ended near the goal only), "timeout" (nothing found),
            "invalid_start", "invalid_goal" (in collision, or out of the joint limits),
            "verification_failed", "too_risky" (only motions, or ends, above `max_risk`, or nearer
            to the level set than it is sure, were found; the safest is `approximate_path`, its
            probability `risk`).
        report: the numbers.
        message: one line for people: what happened and why.
        approximate_path: waypoints that do NOT solve the query: approximate, refused by the
            verification, or the least risky ones that are too risky. None otherwise.
        explanation: the checker's `explain` report for an invalid start or goal, or its
            `check_motion_report` for the first edge that failed verification. None otherwise.
        warnings: what is usable but odd about the world and the robot (`checker.warnings`).
    """

    path: np.ndarray | None
    status: Status
    report: PlanReport
    message: str = ""
    approximate_path: np.ndarray | None = None
    explanation: Any = None
    warnings: tuple[str, ...] = ()

    @property
    def solved(self) -> bool:
        """True only if the path reaches the goal and was verified."""
        return self.status == "exact"

    @property
    def risk(self) -> Any:
        """Joint probability that the path (or the least risky one, if that is too risky) collides:
        `report.risk`, a `RiskEstimate`."""
        return self.report.risk
