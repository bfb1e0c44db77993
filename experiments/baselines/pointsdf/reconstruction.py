# SPDX-License-Identifier: BSD-3-Clause
"""What the network makes of one observation."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from experiments.baselines.pointsdf.cloud import ObjectFrame, prepare_cloud
from experiments.baselines.pointsdf.model import PointSDF
from experiments.baselines.pointsdf.weights import shipped_network
from experiments.protocols import checked_points
from vprism_plan.errors import MapError
from vprism_plan.perception.observation import Observation
from vprism_plan.perception.plane_fitting import fit_plane

_CHUNK = 4096  # queries that the network answers at once


@dataclass(frozen=True, eq=False)
class PointSdfReconstruction:
    """Every object by itself, as the network completes it.

    Satisfies `protocols.Reconstruction`. The objects know nothing of one another, so that
    rows of `predict_proba` need not sum to 1.

    Attributes:
        object_ids: labels, in the order of the columns 1 to C.
        frames: where the network's coordinates of each object lie.
        clouds: (C, n, 3) what was seen of each object, in its frame.
        embeddings: (C, e) of the clouds.
        model: the network.
    """

    object_ids: tuple[int, ...]
    frames: tuple[ObjectFrame, ...]
    clouds: torch.Tensor
    embeddings: torch.Tensor
    model: PointSDF

    def predict_proba(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n k"]:
        """Return the probability of empty and that each object holds the point, (n, 1 + C).

        Column 0 is the product of the objects' complements. Outside the box around an
        object that the network was trained in, the object's probability is 0.

        Args:
            points: (n, 3) world, metres.

        Raises:
            MapError: points of another shape, or not finite.
        """
        points = checked_points(points, MapError)
        proba = np.zeros((len(points), 1 + len(self.object_ids)))
        for k, frame in enumerate(self.frames):
            local = frame.to_object(points)
            rows = np.flatnonzero(frame.covers(local))
            asked = torch.from_numpy(local[rows].astype(np.float32))
            for start in range(0, len(rows), _CHUNK):
                part = slice(start, start + _CHUNK)
                with torch.no_grad():
                    logit = self.model.answer(
                        self.embeddings[k : k + 1], self.clouds[k : k + 1], asked[None, part]
                    )
                proba[rows[part], 1 + k] = torch.sigmoid(logit[0].double()).numpy()
        proba[:, 0] = (1.0 - proba[:, 1:]).prod(axis=1)
        return proba


def reconstruct(
    observation: Observation, seed: int = 0, model: PointSDF | None = None
) -> PointSdfReconstruction:
    """Complete every object that an observation shows.

    Args:
        observation: labelled, with at least one object.
        seed: of the support plane's fit, if the observation has no plane.
        model: network, or None for the one that comes with the package.

    Raises:
        ObservationError: no labels, or no object.
        PlaneNotFoundError: no support plane is known and none can be fitted.
        MapError: the package's weights are missing or damaged.
    """
    ids = observation.require_objects()
    model = shipped_network() if model is None else model
    plane = observation.plane or fit_plane(observation, seed=seed)
    points, labels = observation.points()
    clouds, frames = [], []
    for k in ids:
        cloud, frame = prepare_cloud(
            points[labels == k], plane, observation.camera_center, model.architecture.cloud
        )
        clouds.append(cloud)
        frames.append(frame)
    contexts = np.stack([frame.context for frame in frames])
    stacked = torch.from_numpy(np.stack(clouds))
    with torch.no_grad():
        embeddings = model.embed(stacked, torch.from_numpy(contexts))
    return PointSdfReconstruction(ids, tuple(frames), stacked, embeddings, model)
