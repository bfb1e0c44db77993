# SPDX-License-Identifier: BSD-3-Clause
"""What a point cloud shows is what the image showed that it came from, never more."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.perception_oracles import Scene, intrinsics, look_at
from scipy import ndimage

from vprism_plan.errors import ObservationError
from vprism_plan.perception import Observation
from vprism_plan.perception.camera import (
    backproject,
    invert_transform,
    project,
    transform_points,
)

SHAPE = (96, 128)
BOXES = [((-0.1, -0.05, 0), (0, 0.08, 0.12)), ((0.05, -0.2, 0), (0.12, -0.1, 0.08))]


def view(rng, focal=120.0, center=(63.5, 47.5)) -> Observation:
    """Boxes, a ball and a hole without a return, from somewhere above."""
    turn, up = rng.uniform(0, 2 * np.pi), rng.uniform(0.3, 0.8)
    pose = look_at((0.7 * np.cos(turn), 0.7 * np.sin(turn), up), (0, 0, 0.05))
    matrix = np.array([[focal, 0, center[0]], [0, focal, center[1]], [0, 0, 1.0]])
    ball = ([*rng.uniform(-0.2, 0.2, 2), 0.05], 0.05)
    depth, labels = Scene(spheres=[ball], boxes=BOXES, floor=-0.7).render(pose, matrix, SHAPE)
    row, column = rng.integers(5, 60), rng.integers(5, 80)
    depth[row : row + 25, column : column + 25] = 0.0
    return Observation(depth, np.where(depth > 0, labels, 0), matrix, pose)


# ---------------------------------------------------------------------------------- organised
@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    focal=st.floats(60.0, 400.0),
    center=st.tuples(st.floats(20.0, 110.0), st.floats(20.0, 80.0)),
    frame=st.sampled_from(["world", "camera", "posed", "known"]),
)
def test_an_organised_cloud_tells_its_camera(seed, focal, center, frame):
    true = view(np.random.default_rng(seed), focal, center)
    camera = {"world": true.camera_center, "camera": np.zeros(3), "posed": true.pose}
    points = true.point_image()
    if frame == "camera":
        points = backproject(true.depth, true.intrinsics)
    known = true.intrinsics if frame == "known" else None
    where = camera.get(frame, true.camera_center)
    seen = Observation.from_points(points.astype(np.float32), true.labels, where, known)
    assert seen.warnings == ()
    assert seen.posed == (frame != "camera")
    pose = true.pose if seen.posed else np.eye(4)
    np.testing.assert_allclose(seen.intrinsics, true.intrinsics, rtol=1e-4, atol=1e-2)
    np.testing.assert_allclose(seen.pose, pose, atol=1e-4)
    np.testing.assert_allclose(seen.depth, true.depth, atol=1e-4)
    np.testing.assert_array_equal(seen.labels, true.labels)


def test_points_of_zeros_are_no_returns():
    true = view(np.random.default_rng(0))
    points = np.nan_to_num(true.point_image())
    seen = Observation.from_points(points, true.labels, true.camera_center)
    np.testing.assert_array_equal(seen.depth > 0, true.depth > 0)


def bent(true):
    points = backproject(true.depth, true.intrinsics)
    points[..., :2] *= 1.0 + 0.3 * ((points[..., :2] / points[..., 2:]) ** 2).sum(-1, keepdims=True)
    return transform_points(true.pose, points), true.camera_center


NO_PINHOLE = {
    "mirrored": lambda true: (true.point_image()[:, ::-1], true.camera_center),
    "a lens": bent,
    "the camera is elsewhere": lambda t: (t.point_image(), t.camera_center + np.full(3, 0.1)),
    "mixed": lambda true: (
        np.random.default_rng(0).permutation(true.point_image().reshape(-1, 3)).reshape(*SHAPE, 3),
        true.camera_center,
    ),
}


@pytest.mark.parametrize("name", NO_PINHOLE)
def test_a_grid_that_is_no_image_is_named_and_taken_as_a_cloud(name):
    points, camera = NO_PINHOLE[name](view(np.random.default_rng(1)))
    seen = Observation.from_points(points, None, camera)
    assert "pixels rms, more than 1, and are taken as (N, 3)" in seen.warnings[0]
    flat = points.reshape(-1, 3)
    same = Observation.from_points(flat, None, camera)
    np.testing.assert_array_equal(seen.depth, same.depth)
    known = intrinsics(128, 96).tolist()
    same = Observation.from_points(points, None, camera, known)
    assert "are taken as (N, 3)" in same.warnings[0]


@pytest.mark.parametrize("given", ["pose", "camera_center"])
def test_points_in_the_cameras_frame_are_no_points_in_the_worlds(given):
    true = view(np.random.default_rng(2))
    local = backproject(true.depth, true.intrinsics)
    with pytest.raises(ObservationError, match="points are in the camera's own frame"):
        Observation.from_points(local, None, getattr(true, given))


# -------------------------------------------------------------------------------- unorganised
def keep_all(image, rng):
    return np.ones(SHAPE, bool)


def at_random(image, rng):
    return rng.random(SHAPE) < rng.uniform(0.1, 0.9)


def in_lines(image, rng):
    return np.broadcast_to((np.arange(SHAPE[0]) % rng.integers(2, 5) == 0)[:, None], SHAPE)


def one_per_voxel(image, rng):
    size = rng.uniform(0.005, 0.015)
    cells = np.floor(np.nan_to_num(image) / size).astype(int).reshape(-1, 3)
    kept = np.zeros(len(cells), bool)
    kept[np.unique(cells, axis=0, return_index=True)[1]] = True
    return kept.reshape(SHAPE)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    thinned=st.sampled_from([keep_all, at_random, in_lines, one_per_voxel]),
    twice=st.booleans(),
)
def test_a_cloud_frees_nothing_that_its_image_does_not_free(seed, thinned, twice):
    rng = np.random.default_rng(seed)
    true = view(rng)
    image = true.point_image()
    kept = thinned(image, rng) & (true.depth > 0)
    points, labels = image[kept], true.labels[kept]
    if twice:
        points, labels = np.concatenate([points, points]), np.concatenate([labels, labels])
    mixed = rng.permutation(len(points))
    seen = Observation.from_points(points[mixed], labels[mixed], true.camera_center)
    assert seen.warnings == ()
    np.testing.assert_allclose(seen.camera_center, true.camera_center)

    def shown(obs, world):
        local = transform_points(invert_transform(obs.pose), world)
        pixel, z = project(local, obs.intrinsics)
        pixel = np.where(np.isfinite(pixel), pixel, -1.0)
        column, row = np.rint(pixel).astype(int).T
        inside = (np.abs(pixel - np.floor(pixel) - 0.5) > 1e-6).all(axis=1)  # no edge of a pixel
        inside &= (row >= 0) & (row < obs.shape[0]) & (column >= 0) & (column < obs.shape[1])
        return np.where(inside, row, 0), np.where(inside, column, 0), inside, z

    # No point of the cloud is in free space, and none is unobserved.
    row, column, inside, z = shown(seen, image[kept])
    assert inside.mean() > 0.99
    there = seen.depth[row, column][inside]
    assert (there > 0).all()
    assert (there <= z[inside] + 1e-9).all()

    # What is hidden in the image, also within a few pixels, is neither free nor unobserved.
    gaps = ndimage.distance_transform_edt(~kept & (true.depth > 0))
    wide = 3 + 2 * int(np.ceil(np.percentile(gaps, 99)))
    none = true.depth == 0
    farthest = ndimage.maximum_filter(np.where(none, np.inf, true.depth), 2 * wide + 1)
    nearest = ndimage.maximum_filter(true.depth, 2 * wide + 1, mode="nearest")
    somewhere = rng.uniform((-0.6, -0.6, -0.7), (0.6, 0.6, 0.3), (20000, 3))
    row, column, inside, z = shown(true, somewhere)
    border = (row >= wide) & (row < SHAPE[0] - wide) & (column >= wide) & (column < SHAPE[1] - wide)
    hidden = inside & border & (z > farthest[row, column] + 0.02)
    at_row, at_column, within, depth_there = shown(seen, somewhere)
    found = np.where(within, seen.depth[at_row, at_column], 0.0)
    assert hidden.sum() > 100
    assert (found[hidden] > 0).mean() > 0.999
    free = found > depth_there
    assert not (free & hidden).any()

    # Where nothing returned all around, nothing is free.
    blind = inside & border & (nearest[row, column] == 0)
    assert not (free & blind).any()


def test_nearest_points_win_and_what_lies_behind_is_named():
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.uniform(-0.3, 0.3, (6000, 2)), np.full(6000, 1.0)])
    behind = np.column_stack([rng.uniform(-0.2, 0.2, (4000, 2)), np.full(4000, 1.5)])
    ids = np.repeat([1, 2], [6000, 4000])
    seen = Observation.from_points(np.concatenate([wall, behind]), ids, (0, 0, 0))
    assert seen.object_ids == (1,)
    assert "40 % of the points lie more than 5 cm behind others" in seen.warnings[0]
    assert not seen.posed


@pytest.mark.parametrize("known", [None, np.diag([1e9, 1e9, 1.0])])
def test_an_image_stays_small_however_narrow_and_far_off_the_axis_a_cloud_is(known):
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(2.5, 2.501, (500, 2)), np.ones(500)])
    seen = Observation.from_points(points, None, (0, 0, 0), known)
    assert max(seen.shape) < 2100
    assert (seen.depth > 0).any()


def test_points_to_the_side_are_named():
    rng = np.random.default_rng(0)
    front = np.column_stack([rng.uniform(-0.3, 0.3, (6000, 2)), np.full(6000, 1.0)])
    seen = Observation.from_points(np.concatenate([front, [[0, 0, -1.0]] * 7]), None, (0, 0, 0))
    assert "7 of 6007 points lie more than 72 degrees off" in seen.warnings[0]
    assert seen.posed  # not all points are before it: this is no optical frame


FAULTS = {
    "shape": (np.ones((5, 2)), None, (0, 0, 0), r"shape \(5, 2\)"),
    "few": (np.ones((20, 3)), None, (0, 0, 0), "20 of 20 points are finite"),
    "none": (np.full((200, 3), np.nan), None, (0, 0, 0), "0 of 200 points are finite"),
    "one": (np.ones((200, 3)), None, (0, 0, 0), "only 1 points are distinct"),
    "camera": (np.ones((200, 3)), None, (0, 0), r"camera_position is \[0\.0, 0\.0\]"),
    "scaled": (np.ones((200, 3)), None, 2 * np.eye(4), "not rigid"),
    "labels": (np.ones((200, 3)), np.ones(3, int), (0, 0, 0), r"labels have shape \(3, 1\)"),
    "all behind": (
        np.random.default_rng(0).uniform(-1, -0.5, (200, 3)),
        None,
        np.diag([-1.0, -1, 1, 1]),
        "0 of 200 points lie within 72 degrees",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_faults_are_named(name):
    points, labels, camera, message = FAULTS[name]
    with pytest.raises(ObservationError, match=message):
        Observation.from_points(points, labels, camera)


def test_intrinsics_of_an_unorganised_cloud_are_the_size_of_its_pixels():
    true = view(np.random.default_rng(3))
    points, labels = true.points()
    seen = Observation.from_points(points, labels, true.camera_center, intrinsics(640, 480))
    assert seen.intrinsics[0, 0] == pytest.approx(0.96 * 640)
