# SPDX-License-Identifier: BSD-3-Clause
"""Objects in hand: that they move with their link, are checked, and are held by their spheres."""

import dataclasses
import itertools
import logging
import pickle

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.kinematics_oracle import random_pose
from test_kinematics import kernel_centers
from test_padding import well_formed

from vprism_plan.errors import RobotError
from vprism_plan.robots import Robot
from vprism_plan.robots.pairs import pairs_touching
from vprism_plan.robots.report import enclosed
from vprism_plan.robots.sphere_fit import hold_object

seeds = st.integers(0, 2**32 - 1)
ROWS = [(0.0, 0.0, 0.02, 0.03), (0.05, 0.0, 0.0, 0.01), (0.0, 0.01, 0.08, 0.04)]


def rows_of(robot: Robot, name: str) -> slice:
    link = robot.link_names.index(name)
    return slice(int(robot.arrays.link_start[link]), int(robot.arrays.link_start[link + 1]))


@settings(max_examples=10)
@given(seed=seeds)
@pytest.mark.parametrize(
    ("name", "link"),
    [("panda", "panda_hand_tcp"), ("ur5e", "wrist_2_link"), ("planar3", "tip"), ("panda", "base")],
)
def test_an_object_moves_with_its_link(robots, name, link, seed):
    """Textbook: pose of the link times pose of the object times centre of the sphere."""
    rng = np.random.default_rng(seed)
    link = "panda_link0" if link == "base" else link
    pose, bare = random_pose(rng, 0.1), robots[name].with_base_pose(random_pose(rng))
    robot = bare.attach("mug", link, spheres=ROWS, pose=pose)
    well_formed(robot)
    q = robot.random_configuration(rng)
    poses = robot.link_poses(q)
    np.testing.assert_allclose(poses["mug"], bare.link_poses(q)[link] @ pose, atol=1e-12)
    rows = np.array(sorted(ROWS, key=lambda row: -row[3]))
    expected = rows[:, :3] @ poses["mug"][:3, :3].T + poses["mug"][:3, 3]
    mine = rows_of(robot, "mug")
    np.testing.assert_array_equal(robot.sphere_radii[mine], rows[:, 3])
    in_torch = robot.sphere_centers(torch.tensor(q)).numpy()
    np.testing.assert_allclose(in_torch[mine], expected, atol=1e-12)
    np.testing.assert_allclose(kernel_centers(robot, q), in_torch, atol=1e-12)
    np.testing.assert_allclose(np.delete(in_torch, mine, axis=0), kernel_centers(bare, q))
    assert robot.fixed_links[-1] == (link == "panda_link0")
    assert (np.linalg.norm(expected - robot.base_pose[:3, 3], axis=1) <= robot.reach).all()


def pair_names(robot: Robot) -> set[frozenset[str]]:
    return {frozenset(robot.link_names[i] for i in pair) for pair in robot.collision_pairs}


def test_an_object_is_checked_against_all_but_what_it_may_touch(robots):
    panda = robots["panda"]
    robot = panda.attach("mug", "panda_hand", spheres=ROWS, touch_links=["fingers", "panda_link8"])
    free = set(panda.link_names) - {"panda_hand", "panda_leftfinger", "panda_rightfinger"}
    assert pair_names(robot) - pair_names(panda) == {frozenset(("mug", link)) for link in free}
    assert pair_names(panda) <= pair_names(robot)
    added = {p: why for p, why in robot.disabled_pairs.items() if p not in panda.disabled_pairs}
    assert added == {
        frozenset(("mug", "panda_hand")): "Attached",
        frozenset(("mug", "panda_leftfinger")): "Touch link",
        frozenset(("mug", "panda_rightfinger")): "Touch link",
        frozenset(("mug", "panda_link8")): "Touch link",
    }
    np.testing.assert_array_equal(
        robot.collision_pairs, sorted(map(tuple, robot.collision_pairs.tolist()))
    )
    assert robot.attached == {"mug": "panda_hand"}
    assert robot.links_of("mug") == ("mug",)
    assert robot.groups == panda.groups


