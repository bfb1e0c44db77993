# SPDX-License-Identifier: BSD-3-Clause
"""A robot in the picture: hidden behind it, free where it stood, background nowhere."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.perception_oracles import Scene, intrinsics, look_at
from oracles.world_oracles import KernelMap

from vprism_plan._kernels import world as kernels
from vprism_plan.perception import Observation, Plane, ignore_robot
from vprism_plan.world import World, WorldConfig
from vprism_plan.world.visibility import (
    OCCLUDED,
    SEEN,
    background_points,
    classify_cells,
    classify_points,
    make_view,
    make_views,
)

K = intrinsics()
POSE = look_at((-0.7, 0.0, 0.6))
TABLE = Plane((0.0, 0.0, 1.0), 0.0)
BALL, RADIUS = np.array([-0.1, 0.0, 0.25]), 0.06


def picture(*spheres, boxes=()) -> Observation:
    depth, labels = Scene(spheres=list(spheres), boxes=list(boxes)).render(POSE, K)
    return Observation(depth, np.where(labels > len(spheres), 1, 0), K, POSE)


@pytest.fixture(scope="module")
def raw() -> Observation:
    """One ball in the air, which is the robot."""
    return picture((BALL, RADIUS))


@pytest.fixture(scope="module")
def marked(raw) -> Observation:
    return ignore_robot(raw, BALL[None], [RADIUS])


def behind(distance: float, n: int = 300) -> np.ndarray:
    """Points in the ball's shadow, so many metres behind its middle and near its axis."""
    rng = np.random.default_rng(0)
    axis = (BALL - POSE[:3, 3]) / np.linalg.norm(BALL - POSE[:3, 3])
    return BALL + distance * axis + rng.uniform(-0.02, 0.02, (n, 3))


def test_the_robot_is_no_background_and_what_is_behind_it_is_hidden(raw, marked):
    points, _ = background_points([raw], TABLE, 0.015)
    assert len(points) > 500
    assert (np.linalg.norm(points - BALL, axis=1) < RADIUS + 0.001).all()
    points, widths = background_points([marked], TABLE, 0.015)
    assert len(points) == len(widths) == 0
    views = [make_view(marked, 0.01, TABLE)]
    for distance in (0.12, 0.2, 0.3):
        assert (classify_points(views, behind(distance)) == OCCLUDED).all()
    front = BALL + (POSE[:3, 3] - BALL) * np.linspace(0.2, 0.9, 50)[:, None]
    assert (classify_points(views, front) == SEEN).all()


@settings(max_examples=10)
@given(seed=st.integers(0, 2**32 - 1))
def test_cells_change_only_where_the_robot_stood(raw, marked, seed):
    """Cell by cell: free if wholly in one ball, as it was elsewhere."""
    rng = np.random.default_rng(seed)
    # Balls in the air and in the shadow of the robot, none of which is seen.
    balls = np.column_stack([behind(0.15, 3), rng.uniform(0.05, 0.08, 3)])
    balls[:, :3] += rng.uniform(-0.03, 0.03, (3, 3))
    again = ignore_robot(marked, balls[:, :3], balls[:, 3], 0.0)
    spacing = float(rng.uniform(0.012, 0.02))
    origin, shape = rng.uniform((-0.2, -0.2, 0.0), (-0.15, -0.15, 0.02)), (31, 33, 29)
    one = make_view(marked, 0.01, TABLE)
    without = classify_cells([one], TABLE, origin, spacing, shape)
    cells = classify_cells([make_view(again, 0.01, TABLE)], TABLE, origin, spacing, shape)
    centers = origin + spacing * (np.moveaxis(np.indices(shape), 0, -1) + 0.5)
    gap = np.linalg.norm(centers[..., None, :] - balls[:, :3], axis=-1) - balls[:, 3]
    whole = gap.min(axis=-1) <= -0.5 * np.sqrt(3.0) * spacing
    assert (without[whole] == kernels.OCCLUDED).any()
    np.testing.assert_array_equal(cells, np.where(whole, kernels.FREE, without))
    points = rng.uniform((-0.5, -0.5, 0.0), (0.5, 0.5, 0.8), (2000, 3))
    before = classify_points([one], points)
    inside = (np.linalg.norm(points[:, None] - balls[:, :3], axis=2) <= balls[:, 3]).any(axis=1)
    after = classify_points([make_view(again, 0.01, TABLE)], points)
    np.testing.assert_array_equal(after, np.where(inside, SEEN, before))


@pytest.mark.parametrize("label", [0, 4])
@pytest.mark.parametrize(("x", "low", "believed"), [(-0.2, 0.24, False), (-0.35, 0.34, True)])
def test_behind_what_was_seen_near_the_robot_nothing_is_given_away(label, x, low, believed):
    """A plate stands before half of a ball: close to it, or too far off to be an argument."""
    plate = np.array([[x, 0.0, low], [x + 0.005, 0.1, low + 0.12]])
    seen = picture((BALL, RADIUS), boxes=[plate])
    seen = dataclasses.replace(seen, labels=np.where(seen.labels > 0, label, 0))
    view = make_view(ignore_robot(seen, BALL[None], [RADIUS], 0.005), 0.01, TABLE)
    points = BALL + np.random.default_rng(0).uniform(-RADIUS, RADIUS, (4000, 3))
    axis = (BALL - POSE[:3, 3]) / np.linalg.norm(BALL - POSE[:3, 3])
    depth = (points - BALL) @ axis
    points = points[(np.linalg.norm(points - BALL, axis=1) < RADIUS) & (depth > 0.01)]
    way = points - POSE[:3, 3]
    through = POSE[:3, 3] + way * ((x - POSE[0, 3]) / way[:, :1])
    hidden = ((through > plate[0]) & (through < plate[1]))[:, 1:].all(axis=1)
    beside = through[:, 1] < -0.004
    assert min(hidden.sum(), beside.sum()) > 100
    status = classify_points([view], points)
    assert (status[beside] == SEEN).all()
    assert (status[hidden] == (SEEN if believed else OCCLUDED)).all()


