"""Tasks that worker processes can import by name, and a sweep to kill."""

import os
import sys
import time
from pathlib import Path

from experiments.tables.sweep import Case, sweep

PAUSE = 60.0  # seconds


def square(case):
    """Answer at once; leave a trace of having been asked."""
    with Path(case.asked["trace"]).open("a") as trace:
        trace.write(f"{case.asked['x']}\n")
    if case.asked["x"] in case.asked.get("bad", ()):
        raise ValueError(f"{case.asked['x']} cannot be squared today")
    return {"square": case.asked["x"] ** 2, "pid": os.getpid(), "nan": float("nan")}


def threads(case):
    """Tell how many threads this worker would use."""
    import torch

    from vprism_plan._threads import worker_count

    return {"torch": torch.get_num_threads(), "own": worker_count(), "pid": os.getpid()}


def slowly(case):
    """Take long enough to be killed in the middle."""
    if case.asked["x"] >= 2:
        time.sleep(PAUSE)
    return square(case)


def numbered(trace, count, **more):
    """Cases 0 to count - 1."""
    return [Case(f"x={x}", {"x": x, "trace": str(trace), **more}) for x in range(count)]


if __name__ == "__main__":
    from sweep_tasks import slowly as task  # under its own name, not that of __main__

    folder = Path(sys.argv[1])
    sweep(task, numbered(folder / "trace", 4), folder / "store", jobs=1, progress=False)
