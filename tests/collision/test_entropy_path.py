"""Entropy along a path and over what it sweeps, against loops over every voxel."""

import json

import numpy as np
import pytest
from oracles.checker_oracle import sphere_positions
from oracles.random_robots import as_robot, random_arrays, random_q
from oracles.world_oracles import random_map

import vprism_plan as vp
from vprism_plan.collision import CollisionChecker
from vprism_plan.collision.entropy import path_entropy, swept_voxels
from vprism_plan.errors import RobotError
from vprism_plan.perception import Plane
from vprism_plan.world import World, WorldConfig

RADIUS = 0.03


@pytest.fixture(scope="module")
def world():
    m = random_map(5, plane=Plane((0.0, 0.0, 1.0), -0.05))
    return World(m, WorldConfig(bounds=((-0.4, -0.4, -0.05), (0.4, 0.4, 0.4)), resolution=0.02))


@pytest.fixture(scope="module")
def checker(world, ball_robot):
    return CollisionChecker(world, ball_robot(RADIUS))


# No voxel centre lies just on its rim.
PATH = np.array([[-0.2037, -0.1013, 0.0541], [0.1029, 0.0817, 0.0703], [0.1141, 0.2519, 0.1223]])


def to_segment(x, a, b):
    share = np.clip((x - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
    return np.linalg.norm(x - a - share * (b - a))


def test_swept_volume_and_total_equal_a_loop_over_every_voxel(checker):
    h = 0.02
    found = path_entropy(checker, PATH, resolution=h)
    m, least = checker.world.map, checker.world.config.min_support
    total, voxels, unsupported, close = 0.0, 0, 0, 0
    low = np.floor((PATH.min(axis=0) - RADIUS) / h).astype(int) - 1
    high = np.ceil((PATH.max(axis=0) + RADIUS) / h).astype(int) + 1
    for index in np.ndindex(*(high - low + 1)):
        x = h * (low + np.array(index))
        distance = min(to_segment(x, PATH[0], PATH[1]), to_segment(x, PATH[1], PATH[2]))
        # Between samples, a rim of at most h^2 / (32 r) is left out.
        close += RADIUS - h**2 / (32 * RADIUS) < distance <= RADIUS
        if distance > RADIUS:
            continue
        voxels += 1
        if m.support(x[None])[0] < least:
            unsupported += 1
        else:
            total += h**3 * m.entropy(x[None])[0]
    assert voxels > 150
    assert 0 < unsupported < voxels
    assert voxels - close <= found.voxels <= voxels
    assert close <= 0.05 * voxels
    top = close * h**3 * np.log(m.n_classes)
    assert total - top <= found.swept_total <= total + 1e-12
    assert found.swept_volume == pytest.approx(found.voxels * h**3)
    assert found.unsupported_share == pytest.approx(unsupported / voxels, abs=close / voxels)
    supported = found.swept_volume * (1.0 - found.unsupported_share)
    assert found.swept_mean == pytest.approx(found.swept_total / supported)
    assert found.spacing == 0.5 * h


def test_every_voxel_counts_once(checker):
    there = path_entropy(checker, PATH)
    back = path_entropy(checker, np.concatenate([PATH, PATH[::-1]]))
    assert back.swept_total == pytest.approx(there.swept_total, rel=2e-3)
    assert back.swept_volume == pytest.approx(there.swept_volume, rel=2e-3)
    single = path_entropy(checker, PATH[0])
    assert single.configurations == 1
    assert single.swept_volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.1)


def test_waypoints_average_over_the_spheres_volume(checker):
    found = path_entropy(checker, PATH)
    m, least = checker.world.map, checker.world.config.min_support
    axis = np.arange(-RADIUS, RADIUS, 0.003) + 0.0015
    cube = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    ball = cube[np.linalg.norm(cube, axis=1) <= RADIUS]
    for t, q in enumerate(PATH):
        supported = m.support(q + ball) >= least
        assert found.waypoint_unsupported[t] == pytest.approx(1 - supported.mean(), abs=0.1)
        if supported.mean() < 0.05:
            continue
        exact = m.entropy(q + ball)[supported].mean()
        assert found.waypoint_mean[t] == pytest.approx(exact, abs=0.05)
        assert found.waypoint_max[t] == pytest.approx(found.waypoint_mean[t], rel=1e-12)
    assert np.isfinite(found.waypoint_mean).any()


def test_overlapping_spheres_of_a_robot_are_a_union(world):
    for seed in range(4):
        rng = np.random.default_rng(seed)
        arrays = random_arrays(rng, dof=3, reach=0.3)
        checker = CollisionChecker(world, as_robot(arrays))
        Q = np.array([random_q(rng, arrays) for _ in range(3)])
        h = 0.025
        expected = set()
        moving = np.flatnonzero(~arrays.link_fixed[arrays.sphere_link])
        for q in Q:
            centers = sphere_positions(arrays, q)
            for s in moving:
                c, r = centers[s], arrays.sphere_radius[s]
                low, high = np.floor((c - r) / h).astype(int), np.ceil((c + r) / h).astype(int)
                for offset in np.ndindex(*(high - low + 1)):
                    index = low + np.array(offset)
                    if np.linalg.norm(h * index - c) <= r:
                        expected.add(tuple(index.tolist()))
        got = swept_voxels(checker, Q, h)
        assert len({tuple(v) for v in got.tolist()}) == len(got)
        assert {tuple(v) for v in got.tolist()} == expected


def test_without_support_there_is_no_mean_and_the_share_says_so(checker):
    found = path_entropy(checker, [[1.0, 1.0, 1.0], [1.2, 1.0, 1.0]])
    assert found.unsupported_share == 1.0
    assert found.waypoint_unsupported == (1.0, 1.0)
    assert np.isnan(found.swept_mean)
    assert np.isnan(found.waypoint_mean).all()
    assert found.swept_total == 0.0
    assert found.map_points == 0
    data = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert data["swept_mean"] is None
    assert data["waypoint_mean"] == [None, None]
    assert "no support" in found.text()


def test_links_that_do_not_move_do_not_count(demo_world, repository):
    robot = vp.Robot.from_urdf(repository / "urdf" / "panda.urdf")
    checker = CollisionChecker(demo_world, robot)
    voxels = swept_voxels(checker, robot.neutral[None], 0.02)
    fixed = np.asarray(robot.fixed_links)[robot.sphere_links]
    assert fixed.any()
    centers = checker.sphere_clearances(robot.neutral)[0]
    gaps = np.linalg.norm(0.02 * voxels[:, None] - centers, axis=2) - robot.sphere_radii
    assert (gaps[:, ~fixed].min(axis=1) <= 0.0).all()


def test_nonsense_is_refused(checker):
    for bad in (0.0, -1.0, np.nan):
        with pytest.raises(RobotError, match="resolution"):
            path_entropy(checker, PATH, resolution=bad)
    with pytest.raises(RobotError, match="coarser"):
        swept_voxels(checker, PATH, 0.0002)
    with pytest.raises(RobotError, match="shape"):
        path_entropy(checker, np.zeros((2, 4)))
    with pytest.raises(RobotError, match="finite"):
        path_entropy(checker, np.full((2, 3), np.nan))
