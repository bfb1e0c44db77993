# SPDX-License-Identifier: BSD-3-Clause
"""Softmax EM with Bouchard's bound (section IV, algorithm 1), sparse and in float64.

Classes may be local: each has hinge points of its own, "empty" all of them. Where a class has
none, its logit is its prior's.

Per iteration the cost is N n^2 / 2 multiply-adds for the Gram blocks and as many for the
quadratic forms (N points, n active hinges per point and class), plus one Cholesky factor
and the inverse's envelope per class. Memory: two envelopes per class and one dense matrix
per thread.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int, Int64

from vprism_plan._kernels import mapping as kernels
from vprism_plan._threads import run_chunked, worker_count
from vprism_plan.errors import MapError
from vprism_plan.mapping.config import MapConfig
from vprism_plan.mapping.factors import inverse, run_per_class
from vprism_plan.mapping.features import BlockFeatures, FeatureSpace

PerPoint = Float[np.ndarray, " n"]
Classes = Int[np.ndarray, " n"]
Logits = Float[np.ndarray, "n k"]


@dataclass(frozen=True, eq=False)
class Weights:
    """Gaussian of one class's weights.

    Attributes:
        members: which features of the map the class has, sorted, the bias last.
        space: these features.
        mean: (m,).
        precision, covariance: (e,) envelopes of `space`.
        log_determinant: of the precision.
    """

    members: Int64[np.ndarray, " m"]
    space: FeatureSpace
    mean: Float[np.ndarray, " m"]
    precision: Float[np.ndarray, " e"]
    covariance: Float[np.ndarray, " e"]
    log_determinant: float


@dataclass(frozen=True, eq=False)
class Posterior:
    """Gaussian posterior of every class's weights, and the bound after every iteration."""

    classes: tuple[Weights, ...]
    history: tuple[float, ...]

    @cached_property
    def mean(self) -> Float[np.ndarray, "m k"]:
        """Means of all features, 0 where a class has no weight."""
        out = np.zeros((self.classes[0].space.size, len(self.classes)))
        for k, own in enumerate(self.classes):
            out[own.members, k] = own.mean
        return out


def diagonal_prior(
    space: FeatureSpace,
    mean: Float[np.ndarray, "m k"],
    variance: Float[np.ndarray, " m"],
    members: Bool[np.ndarray, "k m"] | None = None,
) -> tuple[Weights, ...]:
    """Return independent weights with the given means, and variances shared by the classes.

    `members` says which features each class has: all, if it is not given.
    """
    found = []
    every = np.ones(mean.shape[::-1], dtype=bool)
    for k, held in enumerate(every if members is None else members):
        index = np.flatnonzero(held)
        own = space.part(index)
        precision, covariance = np.zeros((2, own.envelope_size))
        precision[own.diagonal], covariance[own.diagonal] = 1.0 / variance[index], variance[index]
        determinant = -float(np.log(variance[index]).sum())
        found.append(Weights(index, own, mean[index, k], precision, covariance, determinant))
    return tuple(found)


