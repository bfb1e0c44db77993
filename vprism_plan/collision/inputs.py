# SPDX-License-Identifier: BSD-3-Clause
"""Joint values as people write them, checked once, before anything is computed from them."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from vprism_plan._kernels.checking import FARTHEST
from vprism_plan.errors import RobotError
from vprism_plan.robots._arrays import KIND_PRISMATIC
from vprism_plan.robots._values import joint_values

AT_MOST = 200_000  # configurations that one query may ask about
# An array, a tensor, a list or a tuple.
Numbers = ArrayLike | Sequence[Any]


def configuration(robot: Any, q: Numbers) -> Float[np.ndarray, "dof"]:
    """Return a configuration (dof,); whether it is finite is for a verdict to say.

    Raises:
        RobotError: the shape is wrong.
    """
    return _read(robot, q, "a configuration", 1)


def configurations(robot: Any, Q: Numbers, finite: bool = False) -> Float[np.ndarray, "n dof"]:
    """Return configurations (n, dof).

    Raises:
        RobotError: the shape is wrong, or a value is not finite where it must be.
    """
    array = _read(robot, Q, "configurations", 2)
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
    array = _read(robot, path, "a path", *((2, 1) if single else (2,)))
    rows = array[None] if array.ndim == 1 else array
    if len(rows) == 0:
        raise RobotError(f"a path has shape {rows.shape}; it needs at least one waypoint")
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


def _read(robot: Any, values: Numbers, what: str, *ranks: int) -> Float[np.ndarray, "..."]:
    """Joint values of one of some ranks; RobotError if they have another shape."""
    array = joint_values(values, robot, what)
    if array.ndim not in ranks or array.shape[-1] != robot.dof:
        shapes = {1: f"({robot.dof},)", 2: f"(n, {robot.dof})"}
        raise RobotError(
            f"{what} has shape {array.shape}; {robot.name} needs "
            f"{' or '.join(shapes[rank] for rank in ranks)}: {', '.join(robot.joint_names)}"
        )
    return array


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
