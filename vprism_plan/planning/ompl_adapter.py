# SPDX-License-Identifier: BSD-3-Clause
"""The two classes that put a V-PRISM world into anybody's OMPL program.

    si.setStateValidityChecker(VPrismStateValidityChecker(si, checker))
    si.setMotionValidator(VPrismMotionValidator(si, checker))

Both keep the state space and never the `SpaceInformation`: a Python motion validator
that holds `si` closes a reference cycle that neither side can collect.
"""

import math
from collections.abc import Callable
from threading import get_ident
from typing import Any

import numpy as np
from jaxtyping import Float
from ompl import base as ob

from vprism_plan.planning._protocol import CheckerLike
from vprism_plan.planning._spaces import StateReader
from vprism_plan.robots.kinematics import joint_values

_TURN = 2.0 * math.pi


class VPrismStateValidityChecker(ob.StateValidityChecker):
    """OMPL's question "is this state valid?", answered by a checker."""

    def __init__(self, si: Any, checker: CheckerLike) -> None:
        """Attach `checker` to the space of `si` (one dimension per joint, flat order).

        Raises PlanningError if the dimensions differ or the space is not made of
        RealVector and SO2 parts.
        """
        super().__init__(si)
        self._reader = StateReader(si.getStateSpace(), checker.robot.dof)
        self._clearance = checker.clearance
        self._ask, self._asked = _question(self._reader, checker.is_valid_buffer)

    @property
    def checks(self) -> int:
        """Number of states asked about so far."""
        return self._asked()

    def isValid(self, state: Any, *unused: Any) -> bool:  # noqa: N802 - OMPL's name
        """Return whether `state` is valid; exceptions of the checker propagate.

        OMPL dispatches its longer overloads to this name too, hence `*unused`.
        """
        return self._ask(state)

    def clearance(self, state: Any, *unused: Any) -> float:
        """Return metres to the nearest obstacle, negative inside one."""
        return float(self._clearance(self._reader.read(state).copy()))


def _question(
    reader: StateReader, is_valid: Callable[[Any], bool]
) -> tuple[Callable[[Any], bool], Callable[[], int]]:
    """Return a function that asks about a state, and one that says how often it was asked.

    This runs for every state a planner samples. Names of a closure are found in half
    the time of attributes, and comparing thread numbers costs less than thread-local
    storage: the thread that made the checker has buffers of its own.
    """
    asked = 0
    owner = get_ident()

    def count() -> int:
        return asked

    def ask_any(state: Any) -> bool:
        nonlocal asked
        asked += 1
        # The bindings accept nothing but a genuine bool.
        return bool(is_valid(reader.read(state)))

    if not reader.fast:
        return ask_any, count
    serialize, target, buffer = reader.space.serialize, *reader.private_buffer()

    def ask(state: Any) -> bool:
        nonlocal asked
        if get_ident() != owner:
            return ask_any(state)
        asked += 1
        serialize(target, state)
        return bool(is_valid(buffer))

    return ask, count


class VPrismMotionValidator(ob.MotionValidator):
    """OMPL's question "is this motion valid?", answered continuously by a checker.

    OMPL's bindings do not pass `lastValid` back, so planners that would keep the valid
    part of a blocked motion (KPIECE1) keep nothing of it; `last_valid` answers that
    question in Python. OMPL's own motion counters stay at zero for the same reason.

    Attributes:
        checks: number of motions asked about so far.
    """

    def __init__(self, si: Any, checker: CheckerLike) -> None:
        """Attach `checker` to the space of `si`; errors as for the state checker."""
        super().__init__(si)
        self.checks = 0
        self._reader = StateReader(si.getStateSpace(), checker.robot.dof)
        self._is_valid = checker.is_valid_buffer
        self._check_motion = checker.check_motion_buffer
        self._wraps = np.array(self._reader.wraps)
        self._any_wraps = bool(self._wraps.any())

    def checkMotion(self, s1: Any, s2: Any, *unused: Any) -> bool:  # noqa: N802 - OMPL's name
        """Return whether the straight motion from s1 to s2 is valid, both ends included.

        RRT, RRTstar and KPIECE1 test no other state of the motion themselves.
        """
        self.checks += 1
        qa, qb = self._reader.read_pair(s1, s2)
        if not self._is_valid(qb):
            return False
        if self._any_wraps:
            qb = nearest_turns(qb, qa, self._wraps)
        return bool(self._check_motion(qa, qb))


def nearest_turns(
    q: Float[np.ndarray, "... dof"], reference: Float[np.ndarray, " dof"], wraps: Any
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


def last_valid(
    checker: CheckerLike,
    qa: Float[np.ndarray, " dof"],
    qb: Float[np.ndarray, " dof"],
    tolerance: float = 1e-3,
) -> tuple[Float[np.ndarray, " dof"] | None, float]:
    """Return how far the straight motion from qa to qb is certified valid.

    Bisects with `checker.check_motion`, so every part up to the answer is certified.

    Args:
        checker: the checker.
        qa: start (dof,), radians or metres.
        qb: end (dof,).
        tolerance: width of the last bisection interval, as a fraction of the motion.

    Returns:
        The furthest certified configuration and its fraction in [0, 1]; (None, 0.0)
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