def bouchard_lambda(xi: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """lambda(xi) = (sigmoid(xi) - 1/2) / (2 xi), with its limit 1/8 at 0."""
    small = np.abs(xi) < 1e-3
    safe = np.where(small, 1.0, xi)
    # sigmoid(x) - 1/2 = tanh(x / 2) / 2 loses no digits near 0; below, three terms of the series.
    return np.where(small, 0.125 - xi**2 / 96.0 + xi**4 / 960.0, np.tanh(0.5 * safe) / (4.0 * safe))


def update_alpha(mean: Logits, weight: Logits) -> PerPoint:
    """Equation for alpha_i, as printed: a sum in the numerator; `weight` is lambda(xi)."""
    classes = mean.shape[1]
    return (0.5 * (0.5 * classes - 1.0) + (weight * mean).sum(axis=1)) / weight.sum(axis=1)


def update_xi(mean: Logits, variance: Logits, alpha: PerPoint) -> Logits:
    """Equation for xi_ik: the root of E[(z_ik - alpha_i)^2]."""
    return np.sqrt(variance + (mean - alpha[:, None]) ** 2)


def expected_bound(
    mean: Logits, variance: Logits, alpha: PerPoint, xi: Logits, labels: Classes
) -> float:
    """Sum over points of E_W[ln Q(y_i | x_i, W; alpha, xi)] (theorem 1)."""
    centred = mean - alpha[:, None]
    square = variance + centred**2
    terms = 0.5 * (centred - xi) + bouchard_lambda(xi) * (square - xi**2) + np.logaddexp(0.0, xi)
    own = mean[np.arange(len(labels)), labels]
    return float((own - alpha - terms.sum(axis=1)).sum())


def divergence(posterior: Weights, prior: Weights) -> float:
    """Kullback-Leibler divergence of the posterior from the prior."""
    rows = prior.space.row_first, prior.space.base
    trace = kernels.envelope_inner(prior.precision, posterior.covariance, *rows)
    difference = posterior.mean - prior.mean
    product = np.empty_like(difference)
    kernels.envelope_product(prior.precision, *rows, difference, product)
    gap = posterior.log_determinant - prior.log_determinant
    return float(0.5 * (trace + difference @ product - prior.space.size + gap))


@dataclass(frozen=True, eq=False)
class _Variational:
    """The parameters of Bouchard's bound, per point and per point and class."""

    alpha: Float[np.ndarray, " n"]
    xi: Logits

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


def _maximised(
    prior: Sequence[Weights], features: Sequence[BlockFeatures], weight: Logits, linear: Logits
) -> list[Weights]:
    """Return the posteriors whose precision is the prior's and sum_i weight_ik phi_i phi_i^T."""
    precisions = [own.precision.copy() for own in prior]
    columns = np.ascontiguousarray(weight.T)
    pieces = [
        (k, *rows)
        for k, own in enumerate(prior)
        for rows in _row_pieces(own.space, features[k])
    ]  # fmt: skip

    def rows(chunk: slice) -> None:
        for k, lo, hi in pieces[chunk]:
            space = prior[k].space
            kernels.gram_rows(
                *features[k].arguments, columns[k], space.row_first, space.base, lo, hi,
                precisions[k],
            )  # fmt: skip

    run_chunked(rows, len(pieces), 1)
    information = np.ascontiguousarray(linear.T)
    found: list[Weights | None] = [None] * len(prior)

    def invert(k: int) -> None:
        own = prior[k]
        vector, sums = np.empty_like(own.mean), np.zeros_like(own.mean)
        kernels.envelope_product(
            own.precision, own.space.row_first, own.space.base, own.mean, vector
        )
        kernels.feature_sums(*features[k].arguments, information[k], sums)
        mean, covariance, log_determinant = inverse(own.space, precisions[k], vector + sums)
        found[k] = Weights(own.members, own.space, mean, precisions[k], covariance, log_determinant)

    run_per_class(invert, len(prior))
    return [own for own in found if own is not None]


def logit_moments(
    classes: Sequence[Weights], features: Sequence[BlockFeatures]
) -> tuple[Logits, Logits]:
    """Return mean and variance of every training point's logits, in block order."""
    shape = len(features[0].order), len(classes)
    m, v = np.empty(shape), np.empty(shape)
    blocks = len(features[0].block_start) - 1
    pieces = [(k, lo) for k in range(len(classes)) for lo in range(0, blocks, 256)]

    def work(chunk: slice) -> None:
        for k, lo in pieces[chunk]:
            own = classes[k]
            kernels.stored_moments(
                *features[k].arguments, lo, min(lo + 256, blocks), own.mean, own.covariance,
                own.space.row_first, own.space.base, k, m, v,
            )  # fmt: skip

    run_chunked(work, len(pieces), 1)
    return m, v


def fit_weights(
    features: BlockFeatures,
    labels: Int[np.ndarray, " n"],
    prior: Sequence[Weights],
    *,
    iterations: int,
    variational_updates: int = 1,
    tolerance: float = 0.0,
    relaxation: float = 1.0,
    start_variance: float = 1.0,
    offset: Logits | None = None,
) -> Posterior:
    """Run EM from xi = 1, alpha = 0 and return the posterior of all classes.

    Around an `offset` it starts from what fits logits of that mean and of `start_variance`.

    `features` are those of the map, of which the classes have what their prior says.
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
    classes = len(prior)
    labels = np.asarray(labels)[features.order]
    if len(labels) == 0 or labels.min() < 0 or labels.max() >= classes:
        raise MapError(f"labels must be classes 0..{classes - 1}, with at least one point")
    one_hot = np.zeros((len(labels), classes))
    one_hot[np.arange(len(labels)), labels] = 1.0
    own_features = [features.part(own.members) for own in prior]
    guessed = offset is not None
    offset = np.zeros((1, classes)) if offset is None else offset[features.order]

    def climbed(m: Logits, v: Logits, start: Logits) -> _Variational:
        """Return alpha and xi that raise the bound of logits with these moments."""
        xi = start
        for _ in range(variational_updates):
            alpha = update_alpha(m, bouchard_lambda(xi))
            xi = update_xi(m, v, alpha)
        return _Variational(alpha, xi)

    used = _Variational(np.zeros(len(labels)), np.ones((len(labels), classes)))
    if guessed:
        used = climbed(offset, np.full_like(offset, start_variance), used.xi)
    plain, relaxed = used, False
    history: list[float] = []
    best: list[Weights] = []
    for _ in range(iterations):
        weight = bouchard_lambda(used.xi)
        linear = one_hot - 0.5 + 2.0 * (used.alpha[:, None] - offset) * weight
        found = _maximised(prior, own_features, 2.0 * weight, linear)
        m, v = logit_moments(found, own_features)
        m += offset
        step = climbed(m, v, used.xi)
        bound = expected_bound(m, v, step.alpha, step.xi, labels)
        bound -= sum(map(divergence, found, prior))
        if not np.isfinite(bound):
            raise MapError("the evidence bound is not finite; lower the prior variance")
        if relaxed and bound < history[-1]:
            used, relaxed = plain, False
            continue
        best, plain = found, step
        used, relaxed = used.towards(plain, relaxation), relaxation > 1.0
        history.append(bound)
        if len(history) > 1 and history[-1] - history[-2] <= tolerance * abs(history[-2]):
            break
    return Posterior(tuple(best), tuple(history))


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


def weight_prior(space: FeatureSpace, config: MapConfig, classes: int) -> tuple[Weights, ...]:
    """Return the prior of all weights, independent between features and classes."""
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
    fresh: Sequence[Weights],
) -> tuple[Weights, ...]:
    """Make the old posterior the prior of a larger feature space.

    Weights that the old one has keep their joint posterior; the others enter independent,
    with `fresh`, a diagonal prior of all of `space`.
    """
    position = {row.tobytes(): i for i, row in enumerate(space.hinges)}
    place = np.array([*(position[row.tobytes()] for row in old_space.hinges), space.size - 1])
    found = []
    for before, own in zip(old.classes, fresh, strict=True):
        target = np.searchsorted(own.members, place[before.members])
        rows, columns = before.space.pairs.T
        high = np.maximum(target[rows], target[columns])
        low = np.minimum(target[rows], target[columns])
        mean, precision = own.mean.copy(), own.precision.copy()
        covariance = own.covariance.copy()
        added = np.ones(len(mean), dtype=bool)
        added[target] = False
        gained = np.log(own.precision[own.space.diagonal][added]).sum()
        mean[target] = before.mean
        entries, kept = own.space.base[high] + low, before.space.base[rows] + columns
        precision[entries], covariance[entries] = before.precision[kept], before.covariance[kept]
        determinant = before.log_determinant + float(gained)
        found.append(Weights(own.members, own.space, mean, precision, covariance, determinant))
    return tuple(found)
