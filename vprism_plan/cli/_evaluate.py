# SPDX-License-Identifier: BSD-3-Clause
"""The command `eval`: one table of results, computed as far as it is missing, and written."""

import json
import logging
import math
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from vprism_plan.cli._commands import Eval
from vprism_plan.cli._console import Console
from vprism_plan.errors import ConfigError

_SCENES = {"planning": 30, "uncertainty": 30}  # 100 for the others


def run_eval(command: Eval, console: Console) -> int:
    """Compute and report; exit code 0.

    Raises:
        ConfigError: an option that does not fit the table, missing data, a folder that cannot
            be written, or a report of more scenes that would be replaced unasked.
        SweepError: some scenes failed; all others are kept.
    """
    from vprism_plan.evaluation.experiments.store import require_writable
    from vprism_plan.evaluation.generation import SETS

    _check(command)
    kinds = SETS if command.set == "all" else (command.set,)
    scenes = _SCENES.get(command.table, 100) if command.scenes is None else command.scenes
    root = _checkout()
    base = Path.cwd() if root is None else root
    store = base / "build" / "evaluation" if command.store is None else command.store
    results = base / "results" if root is None else root / "docs" / "results"
    output = results if command.output is None else command.output
    require_writable(output)
    if command.output is None:
        _keep_larger(output / f"{command.table}.json", _total(command.table, kinds, scenes))
    with console.stage(command.table), _log_lines():
        payload, lines, files = _TABLES.get(command.table, _reconstruction)(
            command, kinds, scenes, store, output
        )
    payload = {
        "table": command.table, "sets": list(kinds), "scenes": scenes,
        "first_seed": command.first_seed, "command": command_line(command), **payload,
        "files": files, "timings": console.timings,
    }  # fmt: skip
    names = ", ".join(file.name for file in files)
    console.finish(payload, [*lines, f"wrote {output}/: {names}"])
    return 0


def _check(command: Eval) -> None:
    if command.methods and command.table == "uncertainty":
        raise ConfigError("--methods does not go with uncertainty; leave it out")
    if command.set == "folder" and command.data is None:
        raise ConfigError("--set folder needs --data, the folder of meshes")
    if command.first_seed < 0:
        raise ConfigError(f"--first-seed is {command.first_seed}; it must be at least 0")
    if command.cluster is not None and command.backend == "loky":
        raise ConfigError("--cluster needs --backend dask or ray; loky runs on this machine")


def _total(table: str, kinds: tuple[str, ...], scenes: int) -> int:
    """Return the scenes of all sets together."""
    return scenes if table == "planning" else scenes * len(kinds)


def _keep_larger(file: Path, scenes: int) -> None:
    """Refuse to replace, where no output is named, the report of more scenes."""
    if not file.is_file():
        return
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
        there = (
            sum(found["about"]["kinds"].values())
            if file.stem == "planning"
            else sum(own["scenes"] for own in found["sets"].values())
        )
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(
            f"{file} is no report of this program ({error!r}); remove it, or name another "
            "folder by --output"
        ) from error
    if scenes < there:
        raise ConfigError(
            f"{file} is of {there} scenes and would be replaced by a report of {scenes}; ask for "
            "as many, or name another folder by --output"
        )


def _checkout() -> Path | None:
    """Return the checkout that this package runs from; None if it is installed elsewhere."""
    root = Path(__file__).resolve().parents[2]
    return root if (root / "pyproject.toml").is_file() and (root / "docs").is_dir() else None


def command_line(command: Eval) -> str:
    """Return the shortest call that gives the same results; FOLDER stands for a folder."""
    words = ["vprism-plan", "eval", command.table]
    if command.set != "all":
        words += ["--set", command.set]
    if command.scenes is not None:
        words += ["--scenes", str(command.scenes)]
    if command.first_seed != 1000:
        words += ["--first-seed", str(command.first_seed)]
    if command.methods:
        words += ["--methods", *command.methods]
    if command.data is not None:
        words += ["--data", "FOLDER"]  # where it lies says nothing to others
    return shlex.join(words)


@contextmanager
def _log_lines() -> Iterator[None]:
    """Where no terminal shows a bar, let the experiments say how far they are."""
    log = logging.getLogger("vprism_plan.evaluation.experiments")
    if sys.stderr.isatty():
        yield
        return
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(asctime)s %(message)s", "%H:%M:%S"))
    before = log.level
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    try:
        yield
    finally:
        log.removeHandler(handler)
        log.setLevel(before)


Report = tuple[dict[str, Any], list[str], list[Path]]


def _reconstruction(
    command: Eval, kinds: tuple[str, ...], scenes: int, store: Path, output: Path
) -> Report:
    """Run one of the tables of reconstruction."""
    from vprism_plan.evaluation.experiments.tables import run

    results, files = run(
        command.table, kinds=kinds, scenes=scenes, first_seed=command.first_seed,
        methods=command.methods, data=command.data, store=store / "reconstruction",
        output=output, jobs=command.jobs, backend=command.backend, cluster=command.cluster,
        command=command_line(command),
    )  # fmt: skip
    claims = [
        {"claim": text, "set": kind, **verdict.to_dict()}
        for text, verdicts in results.verdicts.items()
        for kind, verdict in verdicts.items()
    ]
    means = {
        found.kind: {
            key: {"iou": s.all.mean_iou, "chamfer": s.all.mean_chamfer, "lost": s.all.lost}
            for key, s in found.scores.items()
        }
        for found in results.sets
    }
    lines = [
        f"{kind} {key}: IoU {row['iou']:.3f}, Chamfer {1000 * row['chamfer']:.1f} mm"
        + (f", {row['lost']} lost" if row["lost"] else "")
        for kind, rows in means.items()
        for key, row in rows.items()
    ]
    return {"means": means, "claims": claims}, lines, files


def _planning(
    command: Eval, kinds: tuple[str, ...], scenes: int, store: Path, output: Path
) -> Report:
    """Run the planning benchmark; `scenes` are shared out among the sets."""
    from vprism_plan.evaluation.planning_benchmark.report import benchmark

    figures, files = benchmark(
        kinds, scenes, command.first_seed, checkers=command.methods or None, data=command.data,
        store=store / "planning", output=output, jobs=command.jobs, backend=command.backend,
        cluster=command.cluster, command=command_line(command),
    )  # fmt: skip
    lines = [
        f"{key}: success {row['success']['value']:.3f}, true collisions "
        f"{row['collision']['value'] if row['collision']['value'] is not None else math.nan:.3f}"
        for key, row in figures["contenders"].items()
    ]
    return {"contenders": figures["contenders"], "claims": figures["statements"]}, lines, files


def _uncertainty(
    command: Eval, kinds: tuple[str, ...], scenes: int, store: Path, output: Path
) -> Report:
    """Compare V-PRISM's uncertainty with a point estimate's."""
    from vprism_plan.evaluation.experiments.uncertainty import run

    figures, files = run(
        kinds, scenes, command.first_seed, data=command.data, store=store / "uncertainty",
        output=output, jobs=command.jobs, backend=command.backend, cluster=command.cluster,
        command=command_line(command),
    )  # fmt: skip
    return {"figures": figures}, [], files


_TABLES: dict[str, Any] = {"planning": _planning, "uncertainty": _uncertainty}
