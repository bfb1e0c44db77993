# SPDX-License-Identifier: BSD-3-Clause
"""Trajectories that compete: where they begin, optimised together, asked about from the cheapest
on, repaired."""

import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from vprism_plan.errors import PlanningError
from vprism_plan.planning import CheckerLike
from vprism_plan.planning.ompl_adapter import nearest_turns
from vprism_plan.planning.path import interpolated, one_line, verified
from vprism_plan.planning.result import PlanReport, PlanResult
from vprism_plan.robots.kinematics import within_limits
from vprism_plan.trajopt._minimize import Limits, Minimum, adam, lbfgs

_log = logging.getLogger(__name__)

MINIMISERS = {"lbfgs": lbfgs, "adam": adam}

_SAME = 1e-6  # radians or metres by which a given path may miss start and goal
_DRAWS = 64  # configurations among which a detour's middle is chosen
_SPREAD = 0.15  # standard deviation of detours around the middle, share of the joint's range
_NOISE = 0.08  # the same of smooth noise where it is largest
_WIDTH = 4  # waypoints around a refused edge whose cost counts again
_HEAVIER = 5.0  # factor on the weight of repairs, per repair
_AT_EDGE = 4.0  # weight around a refused edge, as a multiple of the whole trajectory's
_LOSS = 5e-4  # metres by which a kept clearance may be missed: what it is computed to


@dataclass(frozen=True)
class Seeds:
    """Trajectories q (S, T, dof) to begin with, and the initial paths as they were given.

    All begin at the start and end at the goal, up to whole turns of continuous joints.
    """

    names: list[str]
    q: Float[np.ndarray, "s t dof"]
    given: list[np.ndarray]


def smooth_basis(inner: int, order: int) -> Float[np.ndarray, "n n"]:
    """Return B such that B z, z standard normal, is a random function that is zero at both ends.

    Its covariance is the inverse of D^T D with D the differences of that order, as STOMP
    (Kalakrishnan and others 2011) draws its noise; the largest standard deviation is 1.
    """
    D = np.eye(inner)
    for _ in range(order):
        D = np.diff(D, axis=0, prepend=0.0, append=0.0)
    B = np.linalg.cholesky(np.linalg.inv(D.T @ D))
    return np.asarray(B / np.sqrt((B**2).sum(axis=1).max()))


def along(path: Float[np.ndarray, "t dof"], count: int) -> Float[np.ndarray, "count dof"]:
    """Return `count` waypoints of a path at equal arc length in joint space.

    The one nearest to each corner of the path is moved onto it where there are enough, so
    that a free path stays free.
    """
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    keep = np.concatenate([[True], steps > 0.0])
    corners = path[keep]
    if len(corners) == 1:
        return np.repeat(path[:1], count, axis=0)
    at = np.concatenate([[0.0], np.cumsum(steps[steps > 0.0])])
    places = np.linspace(0.0, at[-1], count)
    if len(corners) <= count:  # one place each, in order, and the others evenly between them
        order = np.arange(len(corners))
        nearest = np.rint(at / at[-1] * (count - 1)).astype(np.int64)
        nearest = np.maximum.accumulate(nearest - order) + order
        nearest[-1] = count - 1
        nearest = np.minimum.accumulate((nearest - order)[::-1])[::-1] + order
        places = np.interp(np.arange(count), nearest, at)
    rows = np.stack([np.interp(places, at, column) for column in corners.T], axis=1)
    rows[0], rows[-1] = path[0], path[-1]
    return rows


def make_seeds(
    checker: CheckerLike, start: np.ndarray, goal: np.ndarray, initial: Sequence[Any],
    count: int, waypoints: int, seed: int,
) -> Seeds:  # fmt: skip
    """Return initial paths, the straight line, and detours and noise in turns; see `optimize`.

    Continuous joints go the short way round to the goal. A larger `count` only adds to those of
    a smaller one.
    """
    turns = np.asarray(checker.robot.continuous, dtype=bool)
    given = [_checked(path, i, start, goal, turns) for i, path in enumerate(initial)]
    names = [f"initial {i}" for i in range(len(given))]
    found = [along(path, waypoints) for path in given]
    if len(found) < count or not found:
        end = nearest_turns(goal, start, turns)
        found.append(along(np.stack([start, end]), waypoints))
        names.append("straight")
    first, straight = found[0], found[-1]
    for i in range(count - len(found)):
        number, noise = divmod(i, 2)
        rng = np.random.default_rng([seed, 1 + noise, number])
        if noise:
            found.append(_noisy(checker.robot, first, number, rng))
        else:
            found.append(_detour(checker, straight, number, rng))
        names.append(f"{'noise' if noise else 'via'} {number}")
    return Seeds(names, np.stack(found), given)


