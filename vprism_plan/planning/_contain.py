# SPDX-License-Identifier: BSD-3-Clause
"""Keeps exceptions of a checker out of C++ threads that would not survive them.

PRM and PRMstar run a second C++ thread while they sample. An exception that leaves `solve`
destroys that thread unjoined, and the process ends with `std::terminate`. So here the first
exception is held back, every later question is answered "invalid" without asking the
checker, the search is told to stop, and whoever started it raises the exception again.
"""

from collections.abc import Callable
from typing import Any

from vprism_plan.planning.ompl_adapter import VPrismMotionValidator, VPrismStateValidityChecker


class Containment:
    """The first exception of a search.

    Attributes:
        stop: called when it is caught.
    """

    def __init__(self) -> None:
        self.stop: Callable[[], None] | None = None
        self._error: BaseException | None = None

    def ask(self, question: Callable[..., bool], *states: Any) -> bool:
        """Return the answer to a question, False once any question has raised."""
        if self._error is not None:
            return False
        try:
            return question(*states)
        except BaseException as error:  # KeyboardInterrupt would end the process, too
            self._error = error
            if self.stop is not None:
                self.stop()
            return False

    def release(self) -> None:
        """Raise what was caught."""
        self.stop = None
        error, self._error = self._error, None
        try:
            if error is not None:
                raise error
        finally:
            del error  # its traceback holds this frame: a cycle that would keep the search alive


class ContainedStates(VPrismStateValidityChecker):
    """`VPrismStateValidityChecker` that never raises."""

    def __init__(self, si: Any, checker: Any, containment: Containment) -> None:
        super().__init__(si, checker)
        self._containment = containment

    def isValid(self, state: Any, *unused: Any) -> bool:  # noqa: N802 - OMPL's name
        """Return whether `state` is valid, False once anything has raised."""
        return self._containment.ask(self._ask, state)


class ContainedMotions(VPrismMotionValidator):
    """`VPrismMotionValidator` that never raises."""

    def __init__(self, si: Any, checker: Any, containment: Containment) -> None:
        super().__init__(si, checker)
        self._containment = containment

    def checkMotion(self, s1: Any, s2: Any, *unused: Any) -> bool:  # noqa: N802 - OMPL's name
        """Return whether the motion is valid, False once anything has raised."""
        return self._containment.ask(super().checkMotion, s1, s2)
