# SPDX-License-Identifier: BSD-3-Clause
"""Small problems and one small fitted scene, shared by the mapping tests."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from vprism_plan.mapping import MapConfig, VPrismMap, fit_map
from vprism_plan.mapping.em import Posterior, diagonal_prior, fit_weights
from vprism_plan.mapping.features import FeatureSpace, block_features, sorted_hinges
from vprism_plan.perception import Observation
from vprism_plan.simulation.camera import Camera
from vprism_plan.simulation.scenes import Scene, random_scene, render

COARSE = MapConfig(hinge_spacing=0.06, surface_hinges=10, iterations=3, below_plane_samples=500)


@dataclass
class Problem:
    """A random classification problem with hinges strewn among the points."""

    points: np.ndarray
    labels: np.ndarray
    space: FeatureSpace
    classes: int
    prior_mean: np.ndarray
    variance: np.ndarray

    members: np.ndarray | None = None

    def fit(
        self, iterations: int = 4, updates: int = 1, relaxation: float = 1.0,
        tolerance: float = 0.0, offset: np.ndarray | None = None,
    ) -> Posterior:  # fmt: skip
        prior = diagonal_prior(self.space, self.prior_mean, self.variance, self.members)
        return fit_weights(
            block_features(self.space, self.points), self.labels, prior, iterations=iterations,
            variational_updates=updates, relaxation=relaxation, tolerance=tolerance, offset=offset,
        )  # fmt: skip


def make_problem(
    seed: int, classes: int, n: int = 120, hinges: int = 25, cutoff: float = 1e-5
) -> Problem:
    """Points in a 30 cm cube, one Gaussian cluster per class; `cutoff` 0 means none."""
    rng = np.random.default_rng(seed)
    centers = rng.uniform(-0.15, 0.15, (classes, 3))
    labels = rng.integers(0, classes, n)
    points = centers[labels] + 0.05 * rng.normal(size=(n, 3))
    gamma = 1000.0 * rng.uniform(0.2, 1.5)
    radius = 10.0 if cutoff == 0 else float(np.sqrt(-np.log(cutoff) / gamma))
    space = FeatureSpace(sorted_hinges(rng.uniform(-0.2, 0.2, (hinges, 3))), gamma, radius)
    mean = 0.5 * rng.normal(size=(space.size, classes))
    return Problem(points, labels, space, classes, mean, rng.uniform(1.0, 50.0, space.size))


@pytest.fixture(scope="session")
def make() -> Callable[..., Problem]:
    """Access to `make_problem` without an import between test files."""
    return make_problem


@pytest.fixture(scope="session")
def scene() -> Scene:
    return random_scene(3, 5)


@pytest.fixture(scope="session")
def small_map(scene: Scene) -> VPrismMap:
    return fit_map(scene.observation, COARSE, seed=1, prior=None)


@pytest.fixture(scope="session")
def default_map(scene: Scene) -> VPrismMap:
    """The same scene with the default preset, for what is said about its accuracy."""
    return fit_map(scene.observation, prior=None)


@pytest.fixture(scope="session")
def coarse() -> MapConfig:
    return COARSE


@pytest.fixture(scope="session")
def query(small_map: VPrismMap) -> np.ndarray:
    """Points in and around the map's reach, some of them far out."""
    lower, upper = small_map.support_bounds()
    return np.random.default_rng(0).uniform(lower - 0.1, upper + 0.1, (700, 3))


@pytest.fixture(scope="session")
def second_view(scene: Scene) -> Observation:
    """The same scene from the other side."""
    eye = scene.camera.center * np.array([-1.0, -1.0, 1.0])
    return render(scene, Camera.look_at(eye, np.zeros(3)))
