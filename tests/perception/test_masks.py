# SPDX-License-Identifier: BSD-3-Clause
"""Labels that cannot be right are mended and named; right ones are left alone."""

import numpy as np
import pytest
from oracles.perception_oracles import Scene, intrinsics, look_at, spoil
from scipy.ndimage import grey_dilation
from scipy.spatial import cKDTree

from vprism_plan.errors import ObservationError
from vprism_plan.mapping import MapConfig, fit_map
from vprism_plan.perception import Observation, Plane
from vprism_plan.perception.masks import drop_background, mend
from vprism_plan.simulation.scenes import random_scene

SHAPE = (480, 640)
K = intrinsics(640, 480)
EYE = (-0.75, 0.0, 0.55)
TABLE = Plane([0.0, 0.0, 1.0], 0.0)
BOX = ((-0.04, 0.08, 0.0), (0.04, 0.16, 0.12))
OTHER = ((0.02, -0.16, 0.0), (0.09, -0.09, 0.10))


def observe(scene: Scene, eye=EYE, at=(0.0, 0.0, 0.03), noise=0.001) -> Observation:
    pose = look_at(eye, at)
    depth, labels = scene.render(pose, K, SHAPE)
    noisy, _ = spoil(depth, np.random.default_rng(0), noise=noise, holes=0.0, flying=False)
    return Observation(noisy, labels, K, pose)


def labelled(obs: Observation, labels) -> Observation:
    return Observation(obs.depth, labels, obs.intrinsics, obs.T_world_camera, plane=obs.plane)


def mended(obs: Observation) -> Observation:
    return mend([obs], TABLE)[0]


# ------------------------------------------------------------------ labels that are no object
def small_table() -> Observation:
    """A table of 40 x 30 cm over a floor, all of it labelled 7, and a box on it labelled 1."""
    scene = Scene(
        boxes=[((-0.025, 0.025, 0.0), (0.025, 0.075, 0.06))],
        table=((-0.2, -0.15), (0.2, 0.15)),
        floor=-0.4,
    )
    obs = observe(scene, eye=(-0.35, 0.0, 0.35))
    on_table = np.abs(obs.point_image()[..., 2]) < 0.006
    return labelled(obs, np.where(on_table & (obs.labels == 0), 7, obs.labels))


def test_a_labelled_table_was_an_object_and_the_floor_the_table():
    (found,) = drop_background([small_table()])
    assert found.object_ids == (1,)
    (text,) = found.warnings
    assert "label 7" in text
    assert "stand on" in text
    assert "set it to 0" in text
    coarse = MapConfig(hinge_spacing=0.06, iterations=2, below_plane_samples=200)
    fitted = fit_map(small_table(), coarse)
    assert fitted.object_ids == (1,)
    assert abs(fitted.plane.offset) < 0.003
    assert text in fitted.warnings


def test_a_labelled_wall_is_no_object():
    obs = observe(Scene(boxes=[BOX], wall=0.5), at=(0.4, 0.0, 0.15))
    wall = obs.point_image()[..., 0] > 0.48
    (found,) = drop_background([labelled(obs, np.where(wall, 3, obs.labels))])
    assert found.object_ids == (1,)
    assert "label 3" in found.warnings[0]


@pytest.mark.parametrize(
    ("boxes", "eye"),
    [
        ([((-0.1, -0.3, 0.0), (0.3, 0.3, 0.4)), ((-0.3, 0.0, 0.0), (-0.2, 0.1, 0.1))], EYE),
        ([((0.0, -0.3, 0.0), (0.6, 0.3, 0.6)), ((-0.3, 0.0, 0.0), (-0.2, 0.1, 0.1))], EYE),
        # A tray, a book and a carton, each with things on it, from the side and from above.
        ([((-0.2, -0.25, 0.0), (0.2, 0.25, 0.02)), ((-0.05, 0.0, 0.02), (0.05, 0.1, 0.1))], EYE),
        ([((-0.2, -0.25, 0.0), (0.2, 0.25, 0.02)), ((-0.05, 0.0, 0.02), (0.05, 0.1, 0.1))],
         (0.0, 0.0, 1.0)),
        ([((-0.1, -0.15, 0.0), (0.1, 0.15, 0.03)), ((-0.05, 0.0, 0.03), (0.0, 0.1, 0.1))], EYE),
        ([((-0.15, -0.2, 0.0), (0.15, 0.2, 0.25)), ((-0.05, 0.0, 0.25), (0.05, 0.1, 0.35))],
         (0.0, 0.0, 1.2)),
    ],
)  # fmt: skip
def test_large_and_flat_things_are_objects(boxes, eye):
    obs = observe(Scene(boxes=boxes, table=((-1.0, -1.0), (1.0, 1.0))), eye=eye)
    assert obs.object_ids == (1, 2)
    assert drop_background([obs])[0] is obs


