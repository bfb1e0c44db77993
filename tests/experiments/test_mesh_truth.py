"""Inside, outside and distance to meshes, also to bad ones."""

import igl
import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from experiments.generation import MeshObject, MeshScene
from experiments.generation.raycasting import observe
from experiments.generation.truth import MeshTruth
from experiments.protocols import checked_points
from vprism_plan.errors import ConfigError
from vprism_plan.simulation import Box, Camera, Frustum


def cloud(seed: int, n: int = 2000, reach: float = 0.12) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-reach, reach, (n, 3))


def truth_of(mesh: trimesh.Trimesh) -> MeshTruth:
    return MeshTruth(mesh.vertices, mesh.faces)


def two_boxes(gap: float) -> MeshScene:
    """Two cubes of 8 cm side by side, `gap` metres apart."""
    cube = trimesh.creation.box(extents=(0.08, 0.08, 0.08))
    objects = []
    for x in (-0.04 - gap / 2, 0.04 + gap / 2):
        pose = np.eye(4)
        pose[:3, 3] = (x, 0.0, 0.04)
        objects.append(MeshObject("cube", np.array(cube.vertices), np.array(cube.faces), pose))
    camera = Camera.orbit(np.array([0.0, 0.0, 0.05]), 1.0, 0.4, 0.7)
    seen = observe([body.mesh() for body in objects], (1, 2), camera, None, 0)
    return MeshScene(tuple(objects), camera, seen)


@pytest.mark.parametrize("solid", [Box((0.03, 0.05, 0.07)), Frustum(0.05, 0.03, 0.06)])
def test_distance_is_that_of_the_solid(solid):
    points = cloud(0)
    found = truth_of(solid.mesh()).signed_distance(points)
    # 64 segments stay within 0.06 mm of the round solid.
    assert np.abs(found - solid.signed_distance(points)).max() < 0.00007


@given(st.integers(0, 10_000))
def test_any_soup_agrees_with_exact_winding_numbers(seed):
    rng = np.random.default_rng(seed)
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.08)
    kept = rng.random(len(mesh.faces)) < rng.uniform(0.7, 1.0)
    vertices = mesh.vertices * rng.uniform(0.3, 1.0, 3)
    faces = np.ascontiguousarray(mesh.faces[kept], dtype=np.int64)
    truth = MeshTruth(vertices, faces)
    points = cloud(seed, 300)
    exact = igl.winding_number(np.ascontiguousarray(vertices), faces, points)
    clear = np.abs(exact - 0.5) > 0.02
    in_box = ((points >= truth.low) & (points <= truth.high)).all(axis=1)
    np.testing.assert_array_equal(truth.contains(points)[clear], ((exact > 0.5) & in_box)[clear])


def test_overlapping_pieces_are_one_body():
    a = trimesh.creation.box(extents=(0.1, 0.1, 0.1))
    b = a.copy()
    b.apply_translation((0.05, 0.0, 0.0))
    both = truth_of(trimesh.util.concatenate([a, b]))
    points = cloud(3)
    np.testing.assert_array_equal(both.contains(points), a.contains(points) | b.contains(points))


def test_a_hole_does_not_turn_a_mesh_inside_out():
    box = trimesh.creation.box(extents=(0.1, 0.1, 0.1)).subdivide().subdivide()
    lidless = trimesh.Trimesh(box.vertices, box.faces[20:], process=False)
    points = cloud(4)
    far = np.abs(box.vertices[box.faces[:20]].mean(axis=(0, 1)) - points).max(axis=1) > 0.06
    np.testing.assert_array_equal(
        truth_of(lidless).contains(points)[far], box.contains(points)[far]
    )


@pytest.mark.parametrize("gap", [0.0, 0.002, 0.05])
@pytest.mark.parametrize("table", [False, True])
def test_a_scene_is_the_nearest_of_its_objects(gap, table):
    scene = two_boxes(gap)
    points = cloud(5, 3000, 0.2)
    solids = [Box((0.04,) * 3, pose=body.pose) for body in scene.objects]
    expected = np.minimum(*(solid.signed_distance(points) for solid in solids))
    if table:
        expected = np.minimum(expected, points[:, 2])
    np.testing.assert_allclose(scene.signed_distance(points, table=table), expected, atol=1e-12)
    inside = [solid.signed_distance(points) < 0 for solid in solids]
    np.testing.assert_array_equal(
        scene.object_of(points), np.where(inside[0], 1, np.where(inside[1], 2, 0))
    )


def test_truth_meshes_are_in_the_world():
    meshes = two_boxes(0.01).truth_meshes()
    assert tuple(meshes) == (1, 2)
    np.testing.assert_allclose(meshes[2].bounds, [[0.005, -0.04, 0.0], [0.085, 0.04, 0.08]])


def test_points_that_are_none_are_named():
    scene = two_boxes(0.01)
    with pytest.raises(ConfigError, match=r"shape \(2,\)"):
        scene.object_of(np.zeros(2))
    points = np.zeros((3, 3))
    points[1, 2] = np.inf
    with pytest.raises(ConfigError, match="point 1 is"):
        scene.signed_distance(points)
    assert scene.object_of(np.zeros((0, 3))).shape == (0,)
    assert scene.signed_distance(np.zeros((0, 3))).shape == (0,)
    assert checked_points([[0, 0, 1]], ConfigError).dtype == np.float64


def test_a_view_that_misses_every_object():
    scene = two_boxes(0.01)
    away = Camera.look_at(np.array([2.0, 2.0, 1.0]), np.array([2.5, 2.6, 0.0]))
    seen = scene.render(away)
    assert not (seen.labels > 0).any()
    assert (seen.depth > 0).any()
