# SPDX-License-Identifier: BSD-3-Clause
"""The paper: labelled points in, a probabilistic map of the scene out."""

from vprism_plan.mapping.changes import Changes
from vprism_plan.mapping.config import MapConfig
from vprism_plan.mapping.fitting import fit_map
from vprism_plan.mapping.posterior import VPrismMap
from vprism_plan.mapping.prior import MeshPrior
from vprism_plan.mapping.serialization import load_map

__all__ = ["Changes", "MapConfig", "MeshPrior", "VPrismMap", "fit_map", "load_map"]
