# SPDX-License-Identifier: BSD-3-Clause
"""V-PRISM itself: the presets, and the paper's without parts of its negative sampling."""

from vprism_plan.mapping import MapConfig, VPrismMap, fit_map
from vprism_plan.perception.observation import Observation


def fit_default(observation: Observation, seed: int) -> VPrismMap:
    """Fit with the default preset."""
    return fit_map(observation, MapConfig(), seed)


def fit_fine(observation: Observation, seed: int) -> VPrismMap:
    """Fit with the finer lattice."""
    return fit_map(observation, MapConfig.fine(), seed)


def fit_paper(observation: Observation, seed: int) -> VPrismMap:
    """Fit with the paper's Table III."""
    return fit_map(observation, MapConfig.paper(), seed)
