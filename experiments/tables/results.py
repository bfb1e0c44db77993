# SPDX-License-Identifier: BSD-3-Clause
"""What a table found: its answers on every set, and every figure of them with its interval."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments.baselines import method
from experiments.tables.claims import REPORTED, Verdict, gain
from experiments.tables.intervals import SceneScores, estimate


@dataclass(frozen=True)
class Table:
    """A comparison of methods, in the order of its rows, with one of them scene by scene."""

    key: str
    title: str
    about: str
    methods: tuple[str, ...]
    reference: str


@dataclass(frozen=True, eq=False)
class SetResults:
    """One set of scenes.

    Attributes:
        kind: which set.
        seeds: of the scenes, in order.
        objects: labelled objects of each scene, hidden ones included.
        scores: of each method, scene by scene.
        costs: of each method: median processor seconds per fit, microseconds per
            predicted point.
        commits: that computed any of it.
    """

    kind: str
    seeds: tuple[int, ...]
    objects: tuple[int, ...]
    scores: dict[str, SceneScores]
    costs: dict[str, tuple[float, float]]
    commits: frozenset[str]


@dataclass(frozen=True, eq=False)
class TableResults:
    """A table on all its sets.

    Attributes:
        table: what was compared.
        methods: rows, in order.
        seeds: that were asked for, of every set.
        sets: what was found.
        command: that reprints it.
        verdicts: by the text of a claim and the kind of a set.
        left_out: what failed, in a line each; these scenes count for no method.
    """

    table: Table
    methods: tuple[str, ...]
    seeds: range
    sets: tuple[SetResults, ...]
    command: str
    verdicts: dict[str, dict[str, Verdict]]
    left_out: tuple[str, ...] = ()


def summary(results: TableResults) -> dict[str, Any]:
    """Return every figure of a table with its interval, ready for JSON."""
    return {
        "table": results.table.key,
        "command": results.command,
        "seeds": [results.seeds[0], results.seeds[-1]],
        "left_out": list(results.left_out),
        "commits": sorted({c for found in results.sets for c in found.commits}),
        "sets": {found.kind: _set_summary(found, results) for found in results.sets},
        "claims": [
            {"claim": text, **{kind: verdict.to_dict() for kind, verdict in verdicts.items()}}
            for text, verdicts in results.verdicts.items()
        ],
    }


def _set_summary(found: SetResults, results: TableResults) -> dict[str, Any]:
    reference = found.scores.get(results.table.reference)
    rows = {}
    for key, scores in found.scores.items():
        n = len(scores)
        row: dict[str, Any] = {
            "label": method(key).label,
            "level": method(key).level,
            "iou": estimate(scores.iou(), n).to_dict(),
            "chamfer": estimate(scores.chamfer(), n).to_dict(),
            "lost": scores.all.lost,
            "fit_seconds": found.costs[key][0],
            "predict_microseconds": found.costs[key][1],
            "brier": {p: estimate(scores.brier(c), n).to_dict() for p, c in REPORTED.items()},
            "ece": {p: estimate(scores.ece(c), n).to_dict() for p, c in REPORTED.items()},
            "entropy": {p: estimate(scores.entropy(c), n).to_dict() for p, c in REPORTED.items()},
            "reliability": [part.to_dict() for part in scores.all.parts],
            "scenes": [
                {"seed": seed, "iou": _plain(s.mean_iou), "chamfer": _plain(s.mean_chamfer)}
                for seed, s in zip(found.seeds, scores.scenes, strict=True)
            ],
        }
        if reference is not None and reference is not scores:
            row["against_reference"] = {
                "iou": estimate(gain(scores, reference, "iou"), n).to_dict(),
                "chamfer_saved": estimate(gain(scores, reference, "chamfer"), n).to_dict(),
                "brier_occluded": estimate(gain(scores, reference, "brier"), n).to_dict(),
                "ece_occluded": estimate(gain(scores, reference, "ece"), n).to_dict(),
            }
        rows[key] = row
    some = next(iter(found.scores.values())).all
    return {
        "scenes": len(found.seeds),
        "objects": sum(found.objects),
        "judged": len(some.objects),
        "hidden": some.hidden,
        "points": {p: sum(some.parts[k].n for k in c) for p, c in REPORTED.items()},
        "methods": rows,
    }


def _plain(value: float) -> float | None:
    return None if np.isnan(value) else value
