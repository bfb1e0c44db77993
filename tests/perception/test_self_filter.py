# SPDX-License-Identifier: BSD-3-Clause
"""The robot in the picture: which pixels see it, and that nothing else takes it for the scene."""

import json
import logging
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.perception_oracles import Scene, intrinsics, look_at, spoil

from vprism_plan.errors import ConfigError, ObservationError
from vprism_plan.perception import (
    Observation,
    Plane,
    align_to_table,
    fit_plane,
    ignore_robot,
    ignore_self,
    load_observation,
    save_observation,
    segment_tabletop,
)
from vprism_plan.robots import Robot

K = intrinsics()
POSE = look_at((-0.7, 0.1, 0.6))
CUBE = ((0.05, -0.05, 0.0), (0.15, 0.05, 0.1))
# A fat arm over the table, between the camera and the cube.
ARM = [((-0.2, y, 0.3), 0.06) for y in (-0.3, -0.25, -0.2, -0.15, -0.1, -0.05, 0.0)]


def picture(arm=ARM, noise: int | None = None) -> Observation:
    """The scene with the arm in it; label 1 is the cube, and 9 the arm (as a bad network says)."""
    scene = Scene(spheres=list(arm), boxes=[CUBE])
    depth, labels = scene.render(POSE, K)
    if noise is not None:
        depth, _ = spoil(depth, np.random.default_rng(noise))
    renamed = np.where(labels == len(arm) + 1, 1, np.where(labels > 0, 9, 0))
    return Observation(depth, renamed, K, POSE)


def centers_and_radii(arm=ARM) -> tuple[np.ndarray, np.ndarray]:
    return np.array([c for c, _ in arm]), np.array([r for _, r in arm])


