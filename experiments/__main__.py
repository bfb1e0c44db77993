# SPDX-License-Identifier: BSD-3-Clause
"""One table of results, computed as far as it is missing, and written.

    python -m experiments baselines --set ycb --scenes 30

Results are kept scene by scene: started again, even after a kill, it computes only what is
missing. Needs the extra `experiments`.
"""

import argparse
import json
import logging
import math
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from vprism_plan.errors import ConfigError, VPrismError

_SCENES = {"planning": 30, "asked": 30, "uncertainty": 30}  # 100 for the others
_TABLES = ("baselines", "sampling", "presets", "uncertainty", "planning", "asked")
_SETS = ("all", "analytic", "ycb", "random", "random-train", "folder")
Command = argparse.Namespace


def main(arguments: Sequence[str] | None = None) -> int:
    """Compute and report; return the exit code: 0 done, 2 bad input (one line on stderr).

    Raises:
        SweepError: some scenes failed; all others are kept.
    """
    command = parser().parse_args(arguments)
    try:
        return _run(command)
    except VPrismError as error:
        sys.stderr.write(f"experiments: error: {' '.join(str(error).split())}\n")
        return 2


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = argparse.ArgumentParser("experiments", description=(__doc__ or "").split("\n\n")[0])
    add = made.add_argument
    what = (
        "what to compare: reconstruction by V-PRISM and others, by its negative sampling, by its "
        "presets; uncertainty by SGD; collision checkers, about vetted ends or goals from the image"
    )
    add("table", choices=_TABLES, help=what)
    add("--set", choices=_SETS, default="all", help='"all" is analytic, ycb and random')
    count = (
        "of each set, default 100, uncertainty and asked 30; of all sets together for planning, 30"
    )
    add("--scenes", type=int, help=count)
    add("--first-seed", type=int, default=1000, help="0 to 99 are for tuning; default 1000")
    add("--methods", nargs="+", default=[], metavar="KEY", help="only these rows, in this order")
    add("--data", type=Path, help="folder of meshes (m) for --set folder, or of the YCB objects")
    add("--store", type=Path, help="keeps every result; default build/evaluation")
    add("--output", type=Path, help="for Markdown, JSON and pictures; default docs/results")
    add("--jobs", type=int, default=2, help="processes, one thread each; default 2")
    add("--backend", choices=("loky", "dask", "ray"), default="loky", help="where they run")
    add("--cluster", metavar="ADDRESS", help="of Dask or Ray; default: one is started here")
    add("--json", action="store_true", help="print one JSON object instead of text")
    return made


def _run(command: Command) -> int:
    from experiments.generation import SETS
    from experiments.tables.store import require_writable

    _check(command)
    kinds = SETS if command.set == "all" else (command.set,)
    scenes = _SCENES.get(command.table, 100) if command.scenes is None else command.scenes
    root = Path(__file__).resolve().parents[1]
    store = root / "build" / "evaluation" if command.store is None else command.store
    output = root / "docs" / "results" if command.output is None else command.output
    require_writable(output)
    if command.output is None:
        total = scenes if command.table == "planning" else scenes * len(kinds)
        _keep_larger(output / f"{command.table}.json", total)
    runs = {"planning": _planning, "asked": _asked, "uncertainty": _uncertainty}
    own = command.table if command.table in runs else "reconstruction"
    asked = {
        "kinds": kinds, "scenes": scenes, "first_seed": command.first_seed, "data": command.data,
        "store": store / own, "output": output, "command": command_line(command),
        "jobs": command.jobs, "backend": command.backend, "cluster": command.cluster,
    }  # fmt: skip
    with _log_lines():
        run = runs.get(command.table, _reconstruction)
        payload, lines, files = run(command.table, command.methods, asked)
    payload = {
        "table": command.table, "sets": list(kinds), "scenes": scenes,
        "first_seed": command.first_seed, "command": command_line(command), **payload,
        "files": [str(file) for file in files],
    }  # fmt: skip
    names = ", ".join(file.name for file in files)
    text = json.dumps(payload) if command.json else "\n".join([*lines, f"wrote {output}/: {names}"])
    sys.stdout.write(f"{text}\n")
    return 0


def _check(command: Command) -> None:
    if command.methods and command.table == "uncertainty":
        raise ConfigError("--methods does not go with uncertainty; leave it out")
    if command.set == "folder" and command.data is None:
        raise ConfigError("--set folder needs --data, the folder of meshes")
    if command.first_seed < 0:
        raise ConfigError(f"--first-seed is {command.first_seed}; it must be at least 0")
    if command.cluster is not None and command.backend == "loky":
        raise ConfigError("--cluster needs --backend dask or ray; loky runs on this machine")


def _keep_larger(file: Path, scenes: int) -> None:
    """Refuse to replace, where no output is named, the report of more scenes."""
    if not file.is_file():
        return
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
        there = (
            sum(found["about"]["kinds"].values())
            if file.stem in ("planning", "asked")
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


def command_line(command: Command) -> str:
    """Return the shortest call that gives the same results; FOLDER stands for a folder."""
    words = ["python", "-m", "experiments", command.table]
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
    log = logging.getLogger("experiments")
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


def _reconstruction(table: str, methods: Sequence[str], asked: dict[str, Any]) -> Report:
    """Run one of the tables of reconstruction."""
    from experiments.tables.reconstruction import run

    results, files = run(table, methods=methods, **asked)
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


def _planning(_: str, checkers: Sequence[str], asked: dict[str, Any]) -> Report:
    """Run the planning benchmark; scenes are shared out among the sets."""
    from experiments.planning_benchmark.report import benchmark

    figures, files = benchmark(checkers=checkers or None, **asked)
    lines = [
        f"{key}: success {row['success']['value']:.3f}, true collisions "
        f"{row['collision']['value'] if row['collision']['value'] is not None else math.nan:.3f}"
        for key, row in figures["contenders"].items()
    ]
    return {"contenders": figures["contenders"], "claims": figures["statements"]}, lines, files


def _asked(_: str, checkers: Sequence[str], asked: dict[str, Any]) -> Report:
    """Ask for goals that were proposed from the image."""
    from experiments.planning_benchmark.asked import benchmark

    figures, files = benchmark(checkers=checkers or None, **asked)
    lines = [
        f"{key}: of {row['asked']} answered {row['answered']}, true collisions {row['collided']}"
        for key, row in figures["contenders"].items()
    ]
    return {name: figures[name] for name in ("contenders", "calibration")}, lines, files


def _uncertainty(_: str, __: Sequence[str], asked: dict[str, Any]) -> Report:
    """Compare V-PRISM's uncertainty with a point estimate's."""
    from experiments.tables.uncertainty import run

    figures, files = run(**asked)
    return {"figures": figures}, [], files


if __name__ == "__main__":
    sys.exit(main())
