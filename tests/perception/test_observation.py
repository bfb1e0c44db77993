# SPDX-License-Identifier: BSD-3-Clause
"""What an observation accepts, what it refuses, and how it says so."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from oracles.perception_oracles import intrinsics, look_at

from vprism_plan.errors import ObservationError, VPrismError
from vprism_plan.perception import Observation, Plane

K = intrinsics(8, 6)


def depth(value: float = 1.0) -> np.ndarray:
    return np.full((6, 8), value)


def with_value(array: np.ndarray, index, value) -> np.ndarray:
    array = array.astype(np.float64)
    array[index] = value
    return array


def test_keeps_what_it_is_given():
    labels = np.zeros((6, 8), np.int64)
    labels[2, 3], labels[4, 4] = 7, 2
    obs = Observation(depth(), labels, K, look_at((1.0, 0, 1)), np.zeros((6, 8, 3), np.uint8))
    assert obs.shape == (6, 8)
    assert obs.posed
    assert obs.object_ids == obs.require_objects() == (2, 7)
    assert obs.labels.dtype == np.int32
    np.testing.assert_allclose(obs.camera_center, [1, 0, 1])


def test_unposed_world_is_the_camera():
    obs = Observation(depth(), None, K)
    assert not obs.posed
    np.testing.assert_array_equal(obs.pose, np.eye(4))
    points, labels = obs.points()
    assert (labels == 0).all()
    np.testing.assert_allclose(points[:, 2], 1.0)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_keeps_the_precision_of_depth(dtype):
    assert Observation(depth().astype(dtype), None, K).depth.dtype == dtype


def test_half_precision_depth_becomes_single():
    assert Observation(depth().astype(np.float16), None, K).depth.dtype == np.float32


def test_accepts_torch_tensors_and_lists():
    obs = Observation(
        torch.ones(6, 8), torch.ones(6, 8, dtype=torch.int64), K.tolist(), torch.eye(4)
    )
    assert isinstance(obs.depth, np.ndarray)
    assert obs.object_ids == (1,)


def test_copies_so_that_reused_buffers_do_no_harm():
    buffer = depth()
    obs = Observation(buffer, None, K)
    buffer[:] = 5.0
    assert (obs.depth == 1.0).all()
    obs.pose[:] = 0.0
    np.testing.assert_array_equal(obs.pose, np.eye(4))


def test_small_rounding_of_a_pose_is_removed():
    pose = np.round(look_at((1.0, 0.3, 0.7)), 4)
    R = Observation(depth(), None, K, pose).pose[:3, :3]
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)


def test_point_image_and_points_agree_and_skip_holes():
    image = with_value(depth(), (1, 2), 0.0)
    labels = np.arange(48).reshape(6, 8)
    obs = Observation(image, labels, K, look_at((1.0, 0, 1)))
    points, kept = obs.points()
    assert np.isnan(obs.point_image()[1, 2]).all()
    assert len(points) == 47
    assert 10 not in kept
    np.testing.assert_array_equal(points, obs.point_image().reshape(-1, 3)[kept])


def test_an_object_without_depth_does_not_occur():
    labels = np.zeros((6, 8), int)
    labels[1, 2] = 4
    obs = Observation(with_value(depth(), (1, 2), 0.0), labels, K)
    assert obs.object_ids == ()
    with pytest.raises(ObservationError, match="no depth return"):
        obs.require_objects()


BAD_DEPTH = {
    "shape": (np.ones((6, 8, 1)), r"\(6, 8, 1\)"),
    "empty": (np.ones((0, 8)), r"\(0, 8\)"),
    "raw": (np.ones((6, 8), np.uint16), "uint16.*metres"),
    "negative": (with_value(depth(), (5, 7), -0.5), "-0.5 at row 5, column 7"),
    "millimetres": (depth(700.0), "millimetres"),
    "scaled twice": (depth(0.0007), "scaled twice"),
    "millimetres, half of them without": (
        with_value(depth(700.0), np.s_[:, :5], 65535.0),
        "millimetres",
    ),
    "nothing": (depth(0.0), "0, NaN or infinite everywhere"),
    "nothing, in words": (depth(np.nan), "0, NaN or infinite everywhere"),
    "too near": (depth(-np.inf), "0, NaN or infinite everywhere"),
    "too far": (
        depth(12.5),
        "every depth return lies beyond max_range = 10 m, the nearest at 12.5",
    ),
    "complex": (depth().astype(complex), "complex128"),
    "object": (np.array([[None]]), "Python objects"),
    "ragged": ([[1.0], [1.0, 2.0]], "not an array"),
}


@pytest.mark.parametrize("name", BAD_DEPTH)
def test_bad_depth_is_named(name):
    value, message = BAD_DEPTH[name]
    with pytest.raises(ObservationError, match=message):
        Observation(value, None, K)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("value", [np.nan, np.inf, np.nan_to_num(np.float32(np.inf))])
def test_what_stands_for_no_return_becomes_zero_without_a_word(value, dtype):
    obs = Observation(with_value(depth(), (2, 3), value).astype(dtype), None, K)
    assert obs.depth[2, 3] == 0.0
    assert (obs.depth > 0).sum() == 47
    assert obs.warnings == ()


@pytest.mark.parametrize("value", [-np.inf, np.nan_to_num(np.float32(-np.inf))])
def test_what_is_too_near_to_measure_becomes_no_return_and_is_named(value):
    obs = Observation(with_value(depth(), (2, 3), value), None, K)
    np.testing.assert_array_equal(obs.depth, with_value(depth(), (2, 3), 0.0))
    (warning,) = obs.warnings
    assert "-inf at 1 pixels, nearer than the sensor measures" in warning
    assert replace(obs, labels=np.ones((6, 8), int)).warnings == (warning,)


@pytest.mark.parametrize("pixels", [np.s_[2, 3], np.s_[:, :7]])  # one, and most of the image
def test_depth_beyond_the_sensors_range_becomes_no_return_and_is_named(pixels):
    image = with_value(depth(), pixels, 65.535)
    obs = Observation(image, None, K)
    count = int((image > 10).sum())
    np.testing.assert_array_equal(obs.depth, np.where(image > 10, 0.0, image))
    (warning,) = obs.warnings
    assert f"{count} depth returns" in warning
    assert "max_range = 10 m, the farthest at 65.53 m" in warning
    # What was mended once is not named again, and what is real may be kept.
    assert replace(obs, labels=np.ones((6, 8), int)).warnings == (warning,)
    kept = Observation(image, None, K, max_range=70.0)
    np.testing.assert_array_equal(kept.depth, image)
    assert kept.warnings == ()
    nearer = Observation(with_value(depth(), (2, 3), 2.0), None, K, max_range=1.5)
    assert nearer.depth[2, 3] == 0.0


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_bad_max_range_is_named(value):
    with pytest.raises(ObservationError, match="max_range is"):
        Observation(depth(), None, K, max_range=value)


BAD_LABELS = {
    "shape": (np.zeros((6, 7), int), r"\(6, 7\).*\(6, 8\)"),
    "float": (np.zeros((6, 8)), "float64.*integers"),
    "negative": (np.full((6, 8), -1), "contain -1"),
    "huge": (np.full((6, 8), 2**40), "int32"),
}


@pytest.mark.parametrize("name", BAD_LABELS)
def test_bad_labels_are_named(name):
    value, message = BAD_LABELS[name]
    with pytest.raises(ObservationError, match=message):
        Observation(depth(), value, K)


BAD_INTRINSICS = {
    "shape": (np.eye(4), r"\(4, 4\)"),
    "nan": (with_value(K, (0, 0), np.nan), "not finite"),
    "zero focal": (with_value(K, (0, 0), 0.0), "singular"),
    "negative focal": (with_value(K, (1, 1), -5.0), "singular"),
    "last row": (with_value(K, (2, 2), 0.0), "last row"),
    "skew": (with_value(K, (0, 1), 2.0), "skew"),
    "centre outside": (with_value(K, (0, 2), 300.0), "outside the 8x6"),
    "text": (np.full((3, 3), "x"), "give numbers"),
}


@pytest.mark.parametrize("name", BAD_INTRINSICS)
def test_bad_intrinsics_are_named(name):
    value, message = BAD_INTRINSICS[name]
    with pytest.raises(ObservationError, match=message):
        Observation(depth(), None, value)


BAD_POSES = {
    "shape": (np.eye(3), r"\(3, 3\)"),
    "nan": (with_value(np.eye(4), (0, 3), np.nan), "NaN or infinite"),
    "scaled": (np.diag([2.0, 2, 2, 1]), "not rigid"),
    "mirrored": (np.diag([1.0, 1, -1, 1]), "determinant -1"),
    "transposed": (look_at((1.0, 0, 1)).T, "last row"),
    "zero": (np.zeros((4, 4)), "last row"),
}


@pytest.mark.parametrize("name", BAD_POSES)
def test_bad_poses_are_named(name):
    value, message = BAD_POSES[name]
    with pytest.raises(ObservationError, match=message):
        Observation(depth(), None, K, value)


def test_bad_color_and_plane_are_named():
    with pytest.raises(ObservationError, match="color has shape"):
        Observation(depth(), None, K, None, np.zeros((6, 8), np.uint8))
    with pytest.raises(ObservationError, match=r"float64.*uint8"):
        Observation(depth(), None, K, None, np.zeros((6, 8, 3)))
    with pytest.raises(ObservationError, match="plane is a tuple"):
        Observation(depth(), None, K, plane=(0, 0, 1, 0))


def test_nothing_to_map_is_explained():
    with pytest.raises(ObservationError, match="segment_tabletop"):
        Observation(depth(), None, K).require_objects()
    with pytest.raises(ObservationError, match="every label is 0"):
        Observation(depth(), np.zeros((6, 8), int), K).require_objects()


def test_errors_are_one_line_and_of_the_package():
    with pytest.raises(VPrismError) as caught:
        Observation(depth(700.0), None, K)
    assert isinstance(caught.value, ValueError)
    assert "\n" not in str(caught.value)


def test_plane_is_normalised_or_refused():
    plane = Plane([0, 0, 2.0], 1.0)
    np.testing.assert_allclose(plane.normal, [0, 0, 1])
    assert plane.offset == 0.5
    np.testing.assert_allclose(plane.signed_distance(np.array([[3.0, 4, 2]])), [1.5])
    np.testing.assert_allclose(plane.project(np.array([3.0, 4, 2])), [3, 4, 0.5])
    for normal, offset in (
        ([0, 0, 0], 0.0),
        ([0, np.nan, 1], 0.0),
        ([0, 1], 0.0),
        ([0, 0, 1], np.inf),
    ):
        with pytest.raises(ObservationError, match="plane normal"):
            Plane(normal, offset)


@pytest.mark.parametrize(
    ("at", "value", "said"),
    [
        ((1, 1), 0.51, "beyond the depth seen there"),  # behind the surface that the pixel shows
        ((0, 0), np.inf, "infinity"),  # no surface was seen there
        ((1, 1), -0.1, "< 0"),
        ((1, 1), np.nan, "NaN"),
    ],
)
def test_no_ray_is_free_beyond_its_surface(at, value, said):
    seen = with_value(depth(0.5), (0, 0), 0.0)
    clear = with_value(seen, (0, 0), 2.0)
    np.testing.assert_array_equal(Observation(seen, None, K, clear=clear).free_depth, clear)
    with pytest.raises(ObservationError, match=said):
        Observation(seen, None, K, clear=with_value(clear, at, value))
