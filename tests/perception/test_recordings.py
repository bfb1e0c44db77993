# SPDX-License-Identifier: BSD-3-Clause
"""Which image, camera and pose is taken from a recording, and what is said when none can be."""

import numpy as np
import pytest
from oracles import view_files as files
from oracles.perception_oracles import intrinsics, look_at

from vprism_plan.errors import ObservationError
from vprism_plan.perception import Observation, load_observation

SHAPE = (24, 32)
K = intrinsics(32, 24)


@pytest.fixture(scope="module")
def view() -> Observation:
    return Observation(np.full(SHAPE, 0.7), None, K, look_at((0.6, 0.1, 0.5)))


@pytest.fixture(scope="module")
def drive(view, tmp_path_factory):
    return files.mcap(view, tmp_path_factory.mktemp("drive"))


@pytest.mark.parametrize("image", [0, 3, 17])
def test_the_nearest_image_is_taken(drive, image):
    for at in (0.1 * image - 0.04, 0.1 * image, 0.1 * image + 0.04):
        seen = load_observation(drive, at=max(at, 0.0))
        assert seen.depth[5, 5] == pytest.approx((900 + image) * 1e-3)
        assert not seen.posed


@pytest.mark.parametrize("image", [1, 12, 18])
def test_the_pose_is_that_of_the_images_time(view, drive, image):
    seen = load_observation(drive, frame="base", at=0.1 * image)
    mount = np.linalg.inv(files.moved(1.2)) @ view.pose
    np.testing.assert_allclose(seen.pose, files.moved(0.1 * image) @ mount, atol=1e-9)
    above = load_observation(drive, frame="/map", at=0.1 * image)  # base is below it
    np.testing.assert_allclose(above.pose, seen.pose, atol=1e-12)
    beside = load_observation(drive, frame="hand", at=0.1 * image)
    np.testing.assert_allclose(beside.pose, mount, atol=1e-9)


ASKED = {
    "an image after the end": ({"at": 9.0}, r"nothing within 1 s of 9 s; the recording is 2\.3 s"),
    "before the start": ({"at": -1.0}, "at is -1.0"),
    "no such topic": ({"depth": "/d"}, r"no image topic '/d'; topics: .*/cam/depth/image_raw"),
    "no such frame": ({"frame": "odom"}, "'odom'; frames: base, camera, hand, map"),
}


@pytest.mark.parametrize("name", ASKED)
def test_what_is_not_there_is_named(drive, name):
    asked, message = ASKED[name]
    with pytest.raises(ObservationError, match=message):
        load_observation(drive, **asked)


def two_cameras(bag, v):
    files.one_image(bag, v)
    bag.info("/left/camera_info", 5)
    bag.depth("/left/depth", 5, files.raw(v) + 100)
    bag.depth("/left/mono", 5, np.zeros(SHAPE, np.uint8), "mono8")


def test_topics_are_listed_where_there_is_a_choice(view, tmp_path):
    path = files.bag1(view, tmp_path, two_cameras)
    with pytest.raises(ObservationError, match=r"2 topics .*--depth.*/left/depth \(Image\)"):
        load_observation(path)
    assert load_observation(path, depth="/left/depth").depth[0, 0] == pytest.approx(0.8)
    with pytest.raises(ObservationError, match="/left/mono has images of 'mono8', no depth"):
        load_observation(path, depth="/left/mono")


def strange(bag, v):
    bag.depth("/a/depth", 5, files.raw(v), frame="optical")
    bag.info("/b/camera_info", 5, frame="other")


def by_frame(bag, v):
    strange(bag, v)
    bag.info("/c/camera_info", 5, frame="optical")


def test_a_camera_belongs_by_its_topic_or_its_frame(view, tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    path = files.mcap(view, tmp_path / "a", strange)
    with pytest.raises(ObservationError, match=r"no CameraInfo belongs to /a/depth.*/b/camera"):
        load_observation(path)
    seen = load_observation(files.mcap(view, tmp_path / "b", by_frame))
    np.testing.assert_allclose(seen.intrinsics, K)


def bent(bag, v):
    bag.info("/camera_info", 5, d=(0.2, 0.0, 0.0, 0.0, 0.0))
    pixels = np.tile(np.arange(SHAPE[1], dtype=np.uint16) + 500, (SHAPE[0], 1))
    bag.depth("/depth", 5, pixels)


def test_a_lens_is_undone(view, tmp_path):
    seen = load_observation(files.bag1(view, tmp_path, bent))
    plain = np.tile(np.arange(SHAPE[1]) + 500, (SHAPE[0], 1)) * 1e-3
    assert (seen.depth != plain).any()
    np.testing.assert_allclose(seen.depth[10:14, 14:18], plain[10:14, 14:18])


def big_endian(bag, v):
    bag.info("/camera_info", 5)
    rows = np.pad(files.raw(v).astype(">u2"), ((0, 0), (0, 4)))  # rows are padded, too
    size = {"height": SHAPE[0], "width": SHAPE[1], "step": 2 * (SHAPE[1] + 4), "is_bigendian": 1}
    header, data = bag.header(5, "camera"), np.frombuffer(rows.tobytes(), np.uint8)
    content = {"header": header, "encoding": "16UC1", "data": data}
    bag.write("/depth", "sensor_msgs/msg/Image", 5, **size, **content)


def test_pixels_are_read_as_they_lie(view, tmp_path):
    seen = load_observation(files.mcap(view, tmp_path, big_endian))
    np.testing.assert_allclose(seen.depth, view.depth)


def saturated(bag, v):
    bag.info("/camera_info", 5)
    pixels = files.raw(v)
    pixels[3, 4] = 65535
    bag.depth("/depth", 5, pixels)


def test_the_largest_raw_value_is_no_return(view, tmp_path):
    seen = load_observation(files.mcap(view, tmp_path, saturated))
    assert (seen.depth == 0).sum() == 1
    assert seen.depth[3, 4] == 0.0
    assert seen.warnings == ()


def jumping(bag, v, times=(0, 4)):
    """TF stands still long before the image and after it."""
    for seconds in times:
        bag.transform("/tf", 10**9 * (seconds + 1), "base", "camera", files.moved(seconds))
    bag.info("/camera_info", 2 * 10**9, frame="camera")
    bag.depth("/depth", 2 * 10**9, files.raw(v), frame="camera")


def test_a_pose_is_not_made_up_beyond_what_was_recorded(view, tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    between = load_observation(files.bag1(view, tmp_path / "a", jumping), frame="base")
    np.testing.assert_allclose(between.pose, files.moved(1.0), atol=1e-9)
    path = files.bag1(view, tmp_path / "b", lambda bag, v: jumping(bag, v, (0,)))
    with pytest.raises(ObservationError, match=r"'camera' was recorded from -1\.00 to -1\.00 s"):
        load_observation(path, frame="base")


def looped(bag, v):
    files.one_image(bag, v)
    for parent, child in (("a", "camera"), ("b", "a"), ("a", "b")):
        bag.transform("/tf_static", 5, parent, child, np.eye(4))


def test_frames_in_a_circle_are_named(view, tmp_path):
    with pytest.raises(ObservationError, match="TF has a loop at frame"):
        load_observation(files.mcap(view, tmp_path, looped), frame="base")
