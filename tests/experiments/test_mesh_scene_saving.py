"""Scenes on disk in BOP's layout: the same bits back, and no truth for those who plan."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
from oracles.scene_digest import digest
from PIL import Image

from experiments.generation import MeshObject, MeshScene, generate, load_scene
from experiments.generation.raycasting import observe
from experiments.generation.shapes import file_precision
from experiments.generation.silhouettes import silhouettes
from vprism_plan.errors import ObservationError
from vprism_plan.perception import load_observation
from vprism_plan.perception.camera import invert_transform
from vprism_plan.simulation import Camera
from vprism_plan.simulation.scene_io import GROUND_TRUTH


@pytest.fixture(scope="module", params=[("analytic", True), ("random", False)], ids=str)
def scene(request):
    kind, noise = request.param
    return generate(kind, 6, n_objects=3, noise=noise)


def same_observation(a, b) -> None:
    for name in ("depth", "labels", "intrinsics", "T_world_camera", "color"):
        left, right = getattr(a, name), getattr(b, name)
        assert left.dtype == right.dtype, name
        assert left.tobytes() == right.tobytes(), name


def test_a_saved_scene_reloads_identically(scene, tmp_path):
    scene.save(tmp_path / "scene")
    again = load_scene(tmp_path / "scene")
    assert digest(again) == digest(scene)
    for name in ("name", "seed", "noise", "kind"):
        assert getattr(again, name) == getattr(scene, name)
    same_observation(again.observation, scene.observation)
    points = np.random.default_rng(0).uniform([-0.2, -0.2, 0.0], [0.2, 0.2, 0.2], (500, 3))
    np.testing.assert_array_equal(again.object_of(points), scene.object_of(points))
    np.testing.assert_array_equal(again.signed_distance(points), scene.signed_distance(points))
    again.save(tmp_path / "again")
    for path in sorted((tmp_path / "scene").rglob("*.*")):
        twin = tmp_path / "again" / path.relative_to(tmp_path / "scene")
        assert twin.read_bytes() == path.read_bytes(), path.name


def test_planners_read_the_same_observation_and_no_truth(scene, tmp_path):
    folder = tmp_path / "scene"
    scene.save(folder)
    same_observation(load_observation(folder), scene.observation)
    for truth in (GROUND_TRUTH, "scene_gt.json", "scene_gt_info.json"):
        (folder / truth).unlink()
    for truth in ("models", "mask"):
        shutil.rmtree(folder / truth)
    same_observation(load_observation(folder), scene.observation)


def test_bop_tools_find_the_models_where_the_camera_sees_them(scene, tmp_path):
    scene.save(tmp_path)
    poses = json.loads((tmp_path / "scene_gt.json").read_text())["0"]
    info = json.loads((tmp_path / "models" / "models_info.json").read_text())
    seen = load_observation(tmp_path)
    to_world = seen.T_world_camera
    for entry, mesh in zip(poses, scene.truth_meshes().values(), strict=True):
        model = trimesh.load_mesh(
            tmp_path / "models" / f"obj_{entry['obj_id']:06d}.ply", process=False
        )
        rotation = np.reshape(entry["cam_R_m2c"], (3, 3))
        in_camera = 0.001 * (model.vertices @ rotation.T + entry["cam_t_m2c"])
        np.testing.assert_allclose(
            in_camera @ to_world[:3, :3].T + to_world[:3, 3], mesh.vertices, atol=1e-7
        )
        about = info[str(entry["obj_id"])]
        assert [about[f"size_{axis}"] for axis in "xyz"] == pytest.approx(model.extents, abs=1e-3)
        corners = model.vertices[trimesh.convex.ConvexHull(model.vertices).vertices]
        apart = np.linalg.norm(corners[:, None] - corners[None], axis=2).max()
        assert about["diameter"] == pytest.approx(apart, abs=1e-6)


def png(path):
    return np.array(Image.open(path))


def test_bop_tools_missed_silhouettes_and_their_figures(scene, tmp_path):
    """Every figure of scene_gt_info against its definition, from the files."""
    scene.save(tmp_path)
    figures = json.loads((tmp_path / "scene_gt_info.json").read_text())["0"]
    depth = png(tmp_path / "depth" / "000000.png")
    assert len(figures) == len(scene.objects)
    for index, (found, mesh) in enumerate(zip(figures, scene.truth_meshes().values(), strict=True)):
        visible = png(tmp_path / "mask_visib" / f"000000_{index:06d}.png") > 0
        whole = png(tmp_path / "mask" / f"000000_{index:06d}.png") > 0
        assert not (visible & ~whole).any()
        alone = MeshScene((scene.objects[index],), scene.camera, scene.observation)
        seen = alone.render(scene.camera).labels == 1
        assert (seen ^ whole).sum() <= 2  # pixels at an edge
        assert found["px_count_visib"] == visible.sum()
        assert found["px_count_all"] == whole.sum()  # none of these reaches out of the image
        assert found["px_count_valid"] == (depth[whole] > 0).sum()
        assert found["visib_fract"] == visible.sum() / whole.sum()
        for name, mask in (("bbox_obj", whole), ("bbox_visib", visible)):
            y, x = np.nonzero(mask)
            x0, y0, width, height = found[name]
            assert (x0, y0, x0 + width, y0 + height) == (x.min(), y.min(), x.max(), y.max())
        pixels = (
            scene.camera.intrinsics
            @ (
                invert_transform(scene.camera.T_world_camera)
                @ np.column_stack([mesh.vertices, np.ones(len(mesh.vertices))]).T
            )[:3]
        )
        low, high = (pixels[:2] / pixels[2]).min(axis=1), (pixels[:2] / pixels[2]).max(axis=1)
        x0, y0, width, height = found["bbox_obj"]
        assert np.abs(low - [x0, y0]).max() < 2.0
        assert np.abs(high - [x0 + width, y0 + height]).max() < 2.0


def test_what_reaches_out_of_the_image_or_is_hidden_counts_as_in_bop():
    """A box before another, both cut by the image's left side."""
    near, far = (
        MeshObject(name, *box_corners(size), at(x, size[2] / 2))
        for name, size, x in (("near", (0.02, 0.3, 0.2), 0.1), ("far", (0.02, 0.1, 0.1), 0.0))
    )
    camera = Camera.look_at(np.array([0.8, 0.0, 0.12]), np.array([0.0, 0.35, 0.1]))
    masks, (first, second) = silhouettes(
        MeshScene((near, far), camera, observe([near.mesh(), far.mesh()], (1, 2), camera, None, 0))
    )
    assert masks[0].any(axis=0)[0] or masks[0].any(axis=0)[-1]
    assert first["px_count_all"] > masks[0].sum() == first["px_count_visib"]
    assert first["bbox_obj"][0] < 0 or sum(first["bbox_obj"][::2]) > camera.width
    assert first["bbox_visib"][0] >= 0
    assert sum(first["bbox_visib"][::2]) < camera.width
    assert first["visib_fract"] == first["px_count_visib"] / first["px_count_all"] < 1.0
    assert masks[1].any()
    assert second["px_count_visib"] == second["visib_fract"] == 0
    assert second["bbox_obj"] == second["bbox_visib"] == [-1, -1, -1, -1]


