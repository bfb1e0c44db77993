# SPDX-License-Identifier: BSD-3-Clause
"""A guess of the hidden side: on a grid, joined to the kernels, and overruled by what was seen."""

from itertools import product

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial import cKDTree

from vprism_plan.errors import MapError
from vprism_plan.mapping import MapConfig, MeshPrior, fit_map, load_map
from vprism_plan.mapping.prior import (
    FLAT_OCCUPANCY,
    MOST,
    SIDE,
    Crop,
    PriorField,
    hidden_depth,
)
from vprism_plan.mapping.shape_network import CHANNELS, own_prior
from vprism_plan.perception.plane import Plane
from vprism_plan.simulation.camera import Camera
from vprism_plan.simulation.scenes import Scene, render, upright
from vprism_plan.simulation.solids import Box
from vprism_plan.world import PosteriorWorlds, World, WorldConfig

TABLE = Plane((0.0, 0.0, 1.0), 0.0)


@pytest.fixture(scope="module")
def field():
    rng = np.random.default_rng(5)
    crops = [
        Crop.around(rng.normal(scale=0.04, size=(50, 3)) + at, np.array([1.0, 0.3, 0.8]), TABLE)
        for at in ([0.0, 0.0, 0.1], [0.05, 0.1, 0.05])
    ]
    grids = rng.normal(scale=4.0, size=(2, SIDE, SIDE, SIDE)).astype(np.float32)
    coarse = rng.normal(size=(9, 10, 11)).astype(np.float32)
    to_nodes = np.column_stack([np.eye(3), [0.3, 0.3, 0.1]]) / 0.06
    poses = np.stack([crop.T_voxel_world() for crop in crops])
    return PriorField(poses, grids, to_nodes, coarse)


def textbook(field, points):
    """Point by point, from the definition."""
    expected = np.zeros((len(points), 1 + len(field.log_odds)))
    for row, point in enumerate(points):
        flat = trilinear(field.elsewhere, field.T_node_world @ [*point, 1.0])
        places = [pose @ [*point, 1.0] for pose in field.T_voxel_world]
        shares = [
            min(max(min(*at, *(SIDE - 1.0 - at)) / 2.0, 0.0), 1.0) for at in places
        ]  # of an object's own grid, from its side inwards
        for k, (at, share) in enumerate(zip(places, shares, strict=True)):
            other = (1.0 - max(shares)) * flat + max(shares) * -MOST
            own = trilinear(field.log_odds[k], at)
            expected[row, 1 + k] = share * own + (1.0 - share) * other
    return expected


def trilinear(grid, at):
    """The value at one place; outside, that of the nearest place on the border."""
    at = np.clip(at, 0.0, np.array(grid.shape) - 1.0)
    axes = tuple(np.arange(float(n)) for n in grid.shape)
    return float(RegularGridInterpolator(axes, grid.astype(float))(at[None])[0])


def test_the_field_is_what_its_definition_says(field):
    points = np.random.default_rng(0).uniform(-0.4, 0.5, (300, 3))
    np.testing.assert_allclose(field.at(points), textbook(field, points), atol=1e-9)


def test_a_points_bits_do_not_depend_on_its_company(field):
    points = np.random.default_rng(1).uniform(-0.2, 0.3, (333, 3))
    together = field.at(points)
    for row in range(0, len(points), 11):
        np.testing.assert_array_equal(field.at(points[row : row + 1])[0], together[row])


def test_the_field_has_no_steps_and_its_slopes_are_its_differences(field):
    """A step of the guess would look like a surface to the bound of the level set."""
    rng = np.random.default_rng(2)
    points = rng.uniform(-0.3, 0.4, (4000, 3))
    way = rng.normal(size=(4000, 3))
    way *= 1e-7 / np.linalg.norm(way, axis=1, keepdims=True)
    rise = (field.at(points + way) - field.at(points - way))[:, 1:]
    x = torch.from_numpy(points).requires_grad_()
    for k in range(2):
        (slope,) = torch.autograd.grad(field.logits(x)[:, 1 + k].sum(), x)
        expected = 2.0 * (slope.numpy() * way).sum(axis=1)
        close = np.isclose(rise[:, k], expected, rtol=1e-3, atol=1e-8)
        assert close.mean() > 0.97  # but across the faces between voxels
        # No two voxels differ by more than 30, and they are 7.5 mm apart.
        assert np.abs(rise[:, k]).max() < 2e-7 * 3 * 40.0 / 0.0075


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


def test_a_later_view_changes_the_guess_too(guessed, second_view, scene, hypotheses):
    """An update with a prior is the fit of all views; a guess that was kept held it back."""
    prior = MeshPrior(hypotheses)
    later = guessed.update(second_view, prior)
    joint = fit_map([scene.observation, second_view], seed=1, prior=prior)
    points = np.random.default_rng(3).uniform([-0.2, -0.2, 0.0], [0.2, 0.2, 0.2], (3000, 3))
    np.testing.assert_array_equal(later.predict_proba(points), joint.predict_proba(points))
    truth = scene.signed_distance(points) <= 0.0
    error = [np.mean((m.occupancy(points) - truth) ** 2) for m in (guessed, later)]
    assert error[1] < error[0]


