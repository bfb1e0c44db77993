# SPDX-License-Identifier: BSD-3-Clause
"""Worlds without a map, and of an empty table: every question has an answer, by slow formulas."""

import numpy as np
import pytest
import torch
from oracles.perception_oracles import Scene, intrinsics, look_at
from oracles.small_scenes import at

import vprism_plan as vp
from vprism_plan.errors import ConfigError, WorldError
from vprism_plan.trajopt import ClearanceCost, EntropyCost, OccupancyCost, RiskCost, optimize
from vprism_plan.viz import margin_figure, risk_figure
from vprism_plan.world import Box, Cylinder, HalfSpace, Sphere

SOLIDS = (
    Box("crate", (0.2, 0.3, 0.4), at(0.4, 0.0, 0.2)),
    Sphere("ball", 0.1, (-0.1, 0.5, 0.3)),
    Cylinder("pole", 0.05, 0.8, at(0.2, -0.5, 0.4)),
)
FLOOR = HalfSpace("floor", (0.0, 0.0, 1.0), 0.0)


def empty_table():
    """A table, and a box on it that nobody labelled."""
    size = np.array([0.1, 0.2, 0.3])
    box = (np.array([0.35, 0.0, 0.15]) - size / 2, np.array([0.35, 0.0, 0.15]) + size / 2)
    pose, K = look_at((-0.75, 0.1, 0.65), (0.3, 0.1, 0.05)), intrinsics()
    depth, labels = Scene(boxes=[box], table=((-1.0, -1.0), (1.5, 1.0))).render(pose, K)
    return vp.fit_map(vp.Observation(depth, np.zeros_like(labels), K, pose))


@pytest.fixture(scope="module", params=["solids", "floor", "nothing", "table"])
def case(request):
    """A world, and the signed distance to what is surely an obstacle in it."""
    if request.param == "table":
        map_ = empty_table()
        seen, _ = map_.views[0].points()
        seen = seen[seen[:, 2] > 0.02]
        assert len(seen) > 500

        def distance(points):
            to_seen = np.linalg.norm(points[:, None] - seen[::20], axis=2).min(axis=1)
            return np.minimum(points[:, 2] - map_.plane.offset + 1e-3, to_seen)

        return vp.World(map_), distance
    known = {"solids": (*SOLIDS, FLOOR), "floor": (FLOOR,), "nothing": ()}[request.param]

    def distance(points):
        parts = [np.full(len(points), np.inf)]
        for item in known:
            flat = isinstance(item, HalfSpace)
            parts.append(points[:, 2] if flat else item.signed_distance(points))
        return np.min(parts, axis=0)

    return vp.World(known=known), distance


@pytest.fixture(scope="module")
def robot(ball_robot):
    return ball_robot(0.04)


def test_no_ball_that_touches_is_free_and_free_space_is_found(case, robot):
    world, distance = case
    Q = np.random.default_rng(0).uniform((-0.5, -0.8, -0.2), (0.9, 0.8, 0.9), (4000, 3))
    truth = distance(Q) - 0.04
    checker = vp.CollisionChecker(world, robot)
    clearance = checker.clearance_batch(Q)
    assert (clearance <= truth + 1e-6).all()
    assert not checker.is_valid_batch(Q)[truth <= 0].any()
    assert checker.is_valid_batch(Q)[truth > 0.1].mean() > 0.2  # hidden space is left
    meshes = vp.MeshChecker(world, robot)
    deep = Q[truth < -0.02][:40]
    assert not any(meshes.is_valid(q) for q in deep)
    for q in deep[:10]:
        assert checker.explain(q).contacts


def test_paths_are_planned_judged_and_drawn(case, robot):
    world, distance = case
    checker = vp.CollisionChecker(world, robot)
    start, goal = np.array([0.1, 0.35, 0.12]), np.array([0.1, -0.3, 0.12])
    for judge in (checker, vp.MeshChecker(world, robot)):
        result = vp.plan(judge, start, goal)
        assert result.solved, result.message
        steps = np.linspace(0, 1, 50)[:, None]
        for a, b in zip(result.path[:-1], result.path[1:], strict=True):
            assert distance(a + steps * (b - a)).min() > 0.04
    risk = checker.collision_probability([start, goal])
    assert risk.probability in (0.0, 1.0)
    assert checker.path_entropy(np.array([start, goal])).unsupported_share == 1.0
    assert "mm" in checker.safety_margin(np.array([start, goal])).text(3) or world.empty
    assert optimize(checker, start, goal).solved
    if world.map.views:
        risk_figure(checker, np.array([start, goal]))
        margin_figure(checker, np.array([start, goal]))


@pytest.mark.parametrize("cost", [ClearanceCost, OccupancyCost, EntropyCost, RiskCost])
def test_costs_are_finite_with_finite_gradients(case, robot, cost):
    world, _ = case
    q = torch.linspace(-0.3, 0.6, 6, dtype=torch.float64)[:, None].repeat(1, 3).requires_grad_()
    value = cost(vp.CollisionChecker(world, robot))(q)
    value.backward()
    assert value >= 0.0
    assert torch.isfinite(q.grad).all()


def test_what_nobody_looked_at_can_be_an_obstacle(robot):
    config = vp.WorldConfig(unobserved="occupied")
    checker = vp.CollisionChecker(vp.World(config=config, known=SOLIDS), robot)
    assert not checker.is_valid_batch(np.random.default_rng(0).uniform(-2, 2, (500, 3))).any()


def test_known_geometry_adds_up_and_a_world_of_nothing_has_to_be_asked_for():
    config = vp.WorldConfig(known=SOLIDS[:1])
    assert vp.World(config=config).sources[-1:] == ("known:crate",)
    assert vp.World(None, config, SOLIDS[1:]).sources[-2:] == ("known:ball", "known:pole")
    with pytest.raises(WorldError, match=r"known=\[\]"):
        vp.World()
    with pytest.raises(ConfigError, match="used twice: crate"):
        vp.World(None, config, SOLIDS)
