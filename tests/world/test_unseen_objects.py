# SPDX-License-Identifier: BSD-3-Clause
"""Objects that nobody saw: where they may stand, how many do, and what stays an obstacle."""

import copy
import dataclasses
import math
import pickle

import numpy as np
import pytest
from oracles.risk_oracle import DrawnVoxels, ball_touches
from oracles.small_scenes import at, small_camera, small_config, small_map
from oracles.worlds_oracle import in_cylinders

import vprism_plan as vp
from vprism_plan.errors import ConfigError
from vprism_plan.mapping import MeshPrior, VPrismMap
from vprism_plan.mapping.prior import SIDE, object_crops, prior_field
from vprism_plan.perception.plane import Plane
from vprism_plan.simulation.scenes import Scene
from vprism_plan.simulation.solids import Box
from vprism_plan.world.grid import Grid
from vprism_plan.world.posterior_worlds import PosteriorWorlds
from vprism_plan.world.unseen_objects import HEIGHTS, RADII, UnseenObjects
from vprism_plan.world.visibility import OCCLUDED, SEEN

H = 0.01
S = 64
TABLE = Plane((0.0, 0.0, 1.0), 0.0)
TILTED = Plane((0.1, -0.25, 0.95), 0.03)
POSTERIOR = vp.WorldConfig(occluded="posterior")


@pytest.fixture(scope="module")
def small():
    return small_map()


@pytest.fixture(scope="module")
def wall_map():
    """A wall 20 cm high and 24 cm wide, which hides the table behind it."""
    wall = Box((0.02, 0.12, 0.1), pose=at(0.0, 0.0, 0.1))
    return vp.fit_map(Scene((wall,), (1,), small_camera()).observation, small_config(), seed=0)


@pytest.fixture(scope="module")
def wall_world(wall_map):
    return vp.World(wall_map, POSTERIOR)


def unseen_of(world):
    return world._evidence.unseen


def everywhere(density, plane=TABLE, lower=(-0.12, -0.12, -0.02), upper=(0.2, 0.13, 0.14), h=H):
    """Unseen objects in a box all of which is hidden."""
    first = np.floor(np.array(lower) / h).astype(np.int64)
    shape = tuple(int(n) for n in np.ceil(np.array(upper) / h).astype(int) - first + 1)
    cells = np.ones(tuple(2 * (n - 1) for n in shape), bool)
    return UnseenObjects.among(cells, Grid(h, first, shape), plane, density)


def hidden_points(world, n=30_000, seed=0):
    """Random points in hidden space over the table, up to the height of unseen objects."""
    rng = np.random.default_rng(seed)
    lower, upper = world.grid.origin.copy(), world.grid.upper.copy()
    lower[2], upper[2] = 0.001, HEIGHTS[1]
    points = rng.uniform(lower, upper, (20 * n, 3))
    return points[world.status(points) == OCCLUDED][:n]


def unjudged(world, points):
    """Which of the points lie in cells at whose middle the map has nothing to say."""
    cell = 0.5 * world.config.resolution
    return ~world.map.judges((np.floor(points / cell) + 0.5) * cell, world.config.min_support)


# --- the model ----------------------------------------------------------------------------
@pytest.mark.parametrize("plane", [TABLE, TILTED], ids=["level", "tilted"])
@pytest.mark.parametrize("tolerance", [0.0, 1e-3])
def test_draws_hold_the_cylinders_that_the_definition_says(small, plane, tolerance):
    """Voxel by voxel and cylinder by cylinder, in a mask with holes that reaches out of the map."""
    rng = np.random.default_rng(4)
    unseen = everywhere(60.0, plane, lower=(-0.3, -0.12, -0.03), upper=(0.2, 0.35, 0.2))
    holes = rng.random(unseen.mask.shape) < 0.8
    unseen = dataclasses.replace(unseen, mask=unseen.mask & holes)
    index = rng.integers([-36, -18, -6], [26, 40, 30], (3000, 3))
    plain = PosteriorWorlds(small, S, 9, tolerance=tolerance).owners(index)
    ours = PosteriorWorlds(small, S, 9, tolerance=tolerance, unseen=unseen).owners(index)
    inside = in_cylinders(unseen, unseen.draw(S, 9), index, S)
    expected = np.where((plain == 0) & inside, len(small.object_ids) + 1, plain)
    np.testing.assert_array_equal(ours, expected)
    assert (inside & (plain == 0)).sum() > 500
    assert (inside & (plain > 0)).any()


