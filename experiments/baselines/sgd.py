# SPDX-License-Identifier: BSD-3-Clause
"""A point estimate of the weights by stochastic gradient descent (the paper's last figure).

The same points and features as V-PRISM's, one weight vector per class instead of a
distribution over them: what the data leave open, it does not know that it does not know.
"""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int64

from vprism_plan.mapping import MapConfig, VPrismMap
from vprism_plan.mapping.em import Posterior, diagonal_prior
from vprism_plan.mapping.features import FeatureSpace
from vprism_plan.mapping.fitting import LearningProblem, learning_problem
from vprism_plan.perception.observation import Observation

if TYPE_CHECKING:
    from scipy.sparse import csr_array

EPOCHS = 20
BATCH = 512
RATE = 0.1  # of Adam in the first epoch; it falls to 0 as half a cosine
# A map's posterior has a variance: one so small that it changes no probability in float64.
_VARIANCE = 1e-16


def fit(
    observation: Observation, seed: int, config: MapConfig | None = None, epochs: int = EPOCHS
) -> VPrismMap:
    """Minimise the softmax negative log-likelihood of the augmented data, without a prior.

    The result answers like any map; its logits have no variance, so that `predict_proba` is
    the softmax of the point estimate. `history` holds the log-likelihood per point after
    every epoch. Errors are those of `fit_map`.
    """
    config = MapConfig() if config is None else config
    problem = learning_problem(observation, config, seed)
    weights, history = descend(problem, seed, epochs)
    return VPrismMap(
        problem.config, problem.object_ids, problem.plane, problem.views, problem.space,
        _certain(problem.space, weights, history), seed,
    )  # fmt: skip


def descend(
    problem: LearningProblem, seed: int, epochs: int = EPOCHS
) -> tuple[Float[np.ndarray, "m k"], tuple[float, ...]]:
    """Return the weights (features in hinge order, bias last) and log-likelihoods per point."""
    import torch

    classes = len(problem.object_ids) + 1
    features = sparse_features(problem.space, problem.data.points).astype(np.float32)
    labels = problem.data.classes
    generator = torch.Generator().manual_seed(seed)
    weights = torch.zeros(problem.space.size, classes)
    optimizer = torch.optim.Adam([weights], lr=RATE)
    steps = epochs * -(-len(labels) // BATCH)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    history = []
    for _ in range(epochs):
        order = torch.randperm(len(labels), generator=generator).numpy()
        shuffled, own = features[order], labels[order]
        for start in range(0, len(labels), BATCH):
            batch = slice(start, start + BATCH)
            _, gradient = loss_and_gradient(shuffled[batch], own[batch], weights.numpy())
            weights.grad = torch.from_numpy(gradient)
            optimizer.step()
            schedule.step()
        history.append(-loss_and_gradient(features, labels, weights.numpy())[0])
    return weights.numpy().astype(np.float64), tuple(history)


def loss_and_gradient(
    features: "csr_array", labels: Int64[np.ndarray, " n"], weights: Float[np.ndarray, "m k"]
) -> tuple[float, Float[np.ndarray, "m k"]]:
    """Return the mean negative log-likelihood of points and its derivative by the weights.

    Written out because features are sparse, which autograd serves ten times more slowly.
    """
    logits = features @ weights
    logits -= logits.max(axis=1, keepdims=True)
    probability = np.exp(logits)
    total = probability.sum(axis=1, keepdims=True)
    rows = np.arange(len(labels))
    loss = float((np.log(total[:, 0]) - logits[rows, labels]).mean())
    probability /= total
    probability[rows, labels] -= 1.0
    return loss, np.asarray(features.T @ probability) / len(labels)


def sparse_features(space: FeatureSpace, points: Float[np.ndarray, "n 3"]) -> "csr_array":
    """Return the features (n, M) of points (m), bias last, those that are 0 left out."""
    from scipy.sparse import csr_array
    from scipy.spatial import cKDTree

    pairs = cKDTree(points).sparse_distance_matrix(
        cKDTree(space.hinges), space.radius, output_type="ndarray"
    )
    pairs = pairs[pairs["v"] < space.radius]
    every = np.arange(len(points))
    values = np.concatenate([np.exp(-space.gamma * pairs["v"] ** 2), np.ones(len(points))])
    rows = np.concatenate([pairs["i"], every])
    columns = np.concatenate([pairs["j"], np.full(len(points), space.size - 1)])
    found = csr_array((values, (rows, columns)), shape=(len(points), space.size))
    found.sort_indices()
    return found


def _certain(
    space: FeatureSpace, weights: Float[np.ndarray, "m k"], history: tuple[float, ...]
) -> Posterior:
    """Weights as a posterior of next to no variance."""
    return Posterior(diagonal_prior(space, weights, np.full(space.size, _VARIANCE)), history)