def test_a_prior_of_your_own_is_not_replaced_in_silence(guessed, second_view, tmp_path):
    guessed.save(tmp_path / "m.safetensors")
    for fitted in (guessed, load_map(tmp_path / "m.safetensors")):
        with pytest.raises(MapError, match="give it again"):
            fitted.update(second_view)


def test_nothing_hangs_under_the_table(scene):
    """The guess of the hidden side once went on below it: meshes reached 2 cm down."""
    fitted = fit_map(scene.observation)
    points = np.random.default_rng(3).uniform([-0.2, -0.2, -0.03], [0.2, 0.2, -0.01], (3000, 3))
    assert fitted.occupancy(points).max() < 0.5


def test_without_evidence_the_prediction_is_the_guess():
    """Deep in the shadow of a carton, where no sample is, P is what the prior says."""
    camera = Camera.orbit(np.array([0.0, 0.0, 0.1]), 0.9, 0.4, 0.6)
    carton = Box((0.07, 0.1, 0.12), pose=upright(np.zeros(2), 0.12, 0.2))
    view = render(Scene((carton,), (1,), camera), camera)
    fitted = fit_map(view, prior=lambda *_: lambda points: np.tile([0.3, 0.7], (len(points), 1)))
    points = np.random.default_rng(0).uniform([-0.1, -0.1, 0.04], [0.1, 0.1, 0.2], (4000, 3))
    ways = [0.04 * np.array(way) for way in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]
    around = [points + sign * way for way in ways for sign in (-1, 1)]
    deep = np.all([hidden_depth(p, [view]) > 0.02 for p in around], axis=0)
    assert deep.sum() > 100
    assert abs(np.median(fitted.occupancy(points[deep])) - 0.7) < 0.05


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
    guess = MeshPrior({})([scene.observation], scene.observation.object_ids, TABLE)
    proba = guess(np.zeros((5, 3)))
    np.testing.assert_allclose(proba[:, 0], 1.0 - FLAT_OCCUPANCY)


def test_what_the_network_says_of_a_crop_does_not_depend_on_its_company():
    network = own_prior().network
    rng = np.random.default_rng(0)
    crops = torch.from_numpy(rng.normal(size=(3, CHANNELS, 32, 32, 32)).astype(np.float32))
    crops = crops.contiguous(memory_format=torch.channels_last_3d)
    with torch.inference_mode():
        said = network(crops[:2])[0]
        for company in ([2, 0], [0, 0]):
            assert torch.equal(network(crops[company])[1], said)


def specks(rng, classes):
    """Balls of 6 mm in the air."""
    tree = cKDTree(rng.uniform([-0.2, -0.2, 0.02], [0.2, 0.2, 0.2], (400, 3)))
    return lambda points: split(np.where(tree.query(points)[0] < 0.006, 0.98, 0.02), classes)


def noise(rng, classes):
    """Every voxel for itself."""
    values, shares = [0.002, 0.05, 0.6, 0.95], [0.6, 0.2, 0.1, 0.1]
    return lambda points: split(rng.choice(values, len(points), p=shares), classes)


def split(held, classes):
    return np.column_stack([1.0 - held, *[held / classes] * classes])


@pytest.mark.parametrize("adversary", [specks, noise])
def test_no_speck_of_a_guess_is_outside_the_level_set(scene, adversary):
    """Cells as wide as a kernel stepped over things as small as a voxel: 22 mm of it were free."""
    rng = np.random.default_rng(1)
    fitted = fit_map(scene.observation, prior=lambda _, ids, plane: adversary(rng, len(ids)))
    world = World(fitted, WorldConfig(occluded="free"))
    field = world.field
    lower, upper = fitted.support_bounds()
    lower[2] = 0.002
    points = rng.uniform(lower, upper, (1_500_000, 3))
    points = np.ascontiguousarray(points[fitted.occupancy(points) >= 0.5])
    assert len(points) > 8000
    assert (field.lower_bound(points) <= 0.0).all()


@pytest.mark.parametrize(
    ("row", "says"), [([0.5, 0.5], "shape"), ([0.5, 0.2, 0.2, 0.2], "sum 1"), ([np.nan] * 4, "NaN")]
)
def test_guesses_that_are_no_probabilities_are_refused(scene, coarse, row, says):
    prior = lambda *_: lambda points: np.tile(row, (len(points), 1))  # noqa: E731
    with pytest.raises(MapError, match=says):
        fit_map(scene.observation, coarse, prior=prior)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), half=st.floats(0.001, 0.04))
