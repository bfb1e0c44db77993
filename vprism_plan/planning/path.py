# SPDX-License-Identifier: BSD-3-Clause
"""What becomes of a path that was found: shortened, made cheaper, resampled, verified.

OMPL's `PathSimplifier` cuts accepted edges and keeps the pieces unchecked, which a checker that
samples at its finest step may refuse by microns. Here an edge enters the path only as it will
be verified: same ends, same direction.
"""

import logging
import math
import time
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import replace
from itertools import accumulate, pairwise
from typing import Any

import numpy as np

from vprism_plan.planning.objectives import PathCost
from vprism_plan.planning.protocols import CheckerLike, Configuration, Now, Waypoints
from vprism_plan.planning.result import PlanReport, PlanResult
from vprism_plan.robots.kinematics import outside_limits

Check = Callable[[np.ndarray, np.ndarray], bool]
Edge = tuple[np.ndarray, np.ndarray]

_log = logging.getLogger(__name__)

_MOST_CUTS, _FUTILE_CUTS = 120, 25
_SNAP = 0.02  # share of the path: ends of a cut this near to a waypoint are moved onto it
_WORTHWHILE = 1e-6
_FUTILE_MOVES = 400
_MOVE_RANGE = (0.003, 0.6)  # Euclidean in joint space


class MotionCheck:
    """Counts and answers `checker.check_motion` for edges that may become part of a path.

    Refused are also edges that turn a continuous joint by half a turn or more, which others
    could take for the shorter way round, and those beyond the joint limits, which not every
    checker knows.
    """

    def __init__(self, checker: CheckerLike) -> None:
        self._check = checker.check_motion_buffer
        self._robot = checker.robot
        turns = np.asarray(checker.robot.continuous, dtype=bool)
        self._turns = turns if turns.any() else None
        self.count = 0

    def __call__(self, qa: Configuration, qb: Configuration) -> bool:
        """Return whether the straight motion may become part of a path."""
        self.count += 1
        if self._turns is not None and np.any(np.abs(qb - qa)[self._turns] >= np.pi):
            return False
        if not self._check(qa, qb):
            return False
        return not outside_limits(self._robot, np.stack([qa, qb])).any()


def shorten(
    path: Waypoints,
    check: Check,
    seed: int,
    deadline: float,
    now: Now = time.perf_counter,
    cost: PathCost | None = None,
) -> Waypoints:
    """Shorten a path by dropping waypoints and by random cuts (Geraerts and Overmars 2007).

    Both ends stay, and edges that were not in `path` passed `check`. The result depends on the
    clock only if the deadline strikes. With `cost`, only what does not raise it is taken.
    """
    path = drop_waypoints(path, check, deadline, now, cost)
    cut, unchecked = _cuts(path, check, seed, deadline, now, cost, careful=False)
    if not all(check(*edge) for edge in unchecked):
        cut, _ = _cuts(path, check, seed, deadline, now, cost, careful=True)
    return drop_waypoints(cut, check, deadline, now, cost)


def _cuts(
    path: Waypoints,
    check: Check,
    seed: int,
    deadline: float,
    now: Now,
    cost: PathCost | None,
    careful: bool,
) -> tuple[Waypoints, list[Edge]]:
    """Replace the path between two random points of it by straight motions, again and again.

    A cut that ends within an edge leaves a piece of it, a new edge that has to pass by itself:
    most pass, and most are gone after further cuts, so unless `careful` only the chords are
    checked, and the pieces that are left returned.
    """
    rng = np.random.default_rng(seed)
    unchecked: dict[tuple[bytes, bytes], Edge] = {}
    along = _along(path)
    futile = 0
    for _ in range(_MOST_CUTS):
        if len(path) < 3 or futile >= _FUTILE_CUTS or now() > deadline:
            break
        futile += 1
        first, second = sorted((along[-1] * rng.random(2)).tolist())
        (i, a, first), (j, b, second) = _point(path, along, first), _point(path, along, second)
        if i == j:
            continue
        start, end = path[i] if a is None else a, path[j] if b is None else b
        if second - first - math.dist(start, end) < _WORTHWHILE * along[-1]:
            continue
        head, tail = path[: i + 1], path[j:] if b is None else path[j + 1 :]
        shorter = np.concatenate([head, *(q[None] for q in (a, b) if q is not None), tail])
        # Edges outside the cut are the same; compared as a whole, splitting one counts, too.
        if not _no_dearer(cost, path, shorter) or not check(start, end):
            continue
        pieces = [] if a is None else [(head[-1], a)]
        pieces += [] if b is None else [(b, tail[0])]
        if careful and not all(check(*piece) for piece in pieces):
            continue
        unchecked.update(((p.tobytes(), q.tobytes()), (p, q)) for p, q in pieces)
        path, along, futile = shorter, _along(shorter), 0
    kept = ((p.tobytes(), q.tobytes()) for p, q in pairwise(path))
    return path, [unchecked[edge] for edge in kept if edge in unchecked]


def _along(path: Waypoints) -> list[float]:
    """Arc length at each waypoint."""
    return list(accumulate(map(math.dist, path[:-1], path[1:]), initial=0.0))


def drop_waypoints(
    path: Waypoints,
    check: Check,
    deadline: float,
    now: Now = time.perf_counter,
    cost: PathCost | None = None,
) -> Waypoints:
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


