# SPDX-License-Identifier: BSD-3-Clause
"""What a robot in the picture teaches a map: that rays before it are empty, and nothing more."""

from dataclasses import replace

import numpy as np
import pytest
from oracles.perception_oracles import Scene, intrinsics, look_at

from vprism_plan.mapping import MapConfig, fit_map, load_map
from vprism_plan.mapping.fitting import training_data
from vprism_plan.perception import Observation, Plane, ignore_robot

POSE = look_at((-0.7, 0.0, 0.6))
BALL, RADIUS = np.array([-0.06, 0.0, 0.2]), 0.05
TABLE = Plane((0.0, 0.0, 1.0), 0.0)


@pytest.fixture(scope="module")
def raw() -> Observation:
    """A cube (1) and, between it and the camera, the robot, which someone labelled 2."""
    scene = Scene(spheres=[(BALL, RADIUS)], boxes=[((0.0, -0.06, 0.0), (0.1, 0.06, 0.1))])
    K = intrinsics(160, 120)
    depth, labels = scene.render(POSE, K, (120, 160))
    return Observation(depth, np.array([0, 2, 1])[labels], K, POSE, plane=TABLE)


@pytest.fixture(scope="module")
def marked(raw) -> Observation:
    bare = replace(raw, labels=np.where(raw.labels == 2, 0, raw.labels))
    return ignore_robot(bare, BALL[None], [RADIUS], 0.005, remove_flying=False)


def data_of(obs: Observation, seed: int = 0):
    config = MapConfig(hinge_spacing=0.05)
    return training_data((obs,), obs.object_ids, TABLE, config, np.random.default_rng(seed))


def test_points_of_the_robot_are_neither_object_nor_empty(raw, marked):
    assert raw.object_ids == (1, 2)
    assert marked.object_ids == (1,)
    data = data_of(marked)
    assert (np.linalg.norm(data.points[data.classes > 0] - BALL, axis=1) > RADIUS + 0.02).all()
    gap = np.linalg.norm(data.points[data.classes == 0] - BALL, axis=1) - RADIUS
    assert gap.min() > -0.002
    background = replace(raw, labels=np.where(raw.labels == 2, 0, raw.labels))
    unmarked = data_of(background)
    close = np.abs(np.linalg.norm(unmarked.points - BALL, axis=1) - RADIUS) < 0.003
    assert (np.abs(gap) < 0.003).sum() < 0.7 * close.sum()


def test_rays_before_the_robot_are_empty_and_rays_behind_it_are_not_drawn(marked):
    """Along rays that end on the robot: samples up to it, none past it."""
    data = data_of(marked)
    empty = data.points[data.classes == 0]
    way = empty - POSE[:3, 3]
    axis = BALL - POSE[:3, 3]
    distance = np.linalg.norm(axis)
    along = way @ axis / distance
    aside = np.linalg.norm(way - along[:, None] * axis / distance, axis=1)
    shadow = aside < 0.6 * RADIUS * along / distance
    assert (shadow & (along < distance - RADIUS)).sum() > 20
    above = empty[:, 2] > 0.005
    assert not (shadow & above & (along > distance - 0.5 * RADIUS)).any()


def test_a_view_without_a_robot_gives_the_same_bits(raw):
    far = ignore_robot(raw, np.array([[9.0, 9.0, 9.0]]), [0.1])
    before, after = data_of(raw), data_of(far)
    np.testing.assert_array_equal(before.points, after.points)
    np.testing.assert_array_equal(before.classes, after.classes)


def test_maps_keep_the_marks_and_maps_without_them_still_load(raw, marked, tmp_path):
    config = MapConfig(hinge_spacing=0.06, surface_hinges=8, iterations=1)
    for name, obs in (("marked", marked), ("plain", raw)):
        fitted = fit_map(obs, config)
        fitted.save(tmp_path / name)
        loaded = load_map(tmp_path / name)
        (view,) = loaded.views
        np.testing.assert_array_equal(view.sees_robot, obs.sees_robot)
        np.testing.assert_array_equal(view.labels, obs.labels)
        points = obs.points()[0][::50]
        np.testing.assert_array_equal(loaded.predict_proba(points), fitted.predict_proba(points))
    assert view.robot_spheres is None  # as in every map written before there were marks
