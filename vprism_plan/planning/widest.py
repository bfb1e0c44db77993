# SPDX-License-Identifier: BSD-3-Clause
"""Keep as far from everything as a path can: margins in turn, the widest first."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from vprism_plan.errors import PlanningError
from vprism_plan.planning._clock import clock_named
from vprism_plan.planning._protocol import CheckerLike
from vprism_plan.planning.goals import ReachRegion
from vprism_plan.planning.planner import plan
from vprism_plan.planning.result import PlanResult

EXTRA = (0.02, 0.01, 0.005, 0.0)


@runtime_checkable
class MarginChecker(CheckerLike, Protocol):
    """A checker whose margin can be widened."""

    def with_extra_margin(self, extra: float) -> Any:
        """The same checker with `extra` metres more margin."""


def plan_widest(
    checker: CheckerLike,
    start: ArrayLike | Sequence[float],
    goal: ArrayLike | Sequence[float] | ReachRegion,
    extra: Sequence[float] = EXTRA,
    time_limit: float | int = 5.0,
    *,
    clock: str = "wall",
    **options: Any,
) -> PlanResult:
    """Plan with the widest margin for which a path is found.

    A map's surface is nowhere exact, least behind what the camera saw; a fixed margin that
    allows for that refuses problems which have no room for it. Here every margin gets an
    equal share of the time that is left, the widest first, and the first path found is
    returned: with room to spare it keeps away, in a narrow place it goes through.

    Args:
        checker: a `CollisionChecker`, or anything with `with_extra_margin`.
        start: see `plan`.
        goal: see `plan`.
        extra: metres beyond the checker's own margin, decreasing, none below 0. Put 0 last,
            or problems that only the checker's own margin allows stay unsolved.
        time_limit: seconds for all searches together, more than 0; on `clock`.
        clock: "wall" or "process", see `plan`.
        **options: of `plan`.

    Returns:
        The first solved `PlanResult`, its `message` names the margin; if there is none, the
        last one, which is the most permissive checker's answer.

    Raises:
        PlanningError: as `plan`, or for margins that do not decrease or a checker whose
            margin cannot be widened.
    """
    steps = np.asarray(extra, dtype=np.float64)
    bad = steps.ndim != 1 or len(steps) == 0 or not np.isfinite(steps).all()
    if bad or (steps < 0.0).any() or (np.diff(steps) >= 0.0).any():
        raise PlanningError(
            f"extra is {extra!r}; it must hold decreasing margins of at least 0 m, such as {EXTRA}"
        )
    if not isinstance(checker, MarginChecker):
        raise PlanningError(
            f"a {type(checker).__name__} has no with_extra_margin; give a CollisionChecker"
        )
    now, left = clock_named(clock), float(time_limit)
    result: PlanResult | None = None
    for number, step in enumerate(steps.tolist()):
        judge = checker.with_extra_margin(step) if step > 0.0 else checker
        share = left / (len(steps) - number) if left > 0.0 else time_limit / len(steps)
        began = now()
        result = plan(judge, start, goal, time_limit=share, clock=clock, **options)
        left -= now() - began
        if result.solved:
            kept = f"{1000.0 * step:g} mm beyond the checker's margin"
            return replace(result, message=f"{result.message}; kept {kept}")
    assert result is not None
    return result


__all__ = ["EXTRA", "plan_widest"]