def test_what_one_view_shows_outranks_the_robot_of_another(marked):
    """From the side a plate is seen in the ball that the robot is said to fill."""
    side = look_at((-0.1, 0.9, 0.3), BALL)
    plate = (BALL + np.array([-0.03, 0.02, -0.03]), BALL + 0.03)
    depth, labels = Scene(boxes=[plate]).render(side, K)
    other = Observation(depth, labels, K, side)
    behind_plate = BALL + np.array([[0.0, 0.005, 0.0], [0.0, -0.02, 0.0], [0.0, -0.04, 0.0]])
    alone = make_views([marked], 0.01, TABLE)
    assert (classify_points(alone, behind_plate) == SEEN).all()
    both = make_views([marked, other], 0.01, TABLE)
    assert (classify_points(both, behind_plate) == OCCLUDED).all()


def test_a_robot_on_the_table_casts_a_shadow_although_the_table_does_not():
    """Its low pixels lie on the plane, as far as height tells."""
    flat = (np.array([-0.1, 0.0, -0.0975]), 0.1)  # 2.5 mm of a ball stand out of the table
    raw = picture(flat)
    marked = ignore_robot(raw, flat[0][None], [0.1], 0.002)
    assert marked.sees_robot.sum() > 100
    open_view, view = (make_view(obs, 0.0, TABLE) for obs in (raw, marked))
    u, v = np.argwhere(marked.sees_robot).mean(axis=0).astype(int)[::-1]
    assert np.isfinite(view.reach[0, v, u])
    assert not np.isfinite(open_view.reach[0, v, u])


def world_of(*views: Observation, **config) -> World:
    """A world whose map says "empty" everywhere: only what is unseen counts."""
    hinges, weights = np.array([[5.0, 5.0, 0.0]] * 2), np.array([[1.0, -1.0]] * 2)
    map_ = KernelMap(hinges, weights, np.array([6.0, 0.0]), views=views, plane=TABLE)
    map_ = dataclasses.replace(map_, object_ids=(1,))
    bounds = ((-0.25, -0.2, 0.02), (0.2, 0.2, 0.4))
    return World(map_, WorldConfig(bounds=bounds, **config))


@pytest.mark.parametrize(
    ("resolution", "radius"), [(0.008, 0.02), (0.01, 0.03), (0.01, 0.08), (0.02, 0.06)]
)
def test_the_place_where_the_robot_stood_is_free_by_what_the_documentation_states(
    resolution, radius
):
    """In the middle of a shadow: a room of the margin and twice the resolution is enough."""
    margin = 0.005
    screen = [((-0.3, -0.25, 0.0), (-0.29, 0.25, 0.45))]
    rng = np.random.default_rng(0)
    raw = world_of(picture(boxes=screen), resolution=resolution)
    for center in rng.uniform((-0.08, -0.03, 0.17), (-0.02, 0.03, 0.23), (2, 3)):
        room = margin + 2.0 * resolution
        obs = ignore_robot(picture(boxes=screen), center[None], [radius], 0.0, room=room)
        world = world_of(obs, resolution=resolution)
        assert world.status(center[None])[0] == SEEN
        assert world.field.lower_bound(center[None])[0] > radius + margin
        assert raw.field.lower_bound(center[None])[0] <= 0.0
        # and no more of the shadow than that is given away
        away = rng.normal(size=(400, 3))
        far = radius + room
        points = center + away / np.linalg.norm(away, axis=1, keepdims=True) * far
        hidden = raw.field.lower_bound(points) <= 0.0
        assert hidden.sum() > 100
        assert (world.field.lower_bound(points[hidden]) <= 0.0).all()


def test_a_place_that_one_view_clears_is_free_and_what_another_sees_there_is_not(raw):
    """The robot was there in one picture; in the other, something else is."""
    marked = ignore_robot(raw, BALL[None], [RADIUS], room=0.02)
    world = world_of(marked)
    assert world.field.lower_bound(BALL[None])[0] > RADIUS
    both = world_of(marked, raw)
    assert both.field.lower_bound(BALL[None])[0] <= RADIUS
    node = np.round((BALL - both.grid.origin) / both.grid.spacing).astype(int)
    source = both.sources[int(both.field.source[tuple(node)])]
    assert source in {"background", "occluded"}  # its surface, or what that hides


def test_without_marks_nothing_changes(raw):
    view = make_view(raw, 0.01, TABLE)
    assert view.robot.shape == (0, 4)
    turned = dataclasses.replace(raw, T_world_camera=None)
    balls = make_view(ignore_robot(turned, [[0.0, 0.0, 0.5]], [0.1], 0.0), 0.01).robot
    np.testing.assert_allclose(balls, [[0.0, 0.0, 0.5, 0.1]])
