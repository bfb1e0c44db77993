# SPDX-License-Identifier: BSD-3-Clause
"""Softmax EM with Bouchard's bound (section IV, algorithm 1), sparse and in float64.

Per iteration the cost is N n^2 K / 2 multiply-adds for the Gram blocks and as many for
the quadratic forms (N points, n active hinges per point, K classes), plus one Cholesky
factor and the inverse's envelope per class. Memory: two envelopes of E x K numbers
(E <= M (M + 1) / 2) and one dense matrix.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from vprism_plan._kernels import mapping as kernels
from vprism_plan._threads import run_chunked, worker_count
from vprism_plan.errors import MapError
from vprism_plan.mapping.config import MapConfig
from vprism_plan.mapping.factors import invert_classes
from vprism_plan.mapping.features import BlockFeatures, FeatureSpace


@dataclass(frozen=True, eq=False)
class WeightPrior:
    """Gaussian prior of every class's weights.

    Attributes:
        mean: (M, K).
        precision: (E, K) envelope.
        log_determinant: (K,) of the precision.
    """

    mean: Float[np.ndarray, "m k"]
    precision: Float[np.ndarray, "e k"]
    log_determinant: Float[np.ndarray, " k"]


@dataclass(frozen=True, eq=False)
class Posterior:
    """Gaussian posterior of the weights, and the evidence bound after every iteration."""

    mean: Float[np.ndarray, "m k"]
    covariance: Float[np.ndarray, "e k"]
    precision: Float[np.ndarray, "e k"]
    log_determinant: Float[np.ndarray, " k"]
    history: tuple[float, ...]


def diagonal_prior(
    space: FeatureSpace, mean: Float[np.ndarray, "m k"], variance: Float[np.ndarray, " m"]
) -> WeightPrior:
    """Return independent weights with the given means, and variances shared by the classes."""
    classes = mean.shape[1]
    precision = np.zeros((space.envelope_size, classes))
    precision[space.diagonal] = (1.0 / variance)[:, None]
    return WeightPrior(mean, precision, np.full(classes, -np.log(variance).sum()))


def bouchard_lambda(xi: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """lambda(xi) = (sigmoid(xi) - 1/2) / (2 xi), with its limit 1/8 at 0."""
    small = np.abs(xi) < 1e-3
    safe = np.where(small, 1.0, xi)
    # sigmoid(x) - 1/2 = tanh(x / 2) / 2 loses no digits near 0; below, three terms of the series.
    return np.where(small, 0.125 - xi**2 / 96.0 + xi**4 / 960.0, np.tanh(0.5 * safe) / (4.0 * safe))


def update_alpha(
    mean: Float[np.ndarray, "n k"], weight: Float[np.ndarray, "n k"]
) -> Float[np.ndarray, " n"]:
    """Equation for alpha_i, as printed: a sum in the numerator; `weight` is lambda(xi)."""
    classes = mean.shape[1]
    return (0.5 * (0.5 * classes - 1.0) + (weight * mean).sum(axis=1)) / weight.sum(axis=1)


def update_xi(
    mean: Float[np.ndarray, "n k"],
    variance: Float[np.ndarray, "n k"],
    alpha: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n k"]:
    """Equation for xi_ik: the root of E[(z_ik - alpha_i)^2]."""
    return np.sqrt(variance + (mean - alpha[:, None]) ** 2)


def expected_bound(
    mean: Float[np.ndarray, "n k"],
    variance: Float[np.ndarray, "n k"],
    alpha: Float[np.ndarray, " n"],
    xi: Float[np.ndarray, "n k"],
    labels: Int[np.ndarray, " n"],
) -> float:
    """Sum over points of E_W[ln Q(y_i | x_i, W; alpha, xi)] (theorem 1)."""
    centred = mean - alpha[:, None]
    square = variance + centred**2
    terms = 0.5 * (centred - xi) + bouchard_lambda(xi) * (square - xi**2) + np.logaddexp(0.0, xi)
    own = mean[np.arange(len(labels)), labels]
    return float((own - alpha - terms.sum(axis=1)).sum())


def divergence(space: FeatureSpace, posterior: Posterior, prior: WeightPrior) -> float:
    """Sum over classes of the Kullback-Leibler divergence of the posterior from the prior."""
    classes = prior.mean.shape[1]
    trace = np.empty(classes)
    kernels.envelope_inner(
        prior.precision, posterior.covariance, space.row_first, space.base, trace
    )
    difference = posterior.mean - prior.mean
    product = np.empty_like(difference)
    kernels.envelope_product(prior.precision, space.row_first, space.base, difference, product)
    quadratic = (difference * product).sum(axis=0)
    gap = posterior.log_determinant - prior.log_determinant
    return float(0.5 * (trace + quadratic - space.size + gap).sum())


@dataclass(frozen=True, eq=False)
class _Variational:
    """The parameters of Bouchard's bound, per point and per point and class."""

    alpha: Float[np.ndarray, " n"]
    xi: Float[np.ndarray, "n k"]

    def towards(self, step: "_Variational", factor: float) -> "_Variational":
        """Go `factor` times as far as from here to `step`."""
        if factor == 1.0:
            return step
        start, stop = np.maximum(self.xi, 1e-6), np.maximum(step.xi, 1e-6)
        return _Variational(
            self.alpha + factor * (step.alpha - self.alpha), start * (stop / start) ** factor
        )


