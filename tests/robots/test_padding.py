# SPDX-License-Identifier: BSD-3-Clause
"""Padding and scale: by how much links grow, and that spheres still hold the solids."""

import dataclasses
import logging

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.kinematics_oracle import random_pose
from test_sphere_enclosure import gap, interior, spheres_of, surface

from vprism_plan._kernels import checking
from vprism_plan.collision import CollisionChecker, MeshChecker
from vprism_plan.collision.packing import pack_robot
from vprism_plan.errors import RobotError
from vprism_plan.robots import Robot, enclosing_spheres
from vprism_plan.robots.changes import grown
from vprism_plan.robots.geometry import PrimitiveGeometry
from vprism_plan.robots.pairs import pairs_touching
from vprism_plan.world import Sphere, World, WorldConfig

seeds = st.integers(0, 2**32 - 1)


def well_formed(robot: Robot) -> None:
    """What kernels rely on: links contiguous, radii falling, balls that hold their links."""
    a = robot.arrays
    for link in range(len(robot.link_names)):
        rows = slice(a.link_start[link], a.link_start[link + 1])
        assert (a.sphere_link[rows] == link).all()
        assert (a.sphere_frame[rows] == a.link_frame[link]).all()
        assert (np.diff(a.sphere_radius[rows]) <= 0).all()
        reach = np.linalg.norm(a.sphere_center[rows] - a.link_center[link], axis=1)
        assert (reach + a.sphere_radius[rows] <= a.link_radius[link]).all()
    assert a.link_start[-1] == len(robot.sphere_radii) == len(a.sphere_center)
    assert (a.pairs[:, 0] < a.pairs[:, 1]).all()
    assert a.pairs.max(initial=-1) < len(robot.link_names)
    for name, value in vars(a).items():
        assert value.flags.c_contiguous, name
    assert pack_robot(a)[0].dtype == np.float64


def padded_surface(solid: PrimitiveGeometry, spacing: float) -> np.ndarray:
    """Points of a padded solid's surface, outer ones included: its core's, pushed outward."""
    core = surface(PrimitiveGeometry(solid.kind, solid.size, solid.T_link), spacing)
    i = np.arange(32) + 0.5
    polar, turn = np.arccos(1 - 2 * i / 32), np.pi * (1 + 5**0.5) * i
    ball = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], 1)
    return (core[:, None] + solid.padding * ball).reshape(-1, 3)


@pytest.mark.parametrize("name", ["panda", "ur5e", "planar3"])
def test_padding_adds_exactly_that_many_metres_to_every_radius(robots, name):
    robot = robots[name]
    padded = robot.with_padding(0.0125)
    np.testing.assert_array_equal(padded.sphere_radii, robot.sphere_radii + 0.0125)
    q = torch.tensor(robot.random_configuration(np.random.default_rng(0)))
    assert torch.equal(padded.sphere_centers(q), robot.sphere_centers(q))
    assert padded.reach == pytest.approx(robot.reach + 0.0125)
    well_formed(padded)


def test_no_padding_and_scale_one_change_no_bit(robots):
    for robot in robots.values():
        same = robot.with_padding()
        for name, value in vars(robot.arrays).items():
            np.testing.assert_array_equal(getattr(same.arrays, name), value)
        assert same.geometry.keys() == robot.geometry.keys()


