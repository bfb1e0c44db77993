"""Nodes that a camera made superfluous: against a slow, literal reading of the rule."""

from dataclasses import replace

import numpy as np
import pytest

import vprism_plan as vp
from vprism_plan.errors import ConfigError
from vprism_plan.mapping.fitting import learning_problem
from vprism_plan.mapping.hinges import needed_nodes
from vprism_plan.perception.plane import Plane
from vprism_plan.simulation import demo_scene, random_scene

SPACING, MARGIN = 0.04, 0.04
TABLE = Plane(np.array([0.0, 0.0, 1.0]), 0.0)


def lattice(lower, upper):
    axes = [SPACING * np.arange(np.ceil(a / SPACING), b / SPACING) for a, b in zip(lower, upper)]  # noqa: B905
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


@pytest.fixture(scope="module")
def scene():
    return random_scene(3, 5, noise=False)


@pytest.fixture(scope="module")
def nodes():
    return lattice([-0.3, -0.3, -0.08], [0.3, 0.3, 0.3])


def surface_of(observation):
    points, labels = observation.points()
    return points[labels > 0]


def test_every_node_in_or_behind_an_object_is_kept(scene, nodes):
    surface = surface_of(scene.observation)
    needed = needed_nodes(nodes, (scene.observation,), TABLE, surface, SPACING, MARGIN)
    inside = scene.signed_distance(nodes) <= 0.0
    origin = scene.camera.center
    hidden = np.zeros(len(nodes), dtype=bool)
    for i, node in enumerate(nodes):
        ray = origin + np.linspace(0.0, 1.0, 600)[:, None] * (node - origin)
        hidden[i] = node[2] > 0 and scene.signed_distance(ray[:-3]).min() <= 0.0
    assert inside.sum() > 5
    assert hidden.sum() > 20
    assert needed[inside].all()
    assert needed[hidden].all()


def test_what_is_dropped_is_seen_empty_and_far_from_every_surface(scene, nodes):
    surface = surface_of(scene.observation)
    needed = needed_nodes(nodes, (scene.observation,), TABLE, surface, SPACING, MARGIN)
    dropped = nodes[~needed]
    assert 0.2 < len(dropped) / len(nodes) < 0.9
    gaps = np.linalg.norm(dropped[:, None] - surface[None, ::7], axis=2).min(axis=1)
    assert gaps.min() > MARGIN - 0.002  # every seventh point only
    pixel = np.linalg.inv(scene.observation.pose)
    depth = scene.observation.depth
    for node in dropped[dropped[:, 2] > 0.001]:
        local = pixel[:3, :3] @ node + pixel[:3, 3]
        u, v, w = scene.observation.intrinsics @ local
        shown = depth[round(v / w), round(u / w)]
        assert shown > local[2]  # and 0, a pixel without a return, shows nothing


def test_where_nothing_came_back_and_outside_the_image_nodes_are_kept(scene, nodes):
    surface = surface_of(scene.observation)
    depth = np.where(scene.observation.labels > 0, scene.observation.depth, 0.0)
    blind = replace(scene.observation, depth=depth.astype(np.float32))
    needed = needed_nodes(nodes, (blind,), TABLE, surface, SPACING, MARGIN)
    above = nodes[:, 2] >= 0.0
    assert needed[above].all()
    elsewhere = nodes + np.array([50.0, 0.0, 0.0])
    needed = needed_nodes(elsewhere, (scene.observation,), TABLE, surface, SPACING, MARGIN)
    assert needed[above].all()


def test_a_second_view_never_needs_more(scene, nodes):
    surface = surface_of(scene.observation)
    one = needed_nodes(nodes, (scene.observation,), TABLE, surface, SPACING, MARGIN)
    other = demo_scene().observation
    both = needed_nodes(nodes, (scene.observation, other), TABLE, surface, SPACING, MARGIN)
    assert (one | ~both).all()


def test_the_fit_drops_nodes_only_when_told_and_answers_alike_near_objects(scene):
    kept = vp.MapConfig(gamma=1500.0, hinge_spacing=0.028, hinge_reach=None)
    problem = learning_problem(scene.observation, kept, 0)
    config = replace(kept, hinge_reach=0.04)
    fewer = learning_problem(scene.observation, config, 0)
    every = {tuple(h) for h in problem.space.hinges.round(9)}
    assert {tuple(h) for h in fewer.space.hinges.round(9)} < every
    np.testing.assert_array_equal(problem.data.points, fewer.data.points)
    points = surface_of(scene.observation)[::50]
    full = vp.fit_map(scene.observation, kept).occupancy(points)
    thin = vp.fit_map(scene.observation, config).occupancy(points)
    assert np.abs(np.asarray(full) - np.asarray(thin)).mean() < 0.03


def test_a_negative_reach_is_refused_by_name():
    with pytest.raises(ConfigError, match=r"hinge_reach is -0\.1"):
        vp.MapConfig(hinge_reach=-0.1)
