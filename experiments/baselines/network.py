# SPDX-License-Identifier: BSD-3-Clause
"""The shape prior's network alone, without the map that its guess is made for."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from vprism_plan.errors import MapError
from vprism_plan.mapping import MapConfig
from vprism_plan.mapping.fitting import learning_problem
from vprism_plan.mapping.prior import Guess
from vprism_plan.mapping.shape_network import ShapePrior
from vprism_plan.perception.observation import Observation


@dataclass(frozen=True)
class Guessed:
    """The shape prior's own probabilities, without a map."""

    object_ids: tuple[int, ...]
    guess: Guess

    def predict_proba(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n k"]:
        """Return P(class) at points (m)."""
        if not np.isfinite(points).all():
            raise MapError("points hold NaN or infinity; every coordinate must be finite (m)")
        return self.guess(points)


def fit(observation: Observation, seed: int) -> Guessed:
    """Ask the shape prior's network alone, on the views and the plane that a map would have."""
    problem = learning_problem(observation, MapConfig(), seed)
    guess = ShapePrior()(problem.views, problem.object_ids, problem.plane)
    return Guessed(problem.object_ids, guess)
