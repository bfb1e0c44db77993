# SPDX-License-Identifier: BSD-3-Clause
"""`optimize`: many trajectories at once, and the best that the checker accepts."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from vprism_plan._arguments import choice, number, whole
from vprism_plan._files import jsonable
from vprism_plan.collision import CollisionChecker
from vprism_plan.collision.reports import Answer
from vprism_plan.errors import PlanningError
from vprism_plan.planning import CheckerLike
from vprism_plan.planning.attempts import within_risk
from vprism_plan.planning.goals import PoseGoalConfig, configuration, refuse, valid_goals
from vprism_plan.planning.result import PlanReport, PlanResult
from vprism_plan.planning.search import checked_seed
from vprism_plan.trajopt._candidates import (
    MINIMISERS,
    Candidates,
    Objective,
    make_seeds,
    path_clearance,
)
from vprism_plan.trajopt._minimize import REASONS, Limits
from vprism_plan.trajopt.cost import SumCost, TrajectoryCost
from vprism_plan.trajopt.joint_costs import JointLimitCost, SmoothnessCost
from vprism_plan.trajopt.risk_cost import RiskCost
from vprism_plan.trajopt.sphere_costs import ClearanceCost, SelfCollisionCost

_MARGIN = 0.02  # metres beyond the checker's margin from which obstacles push
_APART = 0.005  # the same of links from each other
_LIMITS = 0.02  # the same of joint limits, radians or metres
_CLEAR, _OWN, _WITHIN = 300.0, 300.0, 300.0  # weights against squared velocity
_RISK = 0.1  # the same of a risk that is as large as `max_risk`
_BEND = 1e-3  # weight of squared acceleration: corners cost, curves hardly do
_GROWTH = 0.005  # metres by which a repair's margin exceeds that of the one before

OptimizeStatus = Literal[
    "exact", "invalid_start", "invalid_goal", "verification_failed", "too_risky", "timeout"
]


@dataclass(frozen=True, eq=False)
class History(Answer):
    """Costs over the optimisation, one row per batch of evaluations.

    A row holds, for every seed, the values at the best point it had found by then in the
    same round; seeds that had ended keep theirs. A new round changes what is minimised.

    Attributes:
        cost: (I, S) what was minimised.
        terms: name of each term -> (I, S) its share of `cost`.
        round: (I,) the round each row belongs to, from 0.
    """

    cost: Float[np.ndarray, "i s"]
    terms: dict[str, np.ndarray]
    round: Int[np.ndarray, " i"]


@dataclass(frozen=True)
class SeedReport(Answer):
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


@dataclass(frozen=True)
class OptimizeReport(Answer):
    """The numbers behind an `OptimizeResult`.

    Attributes:
        method: "lbfgs" or "adam".
        seed: of every random choice.
        seeds: one report per seed.
        winner: number of the seed whose trajectory is returned; None without a path, and
            for an initial path that is returned as it was given.
        rounds: how many times the trajectories were optimised.
        evaluations: trajectories whose cost and gradient were computed.
        optimization_time, verification_time, total_time: seconds spent on that, on checking
            edges, and on everything.
        motion_checks: motions that were checked.
        cost: of the winner, NaN without one.
        path_length: Euclidean length of the path in joint space, NaN without one.
        waypoints: number of rows of the path, 0 without one.
        min_clearance: smallest clearance, metres, NaN without a path: of the whole path if
            `keep_clearance` asked for it and the checker can say, else at
            `clearance_samples` samples of it.
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
        return {**super().to_dict(), "winner_name": self.winner_name}


@dataclass(frozen=True, eq=False)
class OptimizeResult(Answer):
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
        kept = "path", "status", "message", "report", "history"
        return {name: jsonable(getattr(self, name)) for name in kept}


