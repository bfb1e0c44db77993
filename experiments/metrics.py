# SPDX-License-Identifier: BSD-3-Clause
"""How good probabilities are, and how well a level set fits: tables that can be added up."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from experiments.stored import Stored
from vprism_plan.collision.risk import clopper_pearson
from vprism_plan.errors import ConfigError


@dataclass(frozen=True)
class ReliabilityBin:
    """Predictions between two probabilities, and what became of them.

    `low` and `high` are the Clopper-Pearson interval of `observed` (95 percent). It holds
    for independent cases, such as paths through different scenes; neighbouring voxels are
    not, and their interval is too narrow (see `experiments.intervals.over_scenes`).
    """

    lower: float
    upper: float
    count: int
    predicted: float
    observed: float
    low: float
    high: float


@dataclass(frozen=True)
class Reliability(Stored):
    """Predicted probabilities against outcomes, in bins of equal width.

    Bin b of B holds b / B <= p < (b + 1) / B, the last one also p = 1. Tables of separate
    data with the same number of bins add up to that of all data.

    Attributes:
        counts: predictions per bin.
        predicted: sum of the predictions per bin.
        positives: events that happened, per bin.
        squared_error: sum of (p - y)^2 over everything.
    """

    counts: tuple[int, ...]
    predicted: tuple[float, ...]
    positives: tuple[int, ...]
    squared_error: float

    @classmethod
    def of(
        cls, probability: Float[np.ndarray, " n"], happened: Bool[np.ndarray, " n"], bins: int = 10
    ) -> "Reliability":
        """Sort predictions (n,) and outcomes (n,) into `bins` bins.

        Raises:
            ConfigError: shapes differ, a value is not a probability, or no bin is asked for.
        """
        p = np.asarray(probability, dtype=np.float64)
        y = np.asarray(happened, dtype=bool)
        if bins < 1:
            raise ConfigError(f"bins is {bins}; a reliability table needs at least 1")
        if p.ndim != 1 or p.shape != y.shape:
            raise ConfigError(f"predictions {p.shape} and outcomes {y.shape} must both be (n,)")
        if not ((p >= 0.0) & (p <= 1.0 + 1e-9)).all():
            raise ConfigError("a prediction is not a probability: NaN, below 0 or above 1")
        index = np.minimum((p * bins).astype(np.int64), bins - 1)
        return cls(
            tuple(np.bincount(index, minlength=bins).tolist()),
            tuple(np.bincount(index, weights=p, minlength=bins).tolist()),
            tuple(np.bincount(index[y], minlength=bins).tolist()),
            float(((p - y) ** 2).sum()),
        )

    @classmethod
    def merged(cls, tables: Iterable["Reliability"]) -> "Reliability":
        """Return the table of all the data together; at least one table, equal numbers of bins."""
        tables = list(tables)
        if not tables or len({len(table.counts) for table in tables}) != 1:
            raise ConfigError("merged needs at least one table, all with the same number of bins")
        return cls(
            tuple(sum(column) for column in zip(*(t.counts for t in tables), strict=True)),
            tuple(sum(column) for column in zip(*(t.predicted for t in tables), strict=True)),
            tuple(sum(column) for column in zip(*(t.positives for t in tables), strict=True)),
            sum(table.squared_error for table in tables),
        )

    @property
    def n(self) -> int:
        """Number of predictions."""
        return sum(self.counts)

    @property
    def mean_predicted(self) -> float:
        """Mean prediction; NaN without any."""
        return sum(self.predicted) / self.n if self.n else float("nan")

    @property
    def mean_observed(self) -> float:
        """Share of events that happened; NaN without predictions."""
        return sum(self.positives) / self.n if self.n else float("nan")

    @property
    def brier(self) -> float:
        """Mean squared error of the predictions; NaN without any."""
        return self.squared_error / self.n if self.n else float("nan")

    @property
    def ece(self) -> float:
        """Expected calibration error: the mean over predictions of |observed - predicted|,
        each taken over the prediction's bin; NaN without any."""
        if not self.n:
            return float("nan")
        gaps = zip(self.predicted, self.positives, strict=True)
        return sum(abs(p - y) for p, y in gaps) / self.n

    def rows(self) -> tuple[ReliabilityBin, ...]:
        """Return the bins that hold anything."""
        bins, found = len(self.counts), []
        for b, count in enumerate(self.counts):
            if count:
                low, high = clopper_pearson(count, 0.95)
                k = self.positives[b]
                found.append(
                    ReliabilityBin(
                        b / bins, (b + 1) / bins, count, self.predicted[b] / count,
                        k / count, float(low[k]), float(high[k]),
                    )
                )  # fmt: skip
        return tuple(found)


def object_iou(
    found: Int[np.ndarray, " n"], true: Int[np.ndarray, " n"], object_ids: Iterable[int]
) -> dict[int, float]:
    """Return the intersection over union of each object, over a common set of points.

    Args:
        found: (n,) id of the object that the level set puts at each point, 0 for none.
        true: (n,) id of the object that is there.
        object_ids: the objects to compare; one with no point on either side gives NaN.
    """
    found, true = np.asarray(found), np.asarray(true)
    if found.shape != true.shape:
        raise ConfigError(f"found {found.shape} and true {true.shape} must have one shape")
    result = {}
    for k in object_ids:
        union = int(((found == k) | (true == k)).sum())
        both = int(((found == k) & (true == k)).sum())
        result[int(k)] = both / union if union else float("nan")
    return result
