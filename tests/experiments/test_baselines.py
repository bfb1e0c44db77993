# SPDX-License-Identifier: BSD-3-Clause
"""Every compared method keeps the same promises; each baseline is what it says it is."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from oracles import dense_em, ray_oracles
from oracles.small_scenes import small_scene

from experiments.baselines import METHODS, method, octomap, sgd, sigmoid, voxel, voxel_rays
from experiments.baselines.pointsdf import weights as pointsdf_weights
from vprism_plan.errors import ConfigError, MapError, ObservationError
from vprism_plan.mapping import MapConfig, VPrismMap, fit_map
from vprism_plan.mapping.fitting import learning_problem
from vprism_plan.perception import Observation
from vprism_plan.simulation.camera import Camera
from vprism_plan.simulation.scenes import Scene

APART = ("sigmoid", "pointsdf")  # their objects know nothing of one another
REPEATED = tuple(key for key in METHODS if key not in ("vprism-fine", "vprism"))


def small_observation(solids=slice(None)):
    """The small scene in 160 x 120 pixels."""
    scene = small_scene()
    intrinsics = scene.camera.intrinsics / 4.0
    intrinsics[:2, 2] = 79.5, 59.5
    intrinsics[2, 2] = 1.0
    camera = Camera(scene.camera.T_world_camera, intrinsics, 160, 120)
    return Scene(scene.solids[solids], scene.labels[solids], camera).observation


@pytest.fixture(scope="module")
def observation():
    return small_observation()


@pytest.fixture(scope="module")
def fitted(observation):
    """One fit per method, made when it is first asked for."""
    made = {}

    def fit(key):
        if key == "pointsdf" and not pointsdf_weights.SHIPPED.is_file():
            pytest.skip("the weights of PointSDF are not in this checkout")
        if key not in made:
            made[key] = method(key).fit(observation, 0)
        return made[key]

    return fit


@pytest.fixture(scope="module")
def points():
    rng = np.random.default_rng(0)
    return np.concatenate(
        [rng.uniform([-0.1, -0.15, -0.05], [0.15, 0.15, 0.15], (400, 3)), [[5.0, -4.0, 3.0]]]
    )


@pytest.mark.parametrize("key", METHODS)
def test_every_method_gives_probabilities(key, fitted, points, observation):
    found = fitted(key)
    assert tuple(found.object_ids) == (2, 5)
    proba = found.predict_proba(points)
    assert proba.shape == (len(points), 3)
    assert proba.dtype == np.float64
    assert (proba >= 0.0).all()
    assert (proba <= 1.0 + 1e-12).all()
    if key in APART:
        np.testing.assert_allclose(proba[:, 0], np.prod(1.0 - proba[:, 1:], axis=1), atol=1e-12)
    else:
        np.testing.assert_allclose(proba.sum(axis=1), 1.0, atol=1e-9)
    assert found.predict_proba(points[:0]).shape == (0, 3)
    with pytest.raises(MapError):
        found.predict_proba(np.full((2, 3), np.nan))


@pytest.mark.parametrize("key", METHODS)
def test_a_point_is_answered_alike_in_any_company(key, fitted, points):
    found = fitted(key)
    together = found.predict_proba(points)
    order = np.random.default_rng(1).permutation(len(points))
    np.testing.assert_allclose(found.predict_proba(points[order]), together[order], atol=1e-6)
    alone = np.concatenate([found.predict_proba(points[i : i + 1]) for i in range(0, 400, 40)])
    np.testing.assert_allclose(alone, together[0:400:40], atol=1e-6)


@pytest.mark.parametrize("key", METHODS)
def test_every_method_finds_the_objects(key, fitted):
    """The side of each that faces the camera belongs to it, the air before it to nobody."""
    found, level = fitted(key), method(key).level
    scene = small_scene()
    surface, labels = scene.observation.points()
    for column, object_id in enumerate(found.object_ids, start=1):
        own = surface[labels == object_id][::50]
        ray = own - scene.camera.center
        # A voxel with a return may be the last that is known, a continuous surface is inside.
        deep = 0.004 if method(key).continuous else 0.0
        if key == "network":  # its voxels are 7.5 mm wide
            deep = 0.008
        behind = own + deep * ray / np.linalg.norm(ray, axis=1, keepdims=True)
        before = own - 0.06 * ray / np.linalg.norm(ray, axis=1, keepdims=True)
        assert (found.predict_proba(behind)[:, column] >= level).mean() > 0.5
        free = scene.signed_distance(before) > 0.05
        assert (found.predict_proba(before[free])[:, column] < level).mean() > 0.95


@pytest.mark.parametrize("key", REPEATED)
def test_the_same_seed_gives_the_same_bits(key, fitted, observation, points):
    first = fitted(key).predict_proba(points)
    again = method(key).fit(observation, 0).predict_proba(points)
    np.testing.assert_array_equal(first, again)


@pytest.mark.parametrize("key", ["vprism-paper", "sigmoid", "voxel", "octomap"])
def test_columns_follow_the_labels(key, fitted, observation, points):
    """Call object 2 object 9: the columns change places, and that is all."""
    labels = np.where(observation.labels == 2, 9, observation.labels)
    renamed = method(key).fit(replace(observation, labels=labels), 0)
    assert tuple(renamed.object_ids) == (5, 9)
    expected = fitted(key).predict_proba(points)[:, [0, 2, 1]]
    if key in ("voxel", "octomap"):
        np.testing.assert_array_equal(renamed.predict_proba(points), expected)
    else:  # the random numbers fall on other samples
        assert np.abs(renamed.predict_proba(points) - expected).mean() < 0.05


@pytest.mark.parametrize("key", ["voxel", "octomap"])
def test_voxels_turn_and_move_with_the_scene(key, fitted, observation, points):
    """A quarter turn and a shift by whole voxels leave every answer as it was."""
    move = np.eye(4)
    move[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    move[:3, 3] = 0.13, -0.04, 0.02
    plane = fitted("voxel").plane  # fitted once: its own fit would be off by rounding
    moved = replace(
        observation,
        T_world_camera=move @ observation.T_world_camera,
        plane=plane.transformed(move),
    )
    there = points[:400] @ move[:3, :3].T + move[:3, 3]
    expected = fitted(key).predict_proba(points[:400])
    same = (method(key).fit(moved, 0).predict_proba(there) == expected).all(axis=1)
    assert same.mean() > 0.99  # what lies on the side of a voxel may fall to either


@pytest.mark.parametrize("key", METHODS)
def test_nothing_to_map_is_an_error_everywhere(key, observation):
    empty = replace(observation, labels=np.zeros_like(observation.labels))
    with pytest.raises(ObservationError, match="no object"):
        method(key).fit(empty, 0)
    with pytest.raises(ObservationError, match="no labels"):
        method(key).fit(replace(observation, labels=None), 0)


def test_methods_are_found_by_key_and_sent_to_other_processes():
    assert [key for key, entry in METHODS.items() if key != entry.key] == []
    assert pickle.loads(pickle.dumps(method("sgd"))).key == "sgd"
    with pytest.raises(ConfigError, match=r"'psdf'.*voxel"):
        method("psdf")


# ------------------------------------------------------------------ voxels
@given(seed=st.integers(0, 10**6))
def test_rays_mark_exactly_the_voxels_they_pass(seed):
    rng = np.random.default_rng(seed)
    origin, lower, edge, shape = rng.normal(size=3), rng.normal(size=3) * 0.2, 0.3, (4, 3, 5)
    points = rng.normal(size=(3, 3)) * 0.5
    points[0, seed % 3] = origin[seed % 3]  # one ray is parallel to a side
    passed = np.zeros(shape, dtype=bool)
    voxel_rays.mark_passed(points, origin, lower, edge, passed)
    length = ray_oracles.passed_lengths(points, origin, lower, edge, shape)
    assert passed[length > 1e-9].all()
    assert (length[passed] > 0.0).all() or (length[passed] >= -1e-9).all()
    reached = ray_oracles.passed_lengths(points, origin, lower - 1e-9, edge + 2e-9, shape)
    assert not passed[reached == 0.0].any()


@given(seed=st.integers(0, 10**6))
def test_what_is_not_observed_is_as_the_nearest_that_is(seed):
    rng = np.random.default_rng(seed)
    classes = rng.integers(0, 3, (5, 4, 6))
    observed = rng.random(classes.shape) < 0.1
    observed[2, 2, 2] = True
    found = voxel.filled(classes, observed).reshape(-1)
    allowed = ray_oracles.nearest_classes(classes, observed)
    assert all(int(k) in near for k, near in zip(found, allowed, strict=True))


def test_voxels_hold_what_was_seen_and_nothing_under_the_table(fitted, observation, points):
    found = fitted("voxel")
    below = points[points[:, 2] < -0.005]
    assert (found.predict_proba(below)[:, 0] == 1.0).all()
    seen, labels = observation.points()
    high = (labels > 0) & (seen[:, 2] > 0.01)
    proba = found.predict_proba(seen[high])
    # Two objects, or an object and a stray pixel, may share a voxel.
    assert (proba[np.arange(high.sum()), np.searchsorted((0, 2, 5), labels[high])]).mean() > 0.99
    lower = found.edge * (found.first - 0.5)
    upper = lower + found.edge * np.array(found.classes.shape)
    outside = np.array([lower - 0.001, upper + 0.001])
    assert (found.predict_proba(outside)[:, 0] == 1.0).all()


# ------------------------------------------------------------------ OctoMap
def test_octomap_counts_hits_and_misses_part_by_part():
    """A wall in 8 x 6 pixels, all cells near it against a loop over rays and cells."""
    intrinsics = np.array([[20.0, 0.0, 3.4], [0.0, 20.0, 2.3], [0.0, 0.0, 1.0]])
    depth = np.full((6, 8), 0.197)
    depth[:, 5:] = 0.233
    labels = np.zeros((6, 8), dtype=np.int32)
    labels[2:4, 2:4] = 7
    cell = 0.02
    seen = Observation(depth, labels, intrinsics)
    found = octomap.fit(seen, 0, cell)
    image, lower, shape = seen.point_image(), np.array([-0.05, -0.05, 0.15]), (5, 5, 5)
    log_odds, counted = np.zeros(shape), np.zeros(shape, dtype=bool)
    for part in ((0, 0), (0, 1), (1, 0), (1, 1)):
        cloud = image[part[0] :: 2, part[1] :: 2].reshape(-1, 3)
        crossed = ray_oracles.passed_lengths(cloud, np.zeros(3), lower, cell, shape)
        for index in np.ndindex(shape):
            corner = lower + cell * np.array(index)
            hit = ((cloud >= corner) & (cloud < corner + cell)).all(axis=1).any()
            if hit or crossed[index] > 1e-9:
                step = np.log(0.7 / 0.3) if hit else np.log(0.4 / 0.6)
                log_odds[index] = np.clip(
                    log_odds[index] + step, np.log(0.1192 / 0.8808), np.log(0.971 / 0.029)
                )
                counted[index] = True
    centers = lower + cell * (np.argwhere(np.ones(shape)) + 0.5)
    occupancy = found.occupancy(centers).reshape(shape)
    np.testing.assert_array_equal(~np.isnan(occupancy), counted)
    expected = 1.0 / (1.0 + np.exp(-log_odds))
    np.testing.assert_allclose(occupancy[counted], expected[counted], atol=1e-3)
    state = found.state(centers).reshape(shape)
    np.testing.assert_array_equal(state == octomap.UNKNOWN, ~counted)
    np.testing.assert_array_equal(state == octomap.OCCUPIED, counted & (expected >= 0.5))


def test_octomap_leaves_what_it_did_not_see_just_under_one_half(fitted):
    found = fitted("octomap")
    under = np.array([[0.0, 0.0, -0.3]])
    assert found.state(under) == octomap.UNKNOWN
    proba = found.predict_proba(under)[0]
    assert proba[1:].sum() < 0.5
    assert proba[1:].sum() == pytest.approx(0.5)
    table = np.array([[0.0, -0.2, 0.0]])  # occupied, but by no object
    assert found.state(table) == octomap.OCCUPIED
    assert found.predict_proba(table)[0, 0] == 1.0


# ------------------------------------------------------------------ sigmoid maps, SGD
def test_of_a_single_object_the_binary_map_is_the_map():
    alone = small_observation(slice(0, 1))
    config = MapConfig.paper()
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (200, 3))
    whole = fit_map(alone, config, 3).predict_proba(points)
    np.testing.assert_allclose(
        sigmoid.fit(alone, 3, config).predict_proba(points), whole, atol=1e-12
    )


def test_binary_maps_learn_from_the_same_points_in_the_same_features(fitted, observation):
    """Each against dense EM, the other object's points called empty."""
    config = MapConfig(hinge_spacing=0.06, iterations=2, relaxation=1.0, variational_updates=1,
                       below_plane_samples=100, empty_resolution=0.06)  # fmt: skip
    found = sigmoid.fit(observation, 0, config)
    problem = learning_problem(observation, config, 0)
    for k, own in enumerate(found.maps, start=1):
        np.testing.assert_array_equal(own.space.hinges, problem.space.hinges)
        again = fit_binary(problem, own.config, k)
        np.testing.assert_allclose(own.posterior.mean.T, again.mean, rtol=1e-6, atol=1e-8)
    # Together they claim as much of unseen space as the map of all objects would.
    share = 1.0 - found.maps[0].config.prior_occupancy
    assert share**2 == pytest.approx(1.0 - config.prior_occupancy)


