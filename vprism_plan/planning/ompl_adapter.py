# SPDX-License-Identifier: BSD-3-Clause
"""OMPL's view of a checker: state spaces, states as numpy, and two classes for any program.

    si = ob.SpaceInformation(state_space(checker.robot))
    si.setStateValidityChecker(VPrismStateValidityChecker(si, checker))
    si.setMotionValidator(VPrismMotionValidator(si, checker))

Both keep the state space and never the `SpaceInformation`: a Python motion validator
that holds `si` closes a reference cycle that neither side can collect.

The *flat order* of a state is the order in which OMPL serialises it: depth first
through the subspaces. `state_space` builds its subspaces in joint order, so the flat
order of its states is the joint order of the robot.
"""

import ctypes
import math
import threading
from collections.abc import Callable, Iterator
from itertools import groupby
from threading import get_ident
from typing import Any

import numpy as np
from jaxtyping import Float
from ompl import base as ob

from vprism_plan.errors import PlanningError
from vprism_plan.planning.protocols import CheckerLike, Configuration
from vprism_plan.robots.kinematics import joint_values

_TURN = 2.0 * math.pi

# nanobind hands `void*` arguments over in capsules of this name. It is an internal
# of nanobind, which is why every use is tested against the slow way first.
_CAPSULE_NAME = b"nb_handle"
_new_capsule = ctypes.pythonapi.PyCapsule_New
_new_capsule.restype = ctypes.py_object
_new_capsule.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]

# Only these interpolate in straight lines (the shorter way round for SO2), which is
# what a checker certifies. Dubins and similar spaces derive from SE2 or a compound.
_STRAIGHT_COMPOUNDS = ("CompoundStateSpace", "SE2StateSpace")


def state_space(robot: Any) -> Any:
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
    for name, low, high, free in zip(robot.joint_names, lower, upper, continuous, strict=True):
        if not free and not (np.isfinite(low) and np.isfinite(high) and low < high):
            needed = "finite ones with lower < upper are needed (lock what should not move)"
            raise PlanningError(f"joint {name!r} has limits [{low}, {high}]; {needed}")
    if not continuous.any():
        return _real_vector(lower, upper)
    compound = ob.CompoundStateSpace()
    for circle, run in groupby(range(len(continuous)), key=lambda i: bool(continuous[i])):
        joints = list(run)
        if not circle:
            compound.addSubspace(_real_vector(lower[joints], upper[joints]), 1.0)
            continue
        for _ in joints:
            compound.addSubspace(ob.SO2StateSpace(), 1.0)
    compound.lock()
    return compound


def _real_vector(lower: Float[np.ndarray, " n"], upper: Float[np.ndarray, " n"]) -> Any:
    space = ob.RealVectorStateSpace(len(lower))
    bounds = ob.RealVectorBounds(len(lower))
    for i, (low, high) in enumerate(zip(lower, upper, strict=True)):
        bounds.setLow(i, float(low))
        bounds.setHigh(i, float(high))
    space.setBounds(bounds)
    return space


def _parts(space: Any, state: Any = None) -> Iterator[tuple[bool, int, Any]]:
    """Of each part, depth first: whether it is a circle, its size, its state."""
    # The OMPL class, also behind a user's Python subclass.
    names = (c.__name__ for c in type(space).__mro__ if c.__module__.startswith("ompl."))
    kind = next(names, type(space).__name__)
    if kind in ("RealVectorStateSpace", "SO2StateSpace"):
        yield kind == "SO2StateSpace", space.getDimension(), state
    elif kind in _STRAIGHT_COMPOUNDS:
        for i, part in enumerate(space.getSubspaces()):
            yield from _parts(part, None if state is None else state[i])
    else:
        straight = "RealVectorStateSpace, SO2StateSpace, or a CompoundStateSpace of them"
        raise PlanningError(f"the state space contains a {kind}; use {straight}")


def wrapping_coordinates(space: Any) -> tuple[bool, ...]:
    """Return, per flat coordinate, whether the space wraps it at +-pi (SO2).

    Raises PlanningError for spaces whose motions are no straight lines.
    """
    return tuple(circle for circle, size, _ in _parts(space) for _ in range(size))


