# SPDX-License-Identifier: BSD-3-Clause
import numpy as np
import pytest
import trimesh
from oracles.world_oracles import random_map

from vprism_plan.errors import ConfigError, WorldError
from vprism_plan.perception import Plane
from vprism_plan.world import (
    Box,
    Cylinder,
    HalfSpace,
    KnownMesh,
    Sphere,
    World,
    WorldConfig,
)

FREE = {"occluded": "free", "unobserved": "free"}


def _turned(seed: int, at: tuple[float, float, float]) -> np.ndarray:
    pose = np.array(
        trimesh.transformations.random_rotation_matrix(np.random.default_rng(seed).random(3))
    )
    pose[:3, 3] = at
    return pose


KNOWN = [
    Box("crate", (0.2, 0.1, 0.3), _turned(1, (0.3, 0.1, 0.2))),
    Sphere("ball", 0.07, (-0.3, 0.2, 0.1)),
    Cylinder("pole", 0.02, 0.5, _turned(2, (-0.2, -0.2, 0.3))),
]


def _mesh_of(solid) -> trimesh.Trimesh:
    if isinstance(solid, Box):
        return trimesh.creation.box(solid.size, solid.T_world)
    if isinstance(solid, Sphere):
        mesh = trimesh.creation.icosphere(subdivisions=4, radius=solid.radius)
        return mesh.apply_translation(solid.center)
    return trimesh.creation.cylinder(
        solid.radius, solid.length, sections=256, transform=solid.T_world
    )


@pytest.mark.parametrize("solid", KNOWN, ids=lambda s: s.name)
def test_primitive_distance_equals_the_mesh_distance(solid):
    lower, upper = solid.box()
    points = np.random.default_rng(0).uniform(lower - 0.1, upper + 0.1, (300, 3))
    mesh = _mesh_of(solid)
    expected = -trimesh.proximity.signed_distance(mesh, points)
    np.testing.assert_allclose(solid.signed_distance(points), expected, atol=4e-4)
    assert (mesh.bounds[0] >= lower - 1e-9).all()
    assert (mesh.bounds[1] <= upper + 1e-9).all()


@pytest.mark.parametrize("map_", [random_map(1), None], ids=["map", "no map"])
@pytest.mark.parametrize("solid", KNOWN, ids=lambda s: s.name)
def test_known_primitives_are_obstacles(solid, map_):
    world = World(map_, WorldConfig(**FREE), known=[solid])
    field = world.field
    rng = np.random.default_rng(0)
    lower, upper = solid.box()
    points = rng.uniform(lower - 0.1, upper + 0.1, (20000, 3))
    points = np.concatenate(
        [points, rng.uniform(field.origin - 0.3, field.upper + 0.3, (20000, 3))]
    )
    truth = solid.signed_distance(points)
    bound = field.lower_bound(points)
    assert (bound <= truth + 1e-12).all()
    own = world.field.source_at(points) == world.sources.index(f"known:{solid.name}")
    assert own.any()
    inside_grid = ((points > field.origin) & (points < field.upper)).all(axis=1)
    loose = (truth - bound)[own & inside_grid & (truth > 0.02)]
    assert loose.max() < 0.015


def test_known_mesh_covers_surface_and_inside_but_not_its_cavity():
    outer = trimesh.creation.box((0.4, 0.3, 0.3))
    cavity = trimesh.creation.box((0.3, 0.2, 0.2))
    cavity.invert()
    room = trimesh.util.concatenate([outer, cavity])
    room.apply_transform(_turned(4, (0.1, 0.1, 0.3)))
    assert room.is_watertight
    field = World(random_map(1), WorldConfig(known=(KnownMesh("room", room),), **FREE)).field
    pose = _turned(4, (0.1, 0.1, 0.3))
    rng = np.random.default_rng(0)
    local = rng.uniform(-0.25, 0.25, (20000, 3))
    in_box = (np.abs(local) <= (0.2, 0.15, 0.15)).all(axis=1)
    in_cavity = (np.abs(local) < (0.15, 0.1, 0.1)).all(axis=1)
    bound = field.lower_bound(local @ pose[:3, :3].T + pose[:3, 3])
    assert (bound[in_box & ~in_cavity] <= 0.0).all()
    center = field.lower_bound(pose[None, :3, 3])[0]
    assert 0.07 < center < 0.1


