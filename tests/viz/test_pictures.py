# SPDX-License-Identifier: BSD-3-Clause
"""Pictures show what they claim: pixel by pixel where that can be said."""

import numpy as np
import pytest
from PIL import Image

import vprism_plan as vp
from vprism_plan.simulation import load_ground_truth, random_scene
from vprism_plan.viz import (
    map_figure,
    object_color,
    plan_figure,
    resample,
    save_figure,
    scene_figure,
)
from vprism_plan.viz._raster import Film, Layer, View


def pixels(figure) -> np.ndarray:
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3].astype(float) / 255.0


def near(picture: np.ndarray, color, tolerance: float = 0.08) -> int:
    return int((np.abs(picture - np.asarray(color)).max(axis=-1) < tolerance).sum())


@pytest.fixture
def film() -> Film:
    view = View(np.array([0.0, -2.0, 0.5]), np.array([0.0, 0.0, 0.2]))
    return Film(view, np.array([-0.3, -0.3]), np.array([0.3, 0.3]), 250.0)


def test_spheres_are_where_rays_meet_them(film):
    centers = np.array([[0.0, 0.0, 0.2], [0.15, -0.3, 0.25], [0.1, 0.4, 0.3]])
    radii = np.array([0.1, 0.07, 0.2])
    layer = Layer(film)
    layer.add_spheres(centers, radii, (1.0, 0.0, 0.0))
    rays = film.rays.reshape(-1, 3).astype(float)
    offset = centers - film.view.eye
    along = rays @ offset.T
    inside = along**2 - (np.sum(offset**2, axis=1) - radii**2)
    exact = np.where(inside > 0, along - np.sqrt(np.maximum(inside, 0)), np.inf).min(axis=1)
    got = layer.depth.reshape(-1)
    assert (np.isfinite(got) == np.isfinite(exact)).mean() > 0.9999
    both = np.isfinite(got) & np.isfinite(exact)
    assert both.sum() > 1000
    # At the rim a tiny error of the ray is a large one along it.
    assert np.quantile(np.abs(got[both] - exact[both]), 0.99) < 1e-4
    normals = layer.normal.reshape(-1, 3)[both]
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=2e-3)
    assert (np.einsum("ij,ij->i", normals, rays[both]) < 0.05).all()


def test_meshes_agree_with_an_independent_ray_caster(film):
    import trimesh

    meshes = [
        trimesh.creation.icosphere(subdivisions=2, radius=0.12),
        trimesh.creation.box(extents=(0.2, 0.1, 0.15)),
    ]
    meshes[0].apply_translation([0.05, 0.0, 0.2])
    meshes[1].apply_translation([-0.1, -0.2, 0.15])
    layer = Layer(film)
    for mesh in meshes:
        normals = np.repeat(mesh.face_normals[:, None], 3, axis=1)
        layer.add_mesh(np.asarray(mesh.triangles), normals, (0.0, 1.0, 0.0))
    both = trimesh.util.concatenate(meshes)
    rays = film.rays.reshape(-1, 3).astype(float)
    origins = np.repeat(film.view.eye[None], len(rays), axis=0)
    points, which, _ = both.ray.intersects_location(origins, rays, multiple_hits=False)
    exact = np.full(len(rays), np.inf)
    exact[which] = np.linalg.norm(points - film.view.eye, axis=1)
    got = layer.depth.reshape(-1)
    assert (np.isfinite(got) == np.isfinite(exact)).mean() > 0.998
    hit = np.isfinite(got) & np.isfinite(exact)
    assert hit.sum() > 1000
    assert np.quantile(np.abs(got[hit] - exact[hit]), 0.99) < 1e-4


def test_resample_keeps_ends_and_spaces_evenly():
    path = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 3.0]])
    dense = resample(path, 41)
    np.testing.assert_allclose(dense[[0, -1]], path[[0, -1]])
    np.testing.assert_allclose(np.abs(np.diff(dense, axis=0)).sum(axis=1), 0.1, atol=1e-9)
    np.testing.assert_array_equal(resample(path[[0, 0]], 5), np.zeros((5, 2)))


