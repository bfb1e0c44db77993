# SPDX-License-Identifier: BSD-3-Clause
"""The two clocks by which a search can be limited and measured."""

import time
from collections.abc import Callable
from typing import Any

from ompl import base as ob

from vprism_plan.errors import PlanningError

Now = Callable[[], float]

# Processor time is that of the whole process, worker threads included.
# Times the limit after which a search by processor time ends by the wall clock: OMPL sleeps
# while it waits for goals, which spends none. A machine that busy would be no help anyway.
PATIENCE = 50.0
_CLOCKS: dict[str, Now] = {"wall": time.perf_counter, "process": time.process_time}


def clock_named(name: str) -> Now:
    """Return the function that reads a clock, seconds; raise PlanningError for an unknown name."""
    if name not in _CLOCKS:
        raise PlanningError(
            f"clock is {name!r}; valid values are 'wall' (time that passes) and 'process' "
            "(processor time of this process, which other load does not inflate)"
        )
    return _CLOCKS[name]


def time_is_up(name: str, seconds: float) -> Any:
    """Return an OMPL termination condition that holds `seconds` from now on a clock.

    With processor time it also holds after `PATIENCE` times as much time has passed.
    """
    if name == "wall":
        # The form without an interval reads the clock itself: no extra thread, no overshoot.
        return ob.timedPlannerTerminationCondition(seconds)
    now = clock_named(name)
    end = now() + seconds
    asleep = time.perf_counter() + PATIENCE * seconds
    return ob.PlannerTerminationCondition(lambda: now() >= end or time.perf_counter() >= asleep)
