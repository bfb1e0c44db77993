# SPDX-License-Identifier: BSD-3-Clause
"""Statements about methods, decided by the numbers: which of the paper's hold here, and ours."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

from experiments.baselines import METHODS, method
from experiments.stored import Stored
from experiments.tables.intervals import (
    Estimate,
    SceneScores,
    Statistic,
    difference,
    estimate,
    saving,
)

Metric = Literal["iou", "chamfer", "brier", "ece"]
# Parts of space as reports name them; what lies outside support, seen or not, is one.
REPORTED = {"visible": (0,), "occluded": (1,), "outside support": (2, 3)}


@dataclass(frozen=True)
class Claim:
    """In every pair the first method is better than the second, by at least `least`.

    Attributes:
        text: the statement.
        pairs: keys of (better, worse) methods.
        metric: IoU (a difference), Chamfer (the share that is saved), Brier or ECE (a
            difference, where lower is better).
        part: of `REPORTED`, for Brier and ECE.
        least: the gain that is claimed; 0 for any.
    """

    text: str
    pairs: tuple[tuple[str, str], ...]
    metric: Metric
    part: str = "occluded"
    least: float = 0.0


@dataclass(frozen=True)
class Verdict(Stored):
    """What the numbers say of a claim.

    Attributes:
        answer: "yes" where the whole interval of every pair says so, "no" where that of any
            pair says the opposite; otherwise "yes in the mean" or "not in the mean".
        gain: of the pair that decides, with its interval; above 0 is better. Of those that
            give the answer it is the one whose interval reaches lowest.
        pair: that pair.
    """

    answer: str
    gain: Estimate
    pair: tuple[str, str]


def gain(
    better: SceneScores, worse: SceneScores, metric: Metric, part: str = "occluded"
) -> Statistic:
    """Return by how much one method beats another over the same scenes (see `Claim.metric`).

    Chamfer distances are compared on the objects that both reconstruct.
    """
    if metric == "iou":
        return difference(better.iou(), worse.iou())
    if metric == "chamfer":
        return saving(better.chamfer(worse), worse.chamfer(better))
    parts = REPORTED[part]
    if metric == "brier":
        return difference(worse.brier(parts), better.brier(parts))
    return difference(worse.ece(parts), better.ece(parts))


def decide(claim: Claim, scores: Mapping[str, SceneScores]) -> Verdict:
    """Return what the scores of all methods on one set say of a claim."""
    found = []
    for better, worse in claim.pairs:
        a, b = scores[better], scores[worse]
        found.append(estimate(gain(a, b, claim.metric, claim.part), len(a)))
    answers = [_answer(one, claim.least) for one in found]
    answer = min(answers, key=_WORST_FIRST.index)
    deciding = [i for i, own in enumerate(answers) if own == answer]
    index = min(deciding, key=lambda i: _lowest(found[i]))
    return Verdict(answer, found[index], claim.pairs[index])


# One pair to the contrary refutes a claim; one that is undefined keeps it from being decided.
_WORST_FIRST = ("no", "undefined", "not in the mean", "yes in the mean", "yes")


def _lowest(found: Estimate) -> float:
    """Lower end of the interval; of a single scene, the figure itself."""
    return found.value if math.isnan(found.low) else found.low


def _answer(found: Estimate, least: float) -> str:
    if math.isnan(found.value):
        return "undefined"
    if found.low > least:
        return "yes"
    if found.high < least:
        return "no"
    # Without an interval, or with one around the claim, only the mean can be told.
    return "yes in the mean" if found.value >= least and found.value != 0 else "not in the mean"


def claims_of(table: str, methods: Sequence[str]) -> tuple[Claim, ...]:
    """Return the claims of a table that can be decided with these methods."""
    made = {"baselines": _of_baselines, "sampling": _of_sampling, "presets": _of_presets}
    every = made[table](methods)
    return tuple(c for c in every if c.pairs and {k for p in c.pairs for k in p} <= set(methods))


def _of_baselines(methods: Sequence[str]) -> list[Claim]:
    claims = []
    for key in ("vprism-paper", "vprism"):
        others = [k for k in methods if k in METHODS and not k.startswith("vprism")]
        if key == "vprism-paper" and "network" in others:
            others.remove("network")  # which the paper does not know
        continuous = [k for k in others if method(k).continuous]
        name = method(key).label
        # The paper compares with the first two alone.
        for group, keys in (
            ("PointSDF", ["pointsdf"]),
            ("the voxel heuristic", ["voxel"]),
            ("OctoMap", ["octomap"]),
            ("every continuous baseline", continuous),
        ):
            pairs = tuple((key, other) for other in keys)
            claims += [
                Claim(f"{name}: higher IoU than {group}", pairs, "iou"),
                Claim(f"{name}: lower Chamfer than {group}", pairs, "chamfer"),
            ]
        pairs = tuple((key, other) for other in others)
        claims += [
            Claim(
                f"{name}: lower Brier score in occluded space than every baseline", pairs, "brier"
            ),
            Claim(f"{name}: lower ECE in occluded space than every baseline", pairs, "ece"),
        ]
    return claims


def _of_sampling(_: Sequence[str]) -> list[Claim]:
    full = "vprism-paper"
    others = ("bhm-sampling", "no-under-table", "no-stratified")
    pairs = tuple((full, other) for other in others)
    by_iou = (full, "no-under-table", "bhm-sampling", "no-stratified")
    by_chamfer = (full, "no-under-table", "no-stratified", "bhm-sampling")
    names = " > ".join(_short(k) for k in by_iou)
    distances = " < ".join(_short(k) for k in by_chamfer)
    return [
        Claim("The paper's sampling: higher IoU than every ablation", pairs, "iou"),
        Claim("The paper's sampling: lower Chamfer than every ablation", pairs, "chamfer"),
        Claim(f"The paper's order of IoU: {names}", _chain(by_iou), "iou"),
        Claim(f"The paper's order of Chamfer: {distances}", _chain(by_chamfer), "chamfer"),
    ]


def _of_presets(_: Sequence[str]) -> list[Claim]:
    pair = (("vprism", "vprism-paper"),)
    claims = [
        Claim("Default preset: at least 0.10 more IoU than the paper's", pair, "iou", least=0.10),
        Claim(
            "Default preset: at least 15 % less Chamfer than the paper's",
            pair, "chamfer", least=0.15,
        ),
    ]  # fmt: skip
    for part in REPORTED:
        where = part if part == "outside support" else f"in {part} space"
        claims += [
            Claim(f"Default preset: lower Brier score {where}", pair, "brier", part),
            Claim(f"Default preset: lower ECE {where}", pair, "ece", part),
        ]
    finer = (("vprism-fine", "vprism"),)
    return [
        *claims,
        Claim("Fine preset: higher IoU than the default", finer, "iou"),
        Claim("Fine preset: lower Brier score in occluded space than the default", finer, "brier"),
    ]


def _chain(keys: Sequence[str]) -> tuple[tuple[str, str], ...]:
    return tuple(pairwise(keys))


def _short(key: str) -> str:
    return {"vprism-paper": "full"}.get(key, key)