def _detour(
    checker: CheckerLike, straight: np.ndarray, number: int, rng: np.random.Generator
) -> np.ndarray:
    """The way through a free configuration, found farther out with every number.

    Of random ones around the middle, it is the one with most of its two edges free, then
    the one with the shortest way.
    """
    robot: Any = checker.robot
    a, b = straight[0], straight[-1]
    width = _SPREAD * (1.0 + number) * (np.asarray(robot.upper) - np.asarray(robot.lower))
    draws = 0.5 * (a + b) + width * rng.standard_normal((_DRAWS, len(a)))
    draws = within_limits(robot, draws)
    best, rank = draws[0], (-1, -np.inf)
    for q in draws:
        if checker.is_valid(q):
            free = sum(checker.check_motion(*edge) for edge in ((a, q), (q, b)))
            way = float(np.linalg.norm(q - a) + np.linalg.norm(b - q))
            if (free, -way) > rank:
                best, rank = q, (free, -way)
    return along(np.stack([a, best, b]), len(straight))


def _noisy(robot: Any, base: np.ndarray, number: int, rng: np.random.Generator) -> np.ndarray:
    """A trajectory with smooth noise, more of it with every number."""
    basis = smooth_basis(len(base) - 2, 2)
    drawn = basis @ rng.standard_normal((len(basis), base.shape[1]))
    q = base.copy()
    width = np.asarray(robot.upper) - np.asarray(robot.lower)
    q[1:-1] = within_limits(robot, q[1:-1] + _NOISE * (1.0 + number) * width * drawn)
    return q


