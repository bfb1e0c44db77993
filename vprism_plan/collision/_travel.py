# SPDX-License-Identifier: BSD-3-Clause
"""How far joints carry spheres: bounds along edges, and derivatives at one configuration."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from vprism_plan._kernels.checking import FARTHEST
from vprism_plan.collision._packing import reach_table
from vprism_plan.collision.protocols import Answers, Numbers, SphereRobot
from vprism_plan.errors import RobotError
from vprism_plan.robots import KinematicArrays
from vprism_plan.robots.kinematics import KIND_PRISMATIC, frame_poses, joint_values

AT_MOST = 200_000  # configurations of one query


@dataclass(frozen=True)
class Edges:
    """The straight edges of a path, and how far they can move anything.

    Attributes:
        path: (T, dof) waypoints.
        delta: (T - 1, dof) change of the joints along each edge, as the rows say.
        motion: (T - 1,) upper bound of any sphere's way along each edge, metres.
        pair_motion: the same for the change of any gap between two links.
    """

    path: Float[np.ndarray, "t dof"]
    delta: Float[np.ndarray, "e dof"]
    motion: Float[np.ndarray, " e"]
    pair_motion: Float[np.ndarray, " e"]

    def at(
        self, edge: Int[np.ndarray, " n"], fraction: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, "n dof"]:
        """Configurations at fractions of edges."""
        return self.path[edge] + fraction[:, None] * self.delta[edge]

    def samples(
        self, tolerance: float
    ) -> tuple[Float[np.ndarray, "n dof"], Float[np.ndarray, " n"]]:
        """Configurations with at most `tolerance` metres of motion to the nearest of them.

        Returns:
            The configurations, every waypoint among them, and their place on the path:
            the edge's number plus the fraction of it.

        Raises:
            RobotError: that would be more than two hundred thousand.
        """
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


def edges_of(checker: Answers, path: Numbers) -> Edges:
    """Check a path (T, dof) and bound its motion.

    Raises:
        RobotError: the shape is wrong, a value is not finite, or a sliding joint leaves
            its limits, beyond which its motion has no bound.
    """
    robot = checker.robot
    array = joint_values(path, robot, "a path")
    if array.ndim != 2 or array.shape[1] != robot.dof or len(array) == 0:
        raise RobotError(
            f"a path has shape {array.shape}; {robot.name} needs (T, {robot.dof}) with T >= 1: "
            f"{', '.join(robot.joint_names)}"
        )
    refuse_far(array, "waypoint")
    _refuse_beyond_limits(robot, array)
    delta = np.diff(array, axis=0)
    return Edges(array, delta, *motion_bounds(robot.arrays, delta))


def refuse_far(Q: Float[np.ndarray, "n dof"], what: str) -> None:
    """Raise RobotError for the first row with a value that is not finite, or far beyond any
    use: angles lose their last digits there, and motions their bounds."""
    near = (np.abs(Q) <= FARTHEST).all(axis=1)
    if not near.all():
        row = int(np.flatnonzero(~near)[0])
        raise RobotError(
            f"{what} {row} is {Q[row].tolist()}; give finite joint values of at most {FARTHEST:g}"
        )


def checked_tolerance(tolerance: float) -> float:
    """Return a tolerance, metres of motion.

    Raises:
        RobotError: it is not a finite length of at least a micrometre.
    """
    if not (np.isfinite(tolerance) and tolerance >= 1e-6):
        raise RobotError(
            f"tolerance is {tolerance!r}; give metres of motion, finite and at least 1e-6"
        )
    return float(tolerance)


def _refuse_beyond_limits(robot: SphereRobot, path: Float[np.ndarray, "t dof"]) -> None:
    slides = np.unique(robot.arrays.q_index[robot.arrays.kind == KIND_PRISMATIC])
    for j in slides:
        low, high = path[:, j].min(), path[:, j].max()
        if low < robot.lower[j] or high > robot.upper[j]:
            raise RobotError(
                f"joint {robot.joint_names[j]} goes from {low:.4f} to {high:.4f} m, outside its "
                f"limits [{robot.lower[j]:.4f}, {robot.upper[j]:.4f}] m; a sliding joint's motion "
                "is bounded only within them"
            )


def motion_bounds(
    arrays: KinematicArrays, delta: Float[np.ndarray, "e dof"]
) -> tuple[Float[np.ndarray, " e"], Float[np.ndarray, " e"]]:
    """Bound how far any sphere moves, and how much any link pair's gap changes, metres.

    Args:
        arrays: the robot.
        delta: (E, dof) changes of the joints along straight edges.
    """
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
    arrays: KinematicArrays, Q: Float[np.ndarray, "n dof"], spheres: Int[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 dof"]]:
    """Centres, metres, of one sphere at each configuration, and their derivatives.

    The geometric Jacobian, metres per radian or metre: axis x (centre - joint) for a
    revolute joint, the axis for a prismatic one, times the factor of joints that mimic.
    """
    R, t = frame_poses(arrays, Q)
    rows = np.arange(len(Q))
    frames = arrays.sphere_frame[spheres]
    local = arrays.sphere_center[spheres]
    centers = np.einsum("nij,nj->ni", R[rows, frames], local) + t[rows, frames]
    jacobian = np.zeros((len(Q), 3, Q.shape[1]))
    for f, carried in enumerate(_carried(arrays.parent)):
        moved = np.flatnonzero(carried[frames])
        if f == 0 or len(moved) == 0:
            continue
        axis = R[moved, f] @ arrays.axis[f]
        if arrays.kind[f] != KIND_PRISMATIC:
            axis = np.cross(axis, centers[moved] - t[moved, f])
        jacobian[moved, :, arrays.q_index[f]] += arrays.q_mult[f] * axis
    return centers, jacobian


def _carried(parent: Int[np.ndarray, " f"]) -> Bool[np.ndarray, "f f"]:
    """Entry (f, g): whether frame g moves with frame f."""
    table = np.eye(len(parent), dtype=bool)
    for g in range(1, len(parent)):
        table[:, g] |= table[:, parent[g]]
    return table