def test_solid_known_mesh_is_filled_and_open_one_is_not():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    map_ = random_map(1)
    solid = World(map_, WorldConfig(known=(KnownMesh("ball", ball),), **FREE))
    probe = np.array([[0.0, 0.0, -0.05]])
    assert solid.field.lower_bound(probe)[0] < -0.03
    shell = ball.copy()
    shell.update_faces(np.arange(len(ball.faces)) != 0)
    hollow = World(map_, WorldConfig(known=(KnownMesh("shell", shell),), **FREE))
    assert hollow.field.lower_bound(probe)[0] > 0.0


@pytest.mark.parametrize("turned", [0, 3])
def test_a_known_mesh_of_ten_centimetres_is_as_near_as_it_is_to_two_millimetres(turned):
    """At the grid's nodes: between them distances lose what those of any obstacle lose."""
    size, pose = np.array([0.1, 0.07, 0.05]), _turned(turned, (0.1, 0.1, 0.3))
    exact = Box("exact", size, pose)
    mesh = trimesh.creation.box(size).apply_transform(pose)
    world = World(random_map(1), WorldConfig(known=(KnownMesh("box", mesh),), **FREE))
    field = world.source_field("known:box")
    truth = exact.signed_distance(world.grid.slab(0, world.grid.shape[0]))
    nodes = field.distance.reshape(-1)
    assert (nodes <= np.maximum(truth, 0.0)).all()
    assert (np.maximum(truth, 0.0) - np.maximum(nodes, 0.0)).max() <= 0.002
    near = np.random.default_rng(0).normal(pose[:3, 3], 0.05, (5000, 3))
    truth, bound = exact.signed_distance(near), field.lower_bound(near)
    close = (truth > 0.0) & (truth < 0.03)
    assert (bound[close] <= truth[close]).all()
    assert (bound[truth <= 0.0] <= 0.0).all()
    assert (truth - np.maximum(bound, 0.0))[close].mean() <= 0.0025


def test_half_spaces_are_planes_after_the_support_surface():
    wall = HalfSpace("wall", (0.0, 2.0, 0.0), -1.0)
    map_ = random_map(1, plane=Plane((0.0, 0.0, 1.0), 0.02))
    world = World(map_, WorldConfig(known=(wall,), **FREE))
    assert world.plane_names == ("support surface", "known:wall")
    np.testing.assert_allclose(world.planes, [[0, 0, 1, 0.02], [0, 1, 0, -0.5]])
    assert "known:wall" not in world.sources
    assert World(random_map(1)).planes.shape == (0, 4)


def test_interface_holds_for_every_map(any_map, world, objects_only):
    field = world.field
    names = [f"object:{i}" for i in any_map.object_ids]
    assert world.sources == (*names, "background", "occluded", "unobserved")
    assert field.sources == world.sources
    assert field.distance.dtype == np.float32
    assert field.distance.flags.c_contiguous
    assert np.isfinite(field.distance).all()
    assert field.source.shape == field.distance.shape == world.grid.shape
    assert field.source.max() < len(world.sources)
    lower, upper = any_map.support_bounds()
    inside = np.array([lower, upper])
    points = np.random.default_rng(0).uniform(*inside, (5000, 3))
    again = World(any_map, world.config)
    assert np.array_equal(again.field.distance, field.distance)
    assert np.array_equal(again.field.source, field.source)
    occupied = any_map.occupancy(points) >= 0.5
    assert (field.lower_bound(points[occupied]) <= 0.0).all()
    # Level sets shrink with the level, and so the distance grows. (Not that of the whole
    # field: surfaces that were seen stay obstacles where the level set leaves them.)
    strict_world = World(any_map, WorldConfig(level=0.9, bounds=world.config.bounds, **FREE))
    strict = strict_world.object_field(any_map.object_ids[0])
    plain = objects_only.object_field(any_map.object_ids[0])
    assert (strict.lower_bound(points) >= plain.lower_bound(points) - 0.005).mean() > 0.99
    occupancy, entropy, nodes = world.occupancy_slice(0.05)
    assert occupancy.shape == entropy.shape == nodes.shape[:2] == field.distance.shape[:2]
    np.testing.assert_allclose(occupancy[3, 4], any_map.occupancy(nodes[3, 4][None])[0])
    assert set(world.timings) >= {"level set", "visibility", "combine"}