@settings(max_examples=15)
@given(seed=seeds)
def test_self_contacts_of_an_object_are_found(robots, seed):
    """Against every pair of spheres, one by one."""
    rng = np.random.default_rng(seed)
    robot = robots["panda"].attach(
        "rod", "panda_hand", spheres=[(0, 0, z, 0.02) for z in np.arange(0.1, 0.5, 0.03)]
    )
    q = robot.random_configuration(rng)
    centers = robot.sphere_centers(torch.tensor(q)).numpy()
    seen = {
        frozenset((robot.link_names[a], robot.link_names[b]))
        for (a, b), touch in zip(
            robot.collision_pairs,
            pairs_touching(robot.arrays, q[None], robot.collision_pairs)[0],
            strict=True,
        )
        if touch
    }
    rod = range(*rows_of(robot, "rod").indices(len(centers)))
    for link in set(robot.link_names) - {"rod", "panda_hand"}:
        others = range(*rows_of(robot, link).indices(len(centers)))
        touch = any(
            np.linalg.norm(centers[s] - centers[t]) < robot.sphere_radii[s] + robot.sphere_radii[t]
            for s, t in itertools.product(rod, others)
        )
        assert (frozenset(("rod", link)) in seen) == touch


def test_detaching_gives_back_the_same_robot(robots):
    for bare, link in ((robots["panda"], "panda_hand"), (robots["ur5e"], "tool0")):
        first = bare.attach("mug", link, spheres=ROWS)
        both = first.attach("lid", link, spheres=[(0, 0, 0.1, 0.02)], touch_links=["mug"])
        again = both.detach("mug").detach("lid")
        other = both.detach("lid").detach("mug")
        for robot in (again, other):
            for name, value in vars(bare.arrays).items():
                np.testing.assert_array_equal(getattr(robot.arrays, name), value)
                assert getattr(robot.arrays, name).dtype == value.dtype
            assert robot.link_names == bare.link_names
            assert robot.disabled_pairs == bare.disabled_pairs
            assert robot.attached == {}
            q = bare.neutral
            assert robot.link_poses(q).keys() == bare.link_poses(q).keys()
            torch.testing.assert_close(
                robot.sphere_centers(torch.tensor(q)), bare.sphere_centers(torch.tensor(q))
            )
        lid = both.detach("mug")
        well_formed(lid)
        alone = bare.attach("lid", link, spheres=[(0, 0, 0.1, 0.02)])
        np.testing.assert_array_equal(lid.collision_pairs, alone.collision_pairs)


def test_objects_on_one_link_may_touch_and_objects_may_carry_objects(robots):
    tray = robots["panda"].attach("tray", "panda_hand", spheres=[(0, 0, 0.15, 0.05)])
    cup = tray.attach("cup", "tray", spheres=[(0, 0, 0.2, 0.03)], touch_links=["tray"])
    pair = frozenset(("cup", "tray"))
    assert cup.disabled_pairs[pair] == "Attached"
    side = tray.attach("tool", "panda_hand", spheres=[(0, 0, 0.2, 0.03)])
    assert side.disabled_pairs[frozenset(("tool", "tray"))] == "Attached to the same link"
    assert pair not in pair_names(cup)
    assert frozenset(("tool", "tray")) not in pair_names(side)
    with pytest.raises(RobotError, match=r"'tray' carries \['cup'\]; detach them first"):
        cup.detach("tray")
    assert cup.detach("cup").detach("tray").link_names == robots["panda"].link_names


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"name": "panda_hand"}, "attached object 'panda_hand': an object needs a name of its own"),
        ({"name": "panda_link8"}, "a name of its own"),
        ({"name": "hand"}, "a name of its own"),
        ({"name": ""}, "a name of its own"),
        ({"link": "wrist"}, "no link 'wrist'; links:"),
        ({"spheres": None}, "give either spheres or a mesh"),
        ({"mesh": trimesh.creation.box((0.1, 0.1, 0.1))}, "give either spheres or a mesh"),
        ({"spheres": []}, r"spheres have shape \(0,\); give at least one row"),
        ({"spheres": [(0, 0, 0.1)]}, r"spheres have shape \(1, 3\)"),
        ({"spheres": [(0, 0, 0, 0.1), (0, 0, 0, 0.0)]}, r"sphere 1 is \[0.0, 0.0, 0.0, 0.0\]"),
        ({"spheres": [(0, np.nan, 0, 0.1)]}, "sphere 0 is .* must be finite"),
        ({"spheres": "none"}, "spheres are no array"),
        ({"pose": 2 * np.eye(4)}, "attached object 'mug': pose is not rigid"),
        ({"pose": np.eye(3)}, r"pose has shape \(3, 3\)"),
        ({"touch_links": ["thumb"]}, "'thumb' is no link or group"),
        ({"touch_links": "hand"}, "touch_links is the string 'hand'; give a sequence"),
    ],
)
def test_bad_objects_are_refused(robots, options, message):
    given_ = {"name": "mug", "link": "panda_hand", "spheres": ROWS} | options
    with pytest.raises(RobotError, match=message):
        robots["panda"].attach(**given_)


