# SPDX-License-Identifier: BSD-3-Clause
"""One world for a whole path: what that says past one thing and past two, and others do not."""

from itertools import pairwise

import numpy as np
import pytest
from oracles.small_scenes import at

import vprism_plan as vp
from vprism_plan.collision import CheckerConfig, CollisionChecker
from vprism_plan.simulation.camera import Camera
from vprism_plan.simulation.scenes import Scene
from vprism_plan.simulation.solids import sphere

OFFSETS = (0.059, 0.065, 0.07, 0.08)  # behind the balls' centres, metres
WAYPOINTS = (16, 32, 64, 128)
APART = 0.36


def make_checker(places, ball_robot):
    """A ball of 2 cm among draws of balls of 4 cm, seen from the other side."""
    solids = tuple(sphere(0.04, at(0.0, y, 0.04)) for y in places)
    camera = Camera.orbit(np.array([0.0, 0.0, 0.03]), 1.0, np.pi, np.deg2rad(35.0))
    scene = Scene(solids, tuple(range(1, len(places) + 1)), camera)
    world = vp.World(
        vp.fit_map(scene.observation, seed=0, prior=None), vp.WorldConfig(occluded="free")
    )
    return CollisionChecker(world, ball_robot(0.02), CheckerConfig(n_worlds=1024))


@pytest.fixture(scope="module")
def two(ball_robot):
    return make_checker([-APART / 2, APART / 2], ball_robot)


def sweep(offset, low, high, n):
    return np.column_stack([np.full(n, offset), np.linspace(low, high, n), np.full(n, 0.04)])


@pytest.fixture(scope="module")
def runs(two):
    """Estimates per offset, as waypoints double on the same path."""
    return {
        x: [two.collision_probability(sweep(x, -0.28, 0.28, n)) for n in WAYPOINTS] for x in OFFSETS
    }


def uncertain(runs):
    """Offsets where the answer is neither yes nor no."""
    found = [x for x in OFFSETS if 0.02 < runs[x][-1].probability < 0.98]
    assert found, "no offset left where worlds disagree"
    return found


def test_joint_risk_does_not_depend_on_how_a_path_is_divided(runs):
    for estimates in runs.values():
        for a, b in pairwise(estimates):
            assert abs(b.probability - a.probability) < 0.02


def test_products_and_sums_of_waypoints_measure_the_division(runs):
    """Where the balls would just touch, many waypoints have a say, and each is counted anew."""
    estimates = runs[0.059]
    products = [1.0 - np.prod(1.0 - e.per_waypoint) for e in estimates]
    sums = [e.per_waypoint.sum() for e in estimates]
    assert all(b > a + 0.02 for a, b in pairwise(products))
    assert all(b > 1.2 * a for a, b in pairwise(sums))
    for estimate in (runs[0.065][-1], runs[0.07][-1]):
        assert 1.0 - np.prod(1.0 - estimate.per_waypoint) > 2.0 * estimate.probability
    # Where P is above one half nothing is twice as much: what the product leaves of surviving
    # is less than a hundredth of what there is.
    assert 1.0 - products[-1] < 0.01 * (1.0 - estimates[-1].probability)


def test_two_things_are_two_chances_and_the_largest_waypoint_is_too_low(two, runs):
    for x in uncertain(runs):
        first, second = (
            two.collision_probability(sweep(x, low, high, 64)).probability
            for low, high in ((-0.28, 0.0), (0.0, 0.28))
        )
        joint = runs[x][-1].probability
        assert joint == pytest.approx(1.0 - (1.0 - first) * (1.0 - second), abs=0.03)
        assert runs[x][-1].per_waypoint.max() < 0.8 * joint
        assert joint <= first + second + 1e-12
