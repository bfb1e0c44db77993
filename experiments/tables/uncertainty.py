# SPDX-License-Identifier: BSD-3-Clause
"""Does a map know what it cannot see? Entropy in occluded against observed space.

The paper shows heat maps of five real scenes. Here the same question also has numbers: on
generated scenes, where the truth is known, and on those frames, where visibility is.
"""

import math
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from experiments.baselines import method
from experiments.protocols import Reconstruction
from experiments.reconstruction import class_entropy
from experiments.scene_truth import (
    OCCLUDED,
    OCCLUDED_OUTSIDE,
    SPACING,
    VISIBLE,
    VISIBLE_OUTSIDE,
    NodeUnion,
    what_is_known,
)
from experiments.tables import scoring
from experiments.tables.backends import one_thread
from experiments.tables.intervals import estimate
from experiments.tables.store import Case, require_writable
from experiments.tables.sweep import sweep
from vprism_plan.errors import ConfigError
from vprism_plan.mapping.training_data import box_centers
from vprism_plan.perception.observation import Observation

METHODS = ("sgd", "network", "vprism", "vprism-flat", "vprism-paper")
REAL_VARIABLE = "VPRISM_PLAN_REAL"
_VERSION = 1  # of `compare`; raised by hand when its meaning changes
_LEAST = 1e-6  # probability that the logarithm of the truth's is cut off at

# Figures per scene: what they say of a method, and whether more is better.
FIGURES = {
    "entropy_observed": "mean entropy, observed (nats)",
    "entropy_occluded": "mean entropy, occluded (nats)",
    "auc_occluded": "AUC, occluded against observed",
    "auc_everywhere": "AUC, outside support too",
    "auc_wrong": "AUC, wrong against right",
    "log_loss_observed": "log loss, observed (nats)",
    "log_loss_occluded": "log loss, occluded (nats)",
}


def area_under_curve(values: Float[np.ndarray, " n"], positive: Bool[np.ndarray, " n"]) -> float:
    """Return the chance that a positive has the larger value than a negative, ties one half.

    NaN without positives or without negatives.
    """
    from scipy.stats import rankdata

    n = int(positive.sum())
    if n == 0 or n == len(positive):
        return math.nan
    ranks = rankdata(values)
    return float((ranks[positive].sum() - 0.5 * n * (n + 1)) / (n * (len(positive) - n)))


def figures_of(
    proba: Float[np.ndarray, "n k"],
    part: UInt8[np.ndarray, " n"],
    truth: "np.ndarray | None" = None,
) -> dict[str, float]:
    """Return the figures of one method on one scene, NaN where there are no points.

    Args:
        proba: probabilities of empty and of each object at grid points.
        part: of `scene_truth.PARTS`.
        truth: column that is true at each point, -1 for none; None leaves out what needs it.
    """
    entropy = class_entropy(proba)
    observed, occluded = part == VISIBLE, part == OCCLUDED
    near = observed | occluded
    hidden = occluded | (part == OCCLUDED_OUTSIDE)
    every = near | (part == VISIBLE_OUTSIDE) | hidden
    found = {
        "entropy_observed": _mean(entropy[observed]),
        "entropy_occluded": _mean(entropy[occluded]),
        "auc_occluded": area_under_curve(entropy[near], occluded[near]),
        "auc_everywhere": area_under_curve(entropy[every], hidden[every]),
    }
    if truth is not None:
        judged = truth >= 0
        wrong = proba.argmax(axis=1) != truth
        loss = -np.log(np.maximum(proba[np.arange(len(proba)), truth], _LEAST))
        found["auc_wrong"] = area_under_curve(entropy[near & judged], wrong[near & judged])
        found["log_loss_observed"] = _mean(loss[observed & judged])
        found["log_loss_occluded"] = _mean(loss[occluded & judged])
    return found


def compare(case: Case) -> dict[str, Any]:
    """Fit one method to one scene and measure its entropy: a task for `sweep`."""
    scene, truth = scoring.prepared(case)
    found = method(case.asked["method"]["key"]).fit(scene.observation, scene.seed)
    proba = np.asarray(found.predict_proba(truth.grid.points()), dtype=np.float64)
    # Where a wholly hidden object is, no column is right.
    column_of = np.full(int(truth.ids.max(initial=0)) + 1, -1)
    column_of[0] = 0
    for column, k in enumerate(found.object_ids, start=1):
        if k < len(column_of):
            column_of[k] = column
    right = np.where(truth.ids >= 0, column_of[truth.ids], -1)
    values = figures_of(proba, truth.part, right)
    return {"figures": _plain(values), "commit": scoring.commit()}