def test_a_guess_stays_within_its_bounds_in_every_cube(field, seed, half):
    """The level set drops a cube when the guess at its highest does not lift it to the level."""
    rng = np.random.default_rng(seed)
    centers = rng.uniform(-0.3, 0.35, (400, 3))
    low, high = field.bounds(centers, half)
    assert (high - low < 2.0 * MOST).any()
    for _ in range(20):
        inside = centers + half * rng.choice([-1.0, 1.0, rng.uniform(-1.0, 1.0)], centers.shape)
        logits = field.at(inside)[:, 1:]
        assert (logits >= low - 1e-5).all()
        assert (logits <= high + 1e-5).all()


def test_a_map_judges_where_its_prior_has_looked(scene):
    flat, shape = (fit_map(scene.observation, prior=prior) for prior in (None, "shape"))
    points = np.random.default_rng(0).uniform([-0.4, -0.4, 0.0], [0.4, 0.4, 0.3], (4000, 3))
    supported = np.asarray(flat.support(points)) >= 0.5
    np.testing.assert_array_equal(flat.judges(points, 0.5), supported)
    judged = shape.judges(points, 0.5)
    assert (judged >= (np.asarray(shape.support(points)) >= 0.5)).all()
    objects = shape.prior.logits(torch.from_numpy(points)).numpy()[:, 1:]
    # There another object's grid says that it is not this one, or this one's own has looked.
    assert (objects[shape.prior.covers(points)].min(axis=1) < objects[~judged].max()).all()
    assert 0.1 < judged.mean() < 0.9


def test_what_hides_in_the_grid_of_an_object_is_judged_and_what_hides_beyond_is_not(scene):
    shape = fit_map(scene.observation)
    bounds = ((-0.5, -0.5, 0.0), (0.5, 0.5, 0.3))
    strict, trusting, leaving = (
        World(shape, WorldConfig(occluded=policy, bounds=bounds, hidden_objects=number))
        for policy, number in (("occupied", np.inf), ("posterior", np.inf), ("posterior", 2.0))
    )
    points = np.random.default_rng(1).uniform((-0.5, -0.5, 0.004), bounds[1], (150_000, 3))
    hidden = points[(strict.status(points) == 1) & (shape.occupancy(points) < 0.3)]
    corners = 0.005 * np.array(list(product((-1.0, 1.0), repeat=3)))  # cells are 5 mm wide
    around = np.stack([shape.judges(hidden + corner, 0.5) for corner in corners])
    judged, beyond = around.all(axis=0), ~around.any(axis=0)
    assert judged.sum() > 100
    assert beyond.sum() > 100
    assert (strict.field.lower_bound(hidden) <= 0.0).all()
    free = trusting.field.lower_bound(hidden) > 0.0
    assert free[judged].mean() > 0.5
    assert not free[beyond].any()
    left = leaving.field.lower_bound(hidden) > 0.0  # with few unseen objects the draws judge it
    assert left[beyond].mean() > 0.5
    assert left[free].all()


def test_a_hypothesis_beyond_the_kernels_is_in_the_level_set_and_in_the_draws():
    """Both looked where kernels reach only: the far end of a long hidden thing was free."""
    camera = Camera.orbit(np.array([0.0, 0.0, 0.03]), 0.7, np.pi, np.deg2rad(20.0))
    screen = Box((0.01, 0.05, 0.06), pose=upright(np.zeros(2), 0.06, 0.0))
    alone = Scene((screen,), (1,), camera)
    mesh = trimesh.creation.box((0.04, 0.04, 0.06))
    mesh.apply_translation([0.11, 0.0, 0.03])
    config = MapConfig(hinge_margin=0.01, hinge_radius=0.02)
    fitted = fit_map(alone.observation, config, prior=MeshPrior({1: [(mesh, 1.0)]}))
    inside = np.random.default_rng(0).uniform([0.095, -0.015, 0.01], [0.125, 0.015, 0.05], (99, 3))
    lower, upper = fitted.space.bounds
    hidden = inside[((inside < lower) | (inside > upper)).any(axis=1)]
    hidden = hidden[fitted.occupancy(hidden) > 0.9]
    assert len(hidden) > 5
    field = World(fitted, WorldConfig(occluded="free")).field
    assert (field.lower_bound(hidden) <= 0.0).all()
    draws = PosteriorWorlds(fitted, n_worlds=64, seed=0)
    assert draws.touched(hidden, 0.005).mean() > 0.9


def test_a_hypothesis_of_ones_own_judges_nothing_else_that_hides(scene):
    ball = trimesh.creation.icosphere(radius=0.02)
    label = scene.observation.object_ids[0]
    fitted = fit_map(scene.observation, prior=MeshPrior({label: [(ball, 1.0)]}))
    points = np.random.default_rng(0).uniform([-0.4, -0.4, 0.0], [0.4, 0.4, 0.3], (4000, 3))
    supported = np.asarray(fitted.support(points)) >= 0.5
    np.testing.assert_array_equal(fitted.judges(points, 0.5), supported)