def test_padding_of_links_and_groups(robots):
    panda = robots["panda"]
    table = {"hand": 0.01, "fingers": 0.02, "panda_leftfinger": 0.005}
    padded = panda.with_padding(table)
    added = padded.sphere_radii - panda.sphere_radii
    expected = {"panda_hand": 0.01, "panda_rightfinger": 0.02, "panda_leftfinger": 0.005}
    for link, name in enumerate(panda.link_names):
        np.testing.assert_allclose(added[panda.sphere_links == link], expected.get(name, 0.0))
    reverse = dict(reversed(table.items()))
    np.testing.assert_array_equal(panda.with_padding(reverse).sphere_radii, padded.sphere_radii)
    twice = panda.with_padding(0.01).with_padding({"hand": 0.01})
    hand = np.isin(panda.sphere_links, [panda.link_names.index(n) for n in panda.links_of("hand")])
    np.testing.assert_allclose(twice.sphere_radii, panda.sphere_radii + 0.01 + 0.01 * hand)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"padding": -0.01}, r"padding of all links is -0.01; .* at least 0"),
        ({"padding": {"hand": -1e-9}}, r"padding of 'hand' is -1e-09"),
        ({"padding": {"panda_hand": np.nan}}, r"padding of 'panda_hand' is nan"),
        ({"padding": np.inf}, "padding of all links is inf"),
        ({"scale": {"panda_link3": 0.0}}, r"scale of 'panda_link3' is 0.0; .* above 0"),
        ({"scale": -1.0}, "scale of all links is -1.0"),
        ({"padding": {"wrist": 0.01}}, r"'wrist' is no link or group of panda"),
        ({"scale": {"panda_link8": 1.1}}, r"'panda_link8' has no collision spheres"),
    ],
)
def test_bad_values_are_refused_by_link(robots, options, message):
    with pytest.raises(RobotError, match=message):
        robots["panda"].with_padding(**options)


@pytest.mark.parametrize(
    ("name", "scale"), [("panda", 0.8), ("panda", 1.3), ("ur5e", 1.0), ("planar3", 2.0)]
)
def test_scaled_spheres_hold_the_scaled_solids_and_what_they_held_before(robots, name, scale):
    robot = robots[name]
    grown = robot.with_padding(0.01, scale=scale)
    well_formed(grown)
    assert (grown.sphere_radii > 0).all()
    for link, solids in grown.geometry.items():
        spheres = spheres_of(grown, link)
        for solid, before in zip(solids, robot.geometry[link], strict=True):
            assert solid.padding == 0.01
            np.testing.assert_allclose(solid.size, scale * np.array(before.size))
            assert gap(spheres, padded_surface(solid, 0.02)).max() <= 1e-12
            if scale >= 1.0:
                assert gap(spheres, surface(before, 0.008)).max() <= -0.01 + 1e-9


@settings(max_examples=40)
@given(seed=seeds, scale=st.floats(1.0, 3.0))
def test_a_scale_above_one_never_uncovers_a_point(seed, scale):
    """Links with elbows, too: each sphere is held by the one it becomes."""
    from vprism_plan.robots.changes import _scaled

    rng = np.random.default_rng(seed)
    centers, radii = rng.normal(size=(6, 3)) * 0.2, rng.uniform(0.005, 0.15, 6)
    about = rng.normal(size=3) * 0.1
    after, big = _scaled(centers, radii, about, scale)
    image = about + scale * (centers - about)
    assert (np.linalg.norm(after - centers, axis=1) + radii <= big + 1e-12).all()
    assert (np.linalg.norm(after - image, axis=1) + scale * radii <= big + 1e-12).all()
    # and no larger than that needs
    least = np.maximum(
        scale * radii, (np.linalg.norm(image - centers, axis=1) + (1 + scale) * radii) / 2
    )
    np.testing.assert_allclose(big, least, rtol=1e-9)


@given(kind=st.sampled_from(["box", "cylinder", "sphere"]), padding=st.floats(0.0, 0.1), seed=seeds)
def test_a_padded_solid_is_the_points_that_near_to_it(kind, padding, seed):
    rng = np.random.default_rng(seed)
    size = tuple(rng.uniform(0.01, 0.3, {"box": 3, "cylinder": 2, "sphere": 1}[kind]).tolist())
    core = PrimitiveGeometry(kind, size, random_pose(rng))
    solid = PrimitiveGeometry(kind, size, core.T_link, padding=padding)
    points = core.T_link[:3, 3] + rng.normal(size=(300, 3)) * max(size)
    np.testing.assert_allclose(
        solid.signed_distance(points), core.signed_distance(points) - padding, atol=1e-12
    )
    assert solid.bounding_radius() == pytest.approx(core.bounding_radius() + padding)
    spheres = enclosing_spheres(solid)
    rim = padded_surface(solid, max(size) / 4)
    assert gap(spheres, np.vstack([rim, interior(solid, 300, rng)])).max() <= 1e-12


