# SPDX-License-Identifier: BSD-3-Clause
"""Compute many cases in parallel, keep every answer at once, go on where a run was stopped.

    answers = sweep(task, [Case("scene 3", {"seed": 3}), ...], Path("build/evaluation/mine"))

An answer is kept as soon as it is there. Started again with the same questions, even after
a kill, a sweep reads what is done and computes the rest.
"""

import logging
import os
import time
import traceback
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from experiments.tables.backends import one_thread, parallel, use_one_thread
from experiments.tables.store import Case, Store, require_writable
from vprism_plan.errors import ConfigError, VPrismError

_log = logging.getLogger(__name__)
_LINE_EVERY = 30.0  # seconds between two lines of progress where no terminal shows a bar

Task = Callable[[Case], dict[str, Any]]


@dataclass(frozen=True)
class Failure:
    """A case that raised: its name, the error in one line, where, and whether input is to blame."""

    name: str
    error: str
    traceback: str
    of_input: bool


class SweepError(RuntimeError):
    """Some cases raised; the answers of all others are kept. `failures` has each of them."""

    def __init__(self, failures: Sequence[Failure], total: int) -> None:
        self.failures = tuple(failures)
        super().__init__(
            f"{len(failures)} of {total} cases failed (the others are kept): "
            + "; ".join(f"{f.name}: {f.error}" for f in failures[:5])
            + (f"; and {len(failures) - 5} more" if len(failures) > 5 else "")
        )


class SweepInputError(SweepError, VPrismError):
    """As `SweepError`, where every failure says that its input cannot be used."""


# Answers stay under the names that their tasks had when the first were stored.
_FORMERLY = {
    "experiments.tables.": "vprism_plan.evaluation.experiments.",
    "experiments.planning_benchmark.": "vprism_plan.evaluation.planning_benchmark.",
}


def filed_as(task: Task) -> str:
    """Return the name under which the answers of a task are stored."""
    name = f"{task.__module__}.{task.__qualname__}"
    for now, then in _FORMERLY.items():
        name = name.replace(now, then, 1) if name.startswith(now) else name
    return name


def sweep(
    task: Task,
    cases: Sequence[Case],
    store: Path,
    *,
    jobs: int = 2,
    backend: str = "loky",
    progress: bool = True,
    group: Callable[[Case], Hashable] | None = None,
    cluster: Any = None,
) -> list[dict[str, Any]]:
    """Return the answers to all cases, in their order, computing those that are not stored.

    Args:
        task: module-level function from a case to a dict of JSON values. All that it depends
            on is in `Case.asked`: its name and that are the key of a stored answer.
        cases: no two may ask the same.
        store: folder, one file per answer. On a cluster the workers write to it where they
            see the same file system; elsewhere answers are kept when their group is done.
        jobs: processes, each with one thread.
        backend: "loky" (processes here), "dask" or "ray".
        progress: show a bar on a terminal, log a line now and then elsewhere.
        group: cases with the same value run one after another in one process, so that a
            task may keep what they share (in an `lru_cache`, say) for the next.
        cluster: see `backends.parallel`.

    Raises:
        ConfigError: two cases ask the same, a question is not JSON, or something is to be
            computed and the store cannot be written.
        SweepError: after all others are done: some cases raised.
    """
    if isinstance(task, partial):
        raise ConfigError(
            f"task is {task!r}: what its arguments are would not be part of the question; "
            "pass a plain function and put them into Case.asked"
        )
    kept = Store(store, filed_as(task))
    _refuse_duplicates(kept, cases)
    answers = [kept.read(case) for case in cases]
    missing = [i for i, answer in enumerate(answers) if answer is None]
    failures: dict[int, Failure] = {}
    if missing:
        require_writable(kept.folder)
        if len(missing) < len(cases):
            _log.info("%d of %d answers were stored already", len(cases) - len(missing), len(cases))
        groups: dict[Hashable, list[int]] = {}
        for i in missing:
            groups.setdefault(i if group is None else group(cases[i]), []).append(i)
        done = _computed(task, cases, list(groups.values()), kept, backend, jobs, cluster)
        with _watched(len(cases), len(missing), progress) as advance:
            for number, outcome in done:
                if isinstance(outcome, Failure):
                    failures[number] = outcome
                    _log.error("%s failed: %s", outcome.name, outcome.error)
                else:
                    answers[number] = outcome
                    # A worker elsewhere wrote it there; here is no file, or still a damaged one.
                    if kept.read(cases[number]) is None:
                        kept.write(cases[number], outcome)
                advance(outcome)
    if failures:
        found = [failures[i] for i in sorted(failures)]
        kind = SweepInputError if all(f.of_input for f in found) else SweepError
        raise kind(found, len(cases))
    return [answer for answer in answers if answer is not None]


