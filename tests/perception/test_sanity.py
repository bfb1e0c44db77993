# SPDX-License-Identifier: BSD-3-Clause
"""Wrong readings of a view are refused or named, with the reading that would fit."""

import dataclasses

import numpy as np
import pytest
from oracles.perception_oracles import Scene, intrinsics, look_at

import vprism_plan as vp
from vprism_plan.errors import ObservationError
from vprism_plan.perception import Observation, Plane, fit_plane
from vprism_plan.perception.camera import pixel_rays
from vprism_plan.perception.sanity import examine

K = intrinsics()
TABLE = Plane((0.0, 0.0, 1.0), 0.0)
POSE = look_at((-0.75, 0.1, 0.55))
BOXES = [((-0.04, 0.08, 0.0), (0.04, 0.16, 0.12)), ((0.02, -0.15, 0.0), (0.09, -0.09, 0.1))]
LINK = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
FLIP = np.diag([1.0, -1, -1, 1])


def picture(floor=-0.7, **changes) -> Observation:
    depth, labels = Scene(boxes=BOXES, floor=floor).render(POSE, K)
    depth = depth * (1.0 + 0.001 * np.random.default_rng(0).standard_normal(depth.shape))
    return dataclasses.replace(Observation(depth, labels, K, POSE), **changes)


def judged(view: Observation) -> tuple[str, ...]:
    return examine((view,), fit_plane(view))[1]


def test_a_right_view_is_neither_changed_nor_named():
    view = picture()
    (same,), found = examine((view,), fit_plane(view))
    assert found == ()
    assert same is view
    assert judged(dataclasses.replace(view, T_world_camera=None)) == ()


@pytest.mark.parametrize(
    ("pose", "said"),
    [
        (np.linalg.inv(POSE), "inverted"),
        (POSE @ FLIP, "OpenGL"),
        (POSE @ np.linalg.inv(LINK), "camera link"),
        (Y_UP @ POSE, "y-up"),
    ],
    ids=["inverse", "opengl", "link", "y-up"],
)
def test_a_wrong_reading_of_the_pose_is_refused_with_the_right_one(pose, said):
    with pytest.raises(ObservationError, match=said):
        judged(picture(T_world_camera=pose))
    with pytest.raises(ObservationError, match=said):
        vp.fit_map(picture(T_world_camera=pose))


def test_a_tilted_table_is_named():
    turn = np.eye(4)
    turn[1:3, 1:3] = [[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]]
    (text,) = judged(picture(T_world_camera=turn @ POSE))
    assert "23 degrees" in text


def test_millimetres_are_refused():
    far = POSE.copy()
    far[:3, 3] *= 1000.0
    with pytest.raises(ObservationError, match="metres"):
        examine((picture(T_world_camera=far),), TABLE)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ((0, 2, 290.0), "principal point"),
        ((1, 1, 150.0), "square"),
        ((0, 0, 60.0), "focal length"),
    ],
)
def test_intrinsics_of_another_image_are_named(change, said):
    row, column, value = change
    matrix = K.copy()
    matrix[row, column] = value
    _, found = examine((picture(intrinsics=matrix),), TABLE)
    assert any(said in text for text in found)


def test_lengths_of_rays_are_named():
    view = picture()
    length = view.depth * np.linalg.norm(pixel_rays(view.shape, K), axis=2)
    wrong = dataclasses.replace(view, depth=length)
    assert any("length of each ray" in text for text in judged(wrong))


def test_objects_a_metre_wide_are_named():
    view = picture()
    wrong = dataclasses.replace(
        view, depth=8.0 * view.depth, T_world_camera=look_at((-6.0, 0.8, 4.4)), max_range=20.0
    )
    _, found = examine((wrong,), TABLE)
    assert any("object 1 measures 0.9" in text for text in found)
    said = " ".join(vp.fit_map(wrong).warnings)
    assert "largest object measures 0.9" in said
    assert "scale of depth (metres)" in said


def test_a_mirror_on_the_table_is_no_return_and_the_floor_beside_it_is_one():
    view = picture()
    points = view.point_image()
    mirror = (np.abs(points[..., 0] - 0.1) < 0.06) & (np.abs(points[..., 1]) < 0.05)
    mirror &= np.abs(points[..., 2]) < 0.01
    assert mirror.sum() > 200
    deep = dataclasses.replace(view, depth=np.where(mirror, 1.5 * view.depth, view.depth))
    (mended,), found = examine((deep,), TABLE)
    lost = (mended.depth == 0) & (deep.depth > 0)
    assert lost.sum() > 0.5 * mirror.sum()
    assert not (lost & ~mirror).any()
    assert "mirror" in found[0]
    assert (points[(mended.depth > 0)][:, 2] < -0.6).sum() > 1000  # the floor