def test_clearance_falls_by_exactly_the_padding(demo_world, ball_robot):
    robot = ball_robot(0.02)
    rng = np.random.default_rng(0)
    Q = np.column_stack([rng.uniform(-0.4, 0.4, (200, 2)), rng.uniform(0.05, 0.6, 200)])
    bare = CollisionChecker(demo_world, robot).clearance_batch(Q)
    padded = CollisionChecker(demo_world, robot.with_padding({"ball": 0.017})).clearance_batch(Q)
    np.testing.assert_allclose(padded, bare - 0.017, atol=1e-9)


def test_padding_leaves_self_collision_as_it_was(demo_world, robots):
    """As in MoveIt: links may come as near to each other as without it."""
    panda = robots["panda"].attach("rod", "panda_hand", spheres=[(0, 0, 0.3, 0.02)])
    padded = panda.with_padding({"hand": 0.02, "panda_link2": 0.03, "rod": 0.04})
    bare, wide = (CollisionChecker(demo_world, robot) for robot in (panda, padded))
    Q = np.random.default_rng(0).uniform(panda.lower, panda.upper, (400, 7))
    np.testing.assert_allclose(
        wide.self_clearance_batch(Q), bare.self_clearance_batch(Q), atol=1e-9
    )
    touching = pairs_touching(panda.arrays, Q, panda.collision_pairs)
    np.testing.assert_array_equal(
        pairs_touching(padded.arrays, Q, padded.collision_pairs), touching
    )
    assert 50 < touching.any(axis=1).sum() < 350
    for q in Q[:40]:
        np.testing.assert_allclose(wide.pair_gaps(q)[0], bare.pair_gaps(q)[0], atol=1e-9)
    valid = bare.self_clearance_batch(Q) > 0.0
    np.testing.assert_array_equal(wide.is_valid_batch(Q), valid & (wide.clearance_batch(Q) > 0.0))
    scaled = padded.with_padding(scale=1.5)
    assert CollisionChecker(demo_world, scaled).self_clearance_batch(Q).max() < (
        bare.self_clearance_batch(Q).max()
    )


@pytest.mark.slow
def test_the_second_opinion_pads_links_against_the_world_alone(demo_world, robots):
    """Whatever the field accepts of a padded robot, FCL does, with spheres and with solids."""
    pose = np.eye(4)
    pose[:3, 3] = (0.0, -0.7, 0.0)
    padded = robots["panda"].with_base_pose(pose).with_padding({"hand": 0.02, "panda_link5": 0.03})
    checker = CollisionChecker(demo_world, padded)
    Q = np.random.default_rng(0).uniform(padded.lower, padded.upper, (3000, 7))
    accepted = Q[checker.is_valid_batch(Q)][:40]
    assert len(accepted) == 40
    unpadded = pairs_touching(
        dataclasses.replace(padded.arrays, link_padding=np.zeros(len(padded.link_names))),
        accepted,
        padded.collision_pairs,
    )
    assert unpadded.any()  # their padded spheres do overlap
    for links in ("spheres", "geometry"):
        meshes = MeshChecker(demo_world, padded, links=links)
        assert all(meshes.is_valid(q) for q in accepted)


