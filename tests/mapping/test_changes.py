# SPDX-License-Identifier: BSD-3-Clause
"""Scenes that change between views: what is noticed, and what old views are worth then."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import changes_oracle as oracle
from oracles.perception_oracles import Scene, intrinsics, look_at
from scipy import ndimage
from scipy.spatial.transform import Rotation

import vprism_plan as vp
from vprism_plan.errors import MapError, ObservationError, VPrismError
from vprism_plan.mapping.changes import Changes, notice, numbered, without_old
from vprism_plan.perception import Observation, Plane
from vprism_plan.perception.camera import depth_sigma
from vprism_plan.perception.sanity import examine
from vprism_plan.world import visibility

K = intrinsics()
TABLE = Plane((0.0, 0.0, 1.0), 0.0)
BOXES = {
    1: ((-0.04, 0.09, 0.0), (0.04, 0.17, 0.12)),
    2: ((0.02, -0.17, 0.0), (0.09, -0.10, 0.10)),
    3: ((-0.17, -0.05, 0.0), (-0.11, 0.03, 0.06)),
}
SAME, OTHER = (-0.75, 0.0, 0.55), (0.1, 0.75, 0.55)
PLACE = (0.12, 0.0)  # where nothing stands


def shifted(box, shift):
    return tuple(tuple(np.add(corner, (*shift, 0.0))) for corner in box)


def view(eye, boxes, seed=0, order=None, **more) -> Observation:
    """What a camera sees of boxes by id; `order` are the labels that ids 0, 1, ... get instead."""
    pose = look_at(eye, (0.0, 0.0, 0.03))
    depth, labels = Scene(boxes=list(boxes.values()), table=((-0.6, -0.5), (0.6, 0.5))).render(
        pose, K
    )
    labels = np.array([0, *boxes])[labels]
    labels = labels if order is None else np.array(order)[labels]
    noise = 0.5 * depth_sigma(np.where(depth > 0, depth, 1.0))
    noise = noise * np.random.default_rng(seed).standard_normal(depth.shape)
    return Observation(np.where(depth > 0, depth + noise, 0.0), labels, K, pose, **more)


def noticed(new, *earlier):
    """What is noticed, and the new view as it is then."""
    (mended,), _ = examine((new,), TABLE)
    found = notice(mended, earlier, TABLE)
    return found, numbered(mended, found.table, len(earlier))


FIRST = view(SAME, BOXES)
eyes = st.floats(-np.pi, np.pi).map(lambda a: (0.85 * np.cos(a), 0.85 * np.sin(a), 0.6))


# ------------------------------------------------------------------------------- nothing changes
@settings(max_examples=25)
@given(eyes, st.integers(0, 9), st.booleans(), st.booleans())
def test_noise_slight_turns_and_wide_masks_are_no_change(eye, seed, turned, wide):
    second = view(eye, BOXES, seed + 1)
    rng = np.random.default_rng(seed)
    if turned:
        off = np.eye(4)
        off[:3, :3] = Rotation.from_rotvec(np.deg2rad(0.2) * rng.standard_normal(3)).as_matrix()
        off[:3, 3] = 0.002 * rng.standard_normal(3)
        second = dataclasses.replace(second, T_world_camera=second.pose @ off)
    if wide:
        second = dataclasses.replace(second, labels=ndimage.maximum_filter(second.labels, 3))
    found, same = noticed(second, FIRST)
    assert found.earlier == (FIRST,)
    assert (found.moved, found.table) == ((), {})
    assert same.object_ids == second.object_ids


def test_a_second_view_of_the_same_scene_gives_the_same_map_as_both_views_at_once():
    second = view(OTHER, BOXES, 1)
    config = vp.MapConfig(iterations=3)
    first = dataclasses.replace(FIRST, plane=TABLE)
    updated = vp.fit_map(first, config).update(second)
    together = vp.fit_map([first, second], config)
    points = np.random.default_rng(0).uniform(-0.25, 0.25, (500, 3))
    np.testing.assert_array_equal(updated.predict_proba(points), together.predict_proba(points))
    assert updated.views[0].clear is None
    assert updated.warnings == ()
    assert updated.changes == Changes(kept=(1, 2, 3), ids=((1, 1), (2, 2), (3, 3)))


def test_real_frames_taken_twice_have_not_changed(real_frames):
    for path in real_frames:
        seen = vp.align_to_table(vp.segment_tabletop(vp.load_observation(path)))
        (seen,), _ = examine((seen,), seen.plane)
        rng = np.random.default_rng(0)
        noise = depth_sigma(seen.depth) * rng.standard_normal(seen.shape) * (seen.depth > 0)
        lost = rng.random(seen.shape) < 0.02
        again = dataclasses.replace(seen, depth=np.where(lost, 0.0, seen.depth + noise))
        found = notice(again, (seen,), seen.plane)
        assert found.earlier == (seen,)
        assert (found.moved, found.table) == ((), {})


def test_a_real_object_masked_out_has_left(real_frames):
    seen = vp.align_to_table(vp.segment_tabletop(vp.load_observation(real_frames[0])))
    (seen,), _ = examine((seen,), seen.plane)
    gone = max(seen.object_ids, key=lambda k: (seen.labels == k).sum())
    # The table in its stead: every ray through it goes on to the plane.
    own = ndimage.binary_dilation(seen.labels == gone, iterations=3)
    rays = (seen.point_image() - seen.camera_center) / seen.depth[..., None]
    to_plane = -seen.plane.signed_distance(seen.camera_center) / (rays @ seen.plane.normal)
    depth = np.where(own & (seen.depth > 0), to_plane, seen.depth)
    after = dataclasses.replace(seen, depth=depth, labels=np.where(own, 0, seen.labels))
    found = notice(after, (seen,), seen.plane)
    (before,) = found.earlier
    assert set(seen.object_ids) - set(before.object_ids) == {gone}
    assert found.moved == ()


# --------------------------------------------------------------------------------- what happens
@pytest.mark.parametrize("eye", [SAME, OTHER])
@pytest.mark.parametrize("order", [(0, 1, 2, 3), (0, 3, 1, 2)])
class TestOneChange:
    def test_one_that_moved_is_one_object(self, eye, order):
        boxes = {**BOXES, 2: shifted(BOXES[2], (0.02, 0.16))}
        found, new = noticed(view(eye, boxes, 1, order), FIRST)
        assert found.moved == (2,)
        assert found.earlier[0].object_ids == (1, 3)
        assert (new.labels == view(eye, boxes, 1).labels).mean() > 0.99

    def test_one_that_moved_by_a_hand_s_breadth_overlaps_and_is_the_same(self, eye, order):
        boxes = {**BOXES, 1: shifted(BOXES[1], (0.04, -0.03))}
        found, new = noticed(view(eye, boxes, 1, order), FIRST)
        assert found.moved == (1,)
        assert (new.labels == view(eye, boxes, 1).labels).mean() > 0.99

    def test_one_taken_away_leaves(self, eye, order):
        boxes = {k: box for k, box in BOXES.items() if k != 1}
        found, new = noticed(view(eye, boxes, 1, order), FIRST)
        assert found.moved == ()
        assert found.earlier[0].object_ids == (2, 3)
        assert new.object_ids == (2, 3)

    def test_one_that_came_has_an_id_of_its_own(self, eye, order):
        boxes = {**BOXES, 4: shifted(BOXES[1], (PLACE[0], PLACE[1] - 0.13))}
        found, new = noticed(view(eye, boxes, 1, (*order, 4)), FIRST)
        assert found.moved == ()
        assert found.earlier[0].object_ids == (1, 2, 3)
        assert (new.labels == view(eye, boxes, 1).labels).mean() > 0.99

    def test_with_the_number_of_one_that_is_still_there(self, eye, order):
        boxes = {**BOXES, 4: shifted(BOXES[1], (PLACE[0], PLACE[1] - 0.13))}
        labels = view(eye, boxes, 1).labels
        numbers = {1: 7, 2: order[2] + 10, 3: order[3] + 10, 4: 1}
        given = np.select([labels == k for k in numbers], [*numbers.values()], 0)
        second = dataclasses.replace(view(eye, boxes, 1), labels=given)
        _, new = noticed(second, FIRST)
        came = np.unique(new.labels[labels == 4])
        assert not set(came) & {1, 2, 3}


def test_ids_of_what_has_left_are_not_given_again(tmp_path):
    config = vp.MapConfig(iterations=3)
    two = {k: BOXES[k] for k in (1, 2)}
    m = vp.fit_map(dataclasses.replace(FIRST, plane=TABLE, time=0.0), config)
    m = m.update(view(SAME, two, 1, time=1.0))
    assert (m.changes.left, m.changes.retired, m.object_ids) == ((3,), (3,), (1, 2))
    m.save(tmp_path / "map")
    again = vp.load_map(tmp_path / "map")
    assert again.changes == m.changes
    assert [v.time for v in again.views] == [0.0, 1.0]
    np.testing.assert_array_equal(again.views[0].clear, m.views[0].clear)
    points = np.random.default_rng(0).uniform(-0.25, 0.25, (500, 3))
    np.testing.assert_array_equal(again.predict_proba(points), m.predict_proba(points))
    back = again.update(view(SAME, {**two, 3: shifted(BOXES[2], (0.1, 0.1))}, 2))
    assert back.changes.came == (4,)
    assert dict(back.changes.ids)[3] == 4
    assert back.changes.retired == (3,)
    assert any("its 3 is 4" in text for text in back.warnings)


def test_colour_says_which_of_two_that_are_gone_has_moved():
    red, blue = (200, 40, 40), (40, 40, 200)
    paint = np.array([(90, 90, 90), red, blue, (40, 200, 40)], np.uint8)
    cube = ((-0.03, -0.03, 0.0), (0.03, 0.03, 0.08))
    boxes = {1: shifted(cube, (0.0, 0.15)), 2: shifted(cube, (0.0, -0.15)), 3: BOXES[3]}
    first = view(SAME, boxes)
    first = dataclasses.replace(first, color=paint[first.labels])
    second = view(SAME, {2: shifted(cube, (0.15, 0.0)), 3: BOXES[3]}, 1)
    second = dataclasses.replace(
        second, color=paint[second.labels], labels=np.array([0, 0, 1, 3])[second.labels]
    )
    found, new = noticed(second, first)
    assert found.moved == (2,)
    assert found.earlier[0].object_ids == (3,)
    assert new.object_ids == (2, 3)


def test_unlabelled_things_come_and_go_as_well():
    post = shifted(BOXES[1], (0.1, -0.1))
    boxes = {**BOXES, 9: post}
    plain = (*range(4), *[0] * 6)
    first, second = view(SAME, boxes, 0, plain), view(OTHER, BOXES, 1)
    found, _ = noticed(second, first)
    own = view(SAME, boxes).labels == 9
    assert (found.earlier[0].depth[own] == 0).mean() > 0.9
    assert found.earlier[0].object_ids == (1, 2, 3)
    # ... and the other way round: rays that went through it now end before it.
    found, _ = noticed(view(SAME, boxes, 0, plain), second)
    (before,) = found.earlier
    middle = np.mean(post, axis=0)
    assert oracle.is_free(second, middle)
    assert not oracle.is_free(before, middle)


def test_a_view_that_lies_far_off_is_still_refused():
    off = np.eye(4)
    off[2, 3] = 0.1
    second = view(OTHER, BOXES, 1)
    with pytest.raises(ObservationError, match="mm"):
        noticed(dataclasses.replace(second, T_world_camera=off @ second.pose), FIRST)


# ------------------------------------------------------------------------------ against the oracle
@settings(max_examples=12)
@given(eyes, st.sampled_from([1, 2, 3]), st.integers(0, 5))
def test_what_is_looked_through_is_gone_and_nothing_else(eye, taken, seed):
    second = view(eye, {k: box for k, box in BOXES.items() if k != taken}, seed + 1)
    found, _ = noticed(second, FIRST)
    left = set(FIRST.object_ids) - set(found.earlier[0].object_ids)
    for k in FIRST.object_ids:
        share = oracle.share_looked_through(second, FIRST, k)
        assert k not in left or share > 0.02
        assert k in left or share < 0.5


@settings(max_examples=12)
@given(eyes, st.floats(-0.05, 0.05), st.floats(0.0, np.pi), st.integers(0, 5))
def test_no_old_view_calls_free_what_is_behind_what_came(eye, along, turn, seed):
    rng = np.random.default_rng(seed)
    size = rng.uniform(0.03, 0.12, 3)
    low = np.array([PLACE[0] + along - size[0] / 2, PLACE[1] - size[1] / 2, 0.0])
    boxes = {**BOXES, 4: (tuple(low), tuple(low + size))}
    second = view(eye, boxes, seed + 1)
    first = view((0.7 * np.cos(turn), 0.7 * np.sin(turn), 0.7), BOXES, seed)
    found, new = noticed(second, first, FIRST)
    mask = new.labels == 4
    if mask.sum() < 300:
        return
    assert all(before.clear is not None for before in found.earlier)
    start = new.point_image()[mask & (new.depth > 0)]
    rays = start - new.camera_center
    chosen = rng.integers(0, len(start), 400)
    points = start[chosen] + rng.uniform(0.0, 0.4, (400, 1)) * rays[chosen]
    points = points[points[:, 2] > 0.0]
    for point in points:
        assert oracle.is_behind(new, mask, point)
        assert not any(oracle.is_free(before, point) for before in found.earlier)
    # What they show of surfaces is as it was.
    for before, old in zip(found.earlier, (first, FIRST), strict=True):
        np.testing.assert_array_equal(before.depth, old.depth)
        np.testing.assert_array_equal(before.labels, old.labels)


def test_a_world_follows():
    config = vp.MapConfig(iterations=3)
    m = vp.fit_map(dataclasses.replace(FIRST, plane=TABLE), config)
    boxes = {**BOXES, 2: shifted(BOXES[2], (0.0, 0.13))}
    updated = m.update(view(SAME, boxes, 1))
    assert updated.changes.moved == (2,)
    low, high, up = *(np.array(c) for c in BOXES[2]), np.array([0.0, 0.0, 1.0])
    old = np.random.default_rng(0).uniform(low + 0.02 * up, high, (300, 3))
    new = old + np.array([0.0, 0.13, 0.0])
    before, after = vp.World(m).field, vp.World(updated).field
    assert (before.lower_bound(old) <= 0.0).mean() > 0.9
    assert (after.lower_bound(old) <= 0.0).mean() < 0.05
    assert (after.lower_bound(new) <= 0.0).mean() > 0.9
    views = visibility.make_views(updated.views, 0.01, TABLE)
    hidden = new[(new[:, 0] > 0.05) & (new[:, 2] < 0.07)]  # deep in what has come
    assert (visibility.classify_points(views, hidden) == visibility.OCCLUDED).all()


# ----------------------------------------------------------------------------------------- forget
def test_what_is_too_old_is_hidden_not_free():
    config = vp.MapConfig(iterations=3)
    m = vp.fit_map(dataclasses.replace(FIRST, plane=TABLE, time=10.0), config)
    aside = view((0.2, 0.8, 0.5), BOXES, 1, time=15.0)
    beside = ~ndimage.binary_dilation(aside.labels == 1, iterations=10)
    aside = dataclasses.replace(
        aside, depth=np.where(beside, 0.0, aside.depth), labels=np.where(aside.labels == 1, 1, 0)
    )
    kept = m.update(aside, forget=6.0)
    np.testing.assert_array_equal(kept.views[0].depth == 0, FIRST.depth == 0)
    late = dataclasses.replace(aside, time=20.0)
    updated = m.update(late, forget=6.0)
    assert (updated.object_ids, updated.changes.left) == ((1,), (2, 3))
    assert not (updated.views[0].depth > 0).any()
    # Places that only the first view saw: nobody has looked at them since, and they are not free.
    points = np.random.default_rng(0).uniform((-0.7, -0.3, 0.02), (-0.3, 0.3, 0.4), (2000, 3))
    old, new = (
        visibility.classify_points(visibility.make_views(seen, 0.01, TABLE), points)
        for seen in ((FIRST,), (late,))
    )
    only = (old == visibility.SEEN) & (new == visibility.UNOBSERVED)
    assert only.sum() > 50
    both = visibility.classify_points(
        visibility.make_views(updated.views, 0.01, TABLE), points[only]
    )
    assert (both == visibility.OCCLUDED).all()
    # A camera that stays has one such view, however often something is forgotten.
    later = updated.update(dataclasses.replace(aside, time=40.0), forget=6.0)
    again = later.update(dataclasses.replace(aside, time=60.0), forget=6.0)
    assert len(again.views) == len(later.views) == 3
    assert vp.World(again).map is again


@pytest.mark.parametrize(
    ("views", "forget", "wrong"),
    [((FIRST,), 5.0, ObservationError), ((FIRST,), -1.0, MapError)],
)
def test_forget_needs_times_and_a_number(views, forget, wrong):
    m = vp.fit_map(dataclasses.replace(FIRST, plane=TABLE), vp.MapConfig(iterations=1))
    with pytest.raises(wrong, match="forget"):
        m.update(view(OTHER, BOXES, 1, time=3.0), forget=forget)


@pytest.mark.parametrize("name", ["time", "clear"])
@pytest.mark.parametrize("value", ["soon", np.nan, np.zeros((3, 3))])
def test_a_view_names_what_is_wrong_of_its_time_and_free_rays(name, value):
    with pytest.raises(VPrismError, match=name):
        dataclasses.replace(FIRST, **{name: value})


def test_views_of_one_camera_are_hidden_as_one():
    stamped = [dataclasses.replace(FIRST, time=float(t)) for t in range(3)]
    found = without_old(stamped, 10.0, 8.5)
    assert [v.time for v in found] == [1.0, 2.0]
    assert without_old(found, 10.0, 8.5) == found
    np.testing.assert_array_equal(found[0].free_depth > 0, FIRST.depth > 0)