def test_balls_touch_unseen_objects_as_they_touch_others(small):
    """Against the oracle of draws, which asks every voxel and its depth."""
    lower, upper = np.array([-0.05, -0.05, 0.0]), np.array([0.07, 0.06, 0.1])
    unseen = everywhere(60.0, TABLE, lower, upper)
    worlds = PosteriorWorlds(small, S, 5, H, 0.15, 0.0, unseen)
    drawn = DrawnVoxels(small, S, 5, H)
    # Where every draw is free, their log-odds are as the least of them.
    row, _, first = PosteriorWorlds(small, S, 5, H, 0.15, 0.0).owner_tables
    for voxel in np.argwhere(row < 0):
        drawn.odds[tuple(voxel + first - drawn.first)] = 1 + row[tuple(voxel)]
    index = np.argwhere(unseen.mask) + unseen.first
    own = in_cylinders(unseen, unseen.draw(S, 5), index, S)
    places = tuple((index - drawn.first).T)
    own &= drawn.values[places] == 0
    for table, value in ((drawn.values, len(small.object_ids) + 1), (drawn.odds, 127.0)):
        table[places] = np.where(own, value, table[places])
    drawn.possible = drawn.values.any(axis=3)
    rng = np.random.default_rng(0)
    centers = rng.uniform(lower - 0.03, upper + 0.03, (60, 3))
    radii, ids = rng.uniform(0.0, 0.04, 60), small.object_ids
    for allowed in ((), ids):
        ours = worlds.touched(centers, radii, allowed)
        classes = [ids.index(i) + 1 for i in allowed]
        for center, radius, mine in zip(centers, radii, ours, strict=True):
            exact = ball_touches(drawn, center, radius, H, classes)
            np.testing.assert_array_equal(mine, exact)
        assert 0.05 < ours.mean() < 0.95


def test_a_ball_is_as_often_free_as_the_boolean_model_says(small):
    """P(no cylinder touches it) = exp(-density E[area of the centres whose cylinders would])."""
    density, n, radius = 20.0, 4096, 0.05
    unseen = everywhere(density, lower=(-0.3, -0.3, -0.02), upper=(0.3, 0.3, 0.3), h=0.02)
    cylinders = unseen.draw(n, 3)
    center = np.array([0.013, -0.022, 0.02])  # lower than the lowest of them is high
    world, middle = cylinders[:, 0].astype(int), cylinders[:, 1:3] @ unseen.plane.axes()[:, :2]
    away = np.linalg.norm(middle - center[:2], axis=1)
    low, high = RADII

    def void(grown):
        """The analytic probability for a ball of that radius."""
        mean = (high - low) ** 2 / 12.0 + (0.5 * (low + high) + grown) ** 2
        return math.exp(-density * math.pi * mean)

    hit = np.bincount(world, away <= cylinders[:, 3] + radius, n) > 0
    assert abs((~hit).mean() - void(radius)) < 4.0 * math.sqrt(0.25 / n)
    # As voxels, half a voxel either way.
    worlds = PosteriorWorlds(small, n, 3, 0.02, 0.2, unseen=unseen)
    ours = 1.0 - worlds.touched(center[None], radius, small.object_ids).mean()
    assert void(radius + 0.01) - 0.03 < ours < void(radius - 0.01) + 0.03
    # Radii and heights are spread evenly over what they may be, centres over the floor.
    for column, ends in ((3, RADII), (4, HEIGHTS)):
        assert np.ptp(cylinders[:, column]) > 0.99 * (ends[1] - ends[0])
        assert abs(cylinders[:, column].mean() - np.mean(ends)) < 0.03 * (ends[1] - ends[0])
    quarters = np.histogram2d(*middle.T, bins=2, range=[[-0.31, 0.31]] * 2)[0]
    assert np.abs(quarters / len(middle) - 0.25).max() < 0.01
    counts = np.bincount(world, minlength=n)
    expected = density * len(unseen.floor) * 0.02**2
    assert abs(counts.mean() - expected) < 4.0 * math.sqrt(expected / n)
    assert abs(counts.var() / expected - 1.0) < 0.1  # Poisson


