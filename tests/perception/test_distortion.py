# SPDX-License-Identifier: BSD-3-Clause
"""A distorted picture is straightened on reading, or refused; it never passes as it is."""

import json

import numpy as np
import pytest
from oracles.perception_oracles import intrinsics
from PIL import Image

from vprism_plan.errors import ObservationError
from vprism_plan.perception import load_observation

WIDTH, HEIGHT = 160, 120
K = intrinsics(WIDTH, HEIGHT)
# Of a wide webcam, a Kinect's colour camera, and one with OpenCV's rational model.
LENSES = {
    "barrel": [-0.28, 0.07, 0.0, 0.0],
    "plumb bob": [0.12, -0.25, 0.002, -0.003, 0.1],
    "rational": [0.5, -2.4, 0.0005, -0.0002, 1.6, 0.4, -2.2, 1.5],
}


def straight_rays(lens) -> np.ndarray:
    """(H, W, 2) ray (x, y, 1) behind each distorted pixel: OpenCV, inverted step by step."""
    k1, k2, p1, p2, k3, k4, k5, k6 = np.pad(lens, (0, 8 - len(lens)))
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    target = np.stack([(columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1]], -1)
    ray = target.copy()
    for _ in range(60):
        x, y = ray[..., 0], ray[..., 1]
        r = x * x + y * y
        radial = (1 + k1 * r + k2 * r**2 + k3 * r**3) / (1 + k4 * r + k5 * r**2 + k6 * r**3)
        shift = [2 * p1 * x * y + p2 * (r + 2 * x * x), p1 * (r + 2 * y * y) + 2 * p2 * x * y]
        ray = (target - np.stack(shift, -1)) / radial[..., None]
    return ray


def plane_depth(ray) -> np.ndarray:
    """A tilted table, depth along the optical axis."""
    return 0.9 / (1.0 + 0.15 * ray[..., 0] + 0.6 * ray[..., 1])


def write(folder, lens, **camera) -> None:
    ray = straight_rays(lens)
    raw = np.rint(plane_depth(ray) / 1e-4).astype(np.uint16)
    Image.fromarray(raw).save(folder / "depth.png")
    Image.fromarray((ray[..., 0] > 0.1).astype(np.uint8)).save(folder / "labels.png")
    pinhole = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "depth_scale": 1e-4}
    (folder / "camera.json").write_text(json.dumps({**pinhole, **camera}))


@pytest.mark.parametrize(
    ("name", "key"), list(zip(LENSES, ["distortion", "D", "coeffs"], strict=True))
)
def test_a_distorted_plane_becomes_straight(tmp_path, name, key):
    write(tmp_path, LENSES[name], **{key: LENSES[name]})
    obs = load_observation(tmp_path)
    ray = straight_rays([0.0] * 4)
    seen = obs.depth > 0
    assert seen.mean() > 0.8
    # At most half a pixel of the distorted picture beside the right one.
    truth = plane_depth(ray)
    allowed = 0.7 * sum(np.abs(slope) for slope in np.gradient(truth)) + 1e-4
    assert (np.abs(obs.depth - truth) < allowed)[seen].all()
    wrong = (obs.labels > 0) != (ray[..., 0] > 0.1)
    assert not (wrong & seen & (np.abs(ray[..., 0] - 0.1) > 0.6 / K[0, 0])).any()
    # Without the numbers the same picture is off by more than that.
    write(tmp_path, LENSES[name])
    bent = load_observation(tmp_path)
    assert (np.abs(bent.depth - truth) > allowed).mean() > 0.02


def test_coefficients_one_by_one_and_in_a_bop_scene(tmp_path):
    lens = LENSES["barrel"]
    write(tmp_path, lens, distortion=lens)
    listed = load_observation(tmp_path)
    write(tmp_path, lens, k1=lens[0], k2=lens[1])
    np.testing.assert_array_equal(load_observation(tmp_path).depth, listed.depth)
    scene = tmp_path / "scene"
    (scene / "depth").mkdir(parents=True)
    (tmp_path / "depth.png").rename(scene / "depth" / "000000.png")
    camera = {"cam_K": K.ravel().tolist(), "depth_scale": 0.1, "distortion": lens}
    (scene / "scene_camera.json").write_text(json.dumps({"0": camera}))
    np.testing.assert_allclose(load_observation(scene).depth, listed.depth, atol=1e-9)


@pytest.mark.parametrize("zero", [[], [0.0] * 5, [1e-9, 0, 0, 0, 0]])
def test_no_distortion_changes_nothing(tmp_path, zero):
    write(tmp_path, [0.0] * 4)
    plain = load_observation(tmp_path)
    write(tmp_path, [0.0] * 4, coeffs=zero)
    np.testing.assert_array_equal(load_observation(tmp_path).depth, plain.depth)


def test_where_the_polynomial_turns_back_nothing_was_seen(tmp_path):
    lens = [-1.2, 0.0, 0.0, 0.0]  # r - 1.2 r^3 falls from r = 0.53 on
    write(tmp_path, [0.0] * 4, distortion=lens)
    obs = load_observation(tmp_path)
    ray = straight_rays([0.0] * 4)
    np.testing.assert_array_equal(obs.depth > 0, np.hypot(*np.moveaxis(ray, -1, 0)) < 0.527)


BAD = {
    "fisheye": ({"distortion": [0.1, 0, 0, 0], "distortion_model": "equidistant"}, "equidistant"),
    "inverse": (
        {"coeffs": [0.1, 0, 0, 0, 0], "model": "Inverse Brown Conrady"},
        "Inverse Brown Conrady.*nearest pixel",
    ),
    "thin prism": ({"D": [0.1] * 12}, "rational_polynomial"),
    "text": ({"D": ["a"]}, "'D' is not a list of numbers"),
    "not finite": ({"D": [float("nan")] * 4}, "not finite"),
}


@pytest.mark.parametrize("name", BAD)
def test_other_lenses_are_refused(tmp_path, name):
    camera, message = BAD[name]
    write(tmp_path, [0.0] * 4, **camera)
    with pytest.raises(ObservationError, match=message) as caught:
        load_observation(tmp_path)
    assert "camera.json" in str(caught.value)
