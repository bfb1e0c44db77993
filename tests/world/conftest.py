# SPDX-License-Identifier: BSD-3-Clause
import numpy as np
import pytest
from oracles.world_oracles import KernelMap, level_points, random_map

from vprism_plan.mapping import MapConfig, fit_map
from vprism_plan.perception import Plane
from vprism_plan.simulation.scenes import hidden_object_scene
from vprism_plan.world import World, WorldConfig


@pytest.fixture(scope="session")
def hidden_scene():
    return hidden_object_scene(3)


@pytest.fixture(scope="session")
def scene_kernel_map(hidden_scene) -> KernelMap:
    """A formula map over a rendered scene: kernels on what was seen of each object."""
    observation = hidden_scene.observation
    points, labels = observation.points()
    rng = np.random.default_rng(0)
    hinges, weights = [], []
    for k, label in enumerate(observation.object_ids, start=1):
        chosen = rng.choice(np.flatnonzero(labels == label), 60, replace=False)
        hinges.append(points[chosen])
        weight = np.zeros((60, len(observation.object_ids) + 1))
        weight[:, k], weight[:, 0] = 1.0, -1.0
        weights.append(weight)
    return KernelMap(
        np.concatenate(hinges),
        np.concatenate(weights),
        np.array([2.0, -1.0, -1.0]),
        views=(observation,),
        plane=Plane((0.0, 0.0, 1.0), 0.0),
        object_ids=observation.object_ids,
    )


@pytest.fixture(scope="session")
def fitted_map(hidden_scene):
    config = MapConfig(hinge_spacing=0.05, surface_hinges=16, iterations=2)
    return fit_map(hidden_scene.observation, config, seed=0, prior=None)


@pytest.fixture(scope="session", params=["formula", "scene", "fitted"])
def any_map(request):
    """Every implementation of the map's interface."""
    if request.param == "formula":
        return random_map(5)
    return request.getfixturevalue(
        {"scene": "scene_kernel_map", "fitted": "fitted_map"}[request.param]
    )


@pytest.fixture(scope="session")
def occupied(any_map) -> np.ndarray:
    """Points of a lattice, aligned with nothing, with P(occupied) >= 0.5."""
    spacing = 0.004 if isinstance(any_map, KernelMap) else 0.007
    points = level_points(any_map, spacing, 0.5, np.array([0.21, 0.43, 0.67]))
    assert len(points) > 500
    return points


def around(map_) -> tuple[np.ndarray, np.ndarray]:
    """Bounds that hold the map's support and little else: small grids bake fast."""
    lower, upper = map_.support_bounds()
    return lower - 0.05, upper + 0.05


@pytest.fixture(scope="session")
def world(any_map) -> World:
    return World(any_map, WorldConfig(bounds=around(any_map)))


@pytest.fixture(scope="session")
def objects_only(any_map) -> World:
    free = WorldConfig(bounds=around(any_map), occluded="free", unobserved="free")
    return World(any_map, free)
