# SPDX-License-Identifier: BSD-3-Clause
"""Many independent minimisations at once: every row of x is a problem of its own.

`torch.optim.LBFGS` on stacked problems has one line search, one curvature history and one
stopping rule for their sum; scipy's holds one problem at a time, and evaluating the rows one by
one takes twice as long. Here each row has its own, and a row that waits for its line search does
not hold up the others: what they share is the evaluation.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

# Values (k,) and gradients (k, n) of the rows (k,) at x (k, n).
Evaluate = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]

RUNNING, CONVERGED, ITERATIONS, STALLED, TIME = range(5)
REASONS = ("running", "converged", "iterations", "stalled", "time")

_MEMORY = 10  # pairs of steps and gradient changes that are kept
_DECREASE, _CURVATURE = 1e-4, 0.9  # the constants of the (weak) Wolfe conditions
_TRIALS = 20
_PATIENCE = 5  # iterations in a row that must change next to nothing
_SWINGS = 50  # the same for Adam, which goes uphill now and then
_RATE, _DECAYS_TO = 0.03, 0.1  # Adam's first step (units of x), and its last as a share of it


@dataclass(frozen=True)
class Limits:
    """When a minimisation ends.

    Attributes:
        iterations: at most, per row.
        tolerance: relative decrease below which an iteration counts as none; a row ends after
            some such, or where its gradient's maximum is below `tolerance`^2 times the first.
        deadline: value of `time.perf_counter` after which nothing more is evaluated.
    """

    iterations: int
    tolerance: float
    deadline: float = math.inf

    @property
    def over(self) -> bool:
        """Whether time is up."""
        return time.perf_counter() > self.deadline


class Minimum:
    """What has become of every row.

    Attributes:
        x: (S, n) the best point of each row.
        value: (S,) there.
        iterations: (S,) done.
        reason: (S,) why the row ended, index into `REASONS`.
    """

    def __init__(
        self, x: Tensor, value: Tensor, gradient: Tensor, limits: Limits, patience: int
    ) -> None:
        self.x, self.value = x, value
        self.iterations = torch.zeros(len(x), dtype=torch.long)
        self.reason = torch.full((len(x),), RUNNING)
        self._limits, self._patience = limits, patience
        self._still = torch.zeros(len(x), dtype=torch.long)
        steepest = gradient.abs().amax(dim=1)
        self._flat = steepest * limits.tolerance**2
        self.reason[steepest == 0.0] = CONVERGED

    def active(self) -> Tensor:
        """Return the rows that go on; none, once time is up."""
        if self._limits.over:
            self.reason[self.reason == RUNNING] = TIME
        return torch.nonzero(self.reason == RUNNING)[:, 0]

    def step(self, rows: Tensor, before: Tensor, after: Tensor, gradient: Tensor) -> None:
        """Note that rows went from one value to another, with this gradient there."""
        self.iterations[rows] += 1
        small = (before - after).abs() <= self._limits.tolerance * after.abs()
        self._still[rows] = torch.where(small, self._still[rows] + 1, 0)
        flat = gradient.abs().amax(dim=1) <= self._flat[rows]
        done = (self._still[rows] >= self._patience) | flat
        self.reason[rows[done]] = CONVERGED
        spent = ~done & (self.iterations[rows] >= self._limits.iterations)
        self.reason[rows[spent]] = ITERATIONS


def lbfgs(evaluate: Evaluate, x: Tensor, limits: Limits) -> Minimum:
    """Minimise every row by L-BFGS (Nocedal 1980) with a weak Wolfe line search.

    The line search is bisection (Lewis and Overton 2013), which does not ask for smoothness:
    costs with hinges have kinks. Values that are not finite only shorten the step; a row whose
    first gradient is not finite stalls there.
    """
    x = x.detach().clone()
    value, slope = evaluate(x, torch.arange(len(x)))
    minimum = Minimum(x, value, slope, limits, _PATIENCE)
    # There is no direction from there, and a row of NaN must not reach the cost.
    minimum.reason[~torch.isfinite(slope).all(dim=1)] = STALLED
    lines = _Lines(x, value, slope)
    while len(rows := minimum.active()):
        trial = x[rows] + lines.t[rows, None] * lines.direction[rows]
        found, gradient = evaluate(trial, rows)
        taken, hopeless = lines.judge(rows, found, gradient)
        minimum.reason[rows[hopeless]] = STALLED
        moved = rows[taken]
        if len(moved):
            before = value[moved]
            lines.move(moved, trial[taken], found[taken], gradient[taken])
            minimum.step(moved, before, value[moved], slope[moved])
    return minimum


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(dim=-1)


class _Lines:
    """Point, direction, bracket and curvature pairs of every row."""

    def __init__(self, x: Tensor, value: Tensor, slope: Tensor) -> None:
        self.x, self.value, self.slope = x, value, slope
        count, n = x.shape
        self.steps = x.new_zeros(count, _MEMORY, n)
        self.changes = x.new_zeros(count, _MEMORY, n)
        self.rho = x.new_zeros(count, _MEMORY)
        self.direction = torch.zeros_like(x)
        self.t, self.low, self.high = (x.new_zeros(count) for _ in range(3))
        self.trials = torch.zeros(count, dtype=torch.long)
        self._aim(torch.arange(count))

    def judge(self, rows: Tensor, value: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
        """Move the brackets; say which trials are taken and which rows cannot go on."""
        t, direction = self.t[rows], self.direction[rows]
        descent = _dot(self.slope[rows], direction)
        sound = torch.isfinite(value) & torch.isfinite(gradient).all(dim=1)
        lower = sound & (value <= self.value[rows] + _DECREASE * t * descent)
        steep = lower & (_dot(gradient, direction) < _CURVATURE * descent)
        self.trials[rows] += 1
        tired = self.trials[rows] >= _TRIALS
        taken = lower & (~steep | tired)
        on, off = rows[steep], rows[~lower]
        self.low[on], self.high[off] = self.t[on], self.t[off]
        low, high = self.low[rows], self.high[rows]
        middle = torch.where(torch.isfinite(high), 0.5 * (low + high), 2.0 * t)
        # While nothing longer than 0 was acceptable, a parabola guesses better than half.
        bend = value - self.value[rows] - descent * t
        guess = torch.where(
            sound & (bend > 0.0) & (low == 0.0) & ~lower,
            torch.clamp(-0.5 * descent * t * t / bend, 0.1 * t, 0.5 * t),
            middle,
        )
        failed = tired & ~taken
        # Too flat a descent is a descent still: go back to it and take it.
        back = torch.where(failed & (low > 0.0), low, guess)
        self.t[rows] = torch.where(taken, t, back)
        hopeless = failed & (low == 0.0)
        known = (self.rho[rows] != 0.0).any(dim=1)
        again = rows[hopeless & known]
        self.rho[again] = 0.0
        self._aim(again)
        return taken, hopeless & ~known

    def move(self, rows: Tensor, x: Tensor, value: Tensor, gradient: Tensor) -> None:
        """Take the trials and aim again."""
        step, change = x - self.x[rows], gradient - self.slope[rows]
        curvature = _dot(step, change)
        useful = curvature > 1e-10 * change.square().sum(dim=1)
        kept = rows[useful]
        for store, new in ((self.steps, step), (self.changes, change), (self.rho, 1 / curvature)):
            store[kept] = torch.cat([store[kept, 1:], new[useful, None]], dim=1)
        self.x[rows], self.value[rows], self.slope[rows] = x, value, gradient
        self._aim(rows)

    def _aim(self, rows: Tensor) -> None:
        """Choose a direction by the two-loop recursion, and a step of one along it."""
        g = self.slope[rows]
        rho, steps, changes = self.rho[rows], self.steps[rows], self.changes[rows]
        q = g.clone()
        shares = {}
        for k in reversed(range(_MEMORY)):  # an empty pair has rho = 0 and does nothing
            shares[k] = rho[:, k] * _dot(steps[:, k], q)
            q -= shares[k][:, None] * changes[:, k]
        latest = rho[:, -1]
        size = changes[:, -1].square().sum(dim=1)
        first = 1.0 / torch.clamp(g.norm(dim=1), min=1.0)
        known = latest > 0.0
        q *= torch.where(known, 1.0 / torch.where(known, latest * size, 1.0), first)[:, None]
        for k in range(_MEMORY):
            q += (shares[k] - rho[:, k] * _dot(changes[:, k], q))[:, None] * steps[:, k]
        uphill = _dot(q, g) <= 0.0
        q[uphill] = g[uphill] * first[uphill, None]
        self.rho[rows[uphill]] = 0.0
        self.direction[rows] = -q
        self.t[rows], self.low[rows], self.high[rows] = 1.0, 0.0, math.inf
        self.trials[rows] = 0


def adam(evaluate: Evaluate, x: Tensor, limits: Limits) -> Minimum:
    """Minimise every row by `torch.optim.Adam`, whose steps do not mix the rows.

    The step falls as a cosine. Each row ends by itself and keeps the best point it saw.
    """
    point = x.detach().clone().requires_grad_()
    optimizer = torch.optim.Adam([point], lr=_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(
        optimizer, max(1, limits.iterations), eta_min=_DECAYS_TO * _RATE
    )
    value, slope = evaluate(point.detach(), torch.arange(len(x)))
    value = value.fmin(value.new_tensor(math.inf))
    minimum = Minimum(x.detach().clone(), value, slope, limits, _SWINGS)
    while len(rows := minimum.active()):
        keep = point.detach().clone()
        point.grad = torch.zeros_like(point)
        point.grad[rows] = torch.nan_to_num(slope[rows], nan=0.0, posinf=0.0, neginf=0.0)
        optimizer.step()
        schedule.step()
        ended = torch.ones(len(x), dtype=torch.bool)
        ended[rows] = False
        with torch.no_grad():
            point[ended] = keep[ended]
        found, slope[rows] = evaluate(point.detach()[rows], rows)
        before = value[rows]
        better = rows[found < before]
        minimum.x[better], value[better] = point.detach()[better], found[found < before]
        # A step up is no convergence: compare with the best value so far.
        minimum.step(rows, before, torch.minimum(found, before), slope[rows])
    return minimum