@pytest.mark.parametrize("void", [255, 65535])
def test_void_rims_and_rests_are_background(void):
    obs = observe(Scene(boxes=[BOX, OTHER]))
    rim = np.where((grey_dilation(obs.labels, 7) > 0) & (obs.labels == 0), void, obs.labels)
    rest = np.where(obs.labels == 0, void, obs.labels)
    for labels in (rim, rest):
        (found,) = drop_background([labelled(obs, labels)])
        np.testing.assert_array_equal(found.labels, obs.labels)
        assert f"label {void}" in found.warnings[0]


def test_a_picture_in_black_and_white_shows_an_object():
    obs = observe(Scene(boxes=[BOX]))
    white = labelled(obs, 255 * obs.labels)
    assert drop_background([white])[0] is white


def test_nothing_but_a_table_says_why():
    obs = observe(Scene(), at=(0.0, 0.0, 0.0))
    with pytest.raises(ObservationError, match="no object") as caught:
        fit_map(labelled(obs, (obs.depth > 0).astype(np.int32)))
    assert "table or a wall" in str(caught.value)


def test_a_label_on_most_of_the_known_support_surface_is_background():
    obs = observe(Scene(boxes=[BOX]))
    table = np.abs(obs.point_image()[..., 2]) < 0.01
    found = mended(labelled(obs, np.where(table & (obs.labels == 0), 2, obs.labels)))
    assert found.object_ids == (1,)
    assert "label 2" in found.warnings[0]


# ------------------------------------------------------------------------------------ fringes
THINGS = Scene(
    spheres=[((-0.1, -0.1, 0.04), 0.04)],
    boxes=[
        BOX,
        OTHER,
        ((-0.003, 0.25, 0.0), (0.003, 0.256, 0.2)),  # a rod
        ((0.1, 0.25, 0.0), (0.16, 0.31, 0.08)),
    ],
)


def with_wall(scene: Scene, x: float | None) -> Scene:
    return Scene(scene.spheres, scene.boxes, scene.table, scene.floor, x)


def grown(labels, pixels: int):
    return grey_dilation(labels, 2 * pixels + 1)


@pytest.mark.parametrize("wall", [None, 0.3])
@pytest.mark.parametrize("pixels", [1, 2, 4])
def test_wide_masks_no_longer_reach_what_lies_behind(pixels, wall):
    """Every labelled point lies within the foot of its object, and no object loses a pixel.

    Of a rod, four pixels of fringe on each side take a tenth: it stays there, unlabelled.
    """
    least = 0.99 if pixels < 4 else 0.85
    obs = observe(with_wall(THINGS, wall))
    found = mended(labelled(obs, grown(obs.labels, pixels)))
    points = obs.point_image()
    for k in obs.object_ids:
        true = obs.labels == k
        kept = (found.labels == k) & (found.depth > 0)
        assert (kept & true).sum() > least * (true & (grown(obs.labels, pixels) == k)).sum()
        # Of two masks that meet, the wider one claims the other's pixels: things, not fringe.
        fringe = (grown(obs.labels, pixels) == k) & (obs.labels == 0) & (obs.depth > 0)
        away, _ = cKDTree(points[true]).query(points[kept & fringe])
        assert (away > 0.025).sum() <= 0.03 * fringe.sum()
    np.testing.assert_array_equal(found.depth, obs.depth)
    (text,) = found.warnings
    assert "[1, 2, 3, 4, 5]" in text


def test_a_shifted_mask_loses_what_it_shows_of_the_background():
    obs = observe(THINGS)
    moved = np.roll(obs.labels, 3, axis=1)
    found = mended(labelled(obs, moved))
    wrong = (moved > 0) & (obs.labels == 0)
    assert (wrong & (found.labels > 0)).sum() < 0.45 * wrong.sum()
    assert (found.labels[(moved == obs.labels) & (moved > 0)] > 0).mean() > 0.98


def test_a_fringe_on_another_object_goes_to_that_object():
    near = ((-0.2, -0.05, 0.0), (-0.12, 0.05, 0.1))
    far = ((-0.05, -0.12, 0.0), (0.0, 0.12, 0.25))
    obs = observe(Scene(boxes=[far, near]))
    found = mended(labelled(obs, grown(obs.labels, 2)))
    other = (grown(obs.labels, 2) == 2) & (obs.labels == 1)
    assert other.sum() > 200
    assert (found.labels[other] == 1).mean() > 0.9


def test_right_masks_are_left_alone():
    for seed in (0, 3):
        obs = random_scene(4, seed, n_clutter=1).observation
        assert drop_background([obs])[0] is obs
        assert mended(obs) is obs


def test_a_mask_one_pixel_too_wide_made_a_mesh_of_33_cm():
    from vprism_plan.world import extract_meshes

    obs = observe(Scene(boxes=[BOX]))
    # A guess of the hidden side may differ by more than a map that guesses nothing.
    for prior, most in ((None, 0.01), ("shape", 0.03)):
        true, wide = (
            extract_meshes(fit_map(labelled(obs, labels), prior=prior))[1]
            for labels in (obs.labels, grown(obs.labels, 1))
        )
        assert np.abs(np.ptp(wide.bounds, axis=0) - np.ptp(true.bounds, axis=0)).max() < most
        assert wide.body_count == true.body_count