def _row_pieces(space: FeatureSpace, features: BlockFeatures) -> list[tuple[int, int]]:
    """Split the envelope rows into pieces of about equal work, for threads."""
    work = np.bincount(features.near, minlength=space.size).astype(float)
    work[:-1] *= np.maximum(1.0, np.arange(space.size - 1) - space.row_first[:-1])
    pieces = 1 if worker_count() == 1 else 4 * worker_count()
    cumulative = np.cumsum(work)
    cuts = np.searchsorted(cumulative, cumulative[-1] * np.arange(1, pieces) / pieces)
    edges = np.unique(np.concatenate(([0], cuts, [space.size])))
    return list(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True))


def _accumulate(
    space: FeatureSpace,
    features: BlockFeatures,
    weight: Float[np.ndarray, "n k"],
    out: Float[np.ndarray, "e k"],
) -> None:
    """Add sum_i weight_ik phi_i phi_i^T to `out`."""
    pieces = _row_pieces(space, features)

    def rows(chunk: slice) -> None:
        for lo, hi in pieces[chunk]:
            kernels.gram_rows(*features.arguments, weight, space.row_first, space.base, lo, hi, out)

    run_chunked(rows, len(pieces), 1)


def logit_moments(
    space: FeatureSpace,
    features: BlockFeatures,
    mean: Float[np.ndarray, "m k"],
    covariance: Float[np.ndarray, "e k"],
) -> tuple[Float[np.ndarray, "n k"], Float[np.ndarray, "n k"]]:
    """Return mean and variance of every training point's logits, in block order."""
    n, classes = len(features.order), mean.shape[1]
    m, v = np.empty((n, classes)), np.empty((n, classes))

    def blocks(chunk: slice) -> None:
        kernels.stored_moments(
            *features.arguments, chunk.start, chunk.stop,
            mean, covariance, space.row_first, space.base, m, v,
        )  # fmt: skip

    run_chunked(blocks, len(features.block_start) - 1, 256)
    return m, v


