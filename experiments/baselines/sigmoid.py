# SPDX-License-Identifier: BSD-3-Clause
"""One Bayesian Hilbert map per object: what the paper's softmax replaces.

Each map has two classes, its object and everything else, and learns from the same points
in the same features. Nothing keeps two of them from claiming the same place.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from vprism_plan.mapping import MapConfig, VPrismMap
from vprism_plan.mapping.em import fit_weights, weight_prior
from vprism_plan.mapping.features import block_features
from vprism_plan.mapping.fitting import learning_problem
from vprism_plan.perception.observation import Observation
from vprism_plan.perception.plane import Plane


@dataclass(frozen=True, eq=False)
class SigmoidMaps:
    """Independent binary maps, one per object, in the order of `object_ids`."""

    maps: tuple[VPrismMap, ...]

    @property
    def object_ids(self) -> tuple[int, ...]:
        """Labels of the objects, sorted."""
        return tuple(one.object_ids[0] for one in self.maps)

    @property
    def plane(self) -> Plane:
        """Support surface, world frame."""
        return self.maps[0].plane

    def predict_proba(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n k"]:
        """Return the product of the objects' complements, and each object's probability.

        Points (n, 3) are in metres. The rows (n, K) do not sum to 1.
        """
        own = np.stack([one.predict_proba(points)[:, 1] for one in self.maps], axis=1)
        return np.column_stack([np.prod(1.0 - own, axis=1), own])


def fit(observation: Observation, seed: int, config: MapConfig | None = None) -> SigmoidMaps:
    """Fit a binary map to every object; errors are those of `fit_map`.

    Where `config` states a prior probability of "occupied", every object's own is such that
    together they give that probability, as in the map of all objects.
    """
    config = MapConfig() if config is None else config
    problem = learning_problem(observation, config, seed)
    config = problem.config
    if config.prior_occupancy is not None:
        share = 1.0 - (1.0 - config.prior_occupancy) ** (1.0 / len(problem.object_ids))
        config = replace(config, prior_occupancy=share)
    prior = weight_prior(problem.space, config, 2)
    features = block_features(problem.space, problem.data.points)
    maps = []
    for k, object_id in enumerate(problem.object_ids, start=1):
        posterior = fit_weights(
            features, (problem.data.classes == k).astype(np.int64), prior,
            iterations=config.iterations,
            variational_updates=config.variational_updates,
            relaxation=config.relaxation,
            start_variance=config.start_variance,
            tolerance=config.tolerance,
        )  # fmt: skip
        maps.append(
            VPrismMap(
                config, (object_id,), problem.plane, problem.views, problem.space, posterior, seed
            )
        )
    return SigmoidMaps(tuple(maps))


def overlap(probabilities: Float[np.ndarray, "n k"], level: float) -> tuple[int, int]:
    """Return how many points two or more objects claim at `level`, and how many any does.

    `probabilities` (n, K) are those of a reconstruction, column 0 is empty.
    """
    claims = (probabilities[:, 1:] >= level).sum(axis=1)
    return int((claims > 1).sum()), int((claims > 0).sum())
