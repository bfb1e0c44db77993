# SPDX-License-Identifier: BSD-3-Clause
"""V-PRISM itself: the presets, and the paper's without parts of its negative sampling."""

from collections.abc import Callable
from dataclasses import replace

from vprism_plan.mapping import MapConfig, VPrismMap, fit_map
from vprism_plan.perception.observation import Observation

PRESETS: dict[str, Callable[[], MapConfig]] = {
    "vprism": MapConfig,
    "vprism-flat": MapConfig,
    "vprism-fine": MapConfig.fine,
    "vprism-paper": MapConfig.paper,
    # The data of Bayesian Hilbert maps (Senanayake and Ramos, CoRL 2017): one negative anywhere
    # on every ray, all points as they are, no samples under the table.
    "bhm-sampling": lambda: replace(
        MapConfig.paper(), ray_sampling="whole", below_plane_samples=0, object_resolution=None,
        empty_resolution=None, max_points=2_000_000,
    ),
    "no-under-table": lambda: replace(MapConfig.paper(), below_plane_samples=0),
    "no-stratified": lambda: replace(MapConfig.paper(), ray_sampling="steps"),
}  # fmt: skip


def fit(observation: Observation, seed: int, preset: str) -> VPrismMap:
    """Fit with one of the presets; "vprism-flat" is the default without its shape prior."""
    observation.require_objects()
    prior = None if preset == "vprism-flat" else "shape"
    return fit_map(observation, PRESETS[preset](), seed, prior)