def oracle(observation: Observation, centers, radii) -> np.ndarray:
    """Pixel by pixel, in the world frame."""
    image = observation.point_image()
    seen = np.zeros(observation.shape, dtype=bool)
    for row, column in np.ndindex(*observation.shape):
        if observation.depth[row, column] > 0:
            way = np.linalg.norm(image[row, column] - centers, axis=1)
            seen[row, column] = bool((way <= radii).any())
    return seen


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), posed=st.booleans())
def test_pixels_of_the_robot_are_those_within_its_padded_balls(seed, posed):
    """Balls anywhere: beside the image, around the camera, behind it."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.2, 1.5, (13, 17))
    depth[rng.random(depth.shape) < 0.1] = 0.0
    pose = look_at(rng.normal(size=3) + np.array([0, 0, 2])) if posed else None
    obs = Observation(depth, rng.integers(0, 4, depth.shape), intrinsics(17, 13), pose)
    near = obs.points()[0][rng.integers(0, (depth > 0).sum(), 4)]
    centers = np.vstack([near, obs.camera_center + rng.normal(size=(3, 3))])
    radii, padding = rng.uniform(0.02, 0.4, 7), float(rng.uniform(0, 0.1))
    marked = ignore_robot(obs, centers, radii, padding, remove_flying=False)
    expected = oracle(obs, centers, radii + padding)
    np.testing.assert_array_equal(replace(marked, labels=None).sees_robot, expected)
    np.testing.assert_array_equal(marked.sees_robot, expected & (obs.labels == 0))
    np.testing.assert_array_equal(marked.labels, obs.labels)  # balls alone take no label away
    np.testing.assert_array_equal(marked.depth, obs.depth)
    assert not obs.sees_robot.any()  # what was given is left alone


@pytest.fixture(scope="module")
def arm_robot(tmp_path_factory) -> Robot:
    """The arm as the collision geometry of a URDF, held by one sphere that stands far out."""
    solid = (
        '<collision><origin xyz="{} {} {}"/><geometry><sphere radius="{}"/></geometry></collision>'
    )
    arm = "".join(solid.format(*center, radius) for center, radius in ARM)
    text = (
        f'<robot name="arm"><link name="base"/><link name="arm">{arm}</link>'
        '<joint name="x" type="prismatic"><parent link="base"/><child link="arm"/>'
        '<axis xyz="1 0 0"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>'
    )
    path = tmp_path_factory.mktemp("arm") / "arm.urdf"
    path.write_text(text)
    return Robot.from_urdf(path, spheres={"arm": [{"center": [-0.2, -0.15, 0.3], "radius": 0.4}]})


def test_every_pixel_of_the_arm_is_marked_and_none_of_the_cube(arm_robot):
    obs = picture()
    marked = ignore_self(obs, arm_robot, [0.0])
    assert marked.warnings == ()
    np.testing.assert_array_equal(marked.sees_robot, obs.labels == 9)
    assert obs.object_ids == (1, 9)
    assert marked.object_ids == (1,)
    np.testing.assert_array_equal(marked.labels == 1, obs.labels == 1)
    # A clean picture has no flying pixels but single ones in the notches of the outline.
    assert (marked.depth != obs.depth).sum() < 5


def test_marks_move_with_the_world_and_labels_outrank_them(arm_robot):
    marked = ignore_self(picture(), arm_robot, [0.0])
    assert marked.sees_robot.sum() > 1000
    aligned = align_to_table(marked)
    assert not np.allclose(aligned.pose, marked.pose)
    np.testing.assert_array_equal(aligned.sees_robot, marked.sees_robot)
    relabelled = replace(marked, labels=np.full(marked.shape, 5))
    assert (relabelled.labels == 5).all()
    assert not relabelled.sees_robot.any()
    again = ignore_self(relabelled, arm_robot, [0.0])
    assert (again.labels[again.depth > 0] == 5).all()
    assert "of object 5 is seen in or on the pictured robot" in again.warnings[0]


def test_a_label_is_the_robots_only_if_it_lies_on_the_surface_of_its_solids(arm_robot):
    """Standing off by more than the noise, deep inside, or partly elsewhere: an object."""
    obs = picture()
    on_arm = obs.labels == 9
    exact = ignore_self(obs, arm_robot, [0.0])
    assert not exact.labels[on_arm].any()
    rng = np.random.default_rng(0)
    for away, taken in ((0.002, True), (-0.002, True), (-0.012, False), (0.012, False)):
        depth = obs.depth - on_arm * (away + rng.normal(0, 1e-4, obs.shape))
        moved = replace(obs, depth=depth)
        marked = ignore_self(moved, arm_robot, [0.0], remove_flying=False)
        assert (9 in marked.object_ids) != taken
    spilled = np.where((obs.labels == 0) & (np.arange(obs.shape[1]) < 100), 9, obs.labels)
    marked = ignore_self(replace(obs, labels=spilled), arm_robot, [0.0], remove_flying=False)
    np.testing.assert_array_equal(marked.labels, spilled)
    assert "of object 9 is seen in or on the pictured robot" in marked.warnings[0]
    assert "set its label to 0" in marked.warnings[0]
    with_balls = ignore_robot(obs, *centers_and_radii())
    np.testing.assert_array_equal(with_balls.labels, obs.labels)
    assert "100% of object 9" in with_balls.warnings[0]


def test_a_robot_that_the_camera_sees_through_was_elsewhere(arm_robot):
    marked = ignore_self(picture(), arm_robot, [-0.2])
    assert any("the camera saw through" in text and "check q" in text for text in marked.warnings)
    hidden = replace(picture(), depth=np.full(picture().shape, 0.05))  # a hand before the lens
    assert not any("saw through" in text for text in ignore_self(hidden, arm_robot, [0]).warnings)


def test_spheres_that_stand_out_of_the_robot_mask_and_clear_nothing_but_on_ones_word(arm_robot):
    obs = replace(picture(), labels=None)
    plain = ignore_self(obs, arm_robot, [0.0], 0.0)
    gap = np.min([np.linalg.norm(obs.point_image() - c, axis=-1) - r for c, r in ARM], axis=0)
    assert plain.sees_robot.sum() > 1000
    assert (gap[plain.sees_robot] < 0.006).all()
    assert plain.robot_spheres[:, 4].max() == 0.06
    given = ignore_self(obs, arm_robot, [0.0], 0.0, room=0.02)
    np.testing.assert_array_equal(given.sees_robot, plain.sees_robot)
    assert given.robot_spheres[:, 4].max() == pytest.approx(0.42)
    assert "0.02 m around them counts as free by your word" in given.warnings[0]


def test_links_without_solids_are_named(arm_robot):
    bare = replace(arm_robot, geometry_as_read={})
    marked = ignore_self(replace(picture(), labels=None), bare, [0.0])
    assert "['arm'] have no solids" in marked.warnings[0]
    assert marked.robot_spheres[:, 4].tolist() == [0.4]


def test_marking_again_adds_to_what_is_marked():
    centers, radii = centers_and_radii()
    at_once = ignore_robot(picture(), centers, radii)
    in_turn = ignore_robot(ignore_robot(picture(), centers[:3], radii[:3]), centers[3:], radii[3:])
    np.testing.assert_array_equal(in_turn.sees_robot, at_once.sees_robot)
    np.testing.assert_allclose(in_turn.robot_spheres, at_once.robot_spheres)


class FakeRobot:
    sphere_radii = centers_and_radii()[1]

    def sphere_centers(self, q: torch.Tensor) -> torch.Tensor:
        assert q.dtype == torch.float64
        return torch.tensor(centers_and_radii()[0]) + q


def test_a_robot_and_its_configuration_do_as_well():
    obs, shift = picture(), np.array([0.01, 0.02, 0.0])
    by_robot = ignore_self(obs, FakeRobot(), shift, 0.02)
    by_hand = ignore_robot(obs, centers_and_radii()[0] + shift, centers_and_radii()[1], 0.02)
    np.testing.assert_array_equal(by_robot.robot_spheres, by_hand.robot_spheres)
    with pytest.raises(ObservationError, match="no T_world_camera, so the robot cannot be placed"):
        ignore_self(replace(obs, T_world_camera=None), FakeRobot(), shift)


def test_the_robot_is_neither_labelled_nor_part_of_the_plane():
    """A tray held over half of the table is a larger plane than the table."""
    obs = replace(picture(noise=1), labels=None)
    assert 9 not in segment_tabletop(obs).object_ids
    raw = segment_tabletop(obs)
    marked = segment_tabletop(ignore_robot(obs, *centers_and_radii()))
    assert len(raw.object_ids) > len(marked.object_ids) == 1
    assert not marked.labels[marked.sees_robot].any()
    cube = picture().labels == 1
    assert (marked.labels[cube & (obs.depth > 0)] == 1).mean() > 0.7

    flat = Scene(boxes=[((-0.55, -0.6, 0.25), (0.1, 0.6, 0.26))], table=((-0.6, -0.6), (0.9, 0.6)))
    depth, _ = flat.render(POSE, K)
    tray = Observation(depth, None, K, POSE)
    assert abs(fit_plane(tray).offset - 0.26) < 0.01
    grid = np.stack(np.meshgrid(np.arange(-0.6, 0.15, 0.03), np.arange(-0.63, 0.64, 0.03)), -1)
    centers = np.column_stack([grid.reshape(-1, 2), np.full(grid[..., 0].size, 0.255)])
    held = ignore_robot(tray, centers, np.full(len(centers), 0.03))
    assert abs(fit_plane(held).offset) < 0.005
    assert abs(align_to_table(held).pose[2, 3] - POSE[2, 3]) < 0.005


def test_flying_pixels_along_the_outline_are_removed():
    from scipy.ndimage import binary_dilation

    scene = Scene(spheres=list(ARM), boxes=[CUBE])
    clean, labels = scene.render(POSE, K)
    depth, made = spoil(clean, np.random.default_rng(2), holes=0.0)
    obs = Observation(depth, np.where(labels > len(ARM), labels, 0), K, POSE)
    centers, radii = centers_and_radii()
    kept = ignore_robot(obs, centers, radii, remove_flying=False)
    marked = ignore_robot(obs, centers, radii)
    gone = (marked.depth == 0) & (obs.depth > 0)
    near = binary_dilation(kept.sees_robot, np.ones((3, 3)), iterations=2) & ~kept.sees_robot
    assert (gone <= near).all()
    in_air = near & made
    assert in_air.sum() > 200
    assert gone[in_air].mean() > 0.95
    assert gone[near & ~made].mean() < 0.1


def test_an_object_that_vanishes_under_the_robot_is_named(caplog, arm_robot):
    with caplog.at_level(logging.WARNING):
        ignore_self(picture(), arm_robot, [0.0])
    assert "objects [9] are the pictured robot" in caplog.text


@pytest.mark.parametrize(
    ("centers", "radii", "padding", "error", "message"),
    [
        (np.zeros((2, 2)), np.ones(2), 0.01, ObservationError, r"centers have shape \(2, 2\)"),
        (np.zeros((2, 3)), np.ones(3), 0.01, ObservationError, r"radii \(3,\); they must be"),
        (np.full((1, 3), np.nan), np.ones(1), 0.01, ObservationError, "row 0 of robot_spheres"),
        (np.zeros((2, 3)), np.array([1.0, 0.0]), 0.01, ObservationError, "row 1 of robot_spheres"),
        (np.zeros((1, 3)), np.ones(1), -0.01, ConfigError, "padding is -0.01"),
        (np.zeros((1, 3)), np.ones(1), np.nan, ConfigError, "padding is nan"),
    ],
)
def test_balls_that_mean_nothing_are_refused(centers, radii, padding, error, message):
    with pytest.raises(error, match=message):
        ignore_robot(picture(), centers, radii, padding)


@pytest.mark.parametrize("room", [-0.01, np.inf])
def test_a_room_that_means_nothing_is_refused(room, arm_robot):
    with pytest.raises(ConfigError, match=f"room is {room}"):
        ignore_robot(picture(), *centers_and_radii(), room=room)
    with pytest.raises(ConfigError, match=f"room is {room}"):
        ignore_self(picture(), arm_robot, [0.0], room=room)


def test_spheres_of_a_wrong_shape_are_refused():
    obs = picture()
    for value in (np.zeros(4), np.zeros((2, 3)), np.zeros((2, 6)), np.array([["a"] * 4])):
        with pytest.raises(ObservationError, match=r"they must be rows|give numbers"):
            replace(obs, robot_spheres=value)
    for radii in ((-0.1, 0.1), (0.1, -0.1), (0.0, 0.0), (0.1, np.nan)):
        with pytest.raises(ObservationError, match="row 0 of robot_spheres"):
            replace(obs, robot_spheres=[[0, 0, 1, *radii]])


def test_marks_are_saved_and_loaded_and_old_files_still_load(tmp_path):
    plain = replace(picture(), plane=Plane([0, 0, 1.0], 0.0))
    marked = ignore_robot(plain, *centers_and_radii())
    for target in (tmp_path / "view.npz", tmp_path / "view"):
        save_observation(marked, target)
        read = load_observation(target)
        np.testing.assert_array_equal(read.robot_spheres, marked.robot_spheres)
        assert (read.sees_robot == marked.sees_robot).mean() > 0.9999  # PNG rounds depth
    np.testing.assert_array_equal(
        load_observation(tmp_path / "view.npz").sees_robot, marked.sees_robot
    )
    for target in (tmp_path / "old.npz", tmp_path / "old"):
        save_observation(plain, target)
        assert load_observation(target).robot_spheres is None
    assert "robot_spheres" not in np.load(tmp_path / "old.npz").files
    assert "robot_spheres" not in json.loads((tmp_path / "old" / "camera.json").read_text())
    save_observation(plain, tmp_path / "view")  # nothing of the marks stays behind
    assert load_observation(tmp_path / "view").robot_spheres is None