def box_corners(size):
    mesh = trimesh.creation.box(extents=size)
    return file_precision(mesh.vertices), np.asarray(mesh.faces, dtype=np.int64)


def at(x, z):
    pose = np.eye(4)
    pose[:3, 3] = x, 0.0, z
    return pose


def test_a_camera_that_was_not_rounded_reloads_to_the_bit_too(scene, tmp_path):
    camera = Camera.orbit(np.array([0.01, 0.02, 0.03]), 0.9, 1.234567, 0.6543)
    moved = MeshScene(scene.objects, camera, scene.render(camera))
    moved.save(tmp_path)
    assert digest(load_scene(tmp_path)) == digest(moved)


def test_a_scene_replaces_a_scene_but_nothing_else(scene, tmp_path):
    target = tmp_path / "scene"
    scene.save(target)
    fewer = MeshScene(scene.objects[:2], scene.camera, scene.observation)
    fewer.save(target)
    assert len(load_scene(target).objects) == 2
    assert len(list((target / "mask_visib").iterdir())) == 2
    assert [p.name for p in tmp_path.iterdir()] == ["scene"]
    other = tmp_path / "thesis"
    other.mkdir()
    (other / "draft.txt").write_text("years of work")
    with pytest.raises(ObservationError, match="is no mesh scene"):
        scene.save(other)
    assert (other / "draft.txt").read_text() == "years of work"
    with pytest.raises(ObservationError, match="is no mesh scene"):
        scene.save(other / "draft.txt")


def test_damage_is_named(scene, tmp_path):
    with pytest.raises(ObservationError, match=r"ground_truth\.json does not exist"):
        load_scene(tmp_path)
    scene.save(tmp_path)
    truth = tmp_path / GROUND_TRUTH
    whole = truth.read_text()
    for damaged, message in (
        (whole.replace('"seed"', '"sid"'), "is not whole: KeyError: 'seed'"),
        (whole.replace("version 1", "version 9"), "version 9"),
        ("{", "not readable JSON"),
    ):
        truth.write_text(damaged)
        with pytest.raises(ObservationError, match=message):
            load_scene(tmp_path)
    truth.write_text(whole)
    model = tmp_path / "models" / "obj_000002.ply"
    model.write_bytes(b"ply\n")
    with pytest.raises(ObservationError, match=r"obj_000002\.ply is not a readable"):
        load_scene(tmp_path)
    model.unlink()
    with pytest.raises(ObservationError, match=r"obj_000002\.ply is missing"):
        load_scene(tmp_path)


def test_a_replacement_that_fails_leaves_the_old_scene(scene, tmp_path, monkeypatch):
    target = tmp_path / "scene"
    scene.save(target)
    rename = Path.rename

    def refuse(self, other):
        if self.name == "new":
            raise OSError("disk full")
        return rename(self, other)

    monkeypatch.setattr(Path, "rename", refuse)
    with pytest.raises(OSError, match="disk full"):
        MeshScene(scene.objects[:1], scene.camera, scene.observation).save(target)
    assert digest(load_scene(target)) == digest(scene)
    assert [p.name for p in tmp_path.iterdir()] == ["scene"]
