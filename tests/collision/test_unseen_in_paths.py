# SPDX-License-Identifier: BSD-3-Clause
"""What a bound on risk says of hidden space in which only unseen objects may stand."""

import dataclasses
import math

import numpy as np
import pytest
from oracles.small_scenes import at, small_camera, small_config

import vprism_plan as vp
from vprism_plan.collision import CheckerConfig, CollisionChecker
from vprism_plan.planning.objectives import _field
from vprism_plan.simulation.scenes import Scene
from vprism_plan.simulation.solids import Box
from vprism_plan.trajopt import RiskCost

# Deep in the shadow of a wall, farther from it than its map says anything.
WAY = np.array([[0.35, -0.08, 0.05], [0.35, 0.08, 0.05]])


@pytest.fixture(scope="module")
def map_():
    wall = Box((0.02, 0.12, 0.1), pose=at(0.0, 0.0, 0.1))
    return vp.fit_map(Scene((wall,), (1,), small_camera()).observation, small_config(), seed=0)


def world_with(map_, density):
    return vp.World(map_, vp.WorldConfig(occluded="posterior", hidden_objects=density))


@pytest.fixture(scope="module")
def worlds(map_):
    return {density: world_with(map_, density) for density in (0.0, 2.0, 60.0, math.inf)}


@pytest.fixture(scope="module")
def crowded(worlds, ball_robot):
    """A ball of 3 cm where there is hardly room between what may stand there."""
    return CollisionChecker(worlds[60.0], ball_robot(0.03), CheckerConfig(max_risk=0.15))


def test_a_path_meets_them_as_often_as_the_model_says(worlds, ball_robot):
    """The area where a cylinder would be in the way is the swept one, grown by its radius."""
    for density in (2.0, 60.0):
        config = CheckerConfig(n_worlds=1024)
        checker = CollisionChecker(worlds[density], ball_robot(0.03), config)
        estimate = checker.collision_probability(WAY)
        assert not estimate.certain
        touch = {}
        # Cylinders lower than the ball are the fewest (5 to 8 cm over the table are its own).
        for radius, rises in ((0.02, 0.9), (0.03 + 0.01, 1.0)):
            grown = 0.02 + 0.02 + radius
            area = math.pi * (grown**2 + 0.04**2 / 12.0) + 0.16 * 2.0 * grown
            touch[radius] = 1.0 - math.exp(-density * rises * area)
        low, high = touch.values()
        assert low - 0.03 < estimate.probability < high + 0.03
        causes = {contact.body for contact in estimate.first_contact}
        assert causes == {"occluded"}


def test_verdicts_and_their_reasons(worlds, crowded, ball_robot):
    q = WAY[0]
    config = CheckerConfig(max_risk=None)
    plain = {d: CollisionChecker(w, ball_robot(0.03), config) for d, w in worlds.items()}
    assert [plain[d].is_valid(q) for d in (0.0, 2.0, 60.0, math.inf)] == [True, True, True, False]
    assert [contact.kind for contact in plain[math.inf].explain(q).contacts] == ["occluded"]
    bounded = {
        d: CollisionChecker(w, ball_robot(0.03), CheckerConfig(max_risk=0.15))
        for d, w in worlds.items()
    }
    assert [bounded[d].is_valid(q) for d in bounded] == [True, True, False, False]
    assert bounded[2.0].check_motion(*WAY)
    assert bounded[0.0].collision_probability(WAY).probability == 0.0
    assert bounded[math.inf].collision_probability(WAY).certain
    (contact,) = crowded.explain(q).contacts
    assert (contact.kind, contact.body) == ("risk", "occluded")
    assert contact.probability > 0.15
    assert "occluded" in str(crowded.explain(q))


def test_who_may_touch_the_object_may_not_touch_them(worlds, crowded, ball_robot):
    config = CheckerConfig(max_risk=0.15, allowed_contacts={"ball": {1}})
    allowed = CollisionChecker(worlds[60.0], ball_robot(0.03), config)
    inside = np.array([0.0, 0.0, 0.1])
    assert not crowded.is_valid(inside)
    assert allowed.is_valid(inside)
    assert not allowed.is_valid(WAY[0])
    ours, theirs = (c.collision_probability(WAY) for c in (allowed, crowded))
    assert ours.probability == theirs.probability > 0.5


def test_held_out_worlds_hold_others(crowded):
    """The planner's last verdict is by objects that its search has not seen."""
    ours, other = (crowded.collision_probability(WAY[:1], held_out=h) for h in (False, True))
    assert 0.0 < ours.probability < 1.0
    assert ours.probability != other.probability
    assert abs(ours.probability - other.probability) < 0.15
    setting = crowded.risk_setting().worlds
    mine, theirs = (w._owners._cylinders for w in (setting, setting.redrawn(setting.seed + 1)))
    assert mine.shape != theirs.shape or (mine != theirs).any()


def test_objectives_and_costs_count_them(crowded, worlds, ball_robot):
    setting = crowded.risk_setting()
    field, first = _field(setting.worlds, crowded.world, "occupancy")
    voxel = tuple(np.rint(WAY[0] / 0.01).astype(int) - first)
    share = (setting.worlds.owners(np.array([voxel]) + first) > 0).mean()
    assert field[voxel] == pytest.approx(share)
    assert 0.05 < share < 0.5
    import torch

    q = torch.as_tensor(WAY)
    cost = RiskCost(CollisionChecker(worlds[60.0], ball_robot(0.03)), n_worlds=64)
    assert float(cost.probability(q)) > 0.5


def test_meshes_leave_that_space_to_the_draws_as_well(map_, worlds, ball_robot):
    point = WAY[0]
    for density, refused in ((2.0, False), (math.inf, True)):
        checker = vp.MeshChecker(worlds[density], ball_robot(0.03))
        assert checker.is_valid(point) != refused
    bounds = ((-0.1, -0.2, 0.0), (0.25, 0.2, 0.3))
    config = dataclasses.replace(worlds[2.0].config, bounds=bounds)
    small = vp.World(map_, config)
    assert not vp.MeshChecker(small, ball_robot(0.03)).is_valid(point)  # outside the grid
