# SPDX-License-Identifier: BSD-3-Clause
"""Shortening a path so that every edge of the result was itself checked.

OMPL's `PathSimplifier` cuts accepted edges at points of its choice and keeps the
pieces unchecked. A checker that samples at its finest step may refuse such a piece by
microns, and the final verification then refuses the path. Here an edge enters the path
only as it will be verified: same ends, same direction.
"""

import time
from collections.abc import Callable
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from vprism_plan.planning._clock import Now
from vprism_plan.planning.objectives import PathCost

Check = Callable[[np.ndarray, np.ndarray], bool]

_MOST_CUTS = 120
_FUTILE_CUTS = 25
# Ends of a cut this near to a waypoint, as a share of the path, are moved onto it.
_SNAP = 0.02
_WORTHWHILE = 1e-6


def shorten(
    path: Float[np.ndarray, "t dof"],
    check: Check,
    seed: int,
    deadline: float,
    now: Now = time.perf_counter,
    cost: PathCost | None = None,
) -> Float[np.ndarray, "n dof"]:
    """Shorten a path by dropping waypoints and by random cuts (Geraerts and Overmars 2007).

    Args:
        path: waypoints (t, dof), consecutive rows joined by straight motions.
        check: whether a straight motion is valid.
        seed: of the random cuts; the result depends on the clock only if the deadline
            strikes.
        deadline: reading of the clock after which no cut is tried.
        now: reads the clock, seconds.
        cost: with it, only what does not raise the path's cost is taken.

    Returns:
        Waypoints with the same ends. Edges that were not in `path` passed `check`.
    """
    rng = np.random.default_rng(seed)
    path = drop_waypoints(path, check, deadline, now, cost)
    futile = 0
    for _ in range(_MOST_CUTS):
        if len(path) < 3 or futile >= _FUTILE_CUTS or now() > deadline:
            break
        cut = _cut(path, check, rng, cost)
        futile = futile + 1 if cut is None else 0
        path = path if cut is None else cut
    return drop_waypoints(path, check, deadline, now, cost)


def drop_waypoints(
    path: Float[np.ndarray, "t dof"],
    check: Check,
    deadline: float,
    now: Now = time.perf_counter,
    cost: PathCost | None = None,
) -> Float[np.ndarray, "n dof"]:
    """Connect each kept waypoint to the furthest one it reaches in a straight line."""
    kept = [0]
    last = len(path) - 1
    while kept[-1] < last:
        here = kept[-1]
        reached = here + 1
        for ahead in range(last, here + 1, -1):
            if now() > deadline:
                break
            straight = path[[here, ahead]]
            if _no_dearer(cost, path[here : ahead + 1], straight) and check(*straight):
                reached = ahead
                break
        kept.append(reached)
    return path[kept]


def _no_dearer(
    cost: PathCost | None, old: Float[np.ndarray, "t dof"], new: Float[np.ndarray, "n dof"]
) -> bool:
    """Whether a stretch of a path may be replaced by another as far as the cost goes."""
    return cost is None or cost.path(new) <= cost.path(old)


def _cut(
    path: Float[np.ndarray, "t dof"],
    check: Check,
    rng: np.random.Generator,
    cost: PathCost | None,
) -> Float[np.ndarray, "n dof"] | None:
    """Try to replace the path between two random points of it by a straight motion."""
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    first, second = np.sort(rng.uniform(0.0, along[-1], 2))
    i, a, first = _point(path, along, float(first))
    j, b, second = _point(path, along, float(second))
    if i == j:
        return None
    start = path[i] if a is None else a
    end = path[j] if b is None else b
    gain = second - first - float(np.linalg.norm(end - start))
    if gain < _WORTHWHILE * along[-1]:
        return None
    rest = path[j:] if b is None else path[j + 1 :]
    middle = [q[None] for q in (a, b) if q is not None]
    shorter = np.concatenate([path[: i + 1], *middle, rest])
    # Edges outside the cut are the same; compared as a whole, splitting one counts, too.
    if not _no_dearer(cost, path, shorter) or not check(start, end):
        return None
    # Splitting an accepted edge makes new edges: they have to pass by themselves.
    if a is not None and not check(path[i], a):
        return None
    if b is not None and not check(b, path[j + 1]):
        return None
    return shorter


def _point(
    path: Float[np.ndarray, "t dof"], along: Float[np.ndarray, " t"], s: float
) -> tuple[int, Float[np.ndarray, " dof"] | None, float]:
    """Return the edge that holds arc length s, the point there, and s.

    Near a waypoint: its index, None, and its arc length.
    """
    nearest = int(np.argmin(np.abs(along - s)))
    if abs(along[nearest] - s) <= _SNAP * along[-1]:
        return nearest, None, float(along[nearest])
    edge = int(np.searchsorted(along, s, side="right")) - 1
    share = (s - along[edge]) / (along[edge + 1] - along[edge])
    return edge, path[edge] + share * (path[edge + 1] - path[edge]), s


_FUTILE_MOVES = 400
_MOVE_RANGE = (0.003, 0.6)  # Euclidean in joint space


def cheapen(
    path: Float[np.ndarray, "t dof"],
    check: Check,
    seed: int,
    deadline: float,
    now: Now,
    cost: PathCost,
) -> Float[np.ndarray, "n dof"]:
    """Lower a path's cost by moving its waypoints at random, one at a time.

    Where an edge costs much it gets a waypoint more, so that it can bend. Every change is
    taken only if the path costs less with it and its new edges pass the check.

    Args and return value as `shorten`.
    """
    rng = np.random.default_rng([seed, 0xC4EA])
    total = cost.path(path)
    futile = 0
    while futile < _FUTILE_MOVES and now() <= deadline:
        moved = _moved(path, rng, cost)
        new = cost.path(moved)
        futile += 1
        if new < total * (1.0 - 1e-9) and _new_edges_pass(path, moved, check):
            # What brings next to nothing must not keep the search alive.
            futile = 0 if new < total * (1.0 - 1e-3) else futile
            path, total = moved, new
    return path


def _moved(
    path: Float[np.ndarray, "t dof"], rng: np.random.Generator, cost: PathCost
) -> Float[np.ndarray, "n dof"]:
    """Return the path with a waypoint moved, one that was there or a new one."""
    costs = np.array([cost.edge(a, b) for a, b in pairwise(path)])
    share = 0.5 / len(costs) + 0.5 * costs / max(float(costs.sum()), 1e-300)
    edge = int(rng.choice(len(costs), p=share / share.sum()))
    spread = np.exp(rng.uniform(*np.log(_MOVE_RANGE)))
    step = rng.normal(size=path.shape[1]) * spread / np.sqrt(path.shape[1])
    place = edge + int(rng.integers(3))  # its beginning, its end, or a point between
    if place == edge + 2 or not 0 < place < len(path) - 1:
        between = path[edge] + rng.uniform(0.1, 0.9) * (path[edge + 1] - path[edge])
        return np.concatenate([path[: edge + 1], (between + step)[None], path[edge + 1 :]])
    moved = path.copy()
    moved[place] += step
    return moved


def _new_edges_pass(
    old: Float[np.ndarray, "t dof"], new: Float[np.ndarray, "n dof"], check: Check
) -> bool:
    known = {(a.tobytes(), b.tobytes()) for a, b in pairwise(old)}
    fresh = [(a, b) for a, b in pairwise(new) if (a.tobytes(), b.tobytes()) not in known]
    return all(check(a, b) for a, b in fresh)
