# SPDX-License-Identifier: BSD-3-Clause
"""Negative samples, subsampling and hinge points lie where the paper puts them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vprism_plan.mapping import MapConfig
from vprism_plan.mapping.hinges import lattice_hinges, surface_hinges
from vprism_plan.mapping.training_data import (
    box_centers,
    grid_subsample,
    sample_below_plane,
    sample_in_front,
    sample_rays,
)

SEEDS = st.integers(0, 10**6)


@given(seed=SEEDS, radius=st.floats(0.02, 0.6), step=st.floats(0.01, 0.4))
def test_ray_samples_lie_before_the_surface_and_near_an_object(seed, radius, step):
    rng = np.random.default_rng(seed)
    origin = rng.normal(size=3)
    points = origin + rng.normal(size=(1, 3))  # one ray: every sample must be on it
    centers = points + 0.3 * rng.normal(size=(3, 3))
    samples = sample_rays(points, origin, centers, radius, step, rng)
    length = np.linalg.norm(points[0] - origin)
    direction = (points[0] - origin) / length
    along = (samples - origin) @ direction
    assert ((along >= 0) & (along <= length * (1 + 1e-12))).all()
    np.testing.assert_allclose(samples, origin + along[:, None] * direction, atol=1e-12)
    gap = np.linalg.norm(samples[:, None] - centers[None], axis=2).min(axis=1, initial=np.inf)
    assert (gap <= radius * (1 + 1e-12)).all()
    strata = np.floor(along / step - 1e-9)
    assert len(np.unique(strata)) >= len(samples) - 1  # one per stratum, up to rounding at edges


def test_every_stratum_near_an_object_gets_its_sample():
    origin, surface = np.zeros(3), np.array([[0.0, 0.0, 1.0]])
    samples = sample_rays(
        surface, origin, np.array([[0.0, 0.0, 0.9]]), 5.0, 0.1, np.random.default_rng(0)
    )
    np.testing.assert_array_equal(np.sort(np.floor(samples[:, 2] * 10)), np.arange(10))


def test_rays_to_the_table_that_pass_an_object_are_sampled_too():
    """The ray ends far behind the object's ball, and still has samples inside it."""
    origin, table = np.zeros(3), np.array([[2.0, 0.0, 0.0]])
    samples = sample_rays(
        table, origin, np.array([[1.0, 0.1, 0.0]]), 0.25, 0.05, np.random.default_rng(0)
    )
    assert 7 <= len(samples) <= 11
    assert (np.abs(samples[:, 0] - 1.0) <= 0.25).all()


def test_ray_samples_are_uniform_within_their_stratum():
    origin, surface = np.zeros(3), np.tile([[0.0, 0.0, 0.1]], (20000, 1))
    samples = sample_rays(surface, origin, np.zeros((1, 3)), 1.0, 0.2, np.random.default_rng(1))
    histogram, _ = np.histogram(samples[:, 2], bins=10, range=(0.0, 0.1))
    assert histogram.sum() == 20000
    assert (np.abs(histogram - 2000) < 250).all()


@given(seed=SEEDS, radius=st.floats(0.02, 0.6), step=st.floats(0.01, 0.4))
def test_steps_are_the_near_ends_of_all_strata_near_an_object(seed, radius, step):
    rng = np.random.default_rng(seed)
    origin = rng.normal(size=3)
    points = origin + rng.normal(size=(4, 3))
    centers = points[:2] + 0.3 * rng.normal(size=(2, 3))
    samples = sample_rays(points, origin, centers, radius, step, rng, "steps")
    expected = []
    for point in points:
        length = np.linalg.norm(point - origin)
        for t in np.arange(0.0, length, step):
            at = origin + t * (point - origin) / length
            gap = np.linalg.norm(at - centers, axis=1).min()
            if gap <= radius - 1e-9:
                expected.append(at)
            else:
                assert gap > radius + 1e-9  # not a case that rounding decides
    np.testing.assert_allclose(samples, np.array(expected).reshape(-1, 3), atol=1e-9)


def test_whole_rays_are_sampled_evenly_wherever_the_objects_are():
    origin, surface = np.ones(3), np.tile([[1.0, 1.0, 3.0]], (20000, 1))
    nowhere = np.full((1, 3), -9.0)
    samples = sample_rays(surface, origin, nowhere, 0.1, 0.1, np.random.default_rng(1), "whole")
    assert samples.shape == (20000, 3)
    np.testing.assert_array_equal(samples[:, :2], 1.0)
    histogram, _ = np.histogram(samples[:, 2], bins=10, range=(1.0, 3.0))
    assert histogram.sum() == 20000
    assert (np.abs(histogram - 2000) < 250).all()


def test_without_a_resolution_every_point_stays():
    points = np.random.default_rng(0).normal(size=(50, 3))
    kept = grid_subsample(points, None)
    np.testing.assert_array_equal(kept, points)
    assert kept is not points


def test_no_ray_passes_the_object():
    rng = np.random.default_rng(0)
    far = sample_rays(np.ones((5, 3)), np.zeros(3), np.full((1, 3), -9.0), 0.2, 0.1, rng)
    assert far.shape == (0, 3)
    assert sample_rays(np.zeros((0, 3)), np.zeros(3), np.ones((1, 3)), 0.2, 0.1, rng).shape == (
        0,
        3,
    )


