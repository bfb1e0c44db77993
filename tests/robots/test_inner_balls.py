# SPDX-License-Identifier: BSD-3-Clause
"""Balls that fill a robot's own solids: nothing of them stands out, and nothing is left out."""

import dataclasses

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.kinematics_oracle import random_pose
from scipy.spatial import cKDTree

from vprism_plan.robots import Robot
from vprism_plan.robots.geometry import PrimitiveGeometry
from vprism_plan.robots.surfaces import inner_balls

SHORT = 0.0075  # metres by which the balls may fall short of the solids


def random_solid(rng: np.random.Generator) -> PrimitiveGeometry:
    kind = ("box", "cylinder", "sphere")[rng.integers(3)]
    size = rng.uniform(0.004, 0.15, {"box": 3, "cylinder": 2, "sphere": 1}[kind])
    return PrimitiveGeometry(kind, tuple(size.tolist()), random_pose(rng, 0.05))


def gap(points: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Distance from points to the union of balls, one by one."""
    return np.array([(np.linalg.norm(rows[:, :3] - x, axis=1) - rows[:, 3]).min() for x in points])


@settings(max_examples=12)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 3))
def test_balls_lie_within_the_solids_and_fill_them(seed, count):
    rng = np.random.default_rng(seed)
    solids = tuple(random_solid(rng) for _ in range(count))
    rows = inner_balls(solids, ())
    depth = -np.min([solid.signed_distance(rows[:, :3]) for solid in solids], axis=0)
    # Each ball is in one of the solids: in the one in which its middle is deepest.
    assert (rows[:, 3] <= np.maximum(depth, 0.0) + 1e-9).all()
    assert (depth >= -1e-9).all()
    for solid in solids:
        reach = solid.bounding_radius()
        points = solid.T_link[:3, 3] + rng.uniform(-reach, reach, (20_000, 3))
        inside = points[solid.signed_distance(points) <= 0.0][:150]
        assert gap(inside, rows).max(initial=0.0) < SHORT


def surface(mesh: trimesh.Trimesh, count: int, seed: int) -> np.ndarray:
    points, _ = trimesh.sample.sample_surface(mesh, count, seed=seed)
    return np.asarray(points)


class Triangles:
    """What `inner_balls` needs of a mesh file."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self.mesh = mesh

    def triangles(self) -> np.ndarray:
        return np.asarray(self.mesh.triangles, dtype=np.float64)


def lying_l() -> trimesh.Trimesh:
    outline = np.array([[0, 0], [0.12, 0], [0.12, 0.04], [0.04, 0.04], [0.04, 0.1], [0, 0.1]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    return trimesh.creation.extrude_triangulation(outline, faces, height=0.05)


def box(low, high) -> PrimitiveGeometry:
    pose = np.eye(4)
    pose[:3, 3] = np.add(low, high) / 2
    return PrimitiveGeometry("box", tuple(np.subtract(high, low).tolist()), pose)


def capsule_depth(points: np.ndarray) -> np.ndarray:
    """Of a capsule along z, 0.05 m thick and 0.15 m long between its middles."""
    middles = np.zeros_like(points)
    middles[:, 2] = np.clip(points[:, 2], -0.075, 0.075)
    return 0.05 - np.linalg.norm(points - middles, axis=1)


def l_depth(points: np.ndarray) -> np.ndarray:
    parts = box((0, 0, 0), (0.12, 0.04, 0.05)), box((0, 0, 0), (0.04, 0.1, 0.05))
    return -np.min([part.signed_distance(points) for part in parts], axis=0)


def plate_depth(points: np.ndarray) -> np.ndarray:
    return -box((-0.05, -0.04, -0.001), (0.05, 0.04, 0.001)).signed_distance(points)


@pytest.mark.parametrize("name", ["capsule", "cracked capsule", "l", "plate"])
def test_balls_fill_what_a_mesh_encloses(name):
    mesh, depth = {
        "capsule": (trimesh.creation.capsule(height=0.15, radius=0.05), capsule_depth),
        "l": (lying_l(), l_depth),
        "plate": (trimesh.creation.box((0.1, 0.08, 0.002)), plate_depth),
    }[name.split()[-1]]
    on_it = surface(mesh, 300, 0)
    if name.startswith("cracked"):  # published meshes are rarely watertight
        mesh.update_faces(np.arange(len(mesh.faces)) != 0)
    rows = inner_balls((), (Triangles(mesh),))
    assert depth(rows[:, :3]).min() > -1e-9
    away = cKDTree(surface(mesh, 200_000, 1)).query(rows[:, :3])[0]
    assert (rows[:, 3] <= away).all()  # each ball ends before the surface
    assert gap(on_it, rows).max() < SHORT
    points = np.random.default_rng(0).uniform(*mesh.bounds, (3000, 3))
    points = points[depth(points) > 0.0][:200]
    assert gap(points, rows).max() < 0.02  # deep inside it does not matter
    if name != "plate":
        assert rows[:, 3].max() > 0.018


def test_of_a_shell_with_a_hole_only_the_surface_is_known():
    mesh = trimesh.creation.box((0.2, 0.2, 0.2))
    mesh.update_faces(mesh.triangles_center[:, 2] < 0.09)
    rows = inner_balls((), (Triangles(mesh),))
    assert (rows[:, 3] == 0.0).all()
    assert gap(surface(mesh, 200, 1), rows).max() < SHORT


BOX = '<collision><geometry><box size="0.2 0.1 0.06"/></geometry></collision>'
MISSING = '<collision><geometry><mesh filename="nowhere.stl"/></geometry></collision>'


def robot_of(tmp_path, collision: str) -> Robot:
    text = (
        '<robot name="r"><link name="base"/><link name="arm">' + collision + "</link>"
        '<joint name="j" type="prismatic"><parent link="base"/><child link="arm"/>'
        '<axis xyz="1 0 0"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>'
    )
    (tmp_path / "r.urdf").write_text(text)
    fat = {"arm": [{"center": [0, 0, 0], "radius": 0.2}]}
    return Robot.from_urdf(tmp_path / "r.urdf", spheres=fat)


def test_padding_and_scale_do_not_count_and_the_joints_do(tmp_path):
    robot = robot_of(tmp_path, BOX)
    found = robot.solid_balls([0.5])
    assert found.without == ()
    assert len(found.spheres) == 0
    assert (np.abs(found.inner[:, :3] - [0.5, 0, 0]) <= [0.1, 0.05, 0.03 + 1e-9]).all()
    grown = robot.with_padding(0.02, 1.5).solid_balls([0.5])
    np.testing.assert_array_equal(grown.inner, found.inner)


@pytest.mark.parametrize("collision", ["", MISSING])
def test_links_without_solids_are_their_spheres(tmp_path, collision):
    found = robot_of(tmp_path, collision).with_padding(0.02).solid_balls([0.25])
    assert found.without == ("arm",)
    assert len(found.inner) == 0
    np.testing.assert_allclose(found.spheres, [[0.25, 0.0, 0.0, 0.2]])


def test_held_objects_count_with_their_mesh_or_their_spheres(tmp_path):
    robot = robot_of(tmp_path, BOX)
    mug = trimesh.creation.cylinder(0.04, 0.1)
    pose = np.eye(4)
    pose[:3, 3] = 0.0, 0.0, 0.2
    held = robot.attach("mug", "arm", mesh=mug, pose=pose)
    found = held.solid_balls([0.0])
    assert found.without == ()
    top = found.inner[found.inner[:, 2] > 0.04]
    assert len(top) > 50
    assert (np.linalg.norm(top[:, :2], axis=1) + top[:, 3] <= 0.04 + 1e-6).all()
    again = dataclasses.replace(held).detach("mug").solid_balls([0.0])
    np.testing.assert_array_equal(again.inner, robot.solid_balls([0.0]).inner)
    found = robot.attach("ball", "arm", spheres=[(0, 0, 0, 0.03)], pose=pose).solid_balls([0.1])
    assert found.without == ("ball",)
    np.testing.assert_allclose(found.spheres, [[0.1, 0.0, 0.2, 0.03]])