def run(
    kinds: Sequence[str],
    scenes: int = 30,
    first_seed: int = 1000,
    *,
    data: Path | None = None,
    store: Path,
    output: Path,
    command: str = "",
    real: Path | None = None,
    **how: Any,
) -> tuple[dict[str, Any], list[Path]]:
    """Compare the entropy of V-PRISM with a point estimate's; return figures and files.

    Arguments and errors as those of `tables.reconstruction.run`, but a failure ends it. `real`
    is a folder of real depth images; None looks where $VPRISM_PLAN_REAL says, and in
    ../shared/data/real beside the checkout. Without any they are left out.
    """
    from experiments.tables import uncertainty_report as report

    scoring.check_sets(kinds, scenes, data)
    require_writable(output)
    seeds = range(first_seed, first_seed + scenes)
    cases = [
        replace(one, asked={**one.asked, "scores": _VERSION})
        for one in scoring.cases_of_sets(kinds, seeds, METHODS, data)
    ]
    answers = sweep(compare, cases, store, group=scoring.scene_of, **how)
    with one_thread():  # as the workers that computed the answers
        frames = real_observations(real)
        fits = [{key: method(key).fit(seen, 0) for key in METHODS} for _, seen in frames]
        real_figures = _real_figures(frames, fits)
    figures = {
        "command": command,
        "commits": sorted({str(answer["commit"]) for answer in answers}),
        "seeds": [seeds[0], seeds[-1]],
        "sets": {kind: _set_figures(kind, cases, answers) for kind in kinds},
        "real": real_figures,
    }
    with one_thread():
        return figures, report.write(figures, kinds, first_seed, data, frames, fits, output)


def _set_figures(
    kind: str, cases: Sequence[Case], answers: Sequence[dict[str, Any]]
) -> dict[str, Any]:
    """Every figure of every method on a set: mean over scenes with its interval."""
    rows: dict[str, dict[str, Any]] = {}
    values: dict[str, dict[str, np.ndarray]] = {}
    for key in METHODS:
        own = [
            answer["figures"]
            for case, answer in zip(cases, answers, strict=True)
            if case.asked["scene"]["set"] == kind and case.asked["method"]["key"] == key
        ]
        values[key] = {name: _column(own, name) for name in FIGURES}
        rows[key] = {
            name: estimate(_mean_of(column), len(column)).to_dict()
            for name, column in values[key].items()
        }
    gains = {
        key: {
            name: estimate(_mean_of(values[key][name] - values["sgd"][name]), len(own)).to_dict()
            for name in FIGURES
        }
        for key in METHODS
        if key != "sgd"
    }
    return {"scenes": len(own), "methods": rows, "against_sgd": gains}


def _real_figures(
    frames: Sequence[tuple[str, Observation]], fits: Sequence[dict[str, Reconstruction]]
) -> dict[str, Any]:
    """What needs no truth, of every frame."""
    found = {}
    for (name, seen), methods in zip(frames, fits, strict=True):
        points = grid_around(seen)
        part = what_is_known(seen, points)
        found[name] = {
            key: _plain(figures_of(np.asarray(made.predict_proba(points)), part))
            for key, made in methods.items()
        }
    return found


def grid_around(seen: Observation) -> Float[np.ndarray, "n 3"]:
    """Return the grid points (m) around the observed objects' boxes, as around true objects."""
    points, labels = seen.points()
    lower, upper = box_centers(points, labels, seen.require_objects(), 0.01)
    return NodeUnion.around(0.5 * (lower + upper), SPACING, shift=0.5).points()


def real_observations(folder: Path | None = None) -> list[tuple[str, Observation]]:
    """Return name and view of every real depth image, segmented, in a frame on its table.

    An empty list if no folder is given and none is where they usually are.

    Raises:
        ConfigError: the folder that was named holds none.
    """
    from vprism_plan.perception import align_to_table, load_observation, segment_tabletop

    named = folder or os.environ.get(REAL_VARIABLE)
    beside = Path(__file__).resolve().parents[3] / "shared" / "data" / "real"
    paths = sorted(Path(named or beside).glob("frame*-depth.png"))
    if named and not paths:
        raise ConfigError(f"there are no depth images frame*-depth.png in {named}")
    return [
        (
            path.name.removesuffix("-depth.png"),
            align_to_table(segment_tabletop(load_observation(path), seed=0), seed=0),
        )
        for path in paths
    ]


def _mean(values: Float[np.ndarray, " n"]) -> float:
    return float(values.mean()) if len(values) else math.nan


def _mean_of(column: Float[np.ndarray, " n"]) -> Any:
    """Statistic: mean over the scenes that have the figure."""

    def statistic(scenes: np.ndarray) -> np.ndarray:
        drawn = column[scenes]
        there = ~np.isnan(drawn)
        count = there.sum(axis=-1)
        total = np.where(there, drawn, 0.0).sum(axis=-1)
        return np.divide(total, count, out=np.full(np.shape(total), np.nan), where=count > 0)

    return statistic


def _column(own: Sequence[dict[str, Any]], name: str) -> Float[np.ndarray, " n"]:
    return np.array([math.nan if row[name] is None else row[name] for row in own])


def _plain(values: dict[str, float]) -> dict[str, float | None]:
    return {name: None if math.isnan(value) else value for name, value in values.items()}
