# SPDX-License-Identifier: BSD-3-Clause
"""From views to a map: accuracy, invariance, updates, and input that cannot be used."""

import dataclasses

import numpy as np
import pytest
import torch

from vprism_plan.errors import MapError, ObservationError, PlaneNotFoundError
from vprism_plan.mapping import MapConfig, fit_map, load_map
from vprism_plan.mapping.em import expand_prior, weight_prior
from vprism_plan.mapping.features import FeatureSpace
from vprism_plan.mapping.fitting import training_data
from vprism_plan.mapping.posterior import VPrismMap
from vprism_plan.perception import Observation, Plane
from vprism_plan.simulation.scenes import random_scene


def grid_over(scene, spacing=0.015):
    box = np.concatenate([m.vertices for m in scene.truth_meshes().values()])
    axes = [
        np.arange(lo, hi, spacing)
        for lo, hi in zip(box.min(0) - 0.06, box.max(0) + 0.06, strict=True)
    ]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    return grid[grid[:, 2] > 0.002]


def iou(scene, fitted, points):
    truth = scene.object_of(points) > 0
    found = fitted.occupancy(points) > 0.5
    return (truth & found).sum() / (truth | found).sum()


def test_the_map_is_near_the_truth(scene, default_map):
    """Default preset; it must also beat the paper's parameters on the same view."""
    grid = grid_over(scene)
    found = iou(scene, default_map, grid)
    assert found > 0.6
    assert found > iou(scene, fit_map(scene.observation, MapConfig.paper()), grid)
    assert default_map.object_ids == scene.observation.object_ids
    assert default_map.n_classes == len(default_map.object_ids) + 1
    assert default_map.hinge_points.shape == (len(default_map.space.hinges), 3)
    assert (np.diff(default_map.history) > 0).all()


def test_just_behind_an_observed_surface_is_its_object(scene, default_map):
    points, labels = scene.observation.points()
    for k, object_id in enumerate(default_map.object_ids, start=1):
        own = points[labels == object_id][::5]
        inward = own - scene.observation.camera_center
        inside = own + 0.01 * inward / np.linalg.norm(inward, axis=1, keepdims=True)
        inside = inside[scene.signed_distance(inside) < -0.003]
        assert len(inside) > 100
        proba = default_map.predict_proba(inside)
        assert (1.0 - proba[:, 0] > 0.5).mean() > 0.95
        assert (proba.argmax(1) == k).mean() > 0.9


def test_visible_free_space_is_free(scene, default_map):
    points, labels = scene.observation.points()
    center = scene.observation.camera_center
    rays = points[labels > 0] - center
    length = np.linalg.norm(rays, axis=1, keepdims=True)
    before = center + rays * (1.0 - 0.05 / length)
    before = before[scene.signed_distance(before) > 0.03]
    assert (default_map.occupancy(before) > 0.5).mean() < 0.01


def test_same_seed_same_bits(scene, small_map, coarse, query):
    again = fit_map(scene.observation, coarse, seed=1, prior=None)
    np.testing.assert_array_equal(again.predict_proba(query), small_map.predict_proba(query))
    other = fit_map(scene.observation, coarse, seed=2, prior=None)
    assert (other.predict_proba(query) != small_map.predict_proba(query)).any()