# ------------------------------------------------------------------------ see-through objects
def through(obs: Observation, empty: Observation, k: int, part=slice(None)) -> Observation:
    """The view with object k of glass, in some rows of it."""
    depth = obs.depth.copy()
    rows = np.zeros(SHAPE, bool)
    rows[part] = True
    glass = (obs.labels == k) & rows
    depth[glass] = empty.depth[glass]
    return Observation(depth, obs.labels, K, obs.T_world_camera)


def test_glass_that_shows_the_table_keeps_its_label_and_loses_its_depth():
    obs, empty = observe(Scene(boxes=[BOX, OTHER])), observe(Scene(boxes=[BOX]))
    found = mended(through(obs, empty, 2))
    glass = obs.labels == 2
    np.testing.assert_array_equal(found.labels, obs.labels)
    assert (found.depth[glass] == 0).all()
    np.testing.assert_array_equal(found.depth[~glass], obs.depth[~glass])
    (text,) = found.warnings
    assert "object 2: 100 %" in text
    assert "see-through" in text


def test_half_of_glass_loses_half_its_depth():
    obs, empty = observe(Scene(boxes=[BOX, OTHER])), observe(Scene(boxes=[BOX]))
    rows = np.flatnonzero((obs.labels == 2).any(axis=1))
    found = mended(through(obs, empty, 2, slice(0, int(rows.mean()))))
    glass = (obs.labels == 2) & (np.arange(SHAPE[0])[:, None] < int(rows.mean()))
    assert (found.depth[glass] == 0).mean() > 0.9
    assert (found.depth[(obs.labels == 2) & ~glass] > 0).mean() > 0.95


def test_the_edge_of_glass_is_not_given_to_the_table():
    """Its rim returns; what shows the table within four pixels of it is glass all the same."""
    obs, empty = observe(Scene(boxes=[BOX, OTHER])), observe(Scene(boxes=[BOX]))
    rows = np.flatnonzero((obs.labels == 2).any(axis=1))
    found = mended(through(obs, empty, 2, slice(rows[0] + 3, None)))
    assert (found.labels[obs.labels == 2] == 2).all()


@pytest.mark.parametrize("height", [0.01, 0.015, 0.03])
def test_books_and_plates_keep_their_depth(height):
    obs = observe(Scene(boxes=[BOX, ((-0.1, -0.2, 0.0), (0.05, -0.05, height))]))
    assert mended(obs) is obs


def test_a_sheet_of_paper_is_named():
    obs = observe(Scene(boxes=[BOX]))
    x, y, _ = np.moveaxis(obs.point_image(), -1, 0)
    sheet = (np.abs(x) < 0.1) & (np.abs(y + 0.15) < 0.07) & (obs.labels == 0)
    found = mended(labelled(obs, np.where(sheet, 2, obs.labels)))
    assert (found.depth[sheet] == 0).all()
    assert (found.labels[sheet] == 2).all()
    assert "object 2: 100 %" in found.warnings[0]


def test_few_pixels_on_the_table_are_no_glass():
    obs = observe(Scene(boxes=[BOX]))
    labels = obs.labels.copy()
    labels[400:405, 100:105] = 1
    again = labelled(obs, labels)
    assert mended(again) is again


def test_objects_without_returns_are_named():
    obs = observe(Scene(boxes=[BOX, OTHER]))
    rows = np.flatnonzero((obs.labels == 1).any(axis=1))
    lost = (obs.labels == 1) & (np.arange(SHAPE[0])[:, None] < rows[0] + 0.8 * len(rows))
    found = mended(Observation(np.where(lost, 0.0, obs.depth), obs.labels, K, obs.T_world_camera))
    (text,) = found.warnings
    assert "object 1:" in text
    assert "no depth return" in text
    coarse = MapConfig(hinge_spacing=0.06, iterations=2, below_plane_samples=200)
    none = np.where(obs.labels == 2, 0.0, obs.depth)
    fitted = fit_map(Observation(none, obs.labels, K, obs.T_world_camera), coarse)
    assert fitted.object_ids == (1,)
    assert any("object 2 is not in the map" in text for text in fitted.warnings)
    assert ((fitted.views[0].labels == 2) & (fitted.views[0].depth == 0)).sum() == (
        obs.labels == 2
    ).sum()


def test_several_views_are_told_apart():
    obs = small_table()
    _, second = drop_background([observe(Scene(boxes=[BOX])), obs])
    assert second.warnings[0].startswith("view 2: label 7")
    (later,) = drop_background([obs], first=3)
    assert later.warnings[0].startswith("view 4: ")
