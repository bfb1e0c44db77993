# SPDX-License-Identifier: BSD-3-Clause
"""The answers as a log of OMPL's benchmarks, which Planner Arena and OMPL's own script read.

The format is that of OMPL's documentation of benchmarks: a header, then for each planner its
properties, one per line with its SQL type, and one line of values per run. Contenders stand
where planners do; one run is one problem.
"""

import datetime
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.planning_benchmark.asking import Answer, Limits
from experiments.planning_benchmark.contenders import full_label
from experiments.planning_benchmark.summary import Outcome
from vprism_plan._files import write_text

_STATUS = (
    "exact", "approximate", "timeout", "invalid_start", "invalid_goal", "verification_failed",
    "too_risky",
)  # fmt: skip
_PROPERTIES = (
    ("status", "ENUM"),
    ("solved", "BOOLEAN"),
    ("correct solution", "BOOLEAN"),
    ("time", "REAL"),
    ("search time", "REAL"),
    ("solution length", "REAL"),
    ("tip travel", "REAL"),
    ("truly collides", "BOOLEAN"),
    ("penetration", "REAL"),
    ("scene", "INTEGER"),
    ("problem", "INTEGER"),
)


def log_text(found: Sequence[Outcome], name: str, limits: Limits, setup: str, date: str) -> str:
    """Return the log; `setup` are lines on what was asked, `date` is in ISO 8601."""
    runs = sum(len(scene) for scene in found[0].answers) if found else 0
    total = sum(answer.processor for outcome in found for answer in outcome.all)
    lines = [
        "OMPL version 2.0.1",
        f"Experiment {name.replace(' ', '_')}",
        "0 experiment properties",
        f"Running on {platform.machine() or 'unknown'}",
        f"Starting at {date}",
        "<<<|", *setup.splitlines(), "|>>>",
        "<<<|", platform.processor() or "unknown", "|>>>",
        "0 is the random seed",
        f"{limits.time_limit:g} seconds per run",
        "0 MB per run",
        f"{runs} runs per planner",
        f"{total:.3f} seconds spent to collect the data",
        "1 enum type",
        "|".join(("status", *_STATUS)),
        f"{len(found)} planners",
    ]  # fmt: skip
    for outcome in found:
        lines += [
            full_label(outcome.contender).replace("|", "/"),
            "2 common properties",
            f"key = {outcome.contender.key}",
            f"planner = {limits.planner}",
            f"{len(_PROPERTIES)} properties for each run",
            *(f"{prop} {kind}" for prop, kind in _PROPERTIES),
            f"{runs} runs",
        ]
        for number, scene in enumerate(outcome.answers):
            lines += ["".join(f"{v}; " for v in _values(answer, number)) for answer in scene]
        lines.append(".")
    return "\n".join(lines) + "\n"


def _values(answer: Answer, scene: int) -> tuple[Any, ...]:
    """One run's values, empty where there is none."""
    truth = answer.truth
    return (
        _STATUS.index(answer.status),
        int(answer.solved),
        int(truth is not None and not truth.collides),
        f"{answer.processor:.6f}",
        f"{answer.searched:.6f}",
        "" if answer.length is None else f"{answer.length:.6f}",
        "" if answer.travel is None else f"{answer.travel:.6f}",
        "" if truth is None else int(truth.collides),
        "" if truth is None else f"{truth.depth:.6f}",
        scene,
        answer.number,
    )


def write_log(path: Path, found: Sequence[Outcome], name: str, limits: Limits, setup: str) -> None:
    """Write `log_text` of now, whole or not at all."""
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    write_text(path, log_text(found, name, limits, setup, now))