def test_only_what_is_attached_can_be_detached(robots):
    with pytest.raises(RobotError, match=r"'panda_hand' is not attached; attached: \['mug'\]"):
        robots["panda"].attach("mug", "panda_hand", spheres=ROWS).detach("panda_hand")


def test_a_contact_at_rest_is_named_with_its_remedy(robots, caplog):
    with caplog.at_level(logging.WARNING):
        robots["panda"].attach("mug", "panda_hand", spheres=ROWS, touch_links=["fingers"])
    assert "'mug' touches links in the neutral state: [('panda_link7', 'mug')" in caplog.text
    assert "touch_links" in caplog.text
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        robots["panda"].attach("mug", "panda_hand_tcp", spheres=[(0, 0, 0.2, 0.03)])
    assert not caplog.records


def test_padding_moving_and_pickling_work_with_an_object(robots):
    robot = robots["panda"].attach("mug", "panda_hand", spheres=ROWS)
    padded = robot.with_padding({"mug": 0.01}, scale={"mug": 1.2})
    well_formed(padded)
    assert padded.attached == robot.attached
    assert padded.sphere_radii[rows_of(padded, "mug")].min() > 1.2 * 0.01
    copy = pickle.loads(pickle.dumps(padded.with_base_pose(random_pose(np.random.default_rng(0)))))
    q = torch.tensor(copy.neutral)
    assert copy.sphere_centers(q).shape == (len(padded.sphere_radii), 3)
    bare = copy.detach("mug").sphere_centers(q)
    torch.testing.assert_close(bare, copy.sphere_centers(q)[: len(bare)])


# --- meshes -------------------------------------------------------------------------


def bowl() -> trimesh.Trimesh:
    """Closed and not convex: a profile turned round an axis."""
    profile = [(0, 0), (0.06, 0.0), (0.09, 0.07), (0.08, 0.07), (0.05, 0.012), (0, 0.012)]
    return trimesh.creation.revolve(np.array(profile), sections=24)


MESHES = {
    "box": trimesh.creation.box((0.06, 0.06, 0.12)),
    "cylinder": trimesh.creation.cylinder(0.035, 0.2),
    "ring": trimesh.creation.annulus(0.035, 0.04, 0.1),
    "torus": trimesh.creation.torus(0.08, 0.02),
    "bowl": bowl(),
    "plate": trimesh.creation.box((0.2, 0.2, 0.002)),
    "two": trimesh.util.concatenate(
        [
            trimesh.creation.box((0.05, 0.05, 0.05)),
            trimesh.creation.icosphere(2, 0.02).apply_translation((0.2, 0, 0)),
        ]
    ),
}


def gap(spheres: np.ndarray, points: np.ndarray) -> np.ndarray:
    distance = np.linalg.norm(points[:, None] - spheres[None, :, :3], axis=-1)
    return (distance - spheres[:, 3]).min(axis=1)


def inside(mesh: trimesh.Trimesh, n: int, rng: np.random.Generator) -> np.ndarray:
    points = rng.uniform(*mesh.bounds, size=(n, 3))
    return points[mesh.contains(points)]


@pytest.mark.parametrize("name", MESHES)
def test_spheres_hold_the_surface_and_the_inside_of_a_mesh(name):
    rng = np.random.default_rng(len(name))
    mesh = MESHES[name].copy()
    for most in (30, 8):
        spheres = hold_object(np.asarray(mesh.triangles), most)
        assert 1 <= len(spheres) <= most
        surface, _ = trimesh.sample.sample_surface(mesh, 3000, seed=0)
        points = np.vstack([mesh.vertices, surface, inside(mesh, 400, rng)])
        assert gap(spheres, points).max() <= 0.0
        mesh.apply_transform(random_pose(rng))


