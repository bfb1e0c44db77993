# SPDX-License-Identifier: BSD-3-Clause
"""Map settings against each other on tuning scenes: what a new default is chosen by.

Tuning scenes have seeds 0 to 99, those of the tables 1000 and up; what wins here has to be
confirmed there. Of the tables' objects only those of `random` were never tuned on
(`random-train` has others): `ycb` and `analytic` are held out by scene, not by object.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from experiments.baselines import Method
from experiments.reconstruction import ReconstructionScores
from experiments.tables import scoring
from experiments.tables.claims import Metric, gain
from experiments.tables.intervals import Estimate, SceneScores, estimate
from experiments.tables.sweep import Case, sweep
from vprism_plan.errors import ConfigError
from vprism_plan.mapping import MapConfig, fit_map

SETS = ("analytic", "ycb", "random-train")
LAST_SEED = 99  # of the tuning scenes


def score_settings(case: Case) -> dict[str, object]:
    """Fit a scene with the settings that are asked for and score the map: a task for `sweep`."""
    settings = dict(case.asked["config"])
    settings["hinge_shift"] = tuple(settings["hinge_shift"])
    config = MapConfig(**settings)
    chosen = Method("tuned", "tuned", lambda seen, seed: fit_map(seen, config, seed))
    return scoring.scored(case, chosen)


@dataclass(frozen=True)
class Row:
    """What one setting gains over the reference on one set; above 0 is better.

    Attributes:
        name: of the setting.
        iou, chamfer: of the setting itself; m, over objects that it and the reference found.
        gains: of IoU, Chamfer (share saved), Brier score and ECE in occluded space.
        seconds: mean processor time of a fit.
    """

    name: str
    iou: float
    chamfer: float
    gains: tuple[Estimate, ...]
    seconds: float


def compare(
    settings: Mapping[str, MapConfig],
    kind: str,
    seeds: Sequence[int],
    store: Path,
    **how: Any,
) -> list[Row]:
    """Return what each setting gains over the first one, scene by scene; `how` as in `sweep`.

    Raises:
        ConfigError: a seed is not one for tuning, the set is not one of `SETS`, or nothing
            is to be compared.
    """
    if kind not in SETS:
        raise ConfigError(f"set {kind!r} is not for tuning; valid: {', '.join(SETS)}")
    wrong = [seed for seed in seeds if not 0 <= seed <= LAST_SEED]
    if wrong or not seeds or not settings:
        raise ConfigError(
            f"seeds {wrong or list(seeds)} with {len(settings)} settings; tuning takes seeds 0 "
            f"to {LAST_SEED} and at least one setting"
        )
    cases = [
        Case(
            f"{kind}-{seed}-{name}",
            {
                "scene": scoring.scene_question(kind, seed),
                "config": asdict(config),
                "scores": scoring.SCORES,
            },
            scoring.whereabouts(kind),
        )
        for seed in seeds
        for name, config in settings.items()
    ]
    answers = sweep(score_settings, cases, store, group=scoring.scene_of, **how)
    count, n = len(settings), len(seeds)
    scores = [
        SceneScores([ReconstructionScores.from_dict(a["scores"]) for a in answers[i::count]])
        for i in range(count)
    ]
    reference = scores[0]
    rows = []
    for i, name in enumerate(settings):
        own = scores[i]
        metrics: tuple[Metric, ...] = ("iou", "chamfer", "brier", "ece")
        gains = tuple(estimate(gain(own, reference, metric), n) for metric in metrics)
        spent = [a["seconds"]["fit"] for a in answers[i::count]]
        iou, chamfer = (estimate(s, n).value for s in (own.iou(), own.chamfer(reference)))
        rows.append(Row(name, iou, chamfer, gains, sum(spent) / len(spent)))
    return rows