def fit_weights(
    space: FeatureSpace,
    features: BlockFeatures,
    labels: Int[np.ndarray, " n"],
    prior: WeightPrior,
    *,
    iterations: int,
    variational_updates: int = 1,
    tolerance: float = 0.0,
    relaxation: float = 1.0,
    offset: Float[np.ndarray, "n k"] | None = None,
) -> Posterior:
    """Run EM from xi = 1, alpha = 0 and return the posterior of all classes.

    `labels` (class per point, 0 is empty) and `offset` (what is added to every point's
    logits) follow the points as given, not the blocks.
    Stops after `iterations`, or when the bound rises by less than `tolerance` of itself.

    `relaxation` above 1 goes that many times as far as a step of EM: xi by the power of
    its ratio, alpha by the multiple of its change. Where that lowers the bound, the
    posterior is dropped and the plain step taken from the last good one instead, so the
    history never falls (Salakhutdinov and Roweis, "Adaptive overrelaxed bound
    optimization methods", ICML 2003). A dropped step counts as an iteration.

    Raises:
        MapError: a label is not a class, or a precision matrix cannot be factorised.
    """
    classes = prior.mean.shape[1]
    labels = np.asarray(labels)[features.order]
    if len(labels) == 0 or labels.min() < 0 or labels.max() >= classes:
        raise MapError(f"labels must be classes 0..{classes - 1}, with at least one point")
    one_hot = np.zeros((len(labels), classes))
    one_hot[np.arange(len(labels)), labels] = 1.0
    prior_information = np.empty_like(prior.mean)
    kernels.envelope_product(
        prior.precision, space.row_first, space.base, prior.mean, prior_information
    )
    offset = np.zeros((1, classes)) if offset is None else offset[features.order]
    used = _Variational(np.zeros(len(labels)), np.ones((len(labels), classes)))
    plain, relaxed = used, False
    history: list[float] = []
    posterior: Posterior | None = None
    for _ in range(iterations):
        weight = bouchard_lambda(used.xi)
        precision = prior.precision.copy()
        _accumulate(space, features, 2.0 * weight, precision)
        information = prior_information.copy()
        linear = one_hot - 0.5 + 2.0 * (used.alpha[:, None] - offset) * weight
        kernels.feature_sums(*features.arguments, linear, information)
        mean, covariance = np.empty_like(prior.mean), np.empty_like(prior.precision)
        log_determinant = invert_classes(space, precision, information, mean, covariance)
        found = Posterior(mean, covariance, precision, log_determinant, ())
        m, v = logit_moments(space, features, mean, covariance)
        m += offset
        for _ in range(variational_updates):
            alpha = update_alpha(m, weight)
            xi = update_xi(m, v, alpha)
            weight = bouchard_lambda(xi)
        bound = expected_bound(m, v, alpha, xi, labels) - divergence(space, found, prior)
        if not np.isfinite(bound):
            raise MapError("the evidence bound is not finite; lower the prior variance")
        if relaxed and bound < history[-1]:
            used, relaxed = plain, False
            continue
        posterior, plain = found, _Variational(alpha, xi)
        used, relaxed = used.towards(plain, relaxation), relaxation > 1.0
        history.append(bound)
        if len(history) > 1 and history[-1] - history[-2] <= tolerance * abs(history[-2]):
            break
    assert posterior is not None
    return Posterior(
        posterior.mean, posterior.covariance, posterior.precision,
        posterior.log_determinant, tuple(history),
    )  # fmt: skip


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


def weight_prior(space: FeatureSpace, config: MapConfig, classes: int) -> WeightPrior:
    """Return the prior of all weights, (M, K), independent between features and classes."""
    mean = np.zeros((space.size, classes))
    mean[:-1, 0], mean[-1, 0] = prior_means(config, classes)
    return diagonal_prior(space, mean, weight_variances(space, config))


def weight_variances(space: FeatureSpace, config: MapConfig) -> Float[np.ndarray, " m"]:
    """Return the prior variance of every weight, the bias last."""
    variance = np.full(space.size, config.weight_variance)
    variance[-1] = config.bias_variance
    return variance


def correction_variances(
    space: FeatureSpace, config: MapConfig, depth: Float[np.ndarray, " h"]
) -> Float[np.ndarray, " m"]:
    """Return the prior variance of every weight where they correct a guess, the bias last.

    Args:
        depth: of every hinge behind what was seen, m: from seen to hidden space the variance
            of a logit falls geometrically.
    """
    start, stop = config.prior_depths
    hidden = np.clip((depth - start) / (stop - start), 0.0, 1.0)
    assert config.prior_hidden_variance is not None
    logit = config.prior_seen_variance ** (1.0 - hidden) * config.prior_hidden_variance**hidden
    return np.append(logit / config.mean_squared_feature_sum, config.bias_variance)


def expand_prior(
    old_space: FeatureSpace,
    old: Posterior,
    space: FeatureSpace,
    fresh: WeightPrior,
) -> WeightPrior:
    """Make the old posterior the prior of a larger feature space.

    Hinges of `space` that the old one has keep their joint posterior; the others enter
    independent, with `fresh`, a diagonal prior of all of `space`.
    """
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
    gained = np.log(fresh.precision[space.diagonal][added]).sum(axis=0)
    return WeightPrior(mean, precision, old.log_determinant + gained)
