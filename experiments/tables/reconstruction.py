# SPDX-License-Identifier: BSD-3-Clause
"""The tables of reconstruction: which methods, on which scenes, and what is said of them.

    run("baselines", kinds=("ycb",), scenes=100, output=Path("docs/results"))

Every answer is kept per scene and method, for all tables together: a method that two tables
share is computed once, and one that is added later makes nothing else run again.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.reconstruction import ReconstructionScores
from experiments.tables import scoring
from experiments.tables.claims import claims_of, decide
from experiments.tables.intervals import SceneScores
from experiments.tables.report import write_report
from experiments.tables.results import SetResults, Table, TableResults
from experiments.tables.store import Case, require_writable
from experiments.tables.sweep import sweep_complete
from vprism_plan.errors import ConfigError

TABLES = {
    table.key: table
    for table in (
        Table(
            "baselines",
            "Reconstruction: V-PRISM and the systems it is compared with",
            "Table I of the paper, with more systems: every method sees the same single depth "
            "image and the same object labels. The point estimate and the sigmoid maps learn from "
            "the points and features of our default preset, so that only the method differs.",
            (
                "voxel",
                "octomap",
                "sgd",
                "sigmoid",
                "pointsdf",
                "network",
                "vprism-paper",
                "vprism-flat",
                "vprism",
            ),
            "vprism",
        ),
        Table(
            "sampling",
            "Reconstruction: what the parts of the negative sampling bring",
            "Table II of the paper: the paper's preset, whole and with parts of its sampling "
            "replaced or left out.",
            ("bhm-sampling", "vprism-paper", "no-under-table", "no-stratified"),
            "vprism-paper",
        ),
        Table(
            "presets",
            "Reconstruction: our presets against the paper's",
            "The settings of Table III of the paper, the default of this package, and its finer "
            "and slower variant.",
            ("vprism-paper", "vprism", "vprism-fine"),
            "vprism-paper",
        ),
    )
}


def run(
    key: str,
    *,
    kinds: Sequence[str],
    scenes: int = 100,
    first_seed: int = 1000,
    methods: Sequence[str] = (),
    data: Path | None = None,
    store: Path,
    output: Path,
    command: str = "",
    **how: Any,
) -> tuple[TableResults, list[Path]]:
    """Compute what is missing of a table, write its report; return results and files.

    Args:
        key: of `TABLES`.
        kinds: sets of scenes (see `generation.source`).
        scenes, first_seed: seeds first_seed to first_seed + scenes - 1 of each set.
        methods: some of the table's, or others instead; empty for all of the table.
        data: folder of meshes, for the sets that need one.
        store: folder of answers, shared by all tables.
        output: folder of KEY.md, KEY.json and pictures.
        command: that reprints this, for the report.
        how: jobs, backend, cluster, progress: see `sweep`.

    Raises:
        ConfigError: unknown table, set or method, no scene, missing data, or a folder that
            cannot be written.
        SweepError: some scenes failed. The report is written without them (and names them)
            before this is raised, unless no scene of a set is left.
    """
    table = chosen_table(key)
    chosen = tuple(methods) or table.methods
    scoring.check_sets(kinds, scenes, data)
    require_writable(output)
    seeds = range(first_seed, first_seed + scenes)
    cases = scoring.cases_of_sets(kinds, seeds, chosen, data)
    cases, answers, failed = sweep_complete(
        scoring.score, cases, store, group=scoring.scene_of, **how
    )
    if failed is not None and {scoring.scene_of(case)[0] for case in cases} != set(kinds):
        raise failed
    sets = tuple(_collected(kind, cases, answers) for kind in kinds)
    results = TableResults(
        table, chosen, seeds, sets, command,
        {
            claim.text: {found.kind: decide(claim, found.scores) for found in sets}
            for claim in claims_of(key, chosen)
        },
        () if failed is None else tuple(f"{f.name}: {f.error}" for f in failed.failures),
    )  # fmt: skip
    files = write_report(results, output)
    if failed is not None:
        raise failed
    return results, files


def chosen_table(key: str) -> Table:
    """Return the table of that key; ConfigError naming the keys if there is none."""
    if key not in TABLES:
        raise ConfigError(f"there is no table {key!r}; valid: {', '.join(TABLES)}")
    return TABLES[key]


def _collected(kind: str, cases: Sequence[Case], answers: Sequence[dict[str, Any]]) -> SetResults:
    """Put the answers of one set together.

    Raises:
        ConfigError: methods were stored that saw different scenes of one seed.
    """
    found: dict[str, dict[int, dict[str, Any]]] = {}
    for case, answer in zip(cases, answers, strict=True):
        own, seed = scoring.scene_of(case)
        if own == kind:
            found.setdefault(case.asked["method"]["key"], {})[seed] = answer
    base, first = next(iter(found.items()))
    for key, by_seed in found.items():
        for seed, answer in by_seed.items():
            if answer["seen"] != first[seed]["seen"]:
                raise ConfigError(
                    f"stored answers of {key} and {base} are about different scenes {kind} {seed}: "
                    "the generator has changed between them; remove the store, or raise "
                    "experiments.scoring.SCENES"
                )
    return SetResults(
        kind,
        tuple(first),
        tuple(int(answer["objects"]) for answer in first.values()),
        {
            key: SceneScores([ReconstructionScores.from_dict(a["scores"]) for a in own.values()])
            for key, own in found.items()
        },
        {key: _cost(list(own.values())) for key, own in found.items()},
        frozenset(str(a["commit"]) for own in found.values() for a in own.values()),
    )


def _cost(answers: Sequence[dict[str, Any]]) -> tuple[float, float]:
    """Median seconds of a fit, and mean microseconds of predicting a point."""
    points = max(1, sum(a["predicted_points"] for a in answers))
    return (
        float(np.median([a["seconds"]["fit"] for a in answers])),
        1e6 * sum(a["seconds"]["predict"] for a in answers) / points,
    )
