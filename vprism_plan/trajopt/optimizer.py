# SPDX-License-Identifier: BSD-3-Clause
"""`optimize`: many trajectories at once, and the best that the checker accepts."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vprism_plan.errors import PlanningError
from vprism_plan.planning import CheckerLike
from vprism_plan.planning.attempts import within_risk
from vprism_plan.planning.goals import configuration, refuse
from vprism_plan.planning.result import PlanReport, PlanResult
from vprism_plan.planning.search import checked_seed
from vprism_plan.trajopt._candidates import Candidates, Settings, path_clearance
from vprism_plan.trajopt._default_cost import Defaults, has_world
from vprism_plan.trajopt._seeds import make_seeds
from vprism_plan.trajopt.result import OptimizeReport, OptimizeResult, SeedReport

METHODS = ("lbfgs", "adam")
_FEWEST = 4  # waypoints: two inner ones, and a window of four around an edge


def optimize(
    checker: CheckerLike,
    start: ArrayLike | Sequence[float],
    goal: ArrayLike | Sequence[float],
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
        start: start configuration (dof,), radians or metres.
        goal: goal configuration (dof,).
        cost: what to minimise, a module (..., T, dof) -> (...), differentiable; it is given
            float64 on the CPU. None: `default_cost(checker)`, which needs a
            `CollisionChecker`.
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
            still verified. None: no limit. Building the default cost counts (seconds, if
            risk is bounded): build it once and pass it as `cost` where queries follow.
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

    Returns:
        An `OptimizeResult`; `result.solved` is True only for a verified path.

    Raises:
        PlanningError: an argument is malformed, naming the value and the valid ones.
    """
    began = time.perf_counter()
    limit = _checked_numbers(
        seeds=seeds,
        waypoints=waypoints,
        method=method,
        max_iterations=max_iterations,
        tolerance=tolerance,
        time_limit=time_limit,
        repairs=repairs,
        clearance_step=clearance_step,
    )
    number = checked_seed(seed)
    q_start = configuration(start, checker.robot, "start")
    q_goal = configuration(goal, checker.robot, "goal")
    report = OptimizeReport(method=method, seed=number)
    numbers = PlanReport(planner="optimize", seed=number, time_limit=limit)
    for q, what in ((q_start, "start"), (q_goal, "goal")):
        refusal = refuse(checker, q, what, numbers)
        if refusal is not None:
            return _refused(refusal, replace(report, total_time=time.perf_counter() - began))
    begun, paths = make_seeds(checker, q_start, q_goal, _paths(initial), seeds, waypoints, number)
    kept = _kept(checker, keep_clearance, paths, clearance_step)
    minimised, guards = _costs(checker, cost, guard, kept)
    settings = Settings(
        cost=minimised,
        guard=guards,
        method=method,
        iterations=max_iterations,
        tolerance=tolerance,
        repairs=repairs,
        clearance_step=clearance_step,
        kept=kept,
    )
    candidates = Candidates(checker, begun, paths, settings, began + limit)
    result = within_risk(checker, candidates.attempt, limit)
    return _answer(result, candidates, report, began)


def _checked_numbers(
    *,
    seeds: int,
    waypoints: int,
    method: str,
    max_iterations: int,
    tolerance: float,
    time_limit: float | None,
    repairs: int,
    clearance_step: float,
) -> float:
    """Refuse arguments that make no sense; return the time limit, infinite for None."""
    if method not in METHODS:
        raise PlanningError(f"method is {method!r}; valid values are {', '.join(METHODS)}")
    for name, value, least in (
        ("seeds", seeds, 1),
        ("waypoints", waypoints, _FEWEST),
        ("max_iterations", max_iterations, 1),
        ("repairs", repairs, 0),
    ):
        whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
        if not whole or value < least:
            raise PlanningError(f"{name} is {value!r}; it must be a whole number from {least}")
    if not 0.0 < tolerance < 1.0:
        raise PlanningError(f"tolerance is {tolerance!r}; it must be between 0 and 1")
    if not clearance_step > 0.0:
        raise PlanningError(f"clearance_step is {clearance_step!r}; it must be more than 0")
    if time_limit is None:
        return math.inf
    if not time_limit > 0.0:
        raise PlanningError(f"time_limit is {time_limit!r} s; it must be more than 0, or None")
    return float(time_limit)


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
    if isinstance(keep, bool | np.bool_):
        if not keep:
            return None
    else:
        if not math.isfinite(keep):
            raise PlanningError(
                f"keep_clearance is {keep!r}; it must be True, False or a number of metres"
            )
        return float(keep)
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
    if cost is None or (guard is None and has_world(checker)):
        defaults = Defaults(checker, kept)
        cost = defaults.cost() if cost is None else cost
        guards = defaults.guard if guards is None else guards
    return cost, guards


def _refused(refusal: PlanResult, report: OptimizeReport) -> OptimizeResult:
    return OptimizeResult(
        path=None,
        status=refusal.status,  # type: ignore[arg-type]
        message=refusal.message,
        report=report,
        explanation=refusal.explanation,
    )


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
            stopped=candidates.stopped(s),
            refused="" if s == winner else candidates.refused[s],
        )
        for s, name in enumerate(candidates.seeds.names)
    )
    found = result.report
    report = replace(
        report,
        seeds=seeds,
        winner=winner,
        rounds=candidates.rounds,
        evaluations=candidates.objective.evaluations,
        optimization_time=candidates.optimization_time,
        verification_time=candidates.verification_time,
        motion_checks=candidates.motion_checks,
        cost=math.nan if winner is None else seeds[winner].cost,
        path_length=found.path_length,
        waypoints=found.waypoints,
        min_clearance=found.min_clearance,
        clearance_samples=found.clearance_samples,
        kept_clearance=candidates.settings.kept,
        certified=found.certified,
        tolerance=found.tolerance,
        shares=found.shares,
        risk=found.risk,
        risk_levels=found.risk_levels,
        risk_time=found.risk_time,
        total_time=time.perf_counter() - began,
    )
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
        history=candidates.objective.history(),
        begun=candidates.seeds.q,
        ended=candidates.ended,
        best=result.approximate_path,
        explanation=result.explanation,
    )
