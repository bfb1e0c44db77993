# SPDX-License-Identifier: BSD-3-Clause
"""State spaces, and moving states between OMPL and numpy in the shortest way.

The *flat order* of a state is the order in which OMPL serialises it: depth first
through the subspaces. `state_space` builds its subspaces in joint order, so the flat
order of its states is the joint order of the robot.
"""

import ctypes
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from ompl import base as ob

from vprism_plan.errors import PlanningError
from vprism_plan.planning._protocol import RobotLike

# nanobind hands `void*` arguments over in capsules of this name. It is an internal
# of nanobind, which is why every use is tested against the slow way first.
_CAPSULE_NAME = b"nb_handle"
_new_capsule = ctypes.pythonapi.PyCapsule_New
_new_capsule.restype = ctypes.py_object
_new_capsule.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]

# Only these interpolate in straight lines (the shorter way round for SO2), which is
# what a checker certifies. Dubins and similar spaces derive from SE2 or a compound.
_STRAIGHT_COMPOUNDS = ("CompoundStateSpace", "SE2StateSpace")


def state_space(robot: RobotLike) -> Any:
    """Return the OMPL space of a robot's configurations, with its joint limits.

    Without continuous joints it is one `RealVectorStateSpace` (distance: Euclidean,
    radians and metres alike). With them it is a `CompoundStateSpace` in joint order:
    each run of limited joints is a RealVector, each continuous joint an SO2, all with
    weight 1, so the distance is the sum of the parts' distances. Either way the flat
    order is the joint order; see `to_array` and `to_state`.

    Raises PlanningError if a limited joint has no finite, non-empty range.
    """
    continuous = np.asarray(robot.continuous, dtype=bool)
    lower = np.asarray(robot.lower, dtype=np.float64)
    upper = np.asarray(robot.upper, dtype=np.float64)
    _check_limits(tuple(robot.joint_names), lower, upper, continuous)
    if not continuous.any():
        return _real_vector(lower, upper)
    compound = ob.CompoundStateSpace()
    start = 0
    while start < len(continuous):
        stop = start + 1
        if continuous[start]:
            compound.addSubspace(ob.SO2StateSpace(), 1.0)
        else:
            while stop < len(continuous) and not continuous[stop]:
                stop += 1
            compound.addSubspace(_real_vector(lower[start:stop], upper[start:stop]), 1.0)
        start = stop
    compound.lock()
    return compound


def _check_limits(
    names: tuple[str, ...],
    lower: Float[np.ndarray, " dof"],
    upper: Float[np.ndarray, " dof"],
    continuous: Bool[np.ndarray, " dof"],
) -> None:
    for name, low, high, free in zip(names, lower, upper, continuous, strict=True):
        if not free and not (np.isfinite(low) and np.isfinite(high) and low < high):
            raise PlanningError(
                f"joint {name!r} has limits [{low}, {high}]; a limited joint needs finite limits "
                "with lower < upper (lock the joint if it should not move)"
            )


def _real_vector(lower: Float[np.ndarray, " n"], upper: Float[np.ndarray, " n"]) -> Any:
    space = ob.RealVectorStateSpace(len(lower))
    bounds = ob.RealVectorBounds(len(lower))
    for i, (low, high) in enumerate(zip(lower, upper, strict=True)):
        bounds.setLow(i, float(low))
        bounds.setHigh(i, float(high))
    space.setBounds(bounds)
    return space


def wrapping_coordinates(space: Any) -> tuple[bool, ...]:
    """Return, per flat coordinate, whether the space wraps it at +-pi (SO2).

    Raises PlanningError for spaces that do not interpolate in straight lines.
    """
    kind = _bound_class(space)
    if kind == "RealVectorStateSpace":
        return (False,) * space.getDimension()
    if kind == "SO2StateSpace":
        return (True,)
    if kind in _STRAIGHT_COMPOUNDS:
        return tuple(w for part in space.getSubspaces() for w in wrapping_coordinates(part))
    raise PlanningError(
        f"the state space contains a {kind}; use RealVectorStateSpace, SO2StateSpace, or a "
        "CompoundStateSpace of them, whose motions are straight lines in joint space"
    )


def _bound_class(space: Any) -> str:
    """Name the OMPL class behind a space, also for a user's Python subclass."""
    return next(
        (c.__name__ for c in type(space).__mro__ if c.__module__.startswith("ompl.")),
        type(space).__name__,
    )


def _read(space: Any, state: Any, out: list[float]) -> None:
    kind = _bound_class(space)
    if kind == "RealVectorStateSpace":
        out.extend(state[i] for i in range(space.getDimension()))
    elif kind == "SO2StateSpace":
        out.append(state.value)
    else:
        for i, part in enumerate(space.getSubspaces()):
            _read(part, state[i], out)


