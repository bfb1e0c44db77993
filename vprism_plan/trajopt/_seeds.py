# SPDX-License-Identifier: BSD-3-Clause
"""Where the optimiser begins: straight lines, detours, smooth noise, and paths it is given."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from vprism_plan.errors import PlanningError
from vprism_plan.planning import CheckerLike
from vprism_plan.planning.ompl_adapter import nearest_turns

_SAME = 1e-6  # radians or metres by which a given path may miss start and goal
_DRAWS = 64  # configurations among which a detour's middle is chosen
_SPREAD = 0.15  # standard deviation of detours around the middle, share of the joint's range
_NOISE = 0.08  # the same of smooth noise where it is largest


@dataclass(frozen=True)
class Seeds:
    """Trajectories to begin with.

    Attributes:
        names: what each is: "initial 0", "straight", "via 0", "noise 0", ...
        q: (S, T, dof) waypoints; all begin at the start and end at the goal, up to whole
            turns of continuous joints.
    """

    names: tuple[str, ...]
    q: Float[np.ndarray, "s t dof"]


def smooth_basis(inner: int, order: int) -> Float[np.ndarray, "n n"]:
    """Return B such that B z, z standard normal, is a random function that is zero at both ends.

    Its covariance is the inverse of D^T D with D the differences of that order, as STOMP
    (Kalakrishnan and others 2011) draws its noise; the largest standard deviation is 1.
    Of order 1 it is a Brownian bridge; of order 2 it is also at rest at both ends.
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
    if len(corners) <= count:
        places = _onto(places, at)
    rows = np.stack([np.interp(places, at, column) for column in corners.T], axis=1)
    rows[0], rows[-1] = path[0], path[-1]
    return rows


def _onto(places: Float[np.ndarray, " n"], corners: Float[np.ndarray, " c"]) -> np.ndarray:
    """Move one place onto each corner, in order, the others evenly between them."""
    n = len(places)
    nearest = np.rint(corners / corners[-1] * (n - 1)).astype(np.int64)
    for i in range(1, len(corners)):  # no two corners on one place
        nearest[i] = max(nearest[i], nearest[i - 1] + 1)
    nearest[-1] = n - 1
    for i in range(len(corners) - 2, 0, -1):
        nearest[i] = min(nearest[i], nearest[i + 1] - 1)
    return np.interp(np.arange(n), nearest, corners)


def make_seeds(
    checker: CheckerLike,
    start: Float[np.ndarray, " dof"],
    goal: Float[np.ndarray, " dof"],
    initial: Sequence[Any],
    count: int,
    waypoints: int,
    seed: int,
) -> tuple[Seeds, list[np.ndarray]]:
    """Return initial paths, the straight line, and detours and noise in turns; and the
    initial paths as they were given.

    Args:
        checker: asked which middles of detours are free.
        start: (dof,).
        goal: (dof,); continuous joints go the short way round to it.
        initial: paths (t, dof) from start to goal.
        count: how many in all; at least the initial ones.
        waypoints: of each.
        seed: of every choice. A larger `count` only adds to those of a smaller one.

    Raises:
        PlanningError: an initial path does not lead from start to goal.
    """
    turns = np.asarray(checker.robot.continuous, dtype=bool)
    given = [_checked(path, i, start, goal, turns) for i, path in enumerate(initial)]
    names = [f"initial {i}" for i in range(len(given))]
    found = [along(path, waypoints) for path in given]
    if len(found) < count or not found:
        end = nearest_turns(goal, start, turns)
        found.append(along(np.stack([start, end]), waypoints))
        names.append("straight")
    source = _Source(checker, found[-1], found[0], seed)
    for number in range(count - len(found)):
        kind = source.detour if number % 2 == 0 else source.noise
        found.append(kind(number // 2))
        names.append(f"{'via' if number % 2 == 0 else 'noise'} {number // 2}")
    return Seeds(tuple(names), np.stack(found)), given


class _Source:
    """Draws trajectories; each number has its own generator."""

    def __init__(self, checker: CheckerLike, straight: Any, base: Any, seed: int) -> None:
        robot = checker.robot
        self.checker = checker
        self.straight, self.base = straight, base
        self.seed = seed
        self.free = np.asarray(robot.continuous, dtype=bool)
        self.lower = np.where(self.free, -np.inf, robot.lower)
        self.upper = np.where(self.free, np.inf, robot.upper)
        self.range = np.asarray(robot.upper) - np.asarray(robot.lower)

    def detour(self, number: int) -> Float[np.ndarray, "t dof"]:
        """Return the way through a free configuration, found farther out with every number.

        Of random ones around the middle, it is the one with most of its two edges free, then
        the one with the shortest way.
        """
        rng = np.random.default_rng([self.seed, 1, number])
        a, b = self.straight[0], self.straight[-1]
        width = _SPREAD * (1.0 + number) * self.range
        draws = 0.5 * (a + b) + width * rng.standard_normal((_DRAWS, len(a)))
        draws = np.clip(draws, self.lower, self.upper)
        best, rank = draws[0], (-1, -np.inf)
        for q in draws:
            if not self.checker.is_valid(q):
                continue
            free = sum(self.checker.check_motion(*edge) for edge in ((a, q), (q, b)))
            way = float(np.linalg.norm(q - a) + np.linalg.norm(b - q))
            if (free, -way) > rank:
                best, rank = q, (free, -way)
        return along(np.stack([a, best, b]), len(self.straight))

    def noise(self, number: int) -> Float[np.ndarray, "t dof"]:
        """Return the first seed with smooth noise, more of it with every number."""
        rng = np.random.default_rng([self.seed, 2, number])
        basis = smooth_basis(len(self.base) - 2, 2)
        drawn = basis @ rng.standard_normal((len(basis), self.base.shape[1]))
        q = self.base.copy()
        q[1:-1] += _NOISE * (1.0 + number) * self.range * drawn
        q[1:-1] = np.clip(q[1:-1], self.lower, self.upper)
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
