# SPDX-License-Identifier: BSD-3-Clause
"""V-PRISM itself: the presets, and the paper's without parts of its negative sampling."""

from dataclasses import replace

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


def fit_bhm_sampling(observation: Observation, seed: int) -> VPrismMap:
    """Fit to the data of Bayesian Hilbert maps (Senanayake and Ramos, CoRL 2017).

    One negative anywhere on every ray, all points as they are: neither samples under the
    table nor subsampling, the second and third step of the paper's own sampling.
    """
    config = replace(
        MapConfig.paper(),
        ray_sampling="whole",
        below_plane_samples=0,
        object_resolution=None,
        empty_resolution=None,
        max_points=2_000_000,
    )
    return fit_map(observation, config, seed)


def fit_no_under_table(observation: Observation, seed: int) -> VPrismMap:
    """Fit the paper's preset without samples under the table."""
    return fit_map(observation, replace(MapConfig.paper(), below_plane_samples=0), seed)


def fit_no_stratified(observation: Observation, seed: int) -> VPrismMap:
    """Fit the paper's preset to negatives at fixed steps along the rays."""
    return fit_map(observation, replace(MapConfig.paper(), ray_sampling="steps"), seed)
