# SPDX-License-Identifier: BSD-3-Clause
"""Means over scenes and how sure they are: bootstrap intervals, paired differences.

Scenes are what is drawn at random, so scenes are what is drawn again: objects of one scene
hide one another and are not independent.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from experiments.metrics import Reliability, ReliabilityBin
from experiments.reconstruction import ReconstructionScores
from experiments.scene_truth import PARTS
from experiments.stored import Stored
from vprism_plan.errors import ConfigError

RESAMPLES = 4999
CONFIDENCE = 0.95
Statistic = Callable[[Int[np.ndarray, "*batch n"]], Float[np.ndarray, "*batch"]]


@dataclass(frozen=True)
class Estimate(Stored):
    """A figure over scenes and its 95 percent bootstrap interval.

    `low` and `high` are NaN with fewer than two scenes, or where a draw leaves the figure
    undefined.
    """

    value: float
    low: float
    high: float


def estimate(statistic: Statistic, scenes: int, seed: int = 0) -> Estimate:
    """Return a statistic of all scenes with its percentile bootstrap interval.

    Args:
        statistic: from scene numbers (..., n) to the figure over those scenes (...).
        scenes: how many there are.
        seed: of the draws; the same for the same interval.
    """
    everything = np.arange(scenes)
    value = float(statistic(everything)) if scenes else math.nan
    if scenes < 2 or math.isnan(value):
        return Estimate(value, math.nan, math.nan)
    from scipy.stats import bootstrap

    interval = bootstrap(
        (everything,),
        lambda drawn, axis: statistic(drawn),
        vectorized=True,
        axis=-1,
        n_resamples=RESAMPLES,
        batch=500,
        confidence_level=CONFIDENCE,
        method="percentile",
        random_state=np.random.default_rng([seed, 0xB007]),
    ).confidence_interval
    return Estimate(value, float(interval.low), float(interval.high))


def ratio(top: Float[np.ndarray, " n"], bottom: Float[np.ndarray, " n"]) -> Statistic:
    """Return the statistic sum(top) / sum(bottom): a mean over everything in the scenes."""

    def statistic(scenes: Int[np.ndarray, "*batch n"]) -> Float[np.ndarray, "*batch"]:
        over, under = top[scenes].sum(axis=-1), bottom[scenes].sum(axis=-1)
        return np.divide(over, under, out=np.full(np.shape(over), np.nan), where=under > 0)

    return statistic


def over_scenes(tables: Sequence[Reliability]) -> tuple[ReliabilityBin, ...]:
    """Return the bins of all scenes together with intervals that hold for cases that are alike.

    `Reliability.rows` takes every case for an independent one; neighbouring voxels of a scene,
    or paths through it, are not. Here scenes are drawn again (draws that leave a bin empty say
    nothing of it), and an interval ends where the farther of the two ends: a bootstrap knows
    nothing of what no scene shows.

    Args:
        tables: one per scene, with equal numbers of bins.
    """
    counts = np.array([table.counts for table in tables], dtype=float)
    positives = np.array([table.positives for table in tables], dtype=float)
    rng = np.random.default_rng([0, 0xB007])
    drawn = rng.integers(0, len(tables), (RESAMPLES, len(tables)))
    tail = 50.0 * (1.0 - CONFIDENCE)
    rows = []
    for row in Reliability.merged(tables).rows():
        b = round(row.lower * counts.shape[1])
        observed = ratio(positives[:, b], counts[:, b])(drawn)
        low, high = np.nanpercentile(observed, [tail, 100.0 - tail])
        rows.append(replace(row, low=min(row.low, float(low)), high=max(row.high, float(high))))
    return tuple(rows)


class SceneScores:
    """One method's scores of the same scenes, scene by scene, as arrays that can be drawn from.

    Args:
        scenes: scores of each scene, in the order that all methods share; at least one.
    """

    def __init__(self, scenes: Sequence[ReconstructionScores]) -> None:
        if not scenes:
            raise ConfigError("there are no scenes to summarise; ask for at least one")
        self.scenes = tuple(scenes)
        self.all = ReconstructionScores.merged(scenes)
        self._counts = np.array([[p.counts for p in s.parts] for s in scenes], dtype=float)
        self._gaps = np.array(
            [[np.subtract(p.predicted, p.positives) for p in s.parts] for s in scenes]
        )
        self._errors = np.array([[p.squared_error for p in s.parts] for s in scenes])
        self._entropy = np.array([s.entropy for s in scenes])

    def __len__(self) -> int:
        return len(self.scenes)

    def iou(self) -> Statistic:
        """Mean IoU over objects."""
        values = [np.array([o.iou for o in s.objects]) for s in self.scenes]
        return ratio(*_sums(values))

    def chamfer(self, other: "SceneScores | None" = None) -> Statistic:
        """Mean Chamfer distance (m) over objects that are not lost, nor lost to `other`."""
        own = [np.array([o.chamfer for o in s.objects]) for s in self.scenes]
        if other is not None:
            for values, theirs in zip(own, other.scenes, strict=True):
                values[[o.lost for o in theirs.objects]] = np.nan
        return ratio(*_sums(own))

    def brier(self, parts: Sequence[int]) -> Statistic:
        """Mean squared error of P(occupied) over the grid points of some `PARTS`."""
        chosen = _checked(parts)
        return ratio(self._errors[:, chosen].sum(axis=1), self._counts[:, chosen].sum(axis=(1, 2)))

    def ece(self, parts: Sequence[int]) -> Statistic:
        """Expected calibration error of P(occupied) over the grid points of some `PARTS`."""
        chosen = _checked(parts)
        gaps = self._gaps[:, chosen].sum(axis=1)
        count = self._counts[:, chosen].sum(axis=(1, 2))

        def statistic(scenes: Int[np.ndarray, "*batch n"]) -> Float[np.ndarray, "*batch"]:
            over = np.abs(gaps[scenes].sum(axis=-2)).sum(axis=-1)
            under = count[scenes].sum(axis=-1)
            return np.divide(over, under, out=np.full(np.shape(over), np.nan), where=under > 0)

        return statistic

    def entropy(self, parts: Sequence[int]) -> Statistic:
        """Mean entropy (nats) over the grid points of some `PARTS`."""
        chosen = _checked(parts)
        return ratio(self._entropy[:, chosen].sum(axis=1), self._counts[:, chosen].sum(axis=(1, 2)))


def difference(a: Statistic, b: Statistic) -> Statistic:
    """Return a - b over the same scenes."""
    return lambda scenes: a(scenes) - b(scenes)


def saving(a: Statistic, b: Statistic) -> Statistic:
    """Return by which share a lies below b over the same scenes: 1 - a / b."""

    def statistic(scenes: Int[np.ndarray, "*batch n"]) -> Float[np.ndarray, "*batch"]:
        over, under = a(scenes), b(scenes)
        return 1.0 - np.divide(over, under, out=np.full(np.shape(over), np.nan), where=under > 0)

    return statistic


def _sums(
    values: Sequence[Float[np.ndarray, " k"]],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Sum and number of the values of each scene that are not NaN."""
    return (
        np.array([np.nansum(v) for v in values]),
        np.array([np.count_nonzero(~np.isnan(v)) for v in values], dtype=float),
    )


def _checked(parts: Sequence[int]) -> list[int]:
    if not parts or not set(parts) <= set(range(len(PARTS))):
        raise ConfigError(f"parts is {list(parts)}; name some of 0 to {len(PARTS) - 1}")
    return list(parts)