@pytest.mark.parametrize("with_color", [True, False])
def test_scene_picture_shows_every_object(with_color):
    from dataclasses import replace

    obs = random_scene(4, 5).observation
    picture = pixels(scene_figure(obs if with_color else replace(obs, color=None), title="four"))
    assert picture.std() > 0.15
    bare = pixels(scene_figure(replace(obs, labels=None)))
    for object_id in obs.object_ids:
        # Labels are laid over grey at 65 percent: look for the hue, not the shade.
        wanted = 0.65 * object_color(object_id) + 0.35 * 0.5
        count = int((obs.labels == object_id).sum())
        assert near(picture, wanted, 0.13) > near(bare, wanted, 0.13) + 0.1 * count


def test_map_picture_shows_occupied_free_and_uncertain(demo_map):
    truth = load_ground_truth(_bundled()).signed_distance
    with_truth = pixels(map_figure(demo_map, truth=truth, resolution=0.008, title="map"))
    without = pixels(map_figure(demo_map, resolution=0.008))
    yellow, violet = (0.99, 0.91, 0.14), (0.27, 0.0, 0.33)  # the ends of the occupancy scale
    assert near(without, yellow) > 3000
    assert near(without, violet) > 20000
    assert near(without, (0.0, 0.0, 0.02)) > 20000  # no entropy
    assert near(without, (0.99, 0.65, 0.45), 0.12) > 1000  # much entropy
    pink = (1.0, 0.37, 0.64)
    assert near(with_truth, pink, 0.05) > near(without, pink, 0.05) + 200


def test_plan_picture_shows_start_goal_hand_and_objects(demo_map, repository):
    meshes = vp.extract_meshes(demo_map, resolution=0.02)
    robot = vp.Robot.from_urdf(repository / "urdf" / "panda.urdf")
    base = np.eye(4)
    base[:3, 3] = (-0.6, 0.0, 0.0)
    robot = robot.with_base_pose(base)
    start, goal = robot.neutral.copy(), robot.neutral.copy()
    start[0], goal[0] = -0.9, 0.9
    picture = pixels(plan_figure(meshes, robot, np.stack([start, goal]), title="plan"))

    def hue(color):
        """Pixels whose direction in colour space is that of a lit surface of this colour."""
        unit = picture / np.maximum(np.linalg.norm(picture, axis=-1, keepdims=True), 1e-9)
        return int((unit @ (np.asarray(color) / np.linalg.norm(color)) > 0.998).sum())

    from vprism_plan.viz import plan_plot

    assert hue(plan_plot.START_COLOR) > 5000
    assert hue(plan_plot.GOAL_COLOR) > 5000
    assert hue(plan_plot.HAND_COLOR) > 500
    for object_id in meshes:
        assert hue(object_color(object_id)) > 200
    centers = robot.sphere_centers(np.stack([start, goal]))
    assert centers.shape == (2, len(robot.sphere_radii), 3)


def test_equal_pictures_are_equal_files_and_appear_whole(tmp_path):
    obs = random_scene(2, 1).observation
    for name in ("a.png", "b.png"):
        save_figure(scene_figure(obs), tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.png", "b.png"]
    with Image.open(tmp_path / "a.png") as image:
        assert image.size[0] > 1000


def _bundled():
    from vprism_plan._resources import data_path

    return data_path("demo_scene")


@pytest.mark.parametrize("title", [None, "a title"])
def test_saved_at_once_no_label_is_cut_off(demo_map, tmp_path, title):
    save_figure(map_figure(demo_map, title=title), tmp_path / "map.png")
    with Image.open(tmp_path / "map.png") as picture:
        ink = np.asarray(picture.convert("L")) < 200
    assert not ink[:, :2].any()
    assert not ink[:, -2:].any()
    assert ink.mean() > 0.1