def nearest_turns(
    q: Float[np.ndarray, "... dof"], reference: Configuration, wraps: Any
) -> Float[np.ndarray, "... dof"]:
    """Return q moved by whole turns in the coordinates marked in `wraps`: nearest to `reference`.

    A motion is what its two ends say. OMPL's circles are the exception: they interpolate to
    the nearest copy of an angle, and keep the angle itself in [-pi, pi]. This is where the
    two meet; nothing else takes turns off. It mirrors OMPL's rule term by term: at exactly
    half a turn q stays, one bit beyond it the other way is taken.
    """
    away = q - reference
    if not (wraps & (np.abs(away) > math.pi)).any():
        return q
    turns = np.round(away / _TURN)
    left = away - _TURN * turns
    turns += (left > math.pi).astype(float) - (left < -math.pi)
    return np.where(wraps, q - _TURN * turns, q)


def to_array(space: Any, state: Any) -> Configuration:
    """Return the coordinates of an OMPL state in flat order, as a new array."""
    values: list[float] = []
    for circle, size, part in _parts(space, state):
        values += [part.value] if circle else [part[i] for i in range(size)]
    return np.array(values, dtype=np.float64)


def to_state(space: Any, q: Configuration) -> Any:
    """Return a new OMPL state with finite coordinates q (flat order), SO2 parts wrapped."""
    dof = len(wrapping_coordinates(space))
    values = np.array(q, dtype=np.float64)
    if values.shape != (dof,) or not np.isfinite(values).all():
        raise PlanningError(f"configuration {q!r} must be {dof} finite numbers, one per coordinate")
    state = space.allocState()
    write_state(space, values, state)
    return state


def write_state(space: Any, q: Configuration, state: Any) -> None:
    """Write coordinates q (flat order) to a state, SO2 parts wrapped; no checks of q."""
    wraps = np.array(wrapping_coordinates(space))
    turned = np.mod(q + np.pi, 2.0 * np.pi) - np.pi
    # Angles that are already in range stay bit-identical.
    wrap = wraps & ((q < -np.pi) | (q >= np.pi))
    values = iter(np.where(wrap, turned, q).tolist())
    for circle, size, part in _parts(space, state):
        if circle:
            part.value = next(values)
            continue
        for i in range(size):
            part[i] = next(values)


def _capsule(buffer: Configuration) -> Any:
    """What lets OMPL write to an array."""
    return _new_capsule(buffer.ctypes.data, _CAPSULE_NAME, None)


class _Buffers(threading.local):
    """Two float64 buffers per thread and their capsules."""

    def __init__(self, size: int) -> None:
        self.a, self.b = np.zeros(size), np.zeros(size)
        self.capsule_a, self.capsule_b = _capsule(self.a), _capsule(self.b)


class StateReader:
    """Copies OMPL states of one space into preallocated arrays.

    `fast`: straight into numpy's memory (0.1 microseconds), not element by element. Buffers are
    per thread: a kernel that releases the GIL must not see its input overwritten.
    """

    def __init__(self, space: Any, dof: int) -> None:
        """Prepare for `space`; PlanningError if it has not `dof` straight coordinates."""
        self.wraps = np.array(wrapping_coordinates(space))
        if len(self.wraps) != dof:
            raise PlanningError(
                f"the state space has {len(self.wraps)} dimensions but the robot has {dof} joints; "
                "make it by state_space(robot)"
            )
        self.space = space
        self.fast = _serialisation_works(space, dof)
        self._buffers = _Buffers(dof)

    def read(self, state: Any) -> Configuration:
        """Return this thread's first buffer, holding `state`; valid until the next read."""
        own = self._buffers
        return self._copied(state, own.capsule_a, own.a)

    def read_pair(self, first: Any, second: Any) -> tuple[Configuration, Configuration]:
        """Return both buffers of this thread, holding the states."""
        own = self._buffers
        a = self._copied(first, own.capsule_a, own.a)
        return a, self._copied(second, own.capsule_b, own.b)

    def _copied(self, state: Any, capsule: Any, buffer: Configuration) -> Configuration:
        if self.fast:
            self.space.serialize(capsule, state)
        else:
            buffer[:] = to_array(self.space, state)
        return buffer


def _serialisation_works(space: Any, dof: int) -> bool:
    """Test the capsule route against the slow one on a random state."""
    # A longer serialisation would overrun the buffer: ask before trying.
    if space.getSerializationLength() != 8 * dof:
        return False
    state = to_state(space, np.random.default_rng(0).uniform(-3.0, 3.0, dof))
    buffer = np.full(dof, np.nan)
    try:
        space.serialize(_capsule(buffer), state)
    except TypeError:  # a nanobind with another capsule name refuses the argument
        return False
    return bool(np.array_equal(buffer, to_array(space, state)))