def test_the_floor_is_what_is_hidden_of_the_surface():
    unseen = everywhere(1.0)
    area = len(unseen.floor) * H**2
    assert area == pytest.approx(0.33 * 0.26, abs=1e-9)  # and half a voxel all around
    first, shape = np.array([-10, -10, -10]), (41, 31, 41)
    cells = np.zeros((80, 60, 80), bool)
    cells[20:60, 10:50] = True
    part = UnseenObjects.among(cells, Grid(H, first, shape), TABLE, 1.0)
    assert len(part.floor) == 21 * 21  # 20 cm either way, and what shares a voxel with that
    tilted = UnseenObjects.among(cells, Grid(H, first, shape), TILTED, 1.0)
    flat = len(part.floor) / TILTED.normal[2]
    assert len(tilted.floor) == pytest.approx(flat, rel=0.1)
    raised = cells.copy()
    raised[:, :, :30] = False  # nothing is hidden down to 5 cm over the table: none stands there
    floating = UnseenObjects.among(raised, Grid(H, first, shape), TABLE, 1.0)
    assert len(floating.floor) == 0
    assert len(floating.draw(S, 0)) == 0


# --- in a world ---------------------------------------------------------------------------
@pytest.mark.parametrize("name", ["wall_map", "demo_map"])
def test_no_hidden_place_is_forgotten(name, request):
    """It is an obstacle, or the map judges it, or an unseen object may stand in it; and those
    stand in no place that was seen."""
    world = vp.World(request.getfixturevalue(name), POSTERIOR)
    points, unseen = hidden_points(world), unseen_of(world)
    free = (world.field.lower_bound(points) > 0.0) & unjudged(world, points)
    assert free.sum() > 1000
    voxel = np.rint(points[free] / H).astype(int) - unseen.first
    assert ((voxel >= 0) & (voxel < unseen.mask.shape)).all()
    assert unseen.mask[tuple(voxel.T)].all()
    voxels = np.argwhere(unseen.mask) + unseen.first
    shifts = (np.indices((6, 6, 6)).reshape(3, 1, -1).T - 2.5) / 6.0
    parts = (H * (voxels + shifts)).reshape(-1, 3)
    hidden = (world.status(parts) != SEEN).reshape(len(shifts), -1).any(axis=0)
    assert hidden.mean() > 0.95  # the others are at the rim of a shadow, as wide as a pixel


def test_few_and_infinitely_many_unseen_objects(wall_map, wall_world):
    """None: that space is free. Infinitely many: it is an obstacle."""
    none, all_ = (
        vp.World(wall_map, dataclasses.replace(POSTERIOR, hidden_objects=n))
        for n in (0.0, math.inf)
    )
    points = hidden_points(wall_world)
    points = points[unjudged(wall_world, points)]
    assert len(points) > 1000
    free = wall_world.field.lower_bound(points) > 0.0
    assert free.mean() > 0.5
    np.testing.assert_array_equal(none.field.distance, wall_world.field.distance)
    assert (all_.field.lower_bound(points) <= 0.0).all()
    assert (all_.certain_field().lower_bound(points) <= 0.0).all()
    assert unseen_of(none) is None
    assert unseen_of(all_) is None
    crowded = vp.World(wall_map, dataclasses.replace(POSTERIOR, hidden_objects=1001.0))
    assert unseen_of(crowded) is None
    np.testing.assert_array_equal(crowded.field.distance, all_.field.distance)
    index = np.unique(np.rint(points[free] / H).astype(int), axis=0)
    extra = len(wall_map.object_ids) + 1
    for world in (none, all_):
        assert (world.posterior_worlds(S, 0).owners(index) < extra).all()
    assert (wall_world.posterior_worlds(S, 0).owners(index) == extra).any()


def test_more_of_them_are_met_more_often(wall_map, wall_world):
    points = hidden_points(wall_world, 300)
    points = points[unjudged(wall_world, points)]
    assert unseen_of(wall_world).density == 2.0
    shares = []
    for density in (0.5, 2.0, 50.0):
        unseen = dataclasses.replace(unseen_of(wall_world), density=density)
        worlds = PosteriorWorlds(wall_map, 512, 0, H, 0.1, unseen=unseen)
        shares.append(worlds.touched(points, 0.03).mean())
    assert shares[0] < 0.6 * shares[1] < 0.3 * shares[2]
    assert 0.0 < shares[1] < 0.1