def default_cost(checker: Any, kept: float | None = None) -> TrajectoryCost:
    """Return the cost that `optimize` minimises if it is given none.

    Squared velocity (which makes paths short and waypoints even) and a little acceleration,
    plus clearance, self-collision and joint limits, each with a margin beyond what the
    checker refuses. If the checker bounds risk, the objects of the map enter as `RiskCost`, in
    the draws that edges are checked with: instead, or beside their level set where the bound is
    below the world's `level`.

    Args:
        checker: a `CollisionChecker`; its margins, allowed contacts and bound on risk count.
        kept: clearance, metres, that is to be kept, if that is more than the margin.

    Raises:
        PlanningError: the checker is something else.
    """
    return _default_costs(checker, kept)(0)


def _default_costs(checker: Any, kept: float | None) -> Callable[[int], TrajectoryCost]:
    """The default cost as level 0; from 1, what repairs add: all but smoothness, from farther."""
    if not isinstance(checker, CollisionChecker):
        raise PlanningError(
            f"there is no default cost for a {type(checker).__name__}; pass `cost`, or use "
            "a CollisionChecker"
        )
    config, robot = checker.config, checker.robot
    beyond = 0.0 if kept is None else kept - float(config.margin)
    margin = max(_MARGIN, beyond + 0.5 * _MARGIN)

    @cache
    def risk(bound: float) -> TrajectoryCost:
        """What stands for the map's objects where the checker judges them by draws."""
        return RiskCost(checker, seed=config.risk_seed, weight=_RISK / bound)

    def cost(level: int) -> TrajectoryCost:
        smooth = SmoothnessCost(velocity=1.0, acceleration=_BEND, robot=robot)
        return SumCost(
            *([smooth] if level == 0 else []),
            ClearanceCost(checker, margin=margin + _GROWTH * level, weight=_CLEAR),
            *([] if checker.max_risk is None else [risk(checker.max_risk)]),
            SelfCollisionCost(checker, margin=_APART, weight=_OWN),
            JointLimitCost(robot, margin=_LIMITS, weight=_WITHIN),
        )

    return cost


