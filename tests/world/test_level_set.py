# SPDX-License-Identifier: BSD-3-Clause
"""The promise of the world: no sphere that touches the level set is called free."""

from types import SimpleNamespace

import numpy as np
import pytest
from oracles.world_oracles import KernelMap, level_points, random_map
from scipy.spatial import cKDTree

from vprism_plan.errors import WorldError
from vprism_plan.world import World, WorldConfig
from vprism_plan.world.levelset import lattice_refinement

FREE = {"occluded": "free", "unobserved": "free"}


def _spheres(field, inside: np.ndarray, count: int, rng) -> tuple[np.ndarray, np.ndarray]:
    """Half of the spheres anywhere in the grid, half near the level set."""
    anywhere = rng.uniform(field.origin, field.upper, (count // 2, 3))
    near = inside[rng.integers(len(inside), size=count - count // 2)]
    near = near + rng.normal(0.0, 0.03, near.shape)
    return np.concatenate([anywhere, near]), rng.uniform(0.002, 0.1, count)


def _bounds(map_) -> tuple[np.ndarray, np.ndarray]:
    lower, upper = map_.support_bounds()
    return lower - 0.05, upper + 0.05


@pytest.mark.parametrize("seed", range(10))
def test_spheres_never_miss_the_level_set(seed):
    rng = np.random.default_rng(seed)
    length = [0.02236, 0.018, 0.0224][seed % 3]
    level = [0.5, 0.3, 0.8][seed % 3]
    map_ = random_map(seed, objects=1 + seed % 2, kernel_length=length)
    world = World(map_, WorldConfig(level=level, bounds=_bounds(map_), **FREE))
    h = world.config.resolution
    aligned = level_points(map_, h / 4, level, np.zeros(3))
    shifted = level_points(map_, h / 4, level, rng.random(3))
    inside = np.concatenate([aligned, shifted])
    centers, radii = _spheres(world.field, inside, 10_000, rng)
    distance = cKDTree(inside).query(centers)[0]
    collides = world.field.lower_bound(centers) <= radii
    touched = distance <= radii
    assert touched.sum() > 500
    assert not (touched & ~collides).any()
    clear = distance > radii + 1.5 * h
    assert clear.sum() > 500
    assert not (collides & clear).any()
    grid_max = np.abs(centers - np.clip(centers, world.field.origin, world.field.upper)).max()
    assert grid_max < 1.0


@pytest.mark.parametrize("resolution", [0.005, 0.02, 0.05])
def test_other_resolutions_keep_the_promise(resolution):
    rng = np.random.default_rng(7)
    map_ = random_map(3)
    world = World(map_, WorldConfig(resolution=resolution, bounds=_bounds(map_), **FREE))
    inside = level_points(map_, 0.0025, 0.5, rng.random(3))
    centers, radii = _spheres(world.field, inside, 10_000, rng)
    distance = cKDTree(inside).query(centers)[0]
    collides = world.field.lower_bound(centers) <= radii
    assert not ((distance <= radii) & ~collides).any()
    assert not (collides & (distance > radii + 1.5 * resolution)).any()


def test_every_map_keeps_the_promise_under_every_policy(world, objects_only, occupied):
    rng = np.random.default_rng(0)
    for field in (world.field, objects_only.field):
        assert (field.lower_bound(occupied) <= 0.0).all()
        centers, radii = _spheres(field, occupied, 20_000, rng)
        touched = cKDTree(occupied).query(centers)[0] <= radii
        assert not (touched & (field.lower_bound(centers) > radii)).any()


def test_each_object_is_covered_by_its_own_field(any_map, objects_only, occupied):
    world = objects_only
    owner = np.argmax(any_map.predict_proba(occupied)[:, 1:], axis=1)
    rng = np.random.default_rng(1)
    ownership = 0.5 * world.config.resolution * np.sqrt(3.0)
    for k, object_id in enumerate(any_map.object_ids):
        mine = occupied[owner == k]
        assert len(mine) > 20
        field = world.object_field(object_id)
        assert (field.lower_bound(mine) <= ownership).all()
        assert (field.lower_bound(mine) <= 0.0).mean() > 0.99
        assert set(np.unique(field.source)) <= {k}
        centers, radii = _spheres(field, mine, 4000, rng)
        distance = cKDTree(mine).query(centers)[0]
        bound = field.lower_bound(centers)
        assert (bound <= distance + ownership).all()
        assert ((bound <= radii) & (distance > radii + 0.03)).mean() < 0.01


def test_leaving_an_object_out_leaves_the_others(any_map, world, objects_only, occupied):
    gone, *rest = any_map.object_ids
    field = world.fields_without([gone])
    owner = np.argmax(any_map.predict_proba(occupied)[:, 1:], axis=1)
    assert (field.lower_bound(occupied[owner > 0]) <= 0.5 * world.config.resolution * 1.7321).all()
    index = world.sources.index(f"object:{gone}")
    assert not (field.source == index).any()
    assert (world.field.lower_bound(occupied) <= 0.0).all()
    centers = np.random.default_rng(0).uniform(field.origin, field.upper, (5000, 3))
    assert (field.lower_bound(centers) >= world.field.lower_bound(centers) - 0.011).all()
    assert world.fields_without([]) is world.field
    assert world.fields_without([gone]) is field
    # The object can now be touched: its skin is not anybody else's.
    mine = occupied[owner == 0]
    without = objects_only.fields_without([gone])
    far = cKDTree(occupied[owner > 0]).query(mine)[0] > 0.03 if rest else np.ones(len(mine), bool)
    assert far.any()
    assert (without.lower_bound(mine[far]) > 0.0).mean() > 0.98


def test_labels_name_the_likeliest_object(any_map, objects_only, occupied):
    p = any_map.predict_proba(occupied)[:, 1:]
    clear = np.ones(len(p), dtype=bool)
    if p.shape[1] > 1:
        top = np.sort(p, axis=1)
        clear = top[:, -1] > top[:, -2] + 0.5
    named = objects_only.field.source_at(occupied[clear])
    assert (named == np.argmax(p[clear], axis=1)).mean() > 0.98


def test_empty_level_set_is_free_space():
    map_ = KernelMap(np.zeros((1, 3)), np.array([[1.0, -1.0]]), np.array([3.0, 0.0]))
    world = World(map_, WorldConfig())
    assert (world.field.source == -1).all()
    assert world.empty
    assert world.field.lower_bound(np.zeros((1, 3)))[0] > 0.5


def test_map_that_is_occupied_without_evidence_is_refused():
    map_ = KernelMap(np.zeros((1, 3)), np.array([[1.0, -1.0]]), np.array([0.0, 0.1]))
    with pytest.raises(WorldError, match="no evidence"):
        World(map_)


def test_unknown_object_names_the_valid_ones(any_map, world):
    with pytest.raises(WorldError, match=str(any_map.object_ids[0])):
        world.object_field(99)


def test_lattice_is_fine_enough_for_the_kernel_and_for_the_guess():
    smooth = SimpleNamespace(kernel_length=0.0224)
    assert lattice_refinement(0.01, smooth) == 4
    assert lattice_refinement(0.05, smooth) == 16
    assert lattice_refinement(0.05, smooth) * 0.25 * 0.0224 >= 0.05
    guessed = SimpleNamespace(kernel_length=0.0224, detail=0.0075)
    assert lattice_refinement(0.01, guessed) == 4
    assert lattice_refinement(0.02, guessed) * 0.45 * 0.0075 >= 0.02