@settings(max_examples=10)
@given(seed=seeds, most=st.integers(1, 40))
def test_spheres_hold_any_heap_of_triangles(seed, most):
    """Open, flat, crossing, degenerate: nothing is asked of a mesh but finite corners."""
    rng = np.random.default_rng(seed)
    triangles = rng.normal(size=(int(rng.integers(1, 9)), 3, 3)) * rng.uniform(0.01, 0.3)
    if seed % 3 == 0:
        triangles[..., int(rng.integers(3))] = 0.1
    if seed % 5 == 0:
        triangles[0, 2] = triangles[0, :2].mean(axis=0)
    spheres = hold_object(triangles, most)
    assert len(spheres) <= most
    weights = rng.dirichlet((0.5, 0.5, 0.5), size=(len(triangles), 300))
    points = np.einsum("fnk,fki->fni", weights, triangles).reshape(-1, 3)
    assert gap(spheres, np.vstack([points, triangles.reshape(-1, 3)])).max() <= 0.0


@pytest.mark.parametrize(
    ("name", "mean", "most"),
    [("box", 0.008, 0.014), ("cylinder", 0.011, 0.02), ("ring", 0.018, 0.03)],
)
def test_spheres_stay_close_to_a_mesh(name, mean, most):
    """How far 32 spheres stand out: what planning with the object in hand loses."""
    mesh = MESHES[name]
    spheres = hold_object(np.asarray(mesh.triangles))
    i = np.arange(150) + 0.5
    polar, turn = np.arccos(1 - 2 * i / 150), np.pi * (1 + 5**0.5) * i
    ball = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], 1)
    points = (spheres[:, None, :3] + spheres[:, None, 3:] * ball).reshape(-1, 3)
    points = points[gap(spheres, points) > -1e-9]
    out = np.maximum(-trimesh.proximity.signed_distance(mesh, points), 0.0)
    assert out.mean() < mean
    assert out.max() < most


def test_spheres_hold_a_scan_of_many_triangles():
    """Boxes around its triangles stand for them; the proof is of the triangles."""
    mesh = trimesh.creation.icosphere(6)
    wavy = mesh.vertices * (0.05, 0.04, 0.12) * (1.0 + 0.1 * np.sin(40.0 * mesh.vertices[:, :1]))
    spheres = hold_object(wavy[mesh.faces], 20)
    assert len(spheres) <= 20
    assert enclosed(wavy[mesh.faces], spheres)


def test_a_mesh_can_be_attached_from_memory_and_from_a_file(robots, tmp_path):
    panda, mesh = robots["panda"], MESHES["bowl"]
    mesh.export(tmp_path / "bowl.stl")
    pose = random_pose(np.random.default_rng(0), 0.05)
    options = {"pose": pose, "touch_links": ["hand"], "max_spheres": 20}
    robot = panda.attach("bowl", "panda_hand_tcp", mesh=mesh, **options)
    well_formed(robot)
    q = panda.neutral
    T = robot.link_poses(q)["bowl"]
    centers = robot.sphere_centers(torch.tensor(q)).numpy()[rows_of(robot, "bowl")]
    spheres = np.column_stack([centers, robot.sphere_radii[rows_of(robot, "bowl")]])
    assert len(spheres) <= 20
    surface, _ = trimesh.sample.sample_surface(mesh, 2000, seed=1)
    assert gap(spheres, surface @ T[:3, :3].T + T[:3, 3]).max() <= 0.0
    read = panda.attach("bowl", "panda_hand_tcp", mesh=tmp_path / "bowl.stl", **options)
    T = read.link_poses(q)["bowl"]
    centers = read.sphere_centers(torch.tensor(q)).numpy()[rows_of(read, "bowl")]
    spheres = np.column_stack([centers, read.sphere_radii[rows_of(read, "bowl")]])
    assert gap(spheres, surface @ T[:3, :3].T + T[:3, 3]).max() <= 1e-6  # single precision


def test_unusable_meshes_are_refused(robots, tmp_path):
    (tmp_path / "text.stl").write_text("not a mesh")
    box = MESHES["box"]
    broken = dataclasses.make_dataclass("M", ["vertices", "faces"])
    cases = [
        (tmp_path / "none.stl", {}, "no mesh file at"),
        (tmp_path / "text.stl", {}, "text.stl"),
        (42, {}, "a int without triangles"),
        (broken(np.full((3, 3), np.nan), [[0, 1, 2]]), {}, "not finite"),
        (broken(np.ones((3, 3)), [[0, 1, 2]]), {}, "the mesh is 0 m long"),
        (box.copy().apply_scale(1000), {}, r"120 m long.*mesh.apply_scale\(0.001\)"),
        (box, {"max_spheres": 0}, "max_spheres is 0"),
    ]
    for mesh, options, message in cases:
        with pytest.raises(RobotError, match=message):
            robots["panda"].attach("thing", "panda_hand", mesh=mesh, **options)
