# SPDX-License-Identifier: BSD-3-Clause
"""One view in, labelled points with a known camera out."""

from vprism_plan.perception.observation import Observation
from vprism_plan.perception.plane import Plane
from vprism_plan.perception.plane_fitting import align_to_table, fit_plane
from vprism_plan.perception.readers import load_observation, save_observation
from vprism_plan.perception.segmentation import segment_tabletop
from vprism_plan.perception.self_filter import ignore_robot, ignore_self

__all__ = [
    "Observation",
    "Plane",
    "align_to_table",
    "fit_plane",
    "ignore_robot",
    "ignore_self",
    "load_observation",
    "save_observation",
    "segment_tabletop",
]