@pytest.mark.slow
def test_padding_is_a_distance_to_keep_for_meshes(demo_world, tmp_path):
    """It once took a link's mesh from the second opinion, which then judged its one small ball."""
    block = trimesh.creation.box((0.2, 0.2, 0.3))
    block.export(tmp_path / "block.stl")
    path = tmp_path / "block.urdf"
    path.write_text(
        '<robot name="r"><link name="base"/><link name="l"><collision><geometry>'
        '<mesh filename="block.stl"/></geometry></collision></link><joint name="z" '
        'type="prismatic"><parent link="base"/><child link="l"/><axis xyz="0 0 1"/>'
        '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>'
    )
    small = {"l": [{"center": [0, 0, 0], "radius": 0.05}]}
    base = np.eye(4)
    base[:3, 3] = 0.0, -0.9, 0.0
    plain = Robot.from_urdf(path, spheres=small, base_pose=base)
    ball = Sphere("ball", 0.03, (0.09, -0.81, 0.8))
    world = World(demo_world.map, WorldConfig(known=(ball,), occluded="free", resolution=0.02))
    for padding in (0.0, 0.005, 0.02):
        meshes = MeshChecker(world, plain.with_padding(padding))
        # The block's top is 15 cm above its joint value, the ball's bottom at 0.77 m.
        assert meshes.is_valid([0.62 - padding - 0.001])
        assert not meshes.is_valid([0.62 - padding + 0.001])
        if padding:
            contact = meshes.explain([0.62 - padding + 0.001]).contacts[0]
            assert contact.required == pytest.approx(padding)
            assert f"{1000 * padding - 1:.1f} mm from known:ball" in contact.text()


@pytest.mark.parametrize("seed", range(3))
def test_padded_pairs_equal_the_slow_oracle(seed):
    """Any tree, any padding: the kernels against sphere pairs one by one."""
    from oracles import checker_oracle
    from oracles.random_robots import random_arrays, random_q

    rng = np.random.default_rng(seed)
    arrays = random_arrays(rng)
    links = len(arrays.link_frame)
    padded = grown(arrays, np.ones(links), rng.uniform(0, 0.05, links))
    packed, plain = pack_robot(padded), pack_robot(arrays)
    for _ in range(20):
        q = random_q(rng, arrays)
        gaps, spheres = (
            np.empty(len(arrays.pairs)),
            np.zeros((len(arrays.pairs), 2), dtype=np.int64),
        )
        checking.pair_gaps(q, *packed, gaps, spheres)
        assert gaps.min(initial=np.inf) == pytest.approx(
            checker_oracle.self_clearance(arrays, q), abs=1e-12
        )
        again = gaps.copy()
        checking.pair_gaps(q, *plain, again, spheres)
        np.testing.assert_allclose(gaps, again, atol=1e-12)


def test_links_that_a_scale_makes_touch_are_named(robots, caplog):
    panda = robots["panda"]
    with caplog.at_level(logging.WARNING):
        panda.with_padding(0.1)
    assert not caplog.records
    with caplog.at_level(logging.WARNING):
        scaled = panda.with_padding(scale={"panda_link5": 1.2})
    assert "makes links touch in the neutral state: [('panda_link5', 'panda_link7')]" in caplog.text
    assert len(scaled.collision_pairs) == len(panda.collision_pairs)


def test_links_without_spheres_keep_their_solids(write):
    from small_urdfs import TWO

    spheres = {"a": [], "b": [{"center": [0.1, 0, 0], "radius": 0.1}], "c": []}
    robot = Robot.from_urdf(write(TWO), spheres=spheres)
    grown = robot.with_padding(0.01, scale=2.0)
    assert grown.geometry["a"] is robot.geometry["a"]
    assert grown.geometry["b"][0].size == (0.1,)
    # about the middle of the link's spheres, not about its frame
    np.testing.assert_allclose(grown.geometry["b"][0].T_link[:3, 3], [-0.1, 0, 0])


def test_the_robot_asked_is_left_alone(robots):
    panda = robots["panda"]
    before = panda.sphere_radii.copy()
    panda.with_padding(0.05, scale=1.3)
    np.testing.assert_array_equal(panda.sphere_radii, before)
    moved = panda.with_padding(0.02).with_base_pose(random_pose(np.random.default_rng(0)))
    np.testing.assert_array_equal(moved.sphere_radii, before + 0.02)
