"""What no camera saw must stop the robot: hidden objects, clutter, the table, nonsense."""

import numpy as np
import pytest

import vprism_plan as vp
from vprism_plan.simulation.scenes import hidden_object_scene, random_scene

RADIUS = 0.015


def points_near(solid, rng, n, reach):
    """Points up to `reach` metres from a solid's surface, and inside it."""
    points = solid.center + rng.uniform(-1, 1, (20 * n, 3)) * (solid.bounding_radius + reach)
    return points[solid.signed_distance(points) < reach][:n]


@pytest.mark.parametrize("seed", [0, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 2, 3))])
def test_no_accepted_configuration_touches_a_wholly_hidden_object(seed, ball_robot):
    scene = hidden_object_scene(seed)
    assert 2 not in scene.observation.object_ids
    hidden = scene.solids[scene.labels.index(2)]
    fitted = vp.fit_map(scene.observation, seed=seed)
    world = vp.World(fitted, vp.WorldConfig(occluded="occupied"))
    checker = vp.CollisionChecker(world, ball_robot(RADIUS))
    rng = np.random.default_rng(seed)
    Q = points_near(hidden, rng, 4000, 0.05)
    touching = hidden.signed_distance(Q) <= RADIUS
    assert touching.sum() > 500
    assert not checker.is_valid_batch(Q)[touching].any()
    report = checker.explain(hidden.center)
    assert not report.valid
    assert report.contacts[0].kind in {"occluded", "object"}
    assert report.shares["occluded"] > 0.9
    assert report.policies["occluded"] == "occupied"
    world = vp.World(world.map, vp.WorldConfig(occluded="free"))
    free = vp.CollisionChecker(world, ball_robot(RADIUS))
    assert not np.any(checker.is_valid_batch(Q) & ~free.is_valid_batch(Q))


@pytest.fixture(scope="module")
def cluttered():
    scene = random_scene(3, 5, n_clutter=2)
    return scene, vp.World(vp.fit_map(scene.observation, seed=0))


def test_unlabelled_clutter_is_refused_and_named(cluttered, ball_robot):
    scene, world = cluttered
    checker = vp.CollisionChecker(world, ball_robot(RADIUS))
    image = scene.observation.point_image()
    kinds = set()
    checked = 0
    for solid, label in zip(scene.solids, scene.labels, strict=True):
        if label:
            continue
        seen = image[(scene.observation.labels == 0) & np.isfinite(image[..., 2])]
        on_it = seen[(np.abs(solid.signed_distance(seen)) < 0.005) & (seen[:, 2] > 0.03)]
        for q in on_it[:: max(1, len(on_it) // 50)]:
            report = checker.explain(q)
            assert not report.valid
            kinds |= {contact.kind for contact in report.contacts}
            checked += 1
    assert checked > 20
    assert "background" in kinds


def test_the_table_is_refused_and_named(cluttered, ball_robot):
    _, world = cluttered
    checker = vp.CollisionChecker(world, ball_robot(RADIUS))
    rng = np.random.default_rng(0)
    Q = np.column_stack([rng.uniform(-2, 2, (500, 2)), rng.uniform(-0.5, RADIUS - 0.005, 500)])
    assert not checker.is_valid_batch(Q).any()
    report = checker.explain([1.5, 1.5, 0.0])
    assert "support" in {contact.kind for contact in report.contacts}
    assert "support surface" in report.text()


def test_not_a_number_is_refused_and_named(cluttered, ball_robot):
    _, world = cluttered
    checker = vp.CollisionChecker(world, ball_robot(RADIUS))
    assert not checker.is_valid([0.0, np.nan, 1.0])
    report = checker.explain([0.0, np.nan, 1.0])
    assert not report.valid
    assert "joint y is nan" in report.text()


def test_no_accepted_configuration_is_inside_visible_truth(cluttered, ball_robot):
    """Solids the camera saw: a sphere deep inside one is never called free."""
    scene, world = cluttered
    checker = vp.CollisionChecker(world, ball_robot(0.002))
    rng = np.random.default_rng(1)
    for solid in scene.solids:
        inside = points_near(solid, rng, 2000, -0.01)
        assert len(inside) > 50
        assert not checker.is_valid_batch(inside).any()
