# SPDX-License-Identifier: BSD-3-Clause
"""Objects on a table are told apart by geometry, with a stereo sensor's faults on top."""

import numpy as np
import pytest
from oracles.perception_oracles import (
    Scene,
    intersection_over_union,
    intrinsics,
    look_at,
    spoil,
)

from vprism_plan.errors import ConfigError, PlaneNotFoundError
from vprism_plan.perception import Observation, Plane, fit_plane, segment_tabletop

EYE = (-0.8, 0.0, 0.65)
SCENE = Scene(
    spheres=[((0.0, 0.0, 0.06), 0.06), ((-0.15, 0.25, 0.05), 0.05)],
    boxes=[
        ((0.15, 0.1, 0.0), (0.25, 0.2, 0.2)),
        ((-0.2, -0.3, 0.0), (-0.1, -0.2, 0.07)),
        ((0.1, -0.25, 0.0), (0.2, -0.15, 0.12)),
    ],
)


def observe(scene=SCENE, width=640, seed=0, pose=True, eye=EYE, dtype=np.float32, **faults):
    shape = (width * 3 // 4, width)
    K, T = intrinsics(width, shape[0]), look_at(eye)
    depth, truth = scene.render(T, K, shape)
    noisy, made = spoil(depth, np.random.default_rng(seed), **faults)
    return Observation(noisy.astype(dtype), None, K, T if pose else None), truth, made


def matches(found: np.ndarray, truth: np.ndarray, usable: np.ndarray) -> list[float]:
    """Best IoU of every true object, over the pixels that still have a return."""
    return [
        max(
            intersection_over_union((found == k) & usable, (truth == t) & usable)
            for k in range(1, found.max() + 1)
        )
        for t in range(1, truth.max() + 1)
    ]


@pytest.mark.parametrize("width", [320, 640])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_finds_every_object_and_nothing_else(width, dtype):
    obs, truth, _ = observe(width=width, dtype=dtype)
    found = segment_tabletop(obs)
    assert len(found.object_ids) == 5
    assert found.depth.dtype == dtype
    assert min(matches(found.labels, truth, found.depth > 0)) > 0.75
    assert found.plane is not None
    assert found.require_objects() == (1, 2, 3, 4, 5)


@pytest.mark.parametrize("seed", range(3))
def test_survives_noise_holes_and_specks(seed):
    obs, truth, _ = observe(seed=seed, noise=0.002, holes=0.08, specks=150)
    found = segment_tabletop(obs, seed=seed)
    assert len(found.object_ids) == 5
    assert min(matches(found.labels, truth, found.depth > 0)) > 0.7


def test_pose_plane_and_seed_do_not_change_the_labels():
    posed, _, _ = observe()
    free, _, _ = observe(pose=False)
    a, b = segment_tabletop(posed), segment_tabletop(free)
    assert (a.labels != b.labels).mean() < 1e-4
    again = segment_tabletop(posed)
    np.testing.assert_array_equal(a.labels, again.labels)
    given = segment_tabletop(posed, plane=fit_plane(posed))
    np.testing.assert_array_equal(a.labels, given.labels)


def test_labels_run_by_falling_visible_area():
    found = segment_tabletop(observe()[0])
    pitch = found.depth / found.intrinsics[0, 0]
    areas = [float((pitch[found.labels == k] ** 2).sum()) for k in found.object_ids]
    assert areas == sorted(areas, reverse=True)


def test_old_labels_and_the_input_are_left_alone():
    obs, _, _ = observe()
    before = obs.depth.copy()
    relabelled = Observation(obs.depth, np.ones(obs.shape, int), obs.intrinsics, obs.pose)
    found = segment_tabletop(relabelled)
    np.testing.assert_array_equal(obs.depth, before)
    assert len(found.object_ids) == 5


def test_flying_pixels_and_specks_are_removed_and_little_else():
    obs, truth, made = observe(noise=0.001, holes=0.0, specks=60)
    found = segment_tabletop(obs)
    height = found.plane.signed_distance(obs.point_image())
    hanging = made & (height > 0.02)
    removed = (obs.depth > 0) & (found.depth == 0)
    assert hanging.sum() > 200
    assert (removed & hanging).sum() > 0.8 * hanging.sum()
    assert (removed & ~made).sum() < 0.015 * (truth > 0).sum()
    untouched = segment_tabletop(obs, remove_flying=False)
    np.testing.assert_array_equal(untouched.depth, obs.depth)


def test_a_clean_image_loses_next_to_nothing():
    """Not even the sides of boxes that are seen at a glancing angle."""
    obs, truth, _ = observe(noise=0.0, holes=0.0, flying=False)
    found = segment_tabletop(obs)
    lost = (obs.depth > 0) & (found.depth == 0)
    assert lost.sum() < 0.007 * (truth > 0).sum()  # where such a side tapers off


def test_clutter_is_never_dropped():
    """A rod 8 mm thick and a block 2 cm high: too little to label, real obstacles all the same."""
    scene = Scene(
        SCENE.spheres,
        [
            *SCENE.boxes,
            ((0.0, -0.12, 0.0), (0.008, -0.112, 0.3)),
            ((-0.3, 0.05, 0.0), (-0.285, 0.065, 0.02)),
        ],
    )
    obs, truth, _ = observe(scene, noise=0.001, holes=0.0, flying=False)
    found = segment_tabletop(obs)
    for clutter in (6, 7):
        kept = (found.depth > 0) & (truth == clutter)
        assert kept.sum() > 0.9 * (truth == clutter).sum()


def test_what_is_too_large_or_beside_the_table_stays_background():
    scene = Scene(
        SCENE.spheres,
        [
            *SCENE.boxes,
            ((0.35, -0.5, 0.0), (0.45, 0.2, 0.45)),  # a monitor: too wide
            ((0.72, 0.3, -0.7), (0.85, 0.5, 0.15)),  # a chair: not over the table
        ],
        floor=-0.7,
    )
    obs, truth, _ = observe(scene, flying=False)
    found = segment_tabletop(obs)
    assert len(found.object_ids) == 5
    for large in (6, 7):
        assert (truth == large).sum() > 500
        assert (found.labels[truth == large] == 0).mean() > 0.99
        assert (found.depth[truth == large] > 0).mean() > 0.97


def test_touching_objects_with_a_valley_between_them_are_two():
    scene = Scene(spheres=[((0.0, -0.06, 0.06), 0.06), ((0.0, 0.06, 0.06), 0.06)])
    obs, truth, _ = observe(scene)
    found = segment_tabletop(obs)
    assert len(found.object_ids) == 2
    assert min(matches(found.labels, truth, found.depth > 0)) > 0.8


def test_a_box_before_a_box_is_two_and_a_stack_is_one():
    behind = Scene(
        boxes=[((-0.1, -0.05, 0.0), (-0.05, 0.05, 0.1)), ((0.08, -0.06, 0.0), (0.14, 0.06, 0.22))]
    )
    assert len(segment_tabletop(observe(behind)[0]).object_ids) == 2
    stack = Scene(
        boxes=[((0.0, -0.06, 0.0), (0.12, 0.06, 0.1)), ((0.02, -0.04, 0.1), (0.1, 0.04, 0.18))]
    )
    assert len(segment_tabletop(observe(stack)[0]).object_ids) == 1


def test_seen_from_straight_above():
    obs, _, _ = observe(eye=(0.0, 0.0, 1.1))
    assert len(segment_tabletop(obs).object_ids) == 5


def test_an_empty_table_has_no_objects():
    found = segment_tabletop(observe(Scene())[0])
    assert found.object_ids == ()
    assert found.labels.shape == found.shape


def test_a_plane_nobody_sees_is_refused():
    with pytest.raises(PlaneNotFoundError, match="lie on the given plane"):
        segment_tabletop(observe()[0], plane=Plane([0, 0, 1.0], -9.0))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"min_height": 0.0}, "min_height is 0"),
        ({"max_size": -1.0}, "max_size is -1"),
        ({"max_height": float("nan")}, "max_height is nan"),
        ({"min_height": 0.6}, "must be less than max_height"),
        ({"min_points": 0}, "min_points is 0"),
    ],
)
def test_contradictory_limits_are_named(options, message):
    with pytest.raises(ConfigError, match=message):
        segment_tabletop(observe(width=320)[0], **options)


def test_a_plane_that_covers_no_patch_is_refused():
    """A plane that cuts a box in half is crossed by its sides only."""
    obs, _, _ = observe(Scene(boxes=SCENE.boxes[:1]), width=320)
    with pytest.raises(PlaneNotFoundError, match="no patch"):
        segment_tabletop(obs, plane=Plane([0, 0, 1.0], 0.15))