def test_a_rigid_motion_moves_the_map_along(scene, coarse):
    """A shift by whole lattice cells and a quarter turn about z carry all grids along."""
    obs = scene.observation
    plane = Plane([0.0, 0.0, 1.0], 0.0)
    motion = np.eye(4)
    motion[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    motion[:3, 3] = [0.42, -0.84, 0.0]
    # Without drawn samples nothing depends on which random number meets which ray, and the
    # subsampling grids (7 and 15 mm) divide the shift.
    config = dataclasses.replace(
        coarse, surface_hinges=0, below_plane_samples=0, ray_step=50.0, object_radius=0.15
    )
    maps = []
    for transform in (np.eye(4), motion):
        view = Observation(
            obs.depth, obs.labels, obs.intrinsics, transform @ obs.pose,
            plane=plane.transformed(transform),
        )  # fmt: skip
        maps.append(fit_map(view, config, prior=None))
    query = grid_over(scene, 0.03)
    moved = query @ motion[:3, :3].T + motion[:3, 3]
    difference = maps[0].occupancy(query) - maps[1].occupancy(moved)
    assert len(maps[0].hinge_points) == len(maps[1].hinge_points)
    assert np.abs(difference).max() < 0.05
    assert np.abs(difference).mean() < 1e-3


def test_two_views_in_one_fit_beat_one(scene, second_view, small_map, coarse):
    both = fit_map([scene.observation, second_view], coarse, seed=1)
    grid = grid_over(scene)
    assert len(both.views) == 2
    assert iou(scene, both, grid) > iou(scene, small_map, grid) + 0.03


def test_an_update_is_near_the_joint_fit(scene, second_view, small_map, coarse):
    grid = grid_over(scene)
    updated = small_map.update(second_view)
    joint = fit_map([scene.observation, second_view], coarse, seed=1, prior=None)
    assert updated.views == (*small_map.views, second_view)
    assert len(small_map.views) == 1
    assert np.abs(updated.occupancy(grid) - joint.occupancy(grid)).mean() < 0.08
    assert iou(scene, updated, grid) > iou(scene, small_map, grid) + 0.02
    assert iou(scene, updated, grid) > iou(scene, joint, grid) - 0.08


def test_an_update_keeps_old_hinges_and_gives_new_ground_the_prior(small_map):
    """The prior of an update is the old posterior, joint, plus independent new weights."""
    old = small_map.space
    extra = np.array([[5.0, 0.0, 0.0], [5.01, 0.0, 0.0]])
    from vprism_plan.mapping.features import sorted_hinges

    space = FeatureSpace(sorted_hinges(np.concatenate([old.hinges, extra])), old.gamma, old.radius)
    flat = weight_prior(space, small_map.config, small_map.n_classes)
    prior = expand_prior(old, small_map.posterior, space, flat)
    from vprism_plan.mapping.factors import dense

    order = [int(np.flatnonzero((space.hinges == h).all(1))[0]) for h in old.hinges]
    order.append(space.size - 1)
    fresh = [i for i in range(space.size) if i not in order]
    for own, was in zip(prior, small_map.posterior.classes, strict=True):
        new, before = dense(space, own.precision), dense(was.space, was.precision)
        kept = np.array(order)[was.members]
        np.testing.assert_array_equal(new[np.ix_(kept, kept)], before)
        variance = small_map.config.weight_variance
        np.testing.assert_allclose(new[np.ix_(fresh, fresh)], np.eye(2) / variance)
        assert (new[np.ix_(order, fresh)] == 0).all()
        assert own.log_determinant == pytest.approx(np.linalg.slogdet(new)[1], rel=1e-9)
        np.testing.assert_array_equal(own.mean[kept], was.mean)
        # Of a covariance only what points that see both hinges ask for.
        rows, columns = was.space.pairs.T
        np.testing.assert_array_equal(
            dense(space, own.covariance)[kept[rows], kept[columns]],
            dense(was.space, was.covariance)[rows, columns],
        )


def test_an_update_with_a_new_object_fits_all_views_again(scene, coarse):
    obs = scene.observation
    hidden = np.where(obs.labels == 3, 0, obs.labels)
    first = fit_map(
        Observation(obs.depth, hidden, obs.intrinsics, obs.pose, plane=obs.plane), coarse
    )
    assert 3 not in first.object_ids
    second = first.update(obs)
    assert second.object_ids == (*first.object_ids, 3)
    assert len(second.views) == 2


def test_an_update_may_miss_objects(scene, small_map, coarse):
    """A later view shows only object 2: its class index must stay what it was."""
    obs = scene.observation
    only = np.where(obs.labels == 2, 2, 0)
    depth = np.where((obs.labels == 0) | (obs.labels == 2), obs.depth, 0.0)
    updated = small_map.update(Observation(depth, only, obs.intrinsics, obs.pose))
    assert updated.object_ids == small_map.object_ids
    own = obs.points()[0][obs.points()[1] == 2]
    middle = own.mean(0)[None]
    assert updated.predict_proba(middle)[0].argmax() == updated.object_ids.index(2) + 1


def test_training_points_hold_every_kind(scene, coarse):
    obs = scene.observation
    rng = np.random.default_rng(0)
    config = dataclasses.replace(coarse, max_points=3000)
    plane = Plane([0.0, 0.0, 1.0], 0.0)
    full = training_data([obs], obs.object_ids, plane, coarse, rng)
    assert set(np.unique(full.classes)) == set(range(len(obs.object_ids) + 1))
    assert (full.points[full.classes == 0][:, 2] < -0.02).any()
    near = np.linalg.norm(full.points[:, None] - 0.5 * (full.lower + full.upper)[None], axis=2)
    assert (near.min(1)[full.classes == 0] <= coarse.object_radius * 1.02).all()
    thin = training_data([obs], obs.object_ids, plane, config, np.random.default_rng(0))
    assert len(thin.points) == 3000
    assert (thin.classes > 0).sum() == (full.classes > 0).sum()


def table_only():
    obs = random_scene(1, 0).observation
    return obs, np.zeros_like(obs.labels)


def test_no_labels_point_to_segmentation():
    obs, _ = table_only()
    with pytest.raises(ObservationError, match="segment_tabletop"):
        fit_map(Observation(obs.depth, None, obs.intrinsics, obs.pose))


def test_an_empty_table_is_a_map_that_says_so(scene, tmp_path):
    obs, nothing = table_only()
    empty = Observation(obs.depth, nothing, obs.intrinsics, obs.pose)
    fitted = fit_map(empty)
    assert fitted.object_ids == ()
    assert any("segment_tabletop" in text for text in fitted.warnings)
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    assert (fitted.predict_proba(points) == 1.0).all()
    assert (fitted.entropy(points) == 0.0).all()
    assert (fitted.occupancy(torch.from_numpy(points)) == 0.0).all()
    fitted.save(tmp_path / "map.safetensors")
    again = load_map(tmp_path / "map.safetensors")
    assert (again.object_ids, again.warnings) == (fitted.object_ids, fitted.warnings)
    assert again.plane.offset == fitted.plane.offset
    # What is seen later enters. A view without labels takes nothing away that still stands there,
    # but what it looks through.
    seen = scene.observation
    later = fitted.update(seen)
    assert later.object_ids == seen.object_ids
    unlabelled = Observation(seen.depth, nothing, seen.intrinsics, seen.pose)
    assert later.update(unlabelled).object_ids == later.object_ids
    gone = later.update(empty)
    assert (gone.object_ids, gone.changes.left) == ((), seen.object_ids)


def test_labels_of_which_none_is_an_object_are_refused():
    obs, labels = table_only()
    hidden = np.where(obs.depth == 0, 0, labels)
    row, column = np.argwhere(obs.depth > 0)[0]
    hidden[row, column] = 3
    depth = obs.depth.copy()
    depth[row, column] = 0.0
    with pytest.raises(ObservationError, match="no depth return"):
        fit_map(Observation(depth, hidden, obs.intrinsics, obs.pose))


def test_no_plane_is_an_error():
    rng = np.random.default_rng(0)
    labels = np.zeros((60, 80), dtype=np.int32)
    labels[20:30, 20:30] = 1
    intrinsics = np.array([[60.0, 0, 39.5], [0, 60.0, 29.5], [0, 0, 1]])
    depth = rng.uniform(0.3, 3.0, (60, 80))
    with pytest.raises(PlaneNotFoundError):
        fit_map(Observation(depth, labels, intrinsics))


def test_nothing_to_fit_is_an_error():
    with pytest.raises(ObservationError):
        fit_map([])


def test_several_views_need_poses(scene):
    obs = scene.observation
    unposed = Observation(obs.depth, obs.labels, obs.intrinsics)
    with pytest.raises(ObservationError, match="T_world_camera"):
        fit_map([obs, unposed])


def test_a_scene_that_outgrows_the_budget_gets_a_coarser_lattice(scene, second_view):
    asked = MapConfig(max_hinges=400)
    fitted = fit_map(scene.observation, asked, prior=None)
    used = fitted.config
    assert 300 < len(fitted.space.hinges) <= 400
    assert fitted.kernel_length == used.kernel_length > asked.kernel_length
    # Spacing and kernel grow together: the prior of a logit stays what it was.
    assert used.mean_squared_feature_sum == pytest.approx(asked.mean_squared_feature_sum)
    assert used.hinge_spacing / asked.hinge_spacing == pytest.approx(
        used.kernel_length / asked.kernel_length
    )
    (warning,) = [text for text in fitted.warnings if "max_hinges" in text]
    assert f"{1e3 * used.hinge_spacing:.0f} mm apart instead of 28" in warning
    assert iou(scene, fitted, grid_over(scene)) > 0.5
    # New ground that does not fit beside the old: both views again, coarser.
    tight = dataclasses.replace(used, max_hinges=len(fitted.space.hinges))
    again = VPrismMap(
        tight, fitted.object_ids, fitted.plane, fitted.views, fitted.space, fitted.posterior, 0
    ).update(second_view)
    assert len(again.views) == 2
    assert len(again.space.hinges) <= tight.max_hinges


def test_a_budget_that_no_lattice_meets_is_refused(scene):
    with pytest.raises(MapError, match="more than max_hinges = 10, and its largest object"):
        fit_map(scene.observation, MapConfig(max_hinges=10))


def test_around_a_guess_objects_are_local(scene, default_map):
    """An object has the hinges near its box; elsewhere its logit is the guess."""
    fitted = fit_map(scene.observation)
    reach, everywhere = fitted.config.class_reach, fitted.space
    points, labels = scene.observation.points()
    empty, *objects = fitted.posterior.classes
    assert empty.space is everywhere
    for k, own in enumerate(objects, start=1):
        seen = points[labels == fitted.object_ids[k - 1]]
        low, high = seen.min(0) - reach - 1e-9, seen.max(0) + reach + 1e-9
        hinges = own.space.hinges
        assert ((hinges > low) & (hinges < high)).all()
        assert 0 < len(hinges) < len(everywhere.hinges)
        apart = np.linalg.norm(everywhere.hinges[:, None] - hinges, axis=2).min(1)
        far = everywhere.hinges[apart > fitted.cutoff_radius]
        mean, variance = fitted.logit_moments(far)
        np.testing.assert_array_equal(mean[:, k], own.mean[-1] + fitted.prior.at(far)[:, k])
        np.testing.assert_array_equal(variance[:, k], own.covariance[-1])
    # Without a guess kernels alone say what is behind an object.
    assert all(own.space is default_map.space for own in default_map.posterior.classes)


def test_the_repr_is_short(small_map):
    assert isinstance(small_map, VPrismMap)
    assert "object_ids=" in repr(small_map)
    assert len(repr(small_map)) < 200