class VPrismStateValidityChecker(ob.StateValidityChecker):
    """OMPL's question "is this state valid?", answered by a checker."""

    def __init__(self, si: Any, checker: Any) -> None:
        """Attach `checker` to the space of `si`; PlanningError if that has not one dimension
        per joint, in flat order, or a part that is neither RealVector nor SO2."""
        super().__init__(si)
        self._reader = StateReader(si.getStateSpace(), checker.robot.dof)
        self._clearance = checker.clearance
        self._ask, self._asked = _question(self._reader, checker.is_valid_buffer)

    @property
    def checks(self) -> int:
        """Number of states asked about so far."""
        return self._asked()

    def isValid(self, state: Any, *unused: Any) -> bool:  # noqa: N802 - OMPL's name
        """Return whether `state` is valid; OMPL dispatches longer overloads here, too."""
        return self._ask(state)

    def clearance(self, state: Any, *unused: Any) -> float:
        """Return metres to the nearest obstacle, negative inside one."""
        return float(self._clearance(self._reader.read(state).copy()))


def _question(
    reader: StateReader, is_valid: Callable[[Any], bool]
) -> tuple[Callable[[Any], bool], Callable[[], int]]:
    """A function that asks about a state, and one that says how often it was asked.

    It runs for every state a planner samples. Names of a closure are found in half the time of
    attributes, and comparing thread numbers costs less than thread-local storage.
    """
    asked = 0
    owner, buffer = get_ident(), np.zeros(len(reader.wraps))
    fast, target, serialize = reader.fast, _capsule(buffer), reader.space.serialize

    def ask(state: Any) -> bool:
        nonlocal asked
        asked += 1
        # The bindings accept nothing but a genuine bool.
        if not fast or get_ident() != owner:
            return bool(is_valid(reader.read(state)))
        serialize(target, state)
        return bool(is_valid(buffer))

    return ask, lambda: asked


class VPrismMotionValidator(ob.MotionValidator):
    """OMPL's question "is this motion valid?", answered continuously by a checker.

    OMPL's bindings do not pass `lastValid` back, so planners that would keep the valid
    part of a blocked motion (KPIECE1) keep nothing of it; `last_valid` answers that
    question in Python. OMPL's own motion counters stay at zero for the same reason.

    Attributes:
        checks: number of motions asked about so far.
    """

    def __init__(self, si: Any, checker: Any) -> None:
        """Attach `checker` to the space of `si`; errors as for the state checker."""
        super().__init__(si)
        self.checks = 0
        self._reader = StateReader(si.getStateSpace(), checker.robot.dof)
        self._is_valid = checker.is_valid_buffer
        self._check_motion = checker.check_motion_buffer
        self._any_wraps = bool(self._reader.wraps.any())

    def checkMotion(self, s1: Any, s2: Any, *unused: Any) -> bool:  # noqa: N802 - OMPL's name
        """Return whether the straight motion is valid, both ends included (RRT, RRTstar and
        KPIECE1 test no state of it themselves)."""
        self.checks += 1
        qa, qb = self._reader.read_pair(s1, s2)
        if not self._is_valid(qb):
            return False
        if self._any_wraps:
            qb = nearest_turns(qb, qa, self._reader.wraps)
        return bool(self._check_motion(qa, qb))


def last_valid(
    checker: CheckerLike, qa: Configuration, qb: Configuration, tolerance: float = 1e-3
) -> tuple[Configuration | None, float]:
    """Return how far the straight motion from qa to qb, both (dof,), is certified valid.

    Bisects with `checker.check_motion` until the interval is `tolerance`, a fraction of the
    motion. Returns the furthest certified configuration and its fraction in [0, 1]; (None, 0.0)
    if qa itself is invalid.
    """
    qa = joint_values(qa, checker.robot, "qa")
    qb = joint_values(qb, checker.robot, "qb")
    if not checker.is_valid(qa):
        return None, 0.0
    if checker.check_motion(qa, qb):
        return qb.copy(), 1.0
    good, bad = 0.0, 1.0
    while bad - good > tolerance:
        middle = 0.5 * (good + bad)
        left, right = qa + good * (qb - qa), qa + middle * (qb - qa)
        if checker.check_motion(left, right):
            good = middle
        else:
            bad = middle
    return qa + good * (qb - qa), good
