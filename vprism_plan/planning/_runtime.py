# SPDX-License-Identifier: BSD-3-Clause
"""OMPL's process-wide settings: console log and random seed."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from ompl import util as ou

from vprism_plan.errors import PlanningError

MAX_SEED = 2**32 - 2
_lock = threading.Lock()
_quiet_depth = 0
_saved_level: Any = None


@contextmanager
def quiet_ompl() -> Iterator[None]:
    """Silence OMPL's console log inside the block and restore its level afterwards.

    The level is global to the process. Blocks may nest or overlap between threads:
    the first one in saves the level, the last one out restores it.
    """
    global _quiet_depth, _saved_level  # noqa: PLW0603 - OMPL's level is global itself
    with _lock:
        if _quiet_depth == 0:
            _saved_level = ou.getLogLevel()
            ou.setLogLevel(ou.LogLevel.LOG_NONE)
        _quiet_depth += 1
    try:
        yield
    finally:
        with _lock:
            _quiet_depth -= 1
            if _quiet_depth == 0:
                ou.setLogLevel(_saved_level)


def seed_ompl(seed: int) -> None:
    """Seed every OMPL generator that is created from now on.

    OMPL takes 0 as "seed from the clock", so seed s becomes s + 1. Call it before the
    state space of a query is built: generators that exist already keep their state.
    Seeding a second time in a process makes OMPL log an error about determinism that
    does not apply to generators created later, hence the silence.
    """
    with quiet_ompl():
        ou.RNG.setSeed(checked_seed(seed) + 1)


def checked_seed(seed: Any) -> int:
    """Return the seed as an int; raise PlanningError unless it is an integer from 0."""
    whole = isinstance(seed, int | np.integer) and not isinstance(seed, bool)
    if not whole or not 0 <= seed <= MAX_SEED:
        raise PlanningError(f"seed is {seed!r}; it must be an integer from 0 to {MAX_SEED}")
    return int(seed)