def optimize(
    checker: CheckerLike,
    start: ArrayLike | Sequence[float],
    goal: Any,
    *,
    cost: Any = None,
    seeds: int = 8,
    waypoints: int = 32,
    initial: Any = None,
    method: str = "lbfgs",
    max_iterations: int = 200,
    tolerance: float = 1e-4,
    seed: int = 0,
    time_limit: float | None = None,
    guard: Any = None,
    repairs: int = 4,
    keep_clearance: bool | np.bool_ | float = False,
    clearance_step: float = 0.05,
    pose_goal: PoseGoalConfig | None = None,
) -> OptimizeResult:
    """Optimise trajectories from `start` to `goal`, and return the best verified one.

    All seeds are optimised as one batch, each by itself. Then every edge of the candidate
    of least cost is checked with `checker.check_motion`, then of the next one, until one
    passes; if the checker bounds the probability of collision (`max_risk`), the path as a
    whole is then judged by worlds that no cost and no edge has seen, exactly as `plan`
    does. If none passes, all go on with more weight on what was refused: `guard` is added
    to the cost, of the whole trajectory and once more around its refused edge, heavier with
    every repair. What is returned as solved was always verified.

    Args:
        checker: a `CollisionChecker`, or anything with the members of `CheckerLike`.
        start: configuration (dof,), radians or metres.
        goal: that too; or several, a pose or a region, as for `plan`. Then each configuration
            is a query of its own, the nearest first, until one has a path; else the answer is
            that of the nearest.
        cost: what to minimise, a module (..., T, dof) -> (...), differentiable; it is given
            float64 on the CPU. None: `default_cost(checker)`.
        seeds: how many trajectories. The initial paths come first, then the straight line,
            then detours through random free configurations and smooth noise, in turns.
        waypoints: of each, start and goal included, at least 4.
        initial: a path (t, dof) from start to goal, or several; resampled by arc length.
            Where nothing better passes, the first that does is returned as it is.
        method: "lbfgs" or "adam".
        max_iterations: per seed and round.
        tolerance: relative; a seed ends when several iterations in a row lower its cost by
            less.
        seed: of the random seeds. The same arguments give the same result, unless the time
            limit strikes.
        time_limit: seconds after which nothing more is evaluated; what there is then is
            still verified. Building the default cost counts (seconds, if risk is bounded):
            build it once and pass it as `cost` where queries follow.
        guard: cost of being where the checker refuses, which repairs add. None: the
            default cost's own terms with a margin that grows; nothing is repaired without a
            `CollisionChecker`. Repairs go on from where the trajectories are and start anew
            from the seeds in turns.
        repairs: rounds after the first, at most.
        keep_clearance: True: the path's clearance, edges included, must not be below that
            of the initial path (the largest of several); a number: not below so many
            metres. Kept to 0.5 mm, what it is computed to. It becomes the margin of the
            default cost.
        clearance_step: distance between the samples of the reported clearance.
        pose_goal: how a pose, or a region, is turned into configurations.

    Raises:
        PlanningError: an argument is malformed, naming the value and the valid ones.
    """
    began = time.perf_counter()
    choice("method", method, MINIMISERS, error=PlanningError)
    whole("seeds", seeds, 1, error=PlanningError)
    whole("waypoints", waypoints, 4, error=PlanningError)  # a window of four around an edge
    whole("max_iterations", max_iterations, 1, error=PlanningError)
    whole("repairs", repairs, error=PlanningError)
    number("tolerance", tolerance, 0.0, 1.0, above=True, below=True, error=PlanningError)
    number("clearance_step", clearance_step, 0.0, above=True, error=PlanningError)
    limit = math.inf
    if time_limit not in (None, math.inf):
        limit = number("time_limit", time_limit, 0.0, unit="s", above=True, error=PlanningError)
    seed = checked_seed(seed)
    q_start = configuration(start, checker.robot, "start")
    report = OptimizeReport(method=method, seed=seed)
    numbers = PlanReport(planner="optimize", seed=seed, time_limit=limit)
    ends = refuse(checker, q_start, "start", numbers) or valid_goals(
        checker, goal, q_start, pose_goal or PoseGoalConfig(), numbers
    )
    if isinstance(ends, PlanResult):
        return OptimizeResult(
            path=None,
            status=ends.status,  # type: ignore[arg-type]
            message=ends.message,
            report=replace(report, total_time=time.perf_counter() - began),
            explanation=ends.explanation,
        )
    goals, paths = ends[0], _paths(initial)
    if len(goals) > 1 and paths:
        raise PlanningError(f"initial leads to one goal, not to {len(goals)}; give that one")
    kept: float | None = None
    answers: list[OptimizeResult] = []
    for q_goal in goals[np.argsort(np.linalg.norm(goals - q_start, axis=1), kind="stable")]:
        begun = make_seeds(checker, q_start, q_goal, paths, seeds, waypoints, seed)
        if not answers:
            kept = _kept(checker, keep_clearance, begun.given, clearance_step)
            cost, guards = _costs(checker, cost, guard, kept)
        limits = Limits(max_iterations, tolerance, began + limit)
        candidates = Candidates(
            checker, begun, cost=cost, guard=guards, method=method, limits=limits,
            repairs=repairs, clearance_step=clearance_step, kept=kept,
        )  # fmt: skip
        result = within_risk(
            checker, candidates.attempt, max(0.0, began + limit - time.perf_counter())
        )
        answers.append(_answer(result, candidates, report, began))
        if answers[-1].solved:
            return answers[-1]
        if time.perf_counter() - began >= limit:
            break
    return answers[0]


def _paths(initial: Any) -> list[Any]:
    """Return the initial paths: none, one (t, dof), or those of a sequence or (n, t, dof)."""
    if initial is None:
        return []
    if isinstance(initial, np.ndarray):
        return list(initial) if initial.ndim == 3 else [initial]
    items = list(initial)
    if items and np.ndim(items[0]) == 1:
        return [np.asarray(items, dtype=np.float64)]
    return items


