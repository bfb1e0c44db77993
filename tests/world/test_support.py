# SPDX-License-Identifier: BSD-3-Clause
"""A support surface that ends: benches, pedestals, floors beside the table."""

import dataclasses

import numpy as np
import pytest
from oracles.perception_oracles import Scene, intrinsics, look_at
from oracles.world_oracles import KernelMap

import vprism_plan as vp
from vprism_plan.perception import Observation, Plane
from vprism_plan.world import World, WorldConfig
from vprism_plan.world.seen import RIM, seen_support

K = intrinsics()
TABLE = Plane((0.0, 0.0, 1.0), 0.0)
HALF, FLOOR = 0.25, -0.4  # of the table top, metres
POSE = look_at((-0.9, 0.0, 0.8), (0.0, 0.0, -0.2))
BOX = ((-0.04, -0.04, 0.0), (0.04, 0.04, 0.1))


def picture(*boxes) -> Observation:
    scene = Scene(boxes=[BOX, *boxes], table=((-HALF, -HALF), (HALF, HALF)), floor=FLOOR)
    depth, labels = scene.render(POSE, K)
    return Observation(depth, labels, K, POSE, plane=TABLE)


def empty_map(view: Observation) -> KernelMap:
    hinges, weights = np.array([[5.0, 5.0, 0.0]] * 2), np.array([[1.0, -1.0]] * 2)
    return KernelMap(hinges, weights, np.array([6.0, 0.0]), views=(view,), plane=TABLE)


@pytest.fixture(scope="module")
def view() -> Observation:
    return picture()


@pytest.fixture(scope="module")
def world(view) -> World:
    bounds = ((-0.5, -0.5, -0.35), (0.5, 0.5, 0.4))
    return World(empty_map(view), WorldConfig(support="seen", bounds=bounds))


def test_its_distance_is_never_above_that_of_the_prism(view):
    support = seen_support([view], TABLE)
    rng = np.random.default_rng(0)
    points = rng.uniform((-0.6, -0.6, -0.5), (0.6, 0.6, 0.5), (4000, 3))
    flat = rng.uniform(-1.0, 1.0, (40000, 2))
    edges = support.region.halfplanes
    on = flat[(flat @ support.region.axes[:, :2].T @ edges[:, :2].T + edges[:, 2] <= RIM).all(1)]
    assert np.ptp(on, axis=0) == pytest.approx(2 * (HALF + RIM), abs=0.06)
    # The nearest of many points of the prism: an upper bound of the distance.
    prism = np.column_stack([np.repeat(on, 3, axis=0), np.tile([0.0, -0.1, -0.3], len(on))])
    from scipy.spatial import cKDTree

    nearest, _ = cKDTree(prism).query(points)
    assert (support.signed_distance(points) <= nearest + 1e-9).all()
    above = points[(np.abs(points[:, :2]) < HALF - 0.03).all(axis=1) & (points[:, 2] > 0)]
    np.testing.assert_allclose(support.signed_distance(above), above[:, 2], atol=1e-12)


def test_what_lies_lower_is_judged_like_all_other_space(view, world):
    assert world.planes.shape == (0, 4)
    points, _ = view.points()
    floor = points[points[:, 2] < FLOOR + 0.01]
    assert (world.field.lower_bound(floor) <= 0.0).all()
    names = np.array(world.sources)
    rng = np.random.default_rng(1)
    under = rng.uniform((-HALF, -HALF, -0.3), (HALF, HALF, -0.001), (2000, 3))
    assert (world.field.lower_bound(under) <= 0.0).all()
    assert set(names[world.field.source_at(under)]) <= {"support surface", "occluded"}
    # Before the table, above the floor: seen through. Behind it the table hides what is low.
    open_space = rng.uniform((-0.42, -0.1, -0.2), (-0.38, 0.1, -0.05), (500, 3))
    assert (world.field.lower_bound(open_space) > 0.0).all()
    hidden = np.array([[HALF + RIM + 0.03, 0.0, -0.1]])
    assert world.field.lower_bound(hidden)[0] <= 0.0
    assert names[world.field.source_at(hidden)[0]] == "occluded"


def test_above_the_table_nothing_changes(view, world):
    plain = World(world.map, dataclasses.replace(world.config, support="unbounded"))
    points = np.random.default_rng(2).uniform((-0.2, -0.2, 0.02), (0.2, 0.2, 0.4), (4000, 3))
    with_plane = np.minimum(plain.field.lower_bound(points), points[:, 2])
    bounded = world.field.lower_bound(points)
    assert (bounded <= with_plane + 1e-6).all()
    assert (bounded > 0.0).mean() == pytest.approx((with_plane > 0.0).mean(), abs=0.01)


def robot(tmp_path, base_z: float) -> vp.Robot:
    path = tmp_path / "ball.urdf"
    path.write_text(
        '<robot name="ball"><link name="base"/><link name="ball"/>'
        '<joint name="z" type="prismatic"><parent link="base"/><child link="ball"/>'
        '<axis xyz="0 0 1"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>'
    )
    spheres = {"ball": [{"center": [0, 0, 0], "radius": 0.03}]}
    base = np.eye(4)
    base[:3, 3] = (-0.4, 0.0, base_z)
    return vp.Robot.from_urdf(path, spheres=spheres, base_pose=base)


def test_a_robot_whose_base_stands_lower_is_not_in_the_table(view, tmp_path):
    world = World(empty_map(view))
    on_table = vp.CollisionChecker(world, robot(tmp_path, 0.0))
    assert on_table.world is world
    assert not on_table.is_valid([-0.1])
    lower = vp.CollisionChecker(world, robot(tmp_path, -0.3))
    assert lower.world.config.support == "seen"
    assert any("0.30 m below" in text and "unbounded" in text for text in lower.warnings)
    assert lower.is_valid([0.1])
    assert not lower.is_valid([FLOOR + 0.3])
    assert vp.CollisionChecker(world, robot(tmp_path, -0.3)).world is lower.world
    meshes = vp.MeshChecker(world, robot(tmp_path, -0.3))
    assert meshes.world is lower.world
    assert meshes.is_valid([0.1])
    heights = np.linspace(-0.2, 0.5, 30)[:, None]
    assert (meshes.is_valid_batch(heights) >= lower.is_valid_batch(heights)).all()
    assert not meshes.is_valid([FLOOR + 0.3])
    fixed = World(world.map, WorldConfig(support="unbounded"))
    assert not vp.CollisionChecker(fixed, robot(tmp_path, -0.3)).is_valid([0.1])


def test_a_labelled_object_on_a_lower_bench_is_not_denied():
    bench = ((0.0, 0.3, -0.15), (0.3, 0.6, -0.149))
    lower = ((0.1, 0.4, -0.149), (0.18, 0.48, -0.05))
    view = picture(lower, bench)
    view = dataclasses.replace(view, labels=np.where(view.labels == 3, 0, view.labels))
    points, labels = view.points()
    assert (labels == 2).sum() > 200
    m = vp.fit_map(view)
    assert m.occupancy(np.array([[0.14, 0.44, -0.1]]))[0] > 0.5
    assert (m.occupancy(points[labels == 2]) > 0.5).mean() > 0.7