@given(seed=SEEDS, margin=st.floats(0.0, 0.1))
def test_below_plane_samples_are_below_it_and_near_an_object(seed, margin):
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    centers = 0.3 * rng.normal(size=(4, 3))
    offset = float(0.1 * rng.normal())
    samples = sample_below_plane(normal, offset, centers, 0.25, 200, rng, margin)
    assert (samples @ normal < offset - margin).all()
    gap = np.linalg.norm(samples[:, None] - centers[None], axis=2).min(axis=1, initial=np.inf)
    assert (gap <= 0.25 * (1 + 1e-12)).all()


def test_below_plane_samples_fill_the_half_ball_evenly():
    samples = sample_below_plane(
        np.array([0.0, 0.0, 1.0]), 0.0, np.zeros((1, 3)), 1.0, 40000, np.random.default_rng(0)
    )
    assert len(samples) == pytest.approx(20000, rel=0.03)
    inner = (np.linalg.norm(samples, axis=1) < 0.5).mean()
    assert inner == pytest.approx(0.125, abs=0.01)


@given(seed=SEEDS, distance=st.floats(0.001, 0.05))
def test_front_samples_are_on_the_ray_before_the_surface(seed, distance):
    rng = np.random.default_rng(seed)
    origin = rng.normal(size=3)
    points = origin + rng.normal(size=(50, 3))
    points = points[np.linalg.norm(points - origin, axis=1) > distance]
    front = sample_in_front(points, origin, distance)
    np.testing.assert_allclose(np.linalg.norm(points - front, axis=1), distance, rtol=1e-9)
    gain = np.linalg.norm(points - origin, axis=1) - np.linalg.norm(front - origin, axis=1)
    np.testing.assert_allclose(gain, distance, rtol=1e-9)


def test_front_samples_skip_what_touches_the_camera():
    points = np.array([[0.0, 0.0, 0.004], [0.0, 0.0, 1.0]])
    assert len(sample_in_front(points, np.zeros(3), 0.005)) == 1


@given(seed=SEEDS, resolution=st.floats(0.005, 0.2))
def test_subsampling_gives_the_barycentre_of_every_cell(seed, resolution):
    points = np.random.default_rng(seed).normal(scale=0.2, size=(200, 3))
    thin = grid_subsample(points, resolution)
    cells: dict[tuple, list] = {}
    for point in points:
        cells.setdefault(tuple(np.floor(point / resolution).astype(int)), []).append(point)
    expected = np.array([np.mean(cells[key], axis=0) for key in sorted(cells)])
    np.testing.assert_allclose(thin, expected, atol=1e-12)


def test_subsampling_nothing_gives_nothing():
    assert grid_subsample(np.zeros((0, 3)), 0.01).shape == (0, 3)


def test_box_centres_are_per_object():
    points = np.array([[0.0, 0, 0], [2, 4, 6], [1, 1, 1], [9, 9, 9]])
    lower, upper = box_centers(points, np.array([3, 3, 7, 0]), (3, 7))
    np.testing.assert_array_equal(0.5 * (lower + upper), [[1, 2, 3], [1, 1, 1]])


BOX = np.array([[0.1, 0.2, 0.0]]), np.array([[0.2, 0.26, 0.15]])
UP = np.array([0.0, 0.0, 1.0])


def test_lattice_is_anchored_to_world_multiples_and_holds_every_near_node():
    config = MapConfig.paper()
    nodes = lattice_hinges(*BOX, UP, 0.0, config)
    np.testing.assert_allclose(nodes / 0.05, np.round(nodes / 0.05), atol=1e-9)
    center = 0.5 * (BOX[0] + BOX[1])[0]
    axis = 0.05 * np.arange(-10, 15)
    everything = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    near = everything[np.linalg.norm(everything - center, axis=1) <= 0.15]
    assert {tuple(n) for n in np.round(nodes, 9)} == {tuple(n) for n in np.round(near, 9)}


def test_lattice_shift_margin_and_depth():
    config = MapConfig(hinge_shift=(0.01, 0.0, -0.005))
    nodes = lattice_hinges(*BOX, UP, 0.0, config)
    whole = (nodes - config.hinge_shift) / config.hinge_spacing
    np.testing.assert_allclose(whole, np.round(whole), atol=1e-9)
    assert nodes[:, 2].min() >= -config.hinge_depth
    beyond = np.maximum(np.maximum(BOX[0] - nodes, nodes - BOX[1]), 0)
    near_box = np.linalg.norm(beyond, axis=1) <= config.hinge_margin
    near_center = np.linalg.norm(nodes - 0.5 * (BOX[0] + BOX[1]), axis=1) <= config.hinge_radius
    assert (near_box | near_center).all()
    assert near_box.any()


def test_two_boxes_share_their_nodes_once():
    lower, upper = np.repeat(BOX[0], 2, axis=0), np.repeat(BOX[1], 2, axis=0)
    one = lattice_hinges(*BOX, UP, 0.0, MapConfig())
    two = lattice_hinges(lower, upper, UP, 0.0, MapConfig())
    np.testing.assert_array_equal(one, two)


def test_surface_hinges_are_distinct_points_of_each_object():
    rng = np.random.default_rng(0)
    points, labels = rng.normal(size=(100, 3)), np.repeat([2, 5], [90, 10])
    hinges = surface_hinges(points, labels, (2, 5), 32, rng)
    assert len(hinges) == 32 + 10
    assert len(np.unique(hinges, axis=0)) == 42
    assert all((points[labels == 2] == h).all(axis=1).any() for h in hinges[:32])
