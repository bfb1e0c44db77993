# SPDX-License-Identifier: BSD-3-Clause
"""Trajectories that compete: optimised together, asked about from the cheapest on, repaired."""

import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int

from vprism_plan.planning import CheckerLike
from vprism_plan.planning.path import interpolated, one_line, verified
from vprism_plan.planning.result import PlanReport, PlanResult
from vprism_plan.trajopt._minimize import REASONS, Limits, Minimum, adam, lbfgs
from vprism_plan.trajopt._seeds import Seeds, smooth_basis
from vprism_plan.trajopt.result import History

_WIDTH = 4  # waypoints around a refused edge whose cost counts again


@dataclass
class Emphasis:
    """What repairs add to the cost of each seed.

    Attributes:
        guard: cost of coming too near to something.
        weight: (S,) of the whole trajectory's.
        edge: (S,) an edge that was refused; its surroundings count again.
        edge_weight: (S,) of theirs.
    """

    guard: Any
    weight: torch.Tensor
    edge: torch.Tensor
    edge_weight: torch.Tensor


class Objective:
    """Cost and gradient of trajectories given by coordinates z of their inner waypoints.

    The inner waypoints are those of the seed plus B z, with B from the inverse of the
    smoothness metric: a step along the gradient in z moves the trajectory smoothly, which
    is CHOMP's covariant gradient (Ratliff and others 2009) as a change of variables. The
    ends are not variables.

    Args:
        cost: any module (k, T, dof) -> (k,); if it has `terms`, they enter the history.
        begun: (S, T, dof) the seeds.
        order: of the smoothness metric.
    """

    def __init__(self, cost: Any, begun: Float[np.ndarray, "s t dof"], order: int = 1) -> None:
        self.cost = cost
        self.emphasis: Emphasis | None = None
        self.evaluations = 0
        self._base = torch.from_numpy(begun)
        self._basis = torch.from_numpy(smooth_basis(begun.shape[1] - 2, order))
        self._inner = begun.shape[1] - 2, begun.shape[2]
        self._best = torch.full((len(begun),), math.inf, dtype=torch.float64)
        self._terms: dict[str, np.ndarray] = {}
        self._rows: list[tuple[int, np.ndarray, dict[str, np.ndarray]]] = []
        self._round = -1

    @property
    def origin(self) -> torch.Tensor:
        """Coordinates (S, n) of the seeds."""
        return torch.zeros(len(self._base), self._inner[0] * self._inner[1], dtype=torch.float64)

    def trajectories(self, z: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        """Coordinates (k, n) of seeds (k,) to waypoints (k, T, dof)."""
        base = self._base[rows]
        inner = base[:, 1:-1] + self._basis @ z.reshape(-1, *self._inner)
        return torch.cat([base[:, :1], inner, base[:, -1:]], dim=1)

    def begin_round(self, emphasis: Emphasis | None) -> None:
        """Change what is minimised; the history starts anew."""
        self.emphasis = emphasis
        self._best.fill_(math.inf)
        self._round += 1

    def __call__(self, z: torch.Tensor, rows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return costs (k,) and their gradients (k, n)."""
        z = z.detach().requires_grad_()
        q = self.trajectories(z, rows)
        terms = self._named(q, rows)
        total = torch.stack(list(terms.values())).sum(dim=0)
        (gradient,) = torch.autograd.grad(total.sum(), z)
        total = total.detach()
        self.evaluations += len(rows)
        self._note(rows, total, terms)
        return total, gradient

    def values(self, q: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        """Return costs (k,) of waypoints (k, T, dof), seeds (k,) with their emphasis."""
        with torch.no_grad():
            return torch.stack(list(self._named(q, rows).values())).sum(dim=0)

    def _named(self, q: torch.Tensor, rows: torch.Tensor) -> dict[str, torch.Tensor]:
        terms = getattr(self.cost, "terms", None)
        named = dict(terms(q)) if callable(terms) else {"cost": self.cost(q)}
        emphasis = self.emphasis
        if emphasis is not None and emphasis.guard is not None:
            near = torch.clamp(emphasis.edge[rows] - _WIDTH // 2 + 1, 0, q.shape[1] - _WIDTH)
            window = near[:, None] + torch.arange(_WIDTH)
            around = q[torch.arange(len(rows))[:, None], window]
            named["repair"] = emphasis.weight[rows] * emphasis.guard(q) + (
                emphasis.edge_weight[rows] * emphasis.guard(around)
            )
        return named

    def _note(
        self, rows: torch.Tensor, total: torch.Tensor, terms: dict[str, torch.Tensor]
    ) -> None:
        better = total < self._best[rows]
        at = rows[better]
        self._best[at] = total[better]
        for name, values in terms.items():
            column = self._terms.setdefault(name, np.zeros(len(self._best)))
            column[at.numpy()] = values.detach()[better].numpy()
        copies = {name: values.copy() for name, values in self._terms.items()}
        self._rows.append((self._round, self._best.numpy().copy(), copies))

    def history(self) -> History:
        """Return what was noted."""
        names: Sequence[str] = tuple(self._terms)
        count = len(self._best)
        empty = np.zeros(count)
        rounds: Int[np.ndarray, " i"] = np.array([row[0] for row in self._rows], dtype=np.int64)
        return History(
            cost=np.array([row[1] for row in self._rows]).reshape(-1, count),
            terms={
                name: np.array([row[2].get(name, empty) for row in self._rows]).reshape(-1, count)
                for name in names
            },
            round=rounds,
        )


_log = logging.getLogger(__name__)

_HEAVIER = 5.0  # factor on the weight of repairs, per repair
_AT_EDGE = 4.0  # weight around a refused edge, as a multiple of the whole trajectory's
_LOSS = 5e-4  # metres by which a kept clearance may be missed: what it is computed to


@dataclass(frozen=True)
class Settings:
    """What `optimize` was told.

    Attributes:
        cost: the module that is minimised.
        guard: level from 1 -> the module that repairs add at that level; None: no repairs.
        method: "lbfgs" or "adam".
        iterations: per seed and round.
        tolerance: of convergence.
        repairs: rounds after the first, per bound on risk.
        clearance_step: distance between the samples of a reported clearance.
        kept: clearance, metres, that a path must keep; None: what the checker asks for.
    """

    cost: Any
    guard: Callable[[int], Any] | None
    method: str
    iterations: int
    tolerance: float
    repairs: int
    clearance_step: float
    kept: float | None


class Candidates:
    """The trajectories of one query.

    Args:
        checker: whose joint limits hold.
        seeds: where to begin.
        given: initial paths as they were given, for when nothing better passes.
        settings: see there.
        deadline: value of `time.perf_counter` after which nothing more is evaluated.
    """

    def __init__(
        self,
        checker: CheckerLike,
        seeds: Seeds,
        given: list[np.ndarray],
        settings: Settings,
        deadline: float,
    ) -> None:
        robot = checker.robot
        self.seeds, self.given, self.settings = seeds, given, settings
        self.objective = Objective(settings.cost, seeds.q)
        self.limits = Limits(settings.iterations, settings.tolerance, deadline)
        turns = np.asarray(robot.continuous, dtype=bool)
        self.lower = np.where(turns, -np.inf, robot.lower)
        self.upper = np.where(turns, np.inf, robot.upper)
        count = len(seeds.q)
        self.iterations = np.zeros(count, dtype=np.int64)
        self.refused = [""] * count
        self.edges = np.full(count, -1)
        self.rounds = self.motion_checks = self.repaired = 0
        self.optimization_time = self.verification_time = 0.0
        self.minimum: Minimum | None = None
        self.ended = seeds.q
        self._asked: list[tuple[np.ndarray, int | None]] = []

    # --- optimising ----------------------------------------------------------------------
    def attempt(self, judge: CheckerLike, limit: float, number: int) -> PlanResult:
        """Optimise until a candidate passes `judge`; of number 0 for the first judge.

        Later judges are stricter: what passed an earlier one was too risky as a whole, so
        these attempts begin with a repair.
        """
        del limit  # one deadline holds for all attempts
        refusal: PlanResult | None = None
        for repair in range(self.settings.repairs + 1):
            if (repair > 0 or number > 0) and not self._emphasise():
                break
            self._optimise()
            found = self._first_that_passes(judge)
            if found.solved:
                return found
            refusal = found
            if self.limits.over:
                break
        unchanged = self._unchanged(judge)
        if unchanged is not None:
            return unchanged
        if refusal is None:  # nothing can be repaired, or time was up before
            refusal = self._first_that_passes(judge)
        if self.limits.over and not refusal.solved:
            refusal = replace(refusal, status="timeout", message=f"time was up: {refusal.message}")
        return refusal

    def _emphasise(self) -> bool:
        """Make being near things dearer; False if that is impossible."""
        guard = self.settings.guard
        if guard is None or self.limits.over:
            return False
        self.repaired += 1
        count = len(self.seeds.q)
        weight = torch.full((count,), _HEAVIER ** (self.repaired - 1), dtype=torch.float64)
        edges = torch.from_numpy(self.edges)
        self._emphasis = Emphasis(
            guard=guard(self.repaired),
            weight=weight,
            edge=edges,
            edge_weight=torch.where(edges >= 0, _AT_EDGE * weight, 0.0),
        )
        return True

    _emphasis: Emphasis | None = None

    def _optimise(self) -> None:
        began = time.perf_counter()
        # Repairs go on from where they are and from the beginning in turns: what a weight
        # too low has drawn through a wall seldom comes out again.
        cold = self.minimum is None or self.repaired % 2 == 0
        z = self.objective.origin if cold or self.minimum is None else self.minimum.x
        self.objective.begin_round(self._emphasis)
        minimise = lbfgs if self.settings.method == "lbfgs" else adam
        self.minimum = minimise(self.objective, z, self.limits)
        self.iterations += self.minimum.iterations.numpy()
        with torch.no_grad():
            q = self.objective.trajectories(self.minimum.x, torch.arange(len(z))).numpy()
        inside = q.copy()
        inside[:, 1:-1] = np.clip(q[:, 1:-1], self.lower, self.upper)
        clipped = np.flatnonzero((inside != q).any(axis=(1, 2)))
        if len(clipped):  # what is handed out costs something else than what was minimised
            rows = torch.from_numpy(clipped)
            value = self.minimum.value.clone()
            value[rows] = self.objective.values(torch.from_numpy(inside[clipped]), rows)
            self.minimum = replace(self.minimum, value=value)
        self.ended = inside
        self.rounds += 1
        self.optimization_time += time.perf_counter() - began
        _log.debug("round %d: costs %s", self.rounds, self.minimum.value.tolist())

    # --- verifying -----------------------------------------------------------------------
    def _first_that_passes(self, judge: CheckerLike) -> PlanResult:
        """Return the cheapest trajectory that passes, or the refusal of the cheapest."""
        assert self.minimum is not None
        began = time.perf_counter()
        first: PlanResult | None = None
        order = np.argsort(np.nan_to_num(self.minimum.value.numpy(), nan=np.inf), kind="stable")
        for s in order:
            result, edge = self._judged(judge, self.ended[s])
            if result.solved:
                self.refused[s], self.edges[s] = "", -1
                self._asked.append((_path_of(result), int(s)))
                first = result
                break
            self.refused[s], self.edges[s] = result.message, edge
            if first is None:
                first = result
                self._asked.append((_path_of(result), int(s)))
        assert first is not None
        self.verification_time += time.perf_counter() - began
        return first

    def _unchanged(self, judge: CheckerLike) -> PlanResult | None:
        """Return the first initial path that passes as it was given."""
        for path in self.given:
            result, _ = self._judged(judge, path)
            if result.solved:
                self._asked.append((_path_of(result), None))
                return replace(
                    result,
                    message=f"the initial path as it was given, since nothing that came of it "
                    f"passed: {result.message}",
                )
        return None

    def _judged(
        self, judge: CheckerLike, path: Float[np.ndarray, "t dof"]
    ) -> tuple[PlanResult, int]:
        """Return the verdict on a path, and the edge of it that is refused, -1 if none."""
        edge = self._bad_edge(judge, path)
        if edge >= 0:
            why = judge.check_motion_report(path[edge], path[edge + 1])
            return _refusal(path, edge, f"is refused: {one_line(why)}", why), edge
        result = verified(judge, path, self.settings.clearance_step, _no_numbers())
        self.motion_checks += result.report.motion_checks
        kept = self.settings.kept
        if kept is None or not result.solved:
            return result, -1
        clearance, place = path_clearance(judge, path, self.settings.clearance_step)
        if clearance >= kept - _LOSS:
            report = replace(result.report, min_clearance=clearance)
            return replace(result, report=report), -1
        edge = min(int(place), len(path) - 2)
        why = f"comes to {clearance:.4g} m from something; {kept:.4g} m are to be kept"
        return _refusal(path, edge, why, None), edge

    def _bad_edge(self, judge: CheckerLike, path: Float[np.ndarray, "t dof"]) -> int:
        """Return the first edge that the checker refuses, -1 if none."""
        for edge, (a, b) in enumerate(pairwise(path)):
            self.motion_checks += 1
            if not judge.check_motion(a, b):
                return edge
        return -1

    # --- reporting -----------------------------------------------------------------------
    def seed_of(self, path: np.ndarray | None) -> int | None:
        """Return the seed that a path which was asked about came from."""
        for asked, seed in self._asked:
            if asked is path:
                return seed
        return None

    def stopped(self, seed: int) -> str:
        """Return why a seed's last round ended."""
        assert self.minimum is not None
        return REASONS[int(self.minimum.reason[seed])]


def _no_numbers() -> PlanReport:
    return PlanReport(planner="optimize", seed=0, time_limit=0.0)


def _refusal(path: Float[np.ndarray, "t dof"], edge: int, why: str, report: Any) -> PlanResult:
    return PlanResult(
        path=None,
        status="verification_failed",
        report=_no_numbers(),
        message=f"edge {edge} of {len(path) - 1} {why}",
        approximate_path=path,
        explanation=report,
    )


def _path_of(result: PlanResult) -> np.ndarray:
    path = result.path if result.path is not None else result.approximate_path
    assert path is not None
    return path


def path_clearance(
    checker: Any, path: Float[np.ndarray, "t dof"], step: float
) -> tuple[float, float]:
    """Return the smallest clearance on a path, metres, and its place (edge plus fraction).

    Of the whole path where the checker can bound it (`min_clearance`), else of samples.
    """
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
