# SPDX-License-Identifier: BSD-3-Clause
"""What `optimize` answers: a verdict with its numbers, and how it came about."""

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

OptimizeStatus = Literal[
    "exact",
    "invalid_start",
    "invalid_goal",
    "verification_failed",
    "too_risky",
    "timeout",
]


@dataclass(frozen=True, eq=False)
class History:
    """Costs over the optimisation, one row per batch of evaluations.

    A row holds, for every seed, the values at the best point it had found by then in the
    same round; seeds that had ended keep theirs. A new round changes what is minimised, so
    costs may jump where `round` changes.

    Attributes:
        cost: (I, S) what was minimised.
        terms: name of each term -> (I, S) its share of `cost`.
        round: (I,) the round each row belongs to, from 0.
    """

    cost: Float[np.ndarray, "i s"]
    terms: dict[str, np.ndarray]
    round: Int[np.ndarray, " i"]

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-ready values."""
        return {
            "cost": self.cost.tolist(),
            "terms": {name: values.tolist() for name, values in self.terms.items()},
            "round": self.round.tolist(),
        }


@dataclass(frozen=True)
class SeedReport:
    """What became of one seed.

    Attributes:
        name: what it began as: "initial 0", "straight", "via 0", "noise 0", ...
        cost: what was minimised, at its end.
        length: Euclidean length of its trajectory in joint space.
        iterations: steps of the optimiser, over all rounds.
        stopped: why its last round ended: "converged", "iterations", "stalled" (no step
            along any direction lowers the cost at this precision) or "time".
        refused: what the verification said when it was last asked about this trajectory;
            empty if it is the one returned, or if it never was: a cheaper one passed.
    """

    name: str
    cost: float
    length: float
    iterations: int
    stopped: str
    refused: str

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-ready values."""
        return dict(self.__dict__)


@dataclass(frozen=True)
class OptimizeReport:
    """The numbers behind an `OptimizeResult`.

    Attributes:
        method: "lbfgs" or "adam".
        seed: of every random choice.
        seeds: one report per seed.
        winner: number of the seed whose trajectory is returned; None without a path, and
            for an initial path that is returned as it was given.
        rounds: how many times the trajectories were optimised; more than one if none
            passed the verification.
        evaluations: trajectories whose cost and gradient were computed.
        optimization_time: seconds spent on that.
        verification_time: seconds spent checking edges.
        total_time: seconds, everything included.
        motion_checks: motions that were checked.
        cost: of the returned trajectory, NaN without one, and for an initial path that is
            returned as it was given.
        path_length: Euclidean length of the path in joint space, NaN without one.
        waypoints: number of rows of the path, 0 without one.
        min_clearance: smallest clearance, metres, NaN without a path: of the whole path if
            `keep_clearance` asked for it and the checker can say, else at
            `clearance_samples` samples of it.
        clearance_samples: number of those samples.
        kept_clearance: the clearance that the path had to keep, metres; None if none.
        certified, tolerance, shares, risk, risk_levels, risk_time: as in `PlanReport`.
    """

    method: str
    seed: int
    seeds: tuple[SeedReport, ...] = ()
    winner: int | None = None
    rounds: int = 0
    evaluations: int = 0
    optimization_time: float = 0.0
    verification_time: float = 0.0
    total_time: float = 0.0
    motion_checks: int = 0
    cost: float = float("nan")
    path_length: float = float("nan")
    waypoints: int = 0
    min_clearance: float = float("nan")
    clearance_samples: int = 0
    kept_clearance: float | None = None
    certified: bool = False
    tolerance: float = float("nan")
    shares: dict[str, float] = field(default_factory=dict)
    risk: Any = None
    risk_levels: int = 0
    risk_time: float = 0.0

    @property
    def winner_name(self) -> str:
        """What the returned trajectory began as; empty without one."""
        return "" if self.winner is None else self.seeds[self.winner].name

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-ready values."""
        values = dict(self.__dict__)
        values["seeds"] = [seed.to_dict() for seed in self.seeds]
        values["risk"] = self.risk.to_dict() if hasattr(self.risk, "to_dict") else None
        values["winner_name"] = self.winner_name
        return values


@dataclass(frozen=True, eq=False)
class OptimizeResult:
    """The verdict on an optimisation.

    Attributes:
        path: verified waypoints (T, dof), radians and metres, start first; None unless the
            status is "exact". The first row is the start and the last the goal, bit for bit
            (up to whole turns of continuous joints).
        status: "exact" (every edge of the path was verified by the checker, the bound on
            risk included), "invalid_start", "invalid_goal", "verification_failed" (no
            trajectory passed), "too_risky" (one passed edge by edge; as a whole it is above
            `max_risk`), "timeout" (none had passed when time was up).
        message: one line for people: what happened and why.
        report: the numbers.
        history: costs over the optimisation; None if it never began.
        begun: (S, T, dof) the trajectories that the seeds began with.
        ended: (S, T, dof) what became of them. NOT verified, except the winner.
        best: waypoints that do NOT solve the query: of the seed of least cost, or the
            least risky ones; None with a path.
        explanation: the checker's report on an invalid start or goal or on the first edge
            of `best` that it refused; None otherwise.
    """

    path: np.ndarray | None
    status: OptimizeStatus
    message: str
    report: OptimizeReport
    history: History | None = None
    begun: np.ndarray | None = None
    ended: np.ndarray | None = None
    best: np.ndarray | None = None
    explanation: Any = None

    @property
    def solved(self) -> bool:
        """True only if the path reaches the goal and was verified."""
        return self.status == "exact"

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-ready values, the trajectories of all seeds left out."""
        return {
            "path": None if self.path is None else self.path.tolist(),
            "status": self.status,
            "message": self.message,
            "report": self.report.to_dict(),
            "history": None if self.history is None else self.history.to_dict(),
        }
