# SPDX-License-Identifier: BSD-3-Clause
"""How many worker threads this process may use.

Kernels release the GIL and are run over chunks by a small thread pool. That keeps
`fork` safe, which numba's parallel loops (GNU OpenMP) do not, and leaves one knob.
"""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

_Result = TypeVar("_Result")


def worker_count() -> int:
    """Return the number of threads for chunked kernels, at least 1.

    `VPRISM_PLAN_THREADS` overrides it; otherwise it is the number of processors
    this process may run on, at most 8 (beyond that memory bandwidth is the limit).
    """
    override = os.environ.get("VPRISM_PLAN_THREADS")
    if override is not None:
        if not override.isdigit() or int(override) < 1:
            from vprism_plan.errors import ConfigError

            raise ConfigError(
                f"VPRISM_PLAN_THREADS is {override!r}; it must be a whole number of at least 1"
            )
        return int(override)
    return max(1, min(8, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1))


def chunks(n: int, size: int) -> Iterator[slice]:
    """Yield slices that cover range(n) in pieces of at most `size`."""
    for start in range(0, n, size):
        yield slice(start, min(n, start + size))


def run_chunked(work: Callable[[slice], None], n: int, size: int) -> None:
    """Call `work(slice)` for every chunk of range(n), in threads; re-raise the first error.

    `work` must write only to its own slice of preallocated outputs, so the result
    does not depend on the number of threads.
    """
    pieces = list(chunks(n, size))
    workers = min(worker_count(), len(pieces))
    if workers <= 1:
        for piece in pieces:
            work(piece)
        return
    with ThreadPoolExecutor(workers) as pool:
        for future in [pool.submit(work, piece) for piece in pieces]:
            future.result()


@contextmanager
def beside(work: Callable[[], _Result]) -> Iterator[Callable[[], _Result]]:
    """Call `work` while the block runs, if there are threads for both; what the block gets returns
    the result, or raises what `work` did."""
    if worker_count() == 1:
        yield work
    else:
        with ThreadPoolExecutor(1) as pool:
            yield pool.submit(work).result
