# SPDX-License-Identifier: BSD-3-Clause
"""Many independent minimisations at once: every row of x is a problem of its own.

`torch.optim.LBFGS` on stacked problems has one line search, one curvature history and one
stopping rule for their sum; scipy's holds one problem at a time. Here each row has its own,
and a row that waits for its line search does not hold up the others: what they share is the
evaluation.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

# Values (k,) and gradients (k, n) of the rows (k,) at x (k, n).
Evaluate = Callable[[torch.Tensor, torch.Tensor], tuple[torch.Tensor, torch.Tensor]]

RUNNING, CONVERGED, ITERATIONS, STALLED, TIME = range(5)
REASONS = ("running", "converged", "iterations", "stalled", "time")

_DECREASE, _CURVATURE = 1e-4, 0.9  # the constants of the (weak) Wolfe conditions
_TRIALS = 20
_PATIENCE = 5  # iterations in a row that must change next to nothing
_SWINGS = 50  # the same for Adam, which goes uphill now and then
_FAST, _SLOW, _GUARD = 0.9, 0.999, 1e-8  # Adam's defaults
_DECAYS_TO = 0.1  # Adam's step at the last iteration, as a share of the first


@dataclass(frozen=True)
class Limits:
    """When a minimisation ends.

    Attributes:
        iterations: at most, per row.
        tolerance: relative decrease below which an iteration counts as none; a row ends
            after some such in a row, or where no component of its gradient exceeds
            `tolerance` squared times the first one's.
        deadline: value of `time.perf_counter` after which nothing more is evaluated.
    """

    iterations: int
    tolerance: float
    deadline: float = math.inf

    @property
    def over(self) -> bool:
        """Whether time is up."""
        return time.perf_counter() > self.deadline


@dataclass(frozen=True)
class Minimum:
    """What became of every row.

    Attributes:
        x: (S, n) the best point of each row.
        value: (S,) there.
        iterations: (S,) done.
        reason: (S,) why the row ended, index into `REASONS`.
    """

    x: torch.Tensor
    value: torch.Tensor
    iterations: torch.Tensor
    reason: torch.Tensor


class _Progress:
    """Counts iterations per row, and says when a row is done."""

    def __init__(
        self, count: int, slope: torch.Tensor, limits: Limits, patience: int = _PATIENCE
    ) -> None:
        self.limits = limits
        self.patience = patience
        self.iterations = torch.zeros(count, dtype=torch.long)
        self.reason = torch.full((count,), RUNNING)
        self._still = torch.zeros(count, dtype=torch.long)
        self._flat = slope * limits.tolerance**2
        self.reason[slope.cpu() == 0.0] = CONVERGED

    @property
    def active(self) -> torch.Tensor:
        """Rows that go on."""
        return torch.nonzero(self.reason == RUNNING)[:, 0]

    def step(
        self, rows: torch.Tensor, before: torch.Tensor, after: torch.Tensor, slope: torch.Tensor
    ) -> None:
        """Note that rows went from one value to another, with this largest gradient there."""
        self.iterations[rows] += 1
        small = (before - after).abs() <= self.limits.tolerance * after.abs()
        self._still[rows] = torch.where(small.cpu(), self._still[rows] + 1, 0)
        done = (self._still[rows] >= self.patience) | (slope <= self._flat[rows]).cpu()
        self.reason[rows[done]] = CONVERGED
        spent = ~done & (self.iterations[rows] >= self.limits.iterations)
        self.reason[rows[spent]] = ITERATIONS

    def stop(self, rows: torch.Tensor, reason: int) -> None:
        self.reason[rows] = reason


def lbfgs(evaluate: Evaluate, x: torch.Tensor, limits: Limits, memory: int = 10) -> Minimum:
    """Minimise every row by L-BFGS (Nocedal 1980) with a weak Wolfe line search.

    The line search is bisection (Lewis and Overton 2013), which does not ask for
    smoothness: costs with hinges have kinks.

    Args:
        evaluate: see `Evaluate`; may return values that are not finite, which only
            shortens the step. A row whose first gradient is not finite stalls there.
        x: (S, n) where to begin.
        limits: when to end.
        memory: pairs of steps and gradient changes that are kept.
    """
    x = x.detach().clone()
    count = len(x)
    value, slope = evaluate(x, torch.arange(count))
    progress = _Progress(count, _largest(slope), limits)
    # There is no direction from there, and a row of NaN must not reach the cost.
    lost = ~torch.isfinite(slope).all(dim=1)
    progress.stop(torch.nonzero(lost.cpu())[:, 0], STALLED)
    state = _Lines(x, value, slope, memory)
    while len(rows := progress.active):
        if limits.over:
            progress.stop(rows, TIME)
            break
        trial = state.trial(rows)
        found, gradient = evaluate(trial, rows)
        taken, hopeless = state.judge(rows, trial, found, gradient)
        progress.stop(rows[hopeless], STALLED)
        moved = rows[taken]
        if len(moved):
            before = value[moved].clone()
            state.move(moved, trial[taken], found[taken], gradient[taken])
            progress.step(moved, before, value[moved], _largest(slope[moved]))
    return Minimum(x, value, progress.iterations, progress.reason)


def _largest(gradient: torch.Tensor) -> torch.Tensor:
    return gradient.abs().amax(dim=1)


def _dot(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    return (a * b).sum(dim=-1)


class _Lines:
    """Point, direction, bracket and curvature pairs of every row."""

    def __init__(
        self, x: torch.Tensor, value: torch.Tensor, slope: torch.Tensor, memory: int
    ) -> None:
        self.x, self.value, self.slope = x, value, slope
        count, n = x.shape
        self.steps = x.new_zeros(count, memory, n)
        self.changes = x.new_zeros(count, memory, n)
        self.rho = x.new_zeros(count, memory)
        self.direction = torch.zeros_like(x)
        self.t, self.low, self.high = (x.new_zeros(count) for _ in range(3))
        self.trials = torch.zeros(count, dtype=torch.long)
        self._aim(torch.arange(count))

    def trial(self, rows: torch.Tensor) -> torch.Tensor:
        return self.x[rows] + self.t[rows, None] * self.direction[rows]

    def judge(
        self,
        rows: torch.Tensor,
        trial: torch.Tensor,
        value: torch.Tensor,
        gradient: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Move the brackets; say which trials are taken and which rows cannot go on."""
        t, direction = self.t[rows], self.direction[rows]
        descent = _dot(self.slope[rows], direction)
        sound = torch.isfinite(value) & torch.isfinite(gradient).all(dim=1)
        allowed = self.value[rows] + _DECREASE * t * descent
        lower = sound & (value <= allowed)
        steep = lower & (_dot(gradient, direction) < _CURVATURE * descent)
        self.trials[rows] += 1
        tired = (self.trials[rows] >= _TRIALS).to(lower.device)
        taken = lower & (~steep | tired)
        on, off = rows[steep], rows[~lower]
        self.low[on], self.high[off] = self.t[on], self.t[off]
        bracketed = torch.isfinite(self.high[rows])
        middle = torch.where(bracketed, 0.5 * (self.low[rows] + self.high[rows]), 2.0 * t)
        # While nothing longer than 0 was acceptable, a parabola guesses better than half.
        bend = value - self.value[rows] - descent * t
        guess = torch.where(
            sound & (bend > 0.0) & (self.low[rows] == 0.0) & ~lower,
            torch.clamp(-0.5 * descent * t * t / bend, 0.1 * t, 0.5 * t),
            middle,
        )
        self.t[rows] = torch.where(taken, t, guess)
        failed = tired & ~taken
        # Too flat a descent is a descent still: go back to it and take it.
        back = rows[failed & (self.low[rows] > 0.0)]
        self.t[back] = self.low[back]
        hopeless = failed & (self.low[rows] == 0.0)
        known = (self.rho[rows] != 0.0).any(dim=1)
        again = rows[hopeless & known]
        self.rho[again] = 0.0
        self._aim(again)
        return taken, hopeless & ~known

    def move(
        self, rows: torch.Tensor, x: torch.Tensor, value: torch.Tensor, gradient: torch.Tensor
    ) -> None:
        """Take the trials and aim again."""
        step, change = x - self.x[rows], gradient - self.slope[rows]
        curvature = _dot(step, change)
        useful = curvature > 1e-10 * change.square().sum(dim=1)
        kept = rows[useful]
        for store, new in ((self.steps, step), (self.changes, change)):
            store[kept] = torch.cat([store[kept, 1:], new[useful, None]], dim=1)
        self.rho[kept] = torch.cat([self.rho[kept, 1:], 1.0 / curvature[useful, None]], dim=1)
        self.x[rows], self.value[rows], self.slope[rows] = x, value, gradient
        self._aim(rows)

    def _aim(self, rows: torch.Tensor) -> None:
        """Choose a direction by the two-loop recursion, and a step of one along it."""
        g = self.slope[rows]
        rho, steps, changes = self.rho[rows], self.steps[rows], self.changes[rows]
        q = g.clone()
        shares: list[Any] = []
        for k in reversed(range(rho.shape[1])):  # an empty pair has rho = 0 and does nothing
            share = rho[:, k] * _dot(steps[:, k], q)
            q -= share[:, None] * changes[:, k]
            shares.append(share)
        latest = rho[:, -1]
        size = changes[:, -1].square().sum(dim=1)
        first = 1.0 / torch.clamp(g.norm(dim=1), min=1.0)
        known = latest > 0.0
        scale = torch.where(known, 1.0 / torch.where(known, latest * size, 1.0), first)
        q *= scale[:, None]
        for k, share in zip(range(rho.shape[1]), reversed(shares), strict=True):
            q += (share - rho[:, k] * _dot(changes[:, k], q))[:, None] * steps[:, k]
        uphill = _dot(q, g) <= 0.0
        q[uphill] = g[uphill] * first[uphill, None]
        self.rho[rows[uphill]] = 0.0
        self.direction[rows] = -q
        self.t[rows], self.low[rows], self.high[rows] = 1.0, 0.0, math.inf
        self.trials[rows] = 0