def _kept(
    checker: CheckerLike, keep: bool | np.bool_ | float, paths: list[np.ndarray], step: float
) -> float | None:
    """Return the clearance to be kept, metres."""
    if not isinstance(keep, bool | np.bool_):
        return number("keep_clearance", keep, unit="of metres, True or False", error=PlanningError)
    if not keep:
        return None
    if not paths:
        raise PlanningError(
            "keep_clearance is True, but there is no initial path whose clearance could be "
            "kept; give `initial`, or a number of metres"
        )
    return max(path_clearance(checker, path, step)[0] for path in paths)


def _costs(
    checker: CheckerLike, cost: Any, guard: Any, kept: float | None
) -> tuple[Any, Callable[[int], Any] | None]:
    """Return what is minimised, and what repairs add by their number (None if nothing)."""
    for name, given in (("cost", cost), ("guard", guard)):
        if given is not None and not callable(given):
            raise PlanningError(
                f"{name} is a {type(given).__name__}; it must be a trajectory cost, a module "
                "(..., T, dof) -> (...)"
            )
    guards = None if guard is None else lambda _: guard
    if cost is None or (guard is None and isinstance(checker, CollisionChecker)):
        defaults = _default_costs(checker, kept)
        cost = defaults(0) if cost is None else cost
        guards = guards or defaults
    return cost, guards


def _answer(
    result: PlanResult, candidates: Candidates, report: OptimizeReport, began: float
) -> OptimizeResult:
    """Put together what the verification said and what the optimisation did."""
    minimum = candidates.minimum
    assert minimum is not None
    lengths = np.linalg.norm(np.diff(candidates.ended, axis=1), axis=2).sum(axis=1)
    winner = candidates.seed_of(result.path)
    cheapest = candidates.seed_of(result.approximate_path)
    seeds = tuple(
        SeedReport(
            name=name,
            cost=float(minimum.value[s]),
            length=float(lengths[s]),
            iterations=int(candidates.iterations[s]),
            stopped=REASONS[int(minimum.reason[s])],
            refused="" if s == winner else candidates.refused[s],
        )
        for s, name in enumerate(candidates.seeds.names)
    )
    of_path = (
        "path_length", "waypoints", "min_clearance", "clearance_samples", "certified",
        "tolerance", "shares", "risk", "risk_levels", "risk_time",
    )  # fmt: skip
    spent = ("rounds", "optimization_time", "verification_time", "motion_checks")
    report = replace(
        report, seeds=seeds, winner=winner, evaluations=candidates.objective.evaluations,
        cost=math.nan if winner is None else seeds[winner].cost,
        kept_clearance=candidates.kept, total_time=time.perf_counter() - began,
        **{name: getattr(result.report, name) for name in of_path},
        **{name: getattr(candidates, name) for name in spent},
    )  # fmt: skip
    message = result.message
    if winner is not None:
        message = f"from seed {winner} ({seeds[winner].name}) of {len(seeds)}: {message}"
    elif cheapest is not None and result.status == "too_risky":
        message = f"least risky is seed {cheapest} ({seeds[cheapest].name}): {message}"
    elif cheapest is not None:
        message = (
            f"none of {len(seeds)} seeds passed; of least cost is {seeds[cheapest].name}: {message}"
        )
    return OptimizeResult(
        path=result.path,
        status=result.status,  # type: ignore[arg-type]
        message=message,
        report=report,
        history=_history(candidates.objective, len(seeds)),
        begun=candidates.seeds.q,
        ended=candidates.ended,
        best=result.approximate_path,
        explanation=result.explanation,
    )


def _history(objective: Objective, count: int) -> History:
    none = np.zeros(count)
    return History(
        cost=np.array([best for _, best, _ in objective.rows]).reshape(-1, count),
        terms={
            name: np.array([terms.get(name, none) for *_, terms in objective.rows])
            for name in objective.terms
        },
        round=np.array([number for number, *_ in objective.rows], dtype=np.int64),
    )
