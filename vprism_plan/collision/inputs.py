# SPDX-License-Identifier: BSD-3-Clause
"""Joint values as people write them, checked once, before anything is computed from them."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from vprism_plan._kernels.checking import FARTHEST
from vprism_plan.errors import RobotError
from vprism_plan.robots.kinematics import KIND_PRISMATIC, joint_values

AT_MOST = 200_000  # configurations that one query may ask about
# An array, a tensor, a list or a tuple.
Numbers = ArrayLike | Sequence[Any]


def configuration(robot: Any, q: Numbers) -> Float[np.ndarray, "dof"]:
    """Return a configuration (dof,); whether it is finite is for a verdict to say.

    Raises:
        RobotError: the shape is wrong.
    """
    array = joint_values(q, robot, "a configuration")
    if array.shape != (robot.dof,):
        raise _wrong_shape(robot, array, "a configuration", f"({robot.dof},)")
    return array


def configurations(robot: Any, Q: Numbers, finite: bool = False) -> Float[np.ndarray, "n dof"]:
    """Return configurations (n, dof).

    Raises:
        RobotError: the shape is wrong, or a value is not finite where it must be.
    """
    array = joint_values(Q, robot, "configurations")
    if array.ndim != 2 or array.shape[1] != robot.dof:
        raise _wrong_shape(robot, array, "configurations", f"(n, {robot.dof})")
    if finite and not np.isfinite(array).all():
        row = int(np.flatnonzero(~np.isfinite(array).all(axis=1))[0])
        raise RobotError(
            f"configuration {row} is {array[row].tolist()}: joint values that are not finite; "
            "give finite ones"
        )
    return array


def waypoints(robot: Any, path: Numbers, single: bool = False) -> Float[np.ndarray, "t dof"]:
    """Return the waypoints (T, dof), T >= 1, of a path whose motion can be bounded.

    Args:
        robot: whose joints they are.
        path: (T, dof), radians or metres.
        single: take one configuration (dof,) for a path, too.

    Raises:
        RobotError: the shape is wrong, a value is not finite or far beyond any use (angles
            lose their last digits there, and motions their bounds), or a sliding joint leaves
            its limits.
    """
    array = joint_values(path, robot, "a path")
    rows = array[None] if single and array.ndim == 1 else array
    if rows.ndim != 2 or rows.shape[1] != robot.dof or len(rows) == 0:
        shapes = f"(T, {robot.dof}), T >= 1" + (f", or ({robot.dof},)" if single else "")
        raise _wrong_shape(robot, array, "a path", shapes)
    near = (np.abs(rows) <= FARTHEST).all(axis=1)
    if not near.all():
        row = int(np.flatnonzero(~near)[0])
        raise RobotError(
            f"waypoint {row} is {rows[row].tolist()}; give finite joint values of at most "
            f"{FARTHEST:g}"
        )
    for j in np.unique(robot.arrays.q_index[robot.arrays.kind == KIND_PRISMATIC]):
        low, high = rows[:, j].min(), rows[:, j].max()
        if low < robot.lower[j] or high > robot.upper[j]:
            raise RobotError(
                f"prismatic joint {robot.joint_names[j]} goes from {low:.4f} to {high:.4f} m, "
                f"outside its limits [{robot.lower[j]:.4f}, {robot.upper[j]:.4f}] m; its motion "
                "is bounded only within them"
            )
    return rows


def _wrong_shape(robot: Any, array: np.ndarray, what: str, shapes: str) -> RobotError:
    return RobotError(
        f"{what} has shape {array.shape}; {robot.name} needs {shapes}: "
        f"{', '.join(robot.joint_names)}"
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