def adam(evaluate: Evaluate, x: torch.Tensor, limits: Limits, rate: float = 0.03) -> Minimum:
    """Minimise every row by `torch.optim.Adam`, whose steps do not mix the rows.

    The step falls as a cosine to a tenth of `rate` (units of x) at the last iteration.
    Each row ends by itself and keeps the best point it saw.
    """
    point = x.detach().clone().requires_grad_()
    best, count = x.detach().clone(), len(x)
    optimizer = torch.optim.Adam([point], lr=rate, betas=(_FAST, _SLOW), eps=_GUARD)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(
        optimizer, max(1, limits.iterations), eta_min=_DECAYS_TO * rate
    )
    value = x.new_full((count,), math.inf)
    progress: _Progress | None = None
    rows = torch.arange(count)
    while len(rows):
        found, gradient = evaluate(point.detach()[rows], rows)
        better = found < value[rows]
        before = value[rows]
        best[rows[better]] = point.detach()[rows[better]]
        value[rows[better]] = found[better]
        if progress is None:
            progress = _Progress(count, _largest(gradient), limits, _SWINGS)
        else:
            # A step up is no convergence: compare with the best value so far.
            progress.step(rows, before, torch.minimum(found, before), _largest(gradient))
        if limits.over:
            progress.stop(progress.active, TIME)
        keep = point.detach().clone()
        point.grad = torch.zeros_like(point)
        point.grad[rows] = torch.nan_to_num(gradient, nan=0.0, posinf=0.0, neginf=0.0)
        optimizer.step()
        schedule.step()
        ended = torch.ones(count, dtype=torch.bool)
        rows = progress.active
        ended[rows] = False
        with torch.no_grad():
            point[ended] = keep[ended]
    assert progress is not None
    return Minimum(best, value, progress.iterations, progress.reason)