def _write(space: Any, values: list[float], start: int, state: Any) -> int:
    kind = _bound_class(space)
    if kind == "RealVectorStateSpace":
        size = space.getDimension()
        for i in range(size):
            state[i] = values[start + i]
        return start + size
    if kind == "SO2StateSpace":
        state.value = values[start]
        return start + 1
    for i, part in enumerate(space.getSubspaces()):
        start = _write(part, values, start, state[i])
    return start


def to_array(space: Any, state: Any) -> Float[np.ndarray, " dof"]:
    """Return the coordinates of an OMPL state in flat order, as a new array."""
    values: list[float] = []
    _read(space, state, values)
    return np.array(values, dtype=np.float64)


def to_state(space: Any, q: Float[np.ndarray, " dof"]) -> Any:
    """Return a new OMPL state with coordinates q (flat order), SO2 parts wrapped.

    Raises PlanningError if q does not have one finite number per coordinate.
    """
    dof = len(wrapping_coordinates(space))
    values = np.array(q, dtype=np.float64)
    if values.shape != (dof,) or not np.isfinite(values).all():
        raise PlanningError(f"configuration {q!r} must be {dof} finite numbers, one per coordinate")
    state = space.allocState()
    write_state(space, values, state)
    return state


def write_state(space: Any, q: Float[np.ndarray, " dof"], state: Any) -> None:
    """Write coordinates q (flat order) to a state, SO2 parts wrapped; no checks of q."""
    wraps = np.array(wrapping_coordinates(space))
    turned = np.mod(q + np.pi, 2.0 * np.pi) - np.pi
    # Angles that are already in range stay bit-identical.
    wrap = wraps & ((q < -np.pi) | (q >= np.pi))
    _write(space, np.where(wrap, turned, q).tolist(), 0, state)


class _Buffers(threading.local):
    """Two float64 buffers per thread and the capsules that let OMPL write to them."""

    def __init__(self, size: int, with_capsules: bool) -> None:
        self.a = np.zeros(size)
        self.b = np.zeros(size)
        if with_capsules:
            self.capsule_a = _new_capsule(self.a.ctypes.data, _CAPSULE_NAME, None)
            self.capsule_b = _new_capsule(self.b.ctypes.data, _CAPSULE_NAME, None)


class StateReader:
    """Copies OMPL states of one space into preallocated arrays.

    `fast` says whether states are serialised straight into numpy memory (about 0.1
    microseconds) or read element by element. Buffers are per thread, because a kernel
    that releases the GIL must not see its input overwritten by another thread.
    """

    def __init__(self, space: Any, dof: int) -> None:
        """Prepare for `space`, which must have `dof` straight coordinates.

        Raises PlanningError naming both numbers if they differ.
        """
        self.wraps = wrapping_coordinates(space)
        if len(self.wraps) != dof:
            raise PlanningError(
                f"the state space has {len(self.wraps)} dimensions but the robot has {dof} joints; "
                "build the space with state_space(robot), or give it one dimension per joint"
            )
        self.space = space
        self.fast = _serialisation_works(space, dof)
        self.buffers = _Buffers(dof, self.fast)

    def private_buffer(self) -> tuple[Any, Float[np.ndarray, " dof"]]:
        """Return a capsule to serialise to and the array behind it, shared with nobody."""
        buffer = np.zeros(len(self.wraps))
        return _new_capsule(buffer.ctypes.data, _CAPSULE_NAME, None), buffer

    def read(self, state: Any) -> Float[np.ndarray, " dof"]:
        """Return this thread's first buffer, holding `state`; valid until the next read."""
        buffers = self.buffers
        if self.fast:
            self.space.serialize(buffers.capsule_a, state)
        else:
            buffers.a[:] = to_array(self.space, state)
        return buffers.a

    def read_pair(
        self, first: Any, second: Any
    ) -> tuple[Float[np.ndarray, " dof"], Float[np.ndarray, " dof"]]:
        """Return both buffers of this thread, holding the two states."""
        buffers = self.buffers
        if self.fast:
            self.space.serialize(buffers.capsule_a, first)
            self.space.serialize(buffers.capsule_b, second)
        else:
            buffers.a[:] = to_array(self.space, first)
            buffers.b[:] = to_array(self.space, second)
        return buffers.a, buffers.b


def _serialisation_works(space: Any, dof: int) -> bool:
    """Test the capsule route against the slow one on a random state."""
    # A longer serialisation would overrun the buffer: ask before trying.
    if space.getSerializationLength() != 8 * dof:
        return False
    serialize: Callable[[Any, Any], None] | None = getattr(space, "serialize", None)
    if serialize is None:
        return False
    values = np.random.default_rng(0).uniform(-3.0, 3.0, dof)
    state = to_state(space, values)
    buffer = np.full(dof, np.nan)
    try:
        serialize(_new_capsule(buffer.ctypes.data, _CAPSULE_NAME, None), state)
    except TypeError:  # a nanobind with another capsule name refuses the argument
        return False
    return bool(np.array_equal(buffer, to_array(space, state)))
