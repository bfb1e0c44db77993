# SPDX-License-Identifier: BSD-3-Clause
"""The aligned world stands on the table."""

import numpy as np
import pytest
from oracles.perception_oracles import Scene, intrinsics, look_at, spoil

from vprism_plan.errors import ObservationError
from vprism_plan.perception import Observation, Plane, align_to_table, fit_plane

K = intrinsics()
SCENE = Scene(spheres=[((0.1, 0.05, 0.06), 0.06)], boxes=[((0.1, -0.2, 0.0), (0.2, -0.1, 0.15))])


def observe(eye, labels=True, pose=None) -> Observation:
    depth, ids = SCENE.render(look_at(eye), K)
    noisy, _ = spoil(depth, np.random.default_rng(0), flying=False)
    return Observation(noisy, ids if labels else None, K, pose)


@pytest.mark.parametrize("labels", [False, True])
@pytest.mark.parametrize("eye", [(-0.9, 0.0, 0.7), (0.3, -0.8, 0.9), (0.001, 0.0, 1.2)])
def test_table_is_z_zero_and_camera_looks_along_x(eye, labels):
    obs = align_to_table(observe(eye, labels))
    points, _ = obs.points()
    table = SCENE.render(look_at(eye), K)[1][obs.depth > 0] == 0
    assert abs(np.median(points[table, 2])) < 0.001
    np.testing.assert_array_equal(obs.plane.normal, [0, 0, 1])
    assert obs.plane.offset == 0.0
    assert abs(obs.camera_center[2] - eye[2]) < 0.003
    R = obs.pose[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) > 0
    forward = R[:, 2]
    if eye[0] != 0.001:
        assert abs(forward[1]) < 1e-9
        assert forward[0] > 0
    else:  # from straight above, up in the image is +x
        assert -R[0, 1] > 0.99


def test_origin_lies_under_the_objects():
    obs = align_to_table(observe((-0.9, 0.0, 0.7)))
    points, labels = obs.points()
    np.testing.assert_allclose(points[labels > 0].mean(axis=0)[:2], 0.0, atol=1e-9)


def test_origin_lies_amid_the_table_when_unlabelled():
    obs = align_to_table(observe((-0.9, 0.0, 0.7), labels=False))
    points, _ = obs.points()
    near = np.abs(points[:, 2]) < 0.009
    np.testing.assert_allclose(points[near].mean(axis=0)[:2], 0.0, atol=0.01)


def test_an_existing_pose_does_not_change_the_result():
    eye = (-0.9, 0.2, 0.7)
    free, posed = align_to_table(observe(eye)), align_to_table(observe(eye, pose=look_at(eye)))
    np.testing.assert_allclose(free.pose, posed.pose, atol=1e-6)


def test_aligning_twice_changes_nothing():
    once = align_to_table(observe((-0.9, 0.2, 0.7)))
    np.testing.assert_allclose(align_to_table(once).pose, once.pose, atol=1e-12)


def test_given_plane_is_used_in_the_frame_of_the_observation():
    eye = (-0.9, 0.2, 0.7)
    obs = observe(eye, pose=look_at(eye))
    obs = align_to_table(obs, plane=Plane([0, 0, 1.0], -0.1))
    assert abs(obs.camera_center[2] - 0.8) < 1e-9


def test_camera_below_the_plane_is_refused():
    obs = observe((-0.9, 0.2, 0.7))
    plane = fit_plane(obs)
    with pytest.raises(ObservationError, match="flip the plane's normal"):
        align_to_table(obs, plane=Plane(-plane.normal, -plane.offset))


def test_plane_far_from_everything_is_refused():
    eye = (-0.9, 0.2, 0.7)
    obs = observe(eye, labels=False, pose=look_at(eye))
    with pytest.raises(ObservationError, match="no observed point lies"):
        align_to_table(obs, plane=Plane([0, 0, 1.0], -5.0))