def test_bounds_are_a_minimum():
    map_ = random_map(2)
    small = World(map_, WorldConfig(bounds=((0.0, 0.0, 0.0), (0.02, 0.02, 0.02)), **FREE))
    points = np.random.default_rng(0).uniform(*map_.support_bounds(), (20000, 3))
    occupied = points[map_.occupancy(points) >= 0.5]
    assert ((occupied >= small.grid.origin) & (occupied <= small.grid.upper)).all()
    assert (small.field.lower_bound(occupied) <= 0.0).all()
    large = World(map_, WorldConfig(bounds=((-1, -0.5, 0.0), (0.02, 0.02, 0.02)), **FREE))
    assert (large.grid.origin <= (-1, -0.5, 0.0)).all()


def test_grid_of_a_seen_scene_leaves_room_for_an_arm(scene_kernel_map):
    world = World(scene_kernel_map, WorldConfig(occluded="free"))
    points, labels = scene_kernel_map.views[0].points()
    objects = points[labels > 0]
    lower, upper = world.grid.origin, world.grid.upper
    assert (lower[:2] <= objects.min(axis=0)[:2] - 0.59).all()
    assert (upper[:2] >= objects.max(axis=0)[:2] + 0.59).all()
    assert lower[2] <= -0.02
    assert upper[2] >= 0.99


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"resolution": 0.0}, "resolution"),
        ({"resolution": float("nan")}, "resolution"),
        ({"level": 0.0}, "level"),
        ({"level": 1.0}, "level"),
        ({"occluded": "maybe"}, "'posterior'"),
        ({"unobserved": "posterior"}, "'free'"),
        ({"bounds": ((0, 0, 0), (1, 1, 0))}, "bounds"),
        ({"bounds": ((0, 0), (1, 1))}, "bounds"),
        ({"known": ("box",)}, "known"),
        ({"known": (Sphere("a", 1.0, (0, 0, 0)), Sphere("a", 2.0, (0, 0, 0)))}, "twice"),
        ({"min_support": -1.0}, "min_support"),
        ({"occlusion_tolerance": -0.1}, "occlusion_tolerance"),
        ({"background_height": float("nan")}, "background_height"),
        ({"lone_share": 0.5}, "lone_share"),
    ],
)
def test_config_names_what_is_wrong(settings, named):
    with pytest.raises((ConfigError, TypeError), match=named):
        WorldConfig(**settings)


@pytest.mark.parametrize(
    "make",
    [
        lambda: Sphere("", 1.0, (0, 0, 0)),
        lambda: Sphere("a", -1.0, (0, 0, 0)),
        lambda: Sphere("a", 1.0, (0, 0, np.nan)),
        lambda: Box("a", (1, 0, 1)),
        lambda: Box("a", (1, 1, 1), np.eye(4) * 2),
        lambda: Cylinder("a", 1.0, np.inf),
        lambda: HalfSpace("a", (0, 0, 0), 1.0),
        lambda: HalfSpace("a", (0, 0, 1), np.nan),
        lambda: KnownMesh("a", trimesh.Trimesh()),
        lambda: KnownMesh("a", trimesh.Scene()),
    ],
)
def test_known_geometry_is_checked(make):
    with pytest.raises(ConfigError):
        make()


def test_too_large_a_grid_is_refused_with_a_remedy():
    floor = Box("hall", (40.0, 40.0, 5.0))
    with pytest.raises(WorldError, match="HalfSpace"):
        World(random_map(0), WorldConfig(known=(floor,), **FREE))


def test_too_large_a_grid_is_refused_before_the_level_set_is_traced(monkeypatch):
    def traced(*_):
        raise AssertionError("traced")

    monkeypatch.setattr("vprism_plan.world.world.trace_level_set", traced)
    with pytest.raises(WorldError, match="coarser resolution"):
        World(random_map(2), WorldConfig(resolution=1e-4))


def test_too_fine_a_level_set_is_refused_before_it_fills_the_memory():
    small = ((0.0, 0.0, 0.0), (0.01, 0.01, 0.01))
    with pytest.raises(WorldError, match=r"cells of 0\.0001 m"):
        World(random_map(2), WorldConfig(resolution=1e-4, bounds=small))


def test_status_and_bounds_refuse_points_that_are_not_finite():
    world = World(random_map(0), WorldConfig(**FREE))
    for question in (world.status, world.field.lower_bound, world.field.source_at):
        with pytest.raises(WorldError, match="finite"):
            question(np.array([[0.0, 0.0, np.nan]]))
