# SPDX-License-Identifier: BSD-3-Clause
"""The learned baseline: PointSDF with a sigmoid, trained here on generated scenes.

The network is given what V-PRISM's authors gave theirs, the labelled points of one object, in
a frame that also says where the table and the camera are; it does not see neighbours or free
space. What it was trained on, and how well it did, is in the header of weights.safetensors.
"""

from experiments.protocols import Reconstruction
from vprism_plan.perception.observation import Observation

LEVEL = 0.3  # of the surface, as V-PRISM's authors found best for theirs


def fit(observation: Observation, seed: int) -> Reconstruction:
    """Complete every object of an observation; see `reconstruction.reconstruct`."""
    from experiments.baselines.pointsdf.reconstruction import reconstruct

    return reconstruct(observation, seed)
