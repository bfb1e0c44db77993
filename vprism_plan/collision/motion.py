# SPDX-License-Identifier: BSD-3-Clause
"""How far joints carry spheres along edges, and what that says of all that lies between: bounds,
not samples, of the clearance over whole paths and of how far a motion stays safe."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from vprism_plan.collision.packing import (
    AT_MOST,
    Configuration,
    Numbers,
    Rows,
    Waypoints,
    ancestors,
    checked_tolerance,
    configuration,
    configurations,
    reach_table,
    waypoints,
)
from vprism_plan.collision.reports import Answer, StateReport
from vprism_plan.errors import RobotError
from vprism_plan.robots.kinematics import KIND_PRISMATIC, KinematicArrays, frame_poses
from vprism_plan.world.grid import Points, Values

_BATCH = 64  # configurations asked at once where clearance is too small to step by
_HALVINGS = 60
_MOST_INTERVALS = 1_000_000  # of a path at once: what is kept of them fits in memory


@dataclass(frozen=True)
class Edges:
    """The straight edges of a path, and how far they can move anything."""

    path: Waypoints  # waypoints
    delta: Float[np.ndarray, "e dof"]  # change of the joints along each edge, as the rows say
    motion: Float[np.ndarray, " e"]  # upper bound of any sphere's way along each edge, metres
    pair_motion: Float[np.ndarray, " e"]  # the same for the change of any gap between two links

    def at(self, edge: Int[np.ndarray, " n"], fraction: Values) -> Rows:
        """Configurations at fractions of edges."""
        return self.path[edge] + fraction[:, None] * self.delta[edge]

    def samples(self, tolerance: float) -> tuple[Rows, Values]:
        """Configurations with at most `tolerance` metres of motion to the nearest of them, every
        waypoint among them, and their place on the path: the edge's number plus the fraction of
        it. RobotError if that would be more than two hundred thousand."""
        reach = np.maximum(self.motion, self.pair_motion)
        steps = np.maximum(1, np.ceil(reach / (2.0 * tolerance) - 1e-9)).astype(np.int64)
        if steps.sum() > AT_MOST:
            raise RobotError(
                f"a path of up to {reach.sum():.3g} m of motion needs {int(steps.sum()):,} "
                f"configurations at a tolerance of {tolerance:g} m; at most {AT_MOST:,}: "
                "give a coarser tolerance or a shorter path"
            )
        edge = np.repeat(np.arange(len(steps)), steps)
        first = np.repeat(np.cumsum(steps) - steps, steps)
        fraction = (np.arange(len(edge)) - first) / np.repeat(steps, steps)
        last = len(self.path) - 1
        Q = np.concatenate([self.at(edge, fraction), self.path[last:]])
        return Q, np.append(edge + fraction, float(last))


def edges_of(checker: Any, path: Numbers, single: bool = False) -> Edges:
    """Check a path as `waypoints` does, and bound its motion."""
    array = waypoints(checker.robot, path, single)
    delta = np.diff(array, axis=0)
    return Edges(array, delta, *motion_bounds(checker.robot.arrays, delta))


def motion_bounds(
    arrays: KinematicArrays, delta: Float[np.ndarray, "e dof"]
) -> tuple[Float[np.ndarray, " e"], Float[np.ndarray, " e"]]:
    """Bound how far any sphere moves, and how much any link pair's gap changes, metres, where
    the joints change by `delta` along straight edges."""
    table = reach_table(arrays)  # (frames, links): metres per unit, -1 where it moves nothing
    speed = np.abs(delta[:, np.maximum(arrays.q_index, 0)] * arrays.q_mult)
    speed[:, 0] = 0.0
    links = speed @ np.maximum(table, 0.0)
    a, b = table[:, arrays.pairs[:, 0]], table[:, arrays.pairs[:, 1]]
    between = np.where((a >= 0.0) != (b >= 0.0), np.maximum(a, b), 0.0)
    return links.max(axis=1, initial=0.0), (speed @ between).max(axis=1, initial=0.0)


def joint_units(arrays: KinematicArrays) -> tuple[str, ...]:
    """Unit of every joint of a configuration: "rad", or "m" for sliding joints."""
    slides = set(arrays.q_index[arrays.kind == KIND_PRISMATIC].tolist())
    return tuple("m" if j in slides else "rad" for j in range(len(arrays.lower)))


def place_points(
    R: Float[np.ndarray, "n f 3 3"],
    t: Float[np.ndarray, "n f 3"],
    frames: Int[np.ndarray, " s"],
    local: Float[np.ndarray, "s 3"],
) -> Float[np.ndarray, "n s 3"]:
    """World positions of points that move with frames, from `robots.kinematics.frame_poses`."""
    return np.ascontiguousarray(np.einsum("nsij,sj->nsi", R[:, frames], local) + t[:, frames])


def sphere_jacobians(
    arrays: KinematicArrays, Q: Rows, spheres: Int[np.ndarray, " n"]
) -> tuple[Points, Float[np.ndarray, "n 3 dof"]]:
    """Centres, metres, of one sphere at each configuration, and their derivatives.

    The geometric Jacobian, metres per radian or metre: axis x (centre - joint) for a revolute
    joint, the axis for a prismatic one, times the factor of joints that mimic.
    """
    R, t = frame_poses(arrays, Q)
    rows, frames = np.arange(len(Q)), arrays.sphere_frame[spheres]
    local = arrays.sphere_center[spheres]
    centers = np.einsum("nij,nj->ni", R[rows, frames], local) + t[rows, frames]
    jacobian = np.zeros((len(Q), 3, Q.shape[1]))
    chains = ancestors(arrays.parent)
    for f in range(1, len(chains)):
        moved = np.flatnonzero([f in chains[g] for g in frames])
        if len(moved) == 0:
            continue
        axis = R[moved, f] @ arrays.axis[f]
        if arrays.kind[f] != KIND_PRISMATIC:
            axis = np.cross(axis, centers[moved] - t[moved, f])
        jacobian[moved, :, arrays.q_index[f]] += arrays.q_mult[f] * axis
    return centers, jacobian


@dataclass(frozen=True)
class PathClearance(Answer):
    """Answer of `min_clearance`; metres.

    Attributes:
        clearance: lower bound of the distance to the world at every point of the path.
        tolerance: the smallest clearance on the path lies at most this much above `clearance`.
        place: where that was found: number of the edge plus the fraction of it.
        q: (dof,) that configuration; its clearance is `clearance + tolerance`.
        configurations: how many were computed.
        motion: upper bound of any sphere's way along the path.
    """

    clearance: float
    tolerance: float
    place: float
    q: tuple[float, ...]
    configurations: int
    motion: float

    def text(self) -> str:
        """Return the answer in one line."""
        return (
            f"at least {1000 * self.clearance:.2f} mm everywhere, within "
            f"{1000 * self.tolerance:.2f} mm of the smallest, near waypoint {self.place:.3f} "
            f"({self.configurations} configurations)"
        )


@dataclass(frozen=True)
class SafeMotion(Answer):
    """Answer of `max_safe_motion`.

    Attributes:
        fraction: the motion is valid from 0 up to this fraction of dq; 0 if q itself is refused.
        refused_at: a fraction, just after, at which it is refused; None if all of it is valid.
        tolerance: metres of motion. From `fraction` to `refused_at` nothing moves more than this,
            nor from any point before `fraction` to a configuration found valid or proven so.
        distance: upper bound of any sphere's way up to `fraction`, metres.
        reason: why it is refused at `refused_at`; None if it is not.
        configurations: how many were checked.
    """

    fraction: float
    refused_at: float | None
    tolerance: float
    distance: float
    reason: StateReport | None
    configurations: int

    @property
    def whole(self) -> bool:
        """Whether all of the motion is safe."""
        return self.refused_at is None

    def text(self) -> str:
        """Return the answer in one line."""
        if self.reason is None:
            return f"all of it is safe ({self.configurations} configurations)"
        return (
            f"safe up to {self.fraction:.4f} of it (up to {1000 * self.distance:.1f} mm of "
            f"motion, to within {1000 * self.tolerance:.2f} mm): {self.reason.text()}"
        )


def min_clearance(checker: Any, path: Numbers, tolerance: float = 0.0005) -> PathClearance:
    """Return a lower bound of the clearance over a whole path, and where it is smallest.

    Branch and bound over intervals of edges. If no sphere can move more than m from the middle of
    an interval to anywhere in it, the distance there is at least c - m, where c is the middle's
    clearance: distances are 1-Lipschitz and c is a lower bound. An interval is closed when that
    exceeds what is found elsewhere less the tolerance (by a voxel: computed clearances are bounds,
    which drop by up to one between neighbours), or when m is at most the tolerance; otherwise its
    halves are asked.

    Args:
        checker: a `CollisionChecker`.
        path: (T, dof) waypoints, T >= 1; edges as `check_motion` checks them.
        tolerance: metres.

    Raises:
        RobotError: see `waypoints`; the tolerance is too small, or the path too long for it.
    """
    checked_tolerance(tolerance)
    edges = edges_of(checker, path)
    clearances = checker.clearance_batch(edges.path)
    row = int(np.argmin(clearances))
    best, place, q = float(clearances[row]), float(row), edges.path[row]
    count = len(edges.path)
    slack = float(checker.world.field.spacing)
    edge = np.flatnonzero(edges.motion > 0.0)
    middle = np.full(len(edge), 0.5)
    if len(edge) == 0:
        tolerance = 0.0
    half = 0.5
    while len(edge):
        Q = edges.at(edge, middle)
        found = checker.clearance_batch(Q)
        count += len(Q)
        row = int(np.argmin(found))
        if found[row] < best:
            best, place, q = float(found[row]), float(edge[row] + middle[row]), Q[row]
        reach = half * edges.motion[edge]
        still = (reach > tolerance) & (found - reach - slack < best - tolerance)
        if still.sum() > _MOST_INTERVALS:
            raise RobotError(
                f"a path of up to {edges.motion.sum():.3g} m of motion needs more than "
                f"{_MOST_INTERVALS:,} intervals at a tolerance of {tolerance:g} m: give a coarser "
                "tolerance or a shorter path"
            )
        half *= 0.5
        edge = np.repeat(edge[still], 2)
        middle = (middle[still][:, None] + half * np.array([-1.0, 1.0])).reshape(-1)
    motion, where = float(edges.motion.sum()), tuple(q.tolist())
    return PathClearance(best - tolerance, tolerance, place, where, count, motion)


def max_safe_motion(checker: Any, q: Numbers, dq: Numbers, tolerance: float = 0.0005) -> SafeMotion:
    """Return how far from q along dq the checker's verdict stays "valid".

    Conservative advancement: from a configuration with clearance c (less the margin) and self gap g
    the motion cannot be refused before something moves by them. Where they are within a voxel of
    what is required, or `max_risk` is set (of which no such bound exists), it goes on in steps of
    at most `tolerance` metres of motion and asks each. What is refused first is bracketed by
    halving.

    Args:
        checker: a `CollisionChecker`.
        q: (dof,) where the motion starts.
        dq: (dof,) change of the joints over the whole motion; no joint is wrapped.
        tolerance: metres of motion, or RobotError if it is too small.
    """
    checked_tolerance(tolerance)
    march = _March(checker, q, dq, tolerance)
    safe, refused = march.run()
    if refused is not None:  # what is refused may be as far beyond a limit as counts as on it
        safe = max(0.0, min(safe, march.limit()))
    reason = None if refused is None else checker.explain(march.at(refused))
    gap = 0.0 if refused is None else (refused - safe) * march.motion
    gap = max(gap, 0.5 * march.step * march.motion if march.stepped else 0.0)
    return SafeMotion(safe, refused, gap, safe * march.motion, reason, march.count)


class _March:
    """A walk along a motion; all positions are fractions of it."""

    def __init__(self, checker: Any, q: Numbers, dq: Numbers, tolerance: float) -> None:
        self.checker = checker
        ends = (configuration(checker.robot, values) for values in (q, dq))
        self.q, self.dq = configurations(checker.robot, np.stack([*ends]), finite=True)
        own, gap = motion_bounds(checker.robot.arrays, self.dq[None])
        self.world_rate, self.pair_rate = float(own[0]), float(gap[0])
        self.motion = max(self.world_rate, self.pair_rate)
        self.step = tolerance / self.motion if self.motion > tolerance else 1.0
        self.count = 0
        self.stepped = False

    def at(self, fraction: float) -> Configuration:
        return np.asarray(self.q + fraction * self.dq)

    def run(self) -> tuple[float, float | None]:
        """Return the last fraction known to be valid and the first known to be refused."""
        self.count += 1
        if not self.checker.is_valid(self.q):
            return 0.0, 0.0
        end = self.limit()
        safe = 0.0
        while safe < 1.0:
            span = self._span(safe)
            if span > self.step and safe < end:
                ahead = min(safe + span, end)
                self.count += 1
                if self.checker.is_valid(self.at(ahead)):
                    safe = ahead
                    continue
                end = safe  # rounding at a joint's limit: no more leaps
            self.stepped = True
            steps = np.minimum(safe + self.step * np.arange(_BATCH + 1), 1.0)
            valid = self.checker.is_valid_batch(self.q + steps[1:, None] * self.dq)
            self.count += _BATCH
            if not valid.all():
                first = int(np.argmin(valid))
                return self._bracket(float(steps[first]), float(steps[first + 1]))
            safe = float(steps[-1])
        return 1.0, None

    def limit(self) -> float:
        """Return up to which fraction all joints keep their limits."""
        robot = self.checker.robot
        moves = (self.dq != 0.0) & ~np.asarray(robot.continuous)
        ends = np.where(self.dq > 0.0, robot.upper, robot.lower)[moves]
        return float(np.min((ends - self.q[moves]) / self.dq[moves], initial=1.0))

    def _span(self, fraction: float) -> float:
        """Return how far the clearances at a fraction reach, a voxel in reserve."""
        if self.checker.max_risk is not None:
            return 0.0
        Q, config = self.at(fraction)[None], self.checker.config
        self.count += 1
        room = float(self.checker.clearance_batch(Q)[0]) - config.margin
        room -= float(self.checker.world.field.spacing)
        gap = float(self.checker.self_clearance_batch(Q)[0]) - config.self_margin
        rates = (room, self.world_rate), (gap, self.pair_rate)
        return min([1.0, *(free / rate for free, rate in rates if rate > 0.0)])

    def _bracket(self, safe: float, refused: float) -> tuple[float, float]:
        """Halve the step between a valid and a refused fraction to a millionth of it."""
        for _ in range(_HALVINGS):
            middle = 0.5 * (safe + refused)
            if refused - safe <= 1e-3 * self.step or not safe < middle < refused:
                break
            self.count += 1
            if self.checker.is_valid(self.at(middle)):
                safe = middle
            else:
                refused = middle
        return safe, refused