def sweep_complete(
    task: Task, cases: Sequence[Case], store: Path, *, group: Callable[[Case], Hashable], **how: Any
) -> tuple[list[Case], list[dict[str, Any]], SweepError | None]:
    """Return the cases of all groups without a failure, their answers, and what failed."""
    try:
        return list(cases), sweep(task, cases, store, group=group, **how), None
    except SweepError as failed:
        names = {failure.name for failure in failed.failures}
        lost = {group(case) for case in cases if case.name in names}
        kept = [case for case in cases if group(case) not in lost]
        return kept, sweep(task, kept, store, group=group, **how), failed


def _refuse_duplicates(kept: Store, cases: Sequence[Case]) -> None:
    seen: dict[str, str] = {}
    for case in cases:
        key = kept.path(case).stem[-20:]
        if key in seen:
            raise ConfigError(
                f"cases {seen[key]!r} and {case.name!r} ask the same ({case.asked!r}) and would "
                "be counted twice; leave one out"
            )
        seen[key] = case.name


Outcome = dict[str, Any] | Failure


def _computed(
    task: Task,
    cases: Sequence[Case],
    groups: list[list[int]],
    kept: Store,
    backend: str,
    jobs: int,
    cluster: Any,
) -> Iterator[tuple[int, Outcome]]:
    """Yield number and outcome of every case as the groups finish."""
    with one_thread(), parallel(backend, jobs, cluster) as pool:
        import joblib

        calls = [
            joblib.delayed(_answer_group)(task, [cases[i] for i in numbers], kept, os.getpid(), n)
            for n, numbers in enumerate(groups)
        ]
        for n, outcomes in pool(calls):
            yield from zip(groups[n], outcomes, strict=True)


def _answer_group(
    task: Task, cases: list[Case], kept: Store, parent: int, number: int
) -> tuple[int, list[Outcome]]:
    """In a worker: answer the cases of a group one by one, keeping each at once."""
    if os.getpid() != parent:
        use_one_thread()
    outcomes: list[Outcome] = []
    for case in cases:
        try:
            outcomes.append(kept.write(case, task(case)))
        except Exception as error:  # reported with all others at the end of the sweep
            line = f"{type(error).__name__}: {' '.join(str(error).split())}"
            of_input = isinstance(error, VPrismError | OSError)
            outcomes.append(Failure(case.name, line, traceback.format_exc(), of_input))
    return number, outcomes


@contextmanager
def _watched(total: int, missing: int, progress: bool) -> Iterator[Callable[[Outcome], None]]:
    """Yield what to call after each case; a bar on a terminal, lines in the log elsewhere."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    failed, done, began = 0, 0, time.monotonic()
    spoken = began
    bar = Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
        console=console, disable=not (progress and console.is_terminal),
    )  # fmt: skip
    with bar:
        row = bar.add_task("cases", total=total, completed=total - missing)

        def advance(outcome: Outcome) -> None:
            nonlocal failed, done, spoken
            failed += isinstance(outcome, Failure)
            done += 1
            bar.update(row, advance=1, description=f"{failed} failed" if failed else "cases")
            now = time.monotonic()
            if progress and bar.disable and (now - spoken > _LINE_EVERY or done == missing):
                spoken = now
                _log.info(
                    "%d of %d done, %d failed, %.1f min, about %.1f min left",
                    total - missing + done, total, failed, (now - began) / 60.0,
                    (now - began) / 60.0 / done * (missing - done),
                )  # fmt: skip

        yield advance