def test_a_seed_repeats_itself_and_copies_answer_alike(wall_world):
    unseen = unseen_of(wall_world)
    index = np.argwhere(unseen.mask)[::7] + unseen.first
    map_ = wall_world.map
    first, again, other = (PosteriorWorlds(map_, S, seed, H, unseen=unseen) for seed in (4, 4, 5))
    expected = first.owners(index)
    np.testing.assert_array_equal(again.owners(index), expected)
    assert (other.owners(index) != expected).any()
    np.testing.assert_array_equal(first.redrawn(5).owners(index), other.owners(index))
    np.testing.assert_array_equal(first.owners(index), expected)
    centers = H * index[::11]
    touched = first.touched(centers, 0.02)
    for made in (pickle.loads(pickle.dumps(again)), copy.copy(again), copy.deepcopy(again)):
        np.testing.assert_array_equal(made.owners(index), expected)
        np.testing.assert_array_equal(made.touched(centers, 0.02), touched)
        np.testing.assert_array_equal(made.redrawn(5).owners(index), other.owners(index))


# --- what stays an obstacle ---------------------------------------------------------------
def long_box(length, elevation=10.0):
    """View of a box seen end-on, whose top is above the camera."""
    box = Box((0.5 * length, 0.05, 0.15), pose=at(0.5 * length, 0.0, 0.15))
    return Scene((box,), (1,), small_camera(elevation)).observation


def guessing(view, length):
    """A map with a guess of that box, as far as the grid around it reaches, that is kept as the
    package's own."""
    fitted = vp.fit_map(view, small_config(), seed=0, prior=None)

    def guess(points):
        inside = (points[:, 0] > 0.0) & (points[:, 0] < length)
        inside &= (np.abs(points[:, 1]) < 0.05) & (points[:, 2] < 0.3)
        held = np.where(inside, 0.9, 0.01)
        return np.column_stack([1.0 - held, held])

    crops = object_crops([view], (1,), fitted.plane)
    prior = prior_field(guess, crops, lambda points: points[:, 2] < 0.0, 0.2, own=False)
    return VPrismMap(
        fitted.config, fitted.object_ids, fitted.plane, fitted.views, fitted.space,
        fitted.posterior, fitted.seed, (), prior,
    ), crops[0]  # fmt: skip


@pytest.mark.parametrize("length", [0.15, 0.5])
def test_a_guess_that_is_cut_off_goes_on(length):
    """A box longer than the grid around what was seen of it: the rest of it is an obstacle, what
    hides beside and above it is not, nor behind a box that ends within the grid."""
    view = long_box(length)
    map_, crop = guessing(view, length)
    world = vp.World(map_, POSTERIOR)
    end = (crop.T_world_crop[:3, 3] + SIDE * crop.voxel)[0]
    assert 0.16 < end < 0.45
    rng = np.random.default_rng(0)
    far = rng.uniform([end + 0.005, -0.045, 0.005], [0.49, 0.045, 0.29], (2000, 3))
    far = far[world.status(far) == OCCLUDED]
    assert len(far) > 500
    assert not map_.judges(far, 0.5).any()
    blocked = world.field.lower_bound(far) <= 0.0
    assert blocked.all() if length == 0.5 else not blocked.any()
    checker_free = world.certain_field().lower_bound(far) > 0.0
    np.testing.assert_array_equal(checker_free, ~blocked)
    # What hides beside the far end, as the shadow widens, may be touched.
    beside = hidden_points(world)
    beside = beside[(np.abs(beside[:, 1]) > 0.062) & (beside[:, 0] > end)]
    assert len(beside) > 50
    assert (world.field.lower_bound(beside) > 0.0).mean() > 0.5


def test_behind_unlabelled_clutter_all_stays_an_obstacle():
    """One wall is labelled, the one beside it is not."""
    walls = tuple(Box((0.02, 0.1, 0.1), pose=at(0.0, y, 0.1)) for y in (-0.15, 0.15))
    view = Scene(walls, (1, 2), small_camera()).observation
    labels = np.where(view.labels == 2, 0, view.labels)
    view = dataclasses.replace(view, labels=labels)
    world = vp.World(vp.fit_map(view, small_config(), seed=0), POSTERIOR)
    points = hidden_points(world)
    points = points[unjudged(world, points) & (points[:, 0] > 0.1)]
    free = world.field.lower_bound(points) > 0.0
    clutter = points[:, 1] > 0.04
    assert clutter.sum() > 500
    assert not free[clutter].any()
    assert free[points[:, 1] < -0.04].mean() > 0.9
    unseen = unseen_of(world)
    assert (H * (np.argwhere(unseen.mask) + unseen.first)[:, 1]).max() < 0.04


