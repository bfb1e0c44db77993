# SPDX-License-Identifier: BSD-3-Clause
"""A guess of the hidden side: on a grid, joined to the kernels, and overruled by what was seen."""

import numpy as np
import pytest
import torch
import trimesh
from scipy.interpolate import RegularGridInterpolator

from vprism_plan.errors import MapError
from vprism_plan.mapping import MeshPrior, fit_map, load_map
from vprism_plan.mapping.prior import FLAT_OCCUPANCY, MOST, SIDE, Crop, PriorField, hidden_depth
from vprism_plan.perception.plane import Plane

TABLE = Plane((0.0, 0.0, 1.0), 0.0)


@pytest.fixture(scope="module")
def field():
    rng = np.random.default_rng(5)
    crops = [
        Crop.around(rng.normal(scale=0.04, size=(50, 3)) + at, np.array([1.0, 0.3, 0.8]), TABLE)
        for at in ([0.0, 0.0, 0.1], [0.05, 0.1, 0.05])
    ]
    grids = rng.normal(scale=4.0, size=(2, SIDE, SIDE, SIDE)).astype(np.float32)
    return PriorField(np.stack([c.T_voxel_world() for c in crops]), grids, -2.5), crops


def textbook(field, crops, points):
    """Trilinear on every grid; nothing of an object outside its own grid but inside another's."""
    axis = np.arange(float(SIDE))
    columns = [np.zeros(len(points))]
    for crop, grid in zip(crops, field.log_odds, strict=True):
        look = RegularGridInterpolator(
            (axis,) * 3, grid.astype(float), bounds_error=False, fill_value=np.nan
        )
        columns.append(look(crop.to_voxels(points)))
    found = np.stack(columns, axis=1)
    nowhere = np.isnan(found[:, 1:]).all(axis=1)
    return np.where(np.isnan(found), np.where(nowhere, field.elsewhere, -MOST)[:, None], found)


def test_the_field_is_trilinear_on_every_grid(field):
    field, crops = field
    points = np.random.default_rng(0).uniform(-0.2, 0.3, (4000, 3))
    expected = textbook(field, crops, points)
    assert (expected[:, 1:] == field.elsewhere).all(axis=1).any()
    np.testing.assert_allclose(field.at(points, ()), expected, atol=1e-9)


def test_a_points_bits_do_not_depend_on_its_company(field):
    field, _ = field
    points = np.random.default_rng(1).uniform(-0.2, 0.3, (333, 3))
    together = field.at(points, ())
    for row in range(0, len(points), 11):
        np.testing.assert_array_equal(field.at(points[row : row + 1], ())[0], together[row])


def test_slopes_of_the_field_are_its_differences(field):
    field, crops = field
    inner = np.random.default_rng(2).uniform(2.0, SIDE - 3.0, (200, 3))
    pose = crops[0].T_world_crop
    points = (inner + 0.5) * crops[0].voxel @ pose[:3, :3].T + pose[:3, 3]
    x = torch.from_numpy(points).requires_grad_()
    field.logits(x, ())[:, 1].sum().backward()
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-7
        slope = (field.at(points + step, ()) - field.at(points - step, ()))[:, 1] / 2e-7
        close = np.isclose(slope, x.grad[:, axis].numpy(), rtol=1e-3, atol=1e-2)
        assert close.mean() > 0.97  # but at the faces between voxels


def box_around(points, grow=0.0):
    low, high = points.min(axis=0) - grow, points.max(axis=0) + grow
    box = trimesh.creation.box(high - low)
    box.apply_translation(0.5 * (low + high))
    return box


@pytest.fixture(scope="module")
def hypotheses(scene):
    """A box around each object's true solid."""
    return {
        k: [(box_around(np.asarray(mesh.vertices)), 0.9)] for k, mesh in truth_of(scene).items()
    }


def truth_of(scene):
    seen = scene.observation.object_ids
    return {k: mesh for k, mesh in scene.truth_meshes().items() if k in seen}


@pytest.fixture(scope="module")
def guessed(scene, hypotheses):
    return fit_map(scene.observation, seed=1, prior=MeshPrior(hypotheses))


def test_hypotheses_say_what_is_hidden(scene, guessed, hypotheses):
    """Behind what was seen, the boxes are likelier with the prior than without, space is not."""
    for k, [(box, _)] in hypotheses.items():
        points = box.sample(400, seed=0) * 0.6 + box.bounds.mean(axis=0) * 0.4
        deep = hidden_depth(points, [scene.observation]) > 0.03
        column = guessed.object_ids.index(k) + 1
        assert guessed.predict_proba(points[deep])[:, column].mean() > 0.7
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.3, -0.3, 0.01], [0.3, 0.3, 0.3], (4000, 3))
    away = (hidden_depth(points, [scene.observation]) > 0.03) & np.all(
        [~box.contains(points) for [(box, _)] in hypotheses.values()], axis=0
    )
    near = guessed.support(points) > 0.5
    assert guessed.occupancy(points[away & near]).mean() < 0.2