def _checked(
    path: Any, number: int, start: np.ndarray, goal: np.ndarray, turns: np.ndarray
) -> Float[np.ndarray, "t dof"]:
    """Return a path that begins at start and ends at goal, bit for bit, turns aside."""
    array = np.array(path, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != len(start) or len(array) < 2:
        raise PlanningError(
            f"initial path {number} has shape {array.shape}; it must be (waypoints, "
            f"{len(start)}) with at least two waypoints"
        )
    if not np.isfinite(array).all():
        raise PlanningError(f"initial path {number} holds NaN or infinite values")
    array += nearest_turns(array[0], start, turns) - array[0]
    end = nearest_turns(goal, array[-1], turns)
    for name, row, wanted in (("begins", array[0], start), ("ends", array[-1], end)):
        gap = np.abs(row - wanted)
        if gap.max() > _SAME:
            joint = int(np.argmax(gap))
            raise PlanningError(
                f"initial path {number} {name} elsewhere: joint {joint} is {row[joint]:.6g}, "
                f"{wanted[joint]:.6g} is wanted; give a path from start to goal"
            )
    array[0], array[-1] = start, end
    return array


class Objective:
    """Cost and gradient of trajectories given by coordinates z of their inner waypoints.

    The inner waypoints are those of the seed plus B z, with B from the inverse of the
    smoothness metric: a step along the gradient in z moves the trajectory smoothly, which
    is CHOMP's covariant gradient (Ratliff and others 2009) as a change of variables. The
    ends are not variables.

    `cost` is any module (k, T, dof) -> (k,); if it has `terms`, they enter the history.
    """

    def __init__(self, cost: Any, begun: Float[np.ndarray, "s t dof"]) -> None:
        self.cost = cost
        self.evaluations = 0
        self._guard: Any = None
        self._base = torch.from_numpy(begun)
        self._basis = torch.from_numpy(smooth_basis(begun.shape[1] - 2, 1))
        self.terms: dict[str, np.ndarray] = {}
        self.rows: list[tuple[int, np.ndarray, dict[str, np.ndarray]]] = []
        self._round = -1

    @property
    def origin(self) -> torch.Tensor:
        """Coordinates (S, n) of the seeds."""
        return torch.zeros_like(self._base[:, 1:-1]).flatten(start_dim=1)

    def trajectories(self, z: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        """Coordinates (k, n) of seeds (k,) to waypoints (k, T, dof)."""
        base = self._base[rows]
        inner = base[:, 1:-1] + self._basis @ z.reshape(base[:, 1:-1].shape)
        return torch.cat([base[:, :1], inner, base[:, -1:]], dim=1)

    def begin_round(self, guard: Any, weight: float, edges: np.ndarray) -> None:
        """Change what is minimised; the history starts anew.

        Args:
            guard: cost of coming too near to something, which repairs add; None: nothing.
            weight: of the whole trajectory's.
            edges: (S,) an edge that was refused, whose surroundings count again; -1 if none.
        """
        self._guard, self._weight, self._edges = guard, weight, torch.from_numpy(edges.copy())
        self._best = torch.full((len(self._base),), math.inf, dtype=torch.float64)
        self._round += 1

    def __call__(self, z: torch.Tensor, rows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return costs (k,) and their gradients (k, n)."""
        z = z.detach().requires_grad_()
        terms = self._named(self.trajectories(z, rows), rows)
        total = torch.stack(list(terms.values())).sum(dim=0)
        (gradient,) = torch.autograd.grad(total.sum(), z)
        total = total.detach()
        self.evaluations += len(rows)
        better = total < self._best[rows]
        at = rows[better]
        self._best[at] = total[better]
        for name, values in terms.items():
            column = self.terms.setdefault(name, np.zeros(len(self._best)))
            column[at.numpy()] = values.detach()[better].numpy()
        copies = {name: values.copy() for name, values in self.terms.items()}
        self.rows.append((self._round, self._best.numpy().copy(), copies))
        return total, gradient

    def values(self, q: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        """Return costs (k,) of waypoints (k, T, dof) of seeds (k,)."""
        with torch.no_grad():
            return torch.stack(list(self._named(q, rows).values())).sum(dim=0)

    def _named(self, q: torch.Tensor, rows: torch.Tensor) -> dict[str, torch.Tensor]:
        terms = getattr(self.cost, "terms", None)
        named = dict(terms(q)) if callable(terms) else {"cost": self.cost(q)}
        if self._guard is not None:
            edges = self._edges[rows]
            near = torch.clamp(edges - _WIDTH // 2 + 1, 0, q.shape[1] - _WIDTH)
            window = near[:, None] + torch.arange(_WIDTH)
            around = q[torch.arange(len(rows))[:, None], window]
            again = _AT_EDGE * self._weight * (edges >= 0).double()
            named["repair"] = self._weight * self._guard(q) + again * self._guard(around)
        return named


@dataclass(eq=False)
class Candidates:
    """The trajectories of one query; see `optimize`."""

    checker: CheckerLike  # whose joint limits hold
    seeds: Seeds  # where to begin
    cost: Any  # the module that is minimised
    guard: Callable[[int], Any] | None  # level from 1 -> what repairs add at it; None: no repairs
    method: str  # key of `MINIMISERS`
    limits: Limits  # per seed and round
    repairs: int  # rounds after the first, per bound on risk
    clearance_step: float  # distance between the samples of a reported clearance
    kept: float | None  # clearance, metres, that a path must keep; None: what the checker asks for

    def __post_init__(self) -> None:
        self.objective = Objective(self.cost, self.seeds.q)
        count = len(self.seeds.q)
        self.iterations = np.zeros(count, dtype=np.int64)
        self.refused = [""] * count
        self.edges = np.full(count, -1)
        self.rounds = self.motion_checks = self.repaired = 0
        self.optimization_time = self.verification_time = 0.0
        self.minimum: Minimum | None = None
        self.ended = self.seeds.q
        self._guard: Any = None
        self._asked: list[tuple[np.ndarray, int | None]] = []

    def attempt(self, judge: CheckerLike, limit: float, number: int) -> PlanResult:
        """Optimise until a candidate passes `judge`; of number 0 for the first judge.

        Later judges are stricter: what passed an earlier one was too risky as a whole, so
        these attempts begin with a repair.
        """
        del limit  # one deadline holds for all attempts
        refusal: PlanResult | None = None
        for repair in range(self.repairs + 1):
            if repair > 0 or number > 0:
                if self.guard is None or self.limits.over:
                    break
                self.repaired += 1
                self._guard = self.guard(self.repaired)
            self._optimise()
            refusal = self._first_that_passes(judge)
            if refusal.solved:
                return refusal
            if self.limits.over:
                break
        for path in self.seeds.given:
            result, _ = self._judged(judge, path)
            if result.solved:
                self._note(result, None)
                return replace(
                    result,
                    message="the initial path as it was given, since nothing that came of it "
                    f"passed: {result.message}",
                )
        if refusal is None:  # nothing can be repaired, or time was up before
            refusal = self._first_that_passes(judge)
        if self.limits.over and not refusal.solved:
            refusal = replace(refusal, status="timeout", message=f"time was up: {refusal.message}")
        return refusal

    def _optimise(self) -> None:
        began = time.perf_counter()
        # Repairs go on from where they are and from the beginning in turns: what a weight
        # too low has drawn through a wall seldom comes out again.
        cold = self.minimum is None or self.repaired % 2 == 0
        z = self.objective.origin if cold or self.minimum is None else self.minimum.x
        self.objective.begin_round(self._guard, _HEAVIER ** (self.repaired - 1), self.edges)
        minimum = MINIMISERS[self.method](self.objective, z, self.limits)
        self.iterations += minimum.iterations.numpy()
        with torch.no_grad():
            q = self.objective.trajectories(minimum.x, torch.arange(len(z))).numpy()
        inside = q.copy()
        inside[:, 1:-1] = within_limits(self.checker.robot, q[:, 1:-1])
        clipped = np.flatnonzero((inside != q).any(axis=(1, 2)))
        if len(clipped):  # what is handed out costs something else than what was minimised
            rows = torch.from_numpy(clipped)
            minimum.value[rows] = self.objective.values(torch.from_numpy(inside[clipped]), rows)
        self.minimum, self.ended = minimum, inside
        self.rounds += 1
        self.optimization_time += time.perf_counter() - began
        _log.debug("round %d: costs %s", self.rounds, minimum.value.tolist())

    def _first_that_passes(self, judge: CheckerLike) -> PlanResult:
        """The cheapest trajectory that passes, or the refusal of the cheapest."""
        assert self.minimum is not None
        began = time.perf_counter()
        first: PlanResult | None = None
        order = np.argsort(np.nan_to_num(self.minimum.value.numpy(), nan=np.inf), kind="stable")
        for s in order:
            result, edge = self._judged(judge, self.ended[s])
            self.refused[s], self.edges[s] = "" if result.solved else result.message, edge
            if result.solved or first is None:
                self._note(result, int(s))
                first = result
            if result.solved:
                break
        assert first is not None
        self.verification_time += time.perf_counter() - began
        return first

    def _judged(self, judge: CheckerLike, path: np.ndarray) -> tuple[PlanResult, int]:
        """The verdict on a path, and the edge of it that is refused, -1 if none."""
        for edge, (a, b) in enumerate(pairwise(path)):
            self.motion_checks += 1
            if not judge.check_motion(a, b):
                report = judge.check_motion_report(a, b)
                return _refusal(path, edge, f"is refused: {one_line(report)}", report), edge
        result = verified(judge, path, self.clearance_step, _NO_NUMBERS)
        self.motion_checks += result.report.motion_checks
        if self.kept is None or not result.solved:
            return result, -1
        clearance, place = path_clearance(judge, path, self.clearance_step)
        if clearance >= self.kept - _LOSS:
            report = replace(result.report, min_clearance=clearance)
            return replace(result, report=report), -1
        edge = min(int(place), len(path) - 2)
        why = f"comes to {clearance:.4g} m from something; {self.kept:.4g} m are to be kept"
        return _refusal(path, edge, why, None), edge

    def _note(self, result: PlanResult, seed: int | None) -> None:
        path = result.path if result.path is not None else result.approximate_path
        assert path is not None
        self._asked.append((path, seed))

    def seed_of(self, path: np.ndarray | None) -> int | None:
        """Return the seed that a path which was asked about came from."""
        return next((seed for asked, seed in self._asked if asked is path), None)


_NO_NUMBERS = PlanReport(planner="optimize", seed=0, time_limit=0.0)


def _refusal(path: Float[np.ndarray, "t dof"], edge: int, why: str, report: Any) -> PlanResult:
    return PlanResult(
        path=None,
        status="verification_failed",
        report=_NO_NUMBERS,
        message=f"edge {edge} of {len(path) - 1} {why}",
        approximate_path=path,
        explanation=report,
    )


def path_clearance(checker: Any, path: np.ndarray, step: float) -> tuple[float, float]:
    """Return the smallest clearance on a path (else of samples of it), metres, and its place."""
    if hasattr(checker, "min_clearance"):
        answer = checker.min_clearance(path)
        return float(answer.clearance), float(answer.place)
    best, place = np.inf, 0.0
    for edge, ends in enumerate(pairwise(path)):
        rows = interpolated(np.stack(ends), step)
        for k, q in enumerate(rows):
            clearance = float(checker.clearance(q))
            if clearance < best:
                best, place = clearance, edge + k / max(1, len(rows) - 1)
    return best, place
