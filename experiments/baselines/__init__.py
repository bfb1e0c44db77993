# SPDX-License-Identifier: BSD-3-Clause
"""Every system that is compared, each as a named way from an observation to probabilities.

A method's code, and whatever heavy package it needs, is imported when it first fits.
"""

from functools import partial
from importlib import import_module
from typing import Any

from experiments.protocols import Method, Reconstruction
from vprism_plan.errors import ConfigError
from vprism_plan.perception.observation import Observation


def _fit(module: str, extra: dict[str, str], observation: Observation, seed: int) -> Reconstruction:
    fit = import_module(f"{__name__}.{module}").fit
    found: Reconstruction = fit(observation, seed, **extra)
    return found


def _method(key: str, label: str, module: str | None = None, **kwargs: Any) -> Method:
    extra = {"preset": key} if module is None else {}
    # A partial of a module's function, unlike a closure, can be sent to another process.
    return Method(key, label, partial(_fit, module or "maps", extra), **kwargs)


METHODS: dict[str, Method] = {
    entry.key: entry
    for entry in (
        _method("vprism", "V-PRISM (ours)"),
        _method("vprism-flat", "V-PRISM (ours, flat prior)"),
        _method("network", "Shape prior's network alone", "network"),
        _method("vprism-fine", "V-PRISM (ours, fine)"),
        _method("vprism-paper", "V-PRISM (paper)"),
        _method("bhm-sampling", "V-PRISM (paper) with BHM sampling"),
        _method("no-under-table", "V-PRISM (paper) without under the table"),
        _method("no-stratified", "V-PRISM (paper) without stratified sampling"),
        _method("sigmoid", "Sigmoid maps, one per object", "sigmoid"),
        _method("sgd", "Point estimate (SGD)", "sgd", uncertainty=False),
        _method("voxel", "Voxel", "voxel", continuous=False, uncertainty=False),
        _method("octomap", "OctoMap", "octomap", continuous=False),
        _method("pointsdf", "PointSDF", "pointsdf", level=0.3, uncertainty=False),
    )
}


def method(key: str) -> Method:
    """Return the method of that key; ConfigError naming the keys if there is none."""
    if key not in METHODS:
        raise ConfigError(f"there is no method {key!r}; valid: {', '.join(METHODS)}")
    return METHODS[key]
