# SPDX-License-Identifier: BSD-3-Clause
"""Projection and back-projection are each other's inverse, in every frame."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from oracles.perception_oracles import intrinsics, look_at
from scipy.spatial.transform import Rotation

from vprism_plan.perception.camera import (
    backproject,
    invert_transform,
    pixel_rays,
    project,
    transform_points,
)

seeds = st.integers(0, 2**32 - 1)


def rigid(rng: np.random.Generator) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    pose[:3, 3] = rng.normal(size=3)
    return pose


@given(seeds, st.integers(2, 40), st.integers(2, 40))
def test_project_undoes_backproject(seed, width, height):
    rng = np.random.default_rng(seed)
    K = intrinsics(width, height)
    depth = rng.uniform(0.1, 5.0, (height, width))
    depth[rng.random(depth.shape) < 0.2] = 0.0
    points = backproject(depth, K)
    assert np.isnan(points[depth == 0]).all()
    pixels, z = project(points[depth > 0], K)
    rows, cols = np.nonzero(depth)
    np.testing.assert_allclose(pixels, np.stack([cols, rows], 1), atol=1e-9)
    np.testing.assert_allclose(z, depth[depth > 0])


@given(seeds)
def test_world_points_return_to_the_camera(seed):
    rng = np.random.default_rng(seed)
    K, pose = intrinsics(9, 7), rigid(rng)
    depth = rng.uniform(0.1, 5.0, (7, 9)).astype(np.float32)
    world = transform_points(pose, backproject(depth, K))
    assert world.dtype == np.float64
    back = transform_points(invert_transform(pose), world)
    np.testing.assert_allclose(back, backproject(depth, K), atol=1e-12)


def test_points_behind_the_camera_have_no_pixel():
    pixels, z = project(np.array([[0.0, 0, -1], [1, 1, 0], [0, 0, 2]]), intrinsics())
    assert np.isnan(pixels[:2]).all()
    np.testing.assert_allclose(pixels[2], [159.5, 119.5])
    np.testing.assert_allclose(z, [-1, 0, 2])


def test_axes_are_optical():
    rays = pixel_rays((240, 320), intrinsics())
    assert rays[0, 0, 0] < 0 < rays[0, -1, 0]  # x to the right
    assert rays[0, 0, 1] < 0 < rays[-1, 0, 1]  # y down
    assert (rays[..., 2] == 1).all()


def test_look_at_of_the_oracle_is_rigid():
    pose = look_at((1.0, 0.2, 0.8))
    np.testing.assert_allclose(pose @ invert_transform(pose), np.eye(4), atol=1e-12)
