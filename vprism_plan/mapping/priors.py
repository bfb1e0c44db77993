# SPDX-License-Identifier: BSD-3-Clause
"""The prior of the weights: variances per feature, and means that say what unseen space is."""

import math

import numpy as np
from jaxtyping import Float

from vprism_plan.mapping.config import MapConfig
from vprism_plan.mapping.em import Posterior, Prior, diagonal_prior
from vprism_plan.mapping.features import FeatureSpace


def empty_logit(occupancy: float, classes: int, variance: float) -> float:
    """Mean logit of the empty class for which a flat posterior says P(occupied) = occupancy.

    All other logits have mean 0, all have the given variance. With C = K - 1 objects and
    t = exp(m / sqrt(1 + pi/4 variance)) the approximation gives q_0 = t / (C + t) and
    q_k = 1 / (C + t) for each object, so P(empty) / P(occupied) = t / C: solved for m.
    """
    objects = classes - 1
    odds = (1.0 - occupancy) / occupancy
    return math.log(objects * odds) * math.sqrt(1.0 + math.pi / 4.0 * variance)


def prior_means(config: MapConfig, classes: int) -> tuple[float, float]:
    """Prior mean of the empty class's hinge weights and of its bias weight.

    Out of the hinges' reach only the bias acts, inside the lattice the kernels add a
    variance: each gets the mean that makes its flat prediction `config.prior_occupancy`.
    """
    if config.prior_occupancy is None:
        return 0.0, 0.0
    outside = empty_logit(config.prior_occupancy, classes, config.bias_variance)
    inside = empty_logit(
        config.prior_occupancy, classes, config.bias_variance + config.logit_variance
    )
    return (inside - outside) / config.mean_feature_sum, outside


def weight_prior(space: FeatureSpace, config: MapConfig, classes: int) -> Prior:
    """Return the prior of all weights, (M, K), independent between features and classes."""
    mean = np.zeros((space.size, classes))
    mean[:-1, 0], mean[-1, 0] = prior_means(config, classes)
    return diagonal_prior(space, mean, weight_variances(space, config))


def weight_variances(space: FeatureSpace, config: MapConfig) -> Float[np.ndarray, " m"]:
    """Return the prior variance of every weight, the bias last."""
    variance = np.full(space.size, config.weight_variance)
    variance[-1] = config.bias_variance
    return variance


def expand_prior(
    old_space: FeatureSpace,
    old: Posterior,
    space: FeatureSpace,
    config: MapConfig,
) -> Prior:
    """Make the old posterior the prior of a larger feature space.

    Hinges of `space` that the old one has keep their joint posterior; the others enter
    independent, with the configured prior.
    """
    fresh = weight_prior(space, config, old.mean.shape[1])
    position = {row.tobytes(): i for i, row in enumerate(space.hinges)}
    kept = [position[row.tobytes()] for row in old_space.hinges]
    target = np.array([*kept, space.size - 1], dtype=np.int64)
    rows = np.repeat(np.arange(old_space.size), np.arange(old_space.size) - old_space.row_first + 1)
    columns = np.arange(old_space.envelope_size) - old_space.base[rows]
    high = np.maximum(target[rows], target[columns])
    low = np.minimum(target[rows], target[columns])
    # What the new envelope leaves out are pairs too far apart to share a point: exact zeros.
    stored = low >= space.row_first[high]
    mean, precision = fresh.mean.copy(), fresh.precision.copy()
    mean[target] = old.mean
    precision[space.base[high[stored]] + low[stored]] = old.precision[stored]
    added = np.ones(space.size, dtype=bool)
    added[target] = False
    variance = weight_variances(space, config)
    return Prior(mean, precision, old.log_determinant - np.log(variance[added]).sum())
