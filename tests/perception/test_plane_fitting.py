# SPDX-License-Identifier: BSD-3-Clause
"""The support plane is found under noise and clutter, in any frame, or refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.perception_oracles import (
    Scene,
    bin_walls,
    intrinsics,
    look_at,
    shelf_walls,
    spoil,
)
from scipy.spatial.transform import Rotation

from vprism_plan.errors import ConfigError, PlaneNotFoundError
from vprism_plan.perception import Observation, Plane, fit_plane

K = intrinsics()
EYE = (-0.9, 0.0, 0.7)
CLUTTER = Scene(
    spheres=[((0.0, 0.0, 0.06), 0.06), ((0.15, -0.2, 0.05), 0.05)],
    boxes=[((0.1, 0.1, 0.0), (0.2, 0.25, 0.2)), ((-0.2, 0.2, 0.0), (-0.1, 0.3, 0.08))],
)


def observe(scene=CLUTTER, eye=EYE, seed=0, labels=False, pose=None, **faults) -> Observation:
    truth = look_at(eye)
    depth, ids = scene.render(truth, K)
    noisy, _ = spoil(depth, np.random.default_rng(seed), **faults)
    return Observation(noisy, ids if labels else None, K, pose)


def angle(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))


@pytest.mark.parametrize("labels", [False, True])
@pytest.mark.parametrize("eye", [EYE, (-0.5, 0.5, 1.0), (0.0, 0.0, 1.2), (-1.1, 0.1, 0.35)])
def test_recovers_the_table(eye, labels):
    plane = fit_plane(observe(eye=eye, labels=labels, pose=look_at(eye)))
    assert angle(plane.normal, np.array([0, 0, 1.0])) < 0.3
    assert abs(plane.offset) < 0.002
    assert plane.signed_distance(np.array(eye)) > 0


@settings(max_examples=10)
@given(st.integers(0, 2**31))
def test_rigid_motion_moves_the_plane_with_it(seed):
    rng = np.random.default_rng(seed)
    obs = observe(seed=seed, noise=0.003, holes=0.1, specks=200)
    motion = np.eye(4)
    motion[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    motion[:3, 3] = rng.normal(size=3)
    still = fit_plane(obs, seed=seed % 100)
    moved = fit_plane(Observation(obs.depth, None, K, motion), seed=seed % 100)
    expected = still.transformed(motion)
    np.testing.assert_allclose(moved.normal, expected.normal, atol=1e-9)
    assert abs(moved.offset - expected.offset) < 1e-9
    assert angle(still.transformed(look_at(EYE)).normal, np.array([0, 0, 1.0])) < 0.5


def test_same_seed_same_bits_and_other_seed_same_plane():
    obs = observe(noise=0.003)
    first, again, other = fit_plane(obs, seed=3), fit_plane(obs, seed=3), fit_plane(obs, seed=4)
    np.testing.assert_array_equal(first.normal, again.normal)
    assert first.offset == again.offset
    assert angle(first.normal, other.normal) < 0.05


@pytest.mark.parametrize("labels", [False, True])
def test_a_larger_wall_and_floor_behind_are_not_the_table(labels):
    scene = Scene(CLUTTER.spheres, CLUTTER.boxes, ((-0.3, -0.35), (0.3, 0.35)), -0.7, 1.2)
    obs = observe(scene, eye=(-1.0, 0.0, 0.6), labels=labels)
    depth, _ = scene.render(look_at((-1.0, 0.0, 0.6)), K)
    on_table = Scene(table=scene.table).render(look_at((-1.0, 0.0, 0.6)), K)[0]
    assert (depth == on_table).mean() < 0.3  # the table is the smallest of the three
    plane = fit_plane(obs).transformed(look_at((-1.0, 0.0, 0.6)))
    assert angle(plane.normal, np.array([0, 0, 1.0])) < 0.5
    assert abs(plane.offset) < 0.005


def things(spots, seed, height=(0.03, 0.07)):
    """Boxes of 2 to 6 cm around the given (x, y), standing at z = 0."""
    rng = np.random.default_rng(seed)
    boxes = []
    for x, y in spots:
        spot = np.array([x, y]) + rng.uniform(-0.01, 0.01, 2)
        half = rng.uniform(0.01, 0.03, 2)
        boxes.append(((*(spot - half), 0.0), (*(spot + half), rng.uniform(*height))))
    return boxes


def assert_level_at_zero(scene, eye, target, seed, labels=True, posed=True):
    pose = look_at(eye, target)
    depth, ids = scene.render(pose, K)
    noisy, _ = spoil(depth, np.random.default_rng(seed), noise=0.002)
    obs = Observation(noisy, ids if labels else None, K, pose if posed else None)
    plane = fit_plane(obs, seed=seed) if posed else fit_plane(obs, seed=seed).transformed(pose)
    assert angle(plane.normal, np.array([0, 0, 1.0])) < 1.0
    assert abs(plane.signed_distance(np.zeros(3))) < 0.006


@pytest.mark.parametrize("slope", [35, 45, 55, 65, 80])
@pytest.mark.parametrize(("distance", "lean"), [(0.45, 0), (0.6, 25), (0.8, 10)])
def test_the_floor_of_a_bin_not_its_wall(slope, distance, lean):
    seed = slope + lean
    half, raised = (0.16, 0.09), (-0.08 if lean else None)
    boxes = things([(0.05, 0.02), (-0.08, -0.03), (-0.03, 0.05)], seed)
    lower, upper = (-half[0], -half[1]), half
    scene = Scene([], boxes, (lower, upper), raised, panels=bin_walls(slope, half))
    eye = (-distance * np.sin(np.radians(lean)) - 0.003, 0.0, distance * np.cos(np.radians(lean)))
    assert_level_at_zero(scene, eye, (0, 0, 0), seed)


@pytest.mark.parametrize("slope", [35, 55, 80])
@pytest.mark.parametrize(("labels", "posed"), [(False, True), (True, False)])
def test_the_floor_of_a_bin_by_gravity_or_by_what_stands_on_it(slope, labels, posed):
    boxes = things([(0.05, 0.02), (-0.08, -0.03), (-0.03, 0.05)], slope)
    lower, upper = (-0.16, -0.09), (0.16, 0.09)
    scene = Scene([], boxes, (lower, upper), panels=bin_walls(slope))
    assert_level_at_zero(scene, (-0.003, 0.0, 0.6), (0, 0, 0), slope, labels, posed)


@pytest.mark.parametrize("distance", [0.45, 0.6, 0.8])
@pytest.mark.parametrize("above", [0.12, 0.2, 0.3])
@pytest.mark.parametrize("width", [0.5, 0.9])
def test_the_board_of_a_shelf_not_its_back(distance, above, width):
    seed = int(100 * (distance + above))
    boxes = things([(0.02, -0.15), (-0.06, 0.0), (0.06, 0.13)], seed, (0.06, 0.2))
    half = (0.15, width / 2)
    floor = -0.9 if width == 0.5 else None
    table = ((-half[0], -half[1]), half)
    scene = Scene([], boxes, table, floor, panels=shelf_walls(width))
    eye = (-np.sqrt(distance**2 - above**2), 0.03, above)
    assert_level_at_zero(scene, eye, (0, 0, 0.08), seed)
    if distance == 0.6:
        assert_level_at_zero(scene, eye, (0, 0, 0.08), seed, labels=False)
        assert_level_at_zero(scene, eye, (0, 0, 0.08), seed, posed=False)


def test_precision_of_the_depth_does_not_matter():
    obs = observe()
    double = Observation(obs.depth.astype(np.float64), None, K)
    np.testing.assert_allclose(fit_plane(obs).normal, fit_plane(double).normal, atol=1e-9)


@pytest.mark.parametrize("width", [96, 640])
def test_other_resolutions(width):
    K2, shape = intrinsics(width, width * 3 // 4), (width * 3 // 4, width)
    depth, _ = CLUTTER.render(look_at(EYE), K2, shape)
    noisy, _ = spoil(depth, np.random.default_rng(0))
    plane = fit_plane(Observation(noisy, None, K2, look_at(EYE)))
    assert angle(plane.normal, np.array([0, 0, 1.0])) < 0.5


def test_noise_is_no_plane():
    depth = np.random.default_rng(0).uniform(0.5, 1.5, (240, 320))
    with pytest.raises(PlaneNotFoundError, match=r"plane|flat"):
        fit_plane(Observation(depth, None, K))


def test_a_ball_is_no_plane():
    scene = Scene(spheres=[((0.0, 0, 0), 0.2)], table=((9, 9), (9, 9)))
    with pytest.raises(PlaneNotFoundError, match="curved or noisy"):
        fit_plane(observe(scene))


def test_everything_labelled_is_explained():
    with pytest.raises(PlaneNotFoundError, match="every pixel labelled"):
        fit_plane(Observation(np.ones((6, 8)), np.ones((6, 8), int), intrinsics(8, 6)))


def test_a_line_of_points_spans_no_plane():
    depth = np.zeros((240, 320))
    depth[120, :] = 1.0
    with pytest.raises(PlaneNotFoundError, match="no three"):
        fit_plane(Observation(depth, None, K))


@pytest.mark.parametrize(
    "options", [{"threshold": 0.0}, {"threshold": 1.0}, {"min_share": 0.0}, {"min_share": 2.0}]
)
def test_options_out_of_range_are_named(options):
    with pytest.raises(ConfigError, match=next(iter(options))):
        fit_plane(observe(), **options)


def test_min_share_is_enforced_and_quoted():
    with pytest.raises(PlaneNotFoundError, match="99 % is needed"):
        fit_plane(observe(), min_share=0.99)


@given(st.integers(0, 2**32 - 1))
def test_transformed_plane_keeps_distances(seed):
    rng = np.random.default_rng(seed)
    plane = Plane(rng.normal(size=3), rng.normal())
    motion = np.eye(4)
    motion[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    motion[:3, 3] = rng.normal(size=3)
    points = rng.normal(size=(20, 3))
    there = points @ motion[:3, :3].T + motion[:3, 3]
    np.testing.assert_allclose(
        plane.transformed(motion).signed_distance(there), plane.signed_distance(points), atol=1e-9
    )
    axes = np.vstack([plane.axes(), plane.normal])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) > 0