def fit_binary(problem, config, k):
    """Dense EM of one object against everything else."""
    from vprism_plan.mapping.em import weight_prior

    prior = weight_prior(problem.space, config, 2)
    variance = prior[0].covariance[problem.space.diagonal]
    phi = dense_em.features(
        problem.data.points, problem.space.hinges, config.gamma, problem.space.radius
    )
    classes = (problem.data.classes == k).astype(int)
    return dense_em.fit(
        phi,
        classes,
        np.stack([own.mean for own in prior]),
        np.stack([np.diag(variance)] * 2),
        config.iterations,
    )


def test_overlap_counts_points_with_several_owners():
    proba = np.array([[0.1, 0.8, 0.7], [0.2, 0.9, 0.1], [0.9, 0.2, 0.1], [0.3, 0.5, 0.5]])
    assert sigmoid.overlap(proba, 0.5) == (2, 3)


@pytest.fixture(scope="module")
def problem(observation):
    config = MapConfig(hinge_spacing=0.05, below_plane_samples=300, empty_resolution=0.03)
    return learning_problem(observation, config, 0)


def test_sparse_features_are_the_dense_ones(problem):
    space, points = problem.space, problem.data.points[::7]
    points = np.concatenate([points, space.hinges[:3]])  # a distance of 0 counts as well
    dense = dense_em.features(points, space.hinges, space.gamma, space.radius)
    np.testing.assert_allclose(sgd.sparse_features(space, points).toarray(), dense, atol=1e-12)


def test_the_gradient_is_that_of_the_negative_log_likelihood(problem):
    features = sgd.sparse_features(problem.space, problem.data.points[::5])
    labels = problem.data.classes[::5]
    start = np.random.default_rng(0).normal(size=(problem.space.size, 3))
    weights = torch.from_numpy(start).requires_grad_()
    loss = torch.nn.functional.cross_entropy(
        torch.from_numpy(features.toarray()) @ weights, torch.from_numpy(labels)
    )
    loss.backward()
    value, gradient = sgd.loss_and_gradient(features, labels, start)
    assert value == pytest.approx(loss.item())
    np.testing.assert_allclose(gradient, weights.grad.numpy(), atol=1e-12)


def test_the_point_estimate_is_a_softmax_and_fits_its_data(fitted, points):
    found = fitted("sgd")
    assert isinstance(found, VPrismMap)
    phi = dense_em.features(points, found.space.hinges, found.space.gamma, found.space.radius)
    expected = torch.softmax(torch.from_numpy(phi @ found.posterior.mean), dim=1).numpy()
    np.testing.assert_allclose(found.predict_proba(points), expected, atol=1e-9)
    assert found.history[-1] > max(found.history[0], -0.1)  # nats per point


# ------------------------------------------------------------------ meshes