def _no_dearer(cost: PathCost | None, old: Waypoints, new: Waypoints) -> bool:
    """Whether a stretch of a path may be replaced by another as far as the cost goes."""
    return cost is None or cost.path(new) <= cost.path(old)


def _point(
    path: Waypoints, along: list[float], s: float
) -> tuple[int, Configuration | None, float]:
    """Edge that holds arc length s, the point there, s; near a waypoint its index, None, its s."""
    edge = min(bisect_right(along, s), len(along) - 1) - 1
    nearest = edge + (along[edge + 1] - s < s - along[edge])
    if abs(along[nearest] - s) <= _SNAP * along[-1]:
        return nearest, None, along[nearest]
    share = (s - along[edge]) / (along[edge + 1] - along[edge])
    return edge, path[edge] + share * (path[edge + 1] - path[edge]), s


def cheapen(
    path: Waypoints, check: Check, seed: int, deadline: float, now: Now, cost: PathCost
) -> Waypoints:
    """Lower a path's cost by moving its waypoints at random, one at a time.

    Where an edge costs much it gets a waypoint more, so that it can bend. Every change is
    taken only if the path costs less with it and its new edges pass the check.
    """
    rng = np.random.default_rng([seed, 0xC4EA])
    total = cost.path(path)
    futile = 0
    while futile < _FUTILE_MOVES and now() <= deadline:
        moved = _moved(path, rng, cost)
        new = cost.path(moved)
        futile += 1
        if not new < total * (1.0 - 1e-9):
            continue
        known = {(a.tobytes(), b.tobytes()) for a, b in pairwise(path)}
        if all(check(a, b) for a, b in pairwise(moved) if (a.tobytes(), b.tobytes()) not in known):
            # What brings next to nothing must not keep the search alive.
            futile = 0 if new < total * (1.0 - 1e-3) else futile
            path, total = moved, new
    return path


def _moved(path: Waypoints, rng: np.random.Generator, cost: PathCost) -> Waypoints:
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


def resample(path: Waypoints, check: Check, spacing: float) -> Waypoints:
    """Insert equally spaced waypoints on edges longer than `spacing`.

    An edge, accepted within a tolerance, whose pieces do not all pass by themselves stays whole.
    """
    rows = [path[0]]
    for edge in pairwise(path):
        pieces = interpolated(np.stack(edge), spacing)
        split = all(check(a, b) for a, b in pairwise(pieces))
        rows += list(pieces[1:]) if split else [edge[1]]
    return np.stack(rows)


def interpolated(path: Waypoints, spacing: float) -> Waypoints:
    """Return the path with points at most `spacing` apart."""
    pieces = [path[:1]]
    for a, b in pairwise(path):
        n = max(1, math.ceil(float(np.linalg.norm(b - a)) / spacing))
        inner = a + (b - a) * (np.arange(1, n)[:, None] / n)
        pieces += [inner, b[None]]
    return np.concatenate(pieces)


def verified(
    checker: CheckerLike,
    path: Waypoints,
    clearance_step: float,
    report: PlanReport,
    now: Now = time.perf_counter,
) -> PlanResult:
    """Check every edge of the final waypoints again, and measure the path."""
    began = now()
    outside = outside_limits(checker.robot, path)
    verdicts: list[Any] = []
    for edge, (a, b) in enumerate(pairwise(path)):
        verdicts.append(checker.check_motion_report(a, b))
        beyond = outside[edge : edge + 2].any()
        refused = beyond or not verdicts[-1].valid
        if refused:
            break
    checks = report.motion_checks + len(verdicts)
    report = replace(report, verification_time=now() - began, motion_checks=checks)
    if refused:
        _log.warning("edge %d of the final path failed its verification", edge)
        reason = "it leaves the joint limits" if beyond else one_line(verdicts[-1])
        which = f"edge {edge} of {len(path) - 1} of the final path"
        message = f"{which} was refused when checked again: {reason}"
        report = replace(report, goal_index=None)
        return PlanResult(None, "verification_failed", report, message, path, verdicts[-1])
    samples = interpolated(path, clearance_step)
    at_once: Any = getattr(checker, "clearance_batch", lambda Q: [checker.clearance(q) for q in Q])
    clearances = at_once(samples)
    report = replace(
        report,
        path_length=float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()),
        waypoints=len(path),
        min_clearance=float(min(clearances)),
        clearance_samples=len(clearances),
        certified=all(verdict.certified for verdict in verdicts),
        tolerance=float(max(verdict.tolerance for verdict in verdicts)),
        shares=_unseen_shares(checker, path),
    )
    message = (
        f"path of {len(path)} waypoints, length {report.path_length:.3g}, smallest clearance "
        f"{report.min_clearance:.3g} m in {len(clearances)} samples"
    )
    return PlanResult(path, "exact", report, message)


def _unseen_shares(checker: CheckerLike, path: Waypoints) -> dict[str, float]:
    """Largest share of the robot's volume at any waypoint, by the kind of unseen space."""
    at_once: Any = getattr(checker, "unseen_shares", None)
    if at_once is not None:
        return {kind: float(own.max()) for kind, own in at_once(path).items()}
    told = [checker.explain(q).shares for q in path]
    return {kind: max(float(own.get(kind, 0.0)) for own in told) for own in told for kind in own}


def one_line(report: Any) -> str:
    """Return a report's text without line breaks."""
    return " ".join(report.text().split())