def test_who_has_no_prior_of_ours_or_no_endless_table_keeps_obstacles(wall_map):
    view = wall_map.views[0]
    flat = vp.fit_map(view, small_config(), seed=0, prior=None)
    own = vp.fit_map(view, small_config(), seed=0, prior=MeshPrior({}))
    seen = dataclasses.replace(POSTERIOR, support="seen")
    bare = copy.copy(wall_map)
    bare.plane = None
    for map_, config in ((flat, POSTERIOR), (own, POSTERIOR), (wall_map, seen), (bare, POSTERIOR)):
        world = vp.World(map_, config)
        assert unseen_of(world) is None
        points = hidden_points(world, 5000)
        points = points[unjudged(world, points)]
        assert len(points) > 500
        assert (world.field.lower_bound(points) <= 0.0).all()


def test_outside_the_grid_all_stays_an_obstacle(wall_map):
    config = dataclasses.replace(POSTERIOR, bounds=((-0.1, -0.2, 0.0), (0.35, 0.2, 0.3)))
    world = vp.World(wall_map, config)
    behind = np.array([[world.grid.upper[0] + 0.05, 0.0, 0.05]])
    assert world.status(behind)[0] == OCCLUDED
    assert world.field.lower_bound(behind)[0] <= 0.0
    inside = np.array([[world.grid.upper[0] - 0.05, 0.0, 0.05]])
    assert world.field.lower_bound(inside)[0] > 0.0


def test_other_policies_know_no_unseen_objects(wall_map):
    for policy in ("occupied", "free"):
        world = vp.World(wall_map, vp.WorldConfig(occluded=policy))
        world.certain_field()
        assert unseen_of(world) is None


@pytest.mark.parametrize("bad", [-1.0, math.nan, -math.inf])
def test_wrong_numbers_of_them_are_refused(bad):
    with pytest.raises(ConfigError, match="hidden_objects is"):
        vp.WorldConfig(hidden_objects=bad)


def test_nearest_grids_are_nearest(wall_map):
    """Against every node of every grid's inner part."""
    prior = wall_map.prior
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.3, 0.5, (200, 3))
    grid, place = prior.nearest(points)
    nodes = np.stack(np.meshgrid(*[np.linspace(2.0, SIDE - 3.0, 28)] * 3), axis=-1).reshape(-1, 3)
    for point, k, here in zip(points, grid, place, strict=True):
        away = []
        for pose in prior.T_voxel_world:
            world = np.linalg.solve(pose[:, :3], (nodes - pose[:, 3]).T).T
            away.append(np.linalg.norm(world - point, axis=1).min())
        assert k == int(np.argmin(away))
        pose = prior.T_voxel_world[k]
        found = np.linalg.solve(pose[:, :3], here - pose[:, 3])
        assert np.linalg.norm(found - point) <= away[k] + 1e-9
        assert ((here >= 2.0) & (here <= SIDE - 3.0)).all()


@pytest.mark.parametrize("factor", [1, 2, 3])
def test_coarser_voxels_hold_all_that_the_finer_ones_held(factor):
    rng = np.random.default_rng(6)
    fine = everywhere(30.0, lower=(-0.31, -0.12, -0.03), upper=(0.2, 0.35, 0.2))
    fine = dataclasses.replace(fine, mask=fine.mask & (rng.random(fine.mask.shape) < 0.1))
    coarse = fine.coarser(factor)
    assert coarse.resolution == pytest.approx(factor * H)
    corners = np.stack(np.meshgrid(*[(-0.499, 0.499)] * 3, indexing="ij"), -1).reshape(-1, 3)
    points = (np.argwhere(fine.mask) + fine.first)[:, None] + corners
    voxel = np.floor(points.reshape(-1, 3) / factor + 0.5).astype(int) - coarse.first
    middle = np.floor((np.argwhere(fine.mask) + fine.first) / factor + 0.5).astype(int)
    assert coarse.mask[tuple((middle - coarse.first).T)].all()
    inside = ((voxel >= 0) & (voxel < coarse.mask.shape)).all(axis=1)
    assert inside.mean() > 0.9
    # As many of them stand there, on the same floor.
    counts = [len(unseen.draw(4096, 3)) for unseen in (fine, coarse)]
    assert counts[0] == pytest.approx(counts[1], rel=0.05)
