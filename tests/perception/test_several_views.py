# SPDX-License-Identifier: BSD-3-Clause
"""Views of one scene agree: ids mean the same, poses fit, and what does not is named."""

import dataclasses

import numpy as np
import pytest
from oracles.perception_oracles import Scene, intrinsics, look_at

import vprism_plan as vp
from vprism_plan.errors import ObservationError
from vprism_plan.perception import Observation
from vprism_plan.perception.camera import depth_sigma
from vprism_plan.perception.several_views import agree

SHAPE = (480, 640)
K = intrinsics(640, 480)
BOXES = [
    ((-0.04, 0.08, 0.0), (0.04, 0.16, 0.12)),
    ((0.02, -0.16, 0.0), (0.09, -0.09, 0.10)),
    ((-0.16, -0.05, 0.0), (-0.1, 0.03, 0.06)),
]
EYES = [(-0.75, 0.0, 0.55), (0.1, 0.75, 0.55), (0.6, -0.45, 0.5)]


def view(number: int, boxes=BOXES, table=((-0.6, -0.45), (0.6, 0.45))) -> Observation:
    pose = look_at(EYES[number], (0.0, 0.0, 0.03))
    depth, labels = Scene(boxes=boxes, table=table, floor=-0.75).render(pose, K, SHAPE)
    noise = depth_sigma(np.where(depth > 0, depth, 1.0))
    noise = 0.5 * noise * np.random.default_rng(number).standard_normal(SHAPE)
    return Observation(np.where(depth > 0, depth + noise, 0.0), labels, K, pose)


def moved(shift) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = shift
    return T


def test_views_that_agree_are_left_alone():
    views = tuple(view(k) for k in range(3))
    assert all(a is b for a, b in zip(agree(views), views, strict=True))


@pytest.mark.parametrize("order", [(0, 2, 1, 3), (0, 3, 1, 2)])
def test_ids_that_change_between_views_merged_silently(order):
    first, second = view(0), view(1)
    swapped = dataclasses.replace(second, labels=np.array(order)[second.labels])
    same, mended = agree((first, swapped))
    assert same is first
    assert (mended.labels == second.labels).mean() > 0.999
    assert "id" in mended.warnings[0]


def test_a_new_object_keeps_its_new_id():
    first, second = view(0, BOXES[:2]), view(1)
    _, mended = agree((first, second))
    np.testing.assert_array_equal(mended.labels, second.labels)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_pose_off_by_two_centimetres_is_named_and_by_ten_refused(axis):
    first, second = view(0), view(1)
    shift = 0.02 * np.eye(3)[axis]
    off = dataclasses.replace(second, T_world_camera=moved(shift) @ second.pose)
    _, named = agree((first, off))
    assert any("mm" in text for text in named.warnings)
    np.testing.assert_array_equal(named.labels, second.labels)
    if axis == 2:  # along the table a far view may match something else: named, not always refused
        far = dataclasses.replace(second, T_world_camera=moved(5 * shift) @ second.pose)
        with pytest.raises(ObservationError, match="mm"):
            agree((first, far))


def test_an_object_that_moved_is_named():
    gone = [BOXES[0], tuple(tuple(np.add(c, (0.0, 0.2, 0.0))) for c in BOXES[1]), BOXES[2]]
    _, second = agree((view(0), view(1, gone)))
    assert any("object 2" in text and "mov" in text for text in second.warnings)


def test_the_map_carries_what_was_found_and_updates_compare_with_earlier_views():
    m = vp.fit_map(view(0))
    assert m.warnings == ()
    second = view(1)
    swapped = dataclasses.replace(second, labels=np.array([0, 2, 1, 3])[second.labels])
    updated = m.update(swapped)
    assert any("id" in text for text in updated.warnings)
    np.testing.assert_array_equal(updated.views[1].labels > 0, second.labels > 0)