def test_what_was_seen_overrules_the_guess(scene, default_map):
    """Boxes in seen, empty space in front of the objects are denied."""
    seen = scene.observation
    points, labels = seen.points()
    wrong = {}
    for k in seen.object_ids:
        own = points[labels == k]
        way = seen.camera_center - own.mean(axis=0)
        wrong[k] = [(box_around(own + 0.06 * way / np.linalg.norm(way)), 0.99)]
    fitted = fit_map(seen, seed=1, prior=MeshPrior(wrong))
    rng = np.random.default_rng(0)
    for k, [(box, _)] in wrong.items():
        inside = rng.uniform(*box.bounds, (2000, 3))
        free = hidden_depth(inside, [seen]) < -0.015
        assert free.sum() > 100
        assert np.quantile(fitted.occupancy(inside[free]), 0.9) < 0.5
        own = points[labels == k]
        assert (
            np.mean(fitted.occupancy(own) > 0.3) > np.mean(default_map.occupancy(own) > 0.3) - 0.2
        )


def test_with_a_prior_the_questions_agree(guessed, query):
    proba = guessed.predict_proba(query)
    x = torch.from_numpy(query).requires_grad_()
    np.testing.assert_allclose(guessed.predict_proba(x).detach().numpy(), proba, atol=1e-12)
    np.testing.assert_allclose(guessed.occupancy(query), 1.0 - proba[:, 0], atol=1e-12)
    guessed.occupancy(x).sum().backward()
    step = np.array([1e-6, 0.0, 0.0])
    slope = (guessed.occupancy(query + step) - guessed.occupancy(query - step)) / 2e-6
    assert np.isclose(slope, x.grad[:, 0].numpy(), rtol=1e-3, atol=1e-3).mean() > 0.98


def test_a_saved_map_keeps_its_prior(guessed, query, tmp_path):
    guessed.save(tmp_path / "m.safetensors")
    loaded = load_map(tmp_path / "m.safetensors")
    np.testing.assert_array_equal(loaded.predict_proba(query), guessed.predict_proba(query))


def test_a_later_view_builds_on_the_prior(guessed, second_view, scene):
    later = guessed.update(second_view)
    assert later.prior is guessed.prior
    points = np.random.default_rng(3).uniform([-0.2, -0.2, 0.0], [0.2, 0.2, 0.2], (3000, 3))
    truth = scene.signed_distance(points) <= 0.0
    error = [np.mean((m.occupancy(points) - truth) ** 2) for m in (guessed, later)]
    assert error[1] < error[0]


def test_without_evidence_the_prediction_is_the_guess(scene):
    """Whatever the variance of the weights: far behind, where no sample is, P is the prior's."""
    guess = 0.37

    def constant(views, object_ids, plane):
        n = len(object_ids)
        return lambda points: np.tile([1.0 - guess, *[guess / n] * n], (len(points), 1))

    one = scene.observation.object_ids[:1]
    labels = np.where(scene.observation.labels == one[0], one[0], 0).astype(np.int32)
    view = type(scene.observation)(
        scene.observation.depth, labels, scene.observation.intrinsics,
        scene.observation.T_world_camera,
    )  # fmt: skip
    fitted = fit_map(view, prior=constant)
    crop = fitted.prior
    centers = np.linalg.inv(np.vstack([crop.T_voxel_world[0], [0, 0, 0, 1]]))
    grid = np.random.default_rng(0).uniform(1, SIDE - 2, (6000, 3))
    points = grid @ centers[:3, :3].T + centers[:3, 3]
    deep = (hidden_depth(points, [view]) > 0.1) & (points[:, 2] > 0.05)
    assert deep.sum() > 20
    assert abs(np.median(fitted.occupancy(points[deep])) - guess) < 0.05


def test_the_papers_preset_asks_no_prior(scene):
    from vprism_plan.mapping import MapConfig

    def never(views, object_ids, plane):
        raise AssertionError("asked")

    config = MapConfig.paper()
    assert fit_map(scene.observation, config, prior=never).prior is None


@pytest.mark.parametrize(
    ("prior", "says"),
    [("shapes", "'shape'"), (3, "MeshPrior"), (MeshPrior({99: []}), r"\[99\]")],
)
def test_what_is_no_prior_is_refused(scene, coarse, prior, says):
    with pytest.raises(MapError, match=says):
        fit_map(scene.observation, coarse, prior=prior)


def test_meshes_that_are_no_solids_are_refused():
    open_box = trimesh.creation.box((0.1, 0.1, 0.1))
    open_box.update_faces(np.arange(10))
    with pytest.raises(MapError, match="object 1 is not closed"):
        MeshPrior({1: [(open_box, 0.5)]})
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    with pytest.raises(MapError, match="sum of the weights of object 2"):
        MeshPrior({2: [(box, 0.7), (box, 0.7)]})


def test_an_unknown_object_keeps_the_flat_prior(scene):
    guess = MeshPrior({})(scene.observation, scene.observation.object_ids, TABLE)
    proba = guess(np.zeros((5, 3)))
    np.testing.assert_allclose(proba[:, 0], 1.0 - FLAT_OCCUPANCY)
