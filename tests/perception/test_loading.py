# SPDX-License-Identifier: BSD-3-Clause
"""Every form an observation is kept in survives a round trip; every fault is one clear line."""

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from oracles.perception_oracles import intrinsics, look_at
from PIL import Image

from vprism_plan.errors import ObservationError
from vprism_plan.perception import Observation, Plane, load_observation, save_observation
from vprism_plan.perception.camera import invert_transform
from vprism_plan.perception.readers import views_in

SHAPE = (12, 16)
K = intrinsics(16, 12)
CAMERA = {
    "fx": K[0, 0],
    "fy": K[1, 1],
    "cx": K[0, 2],
    "cy": K[1, 2],
    "depth_scale": 0.001,
}


@pytest.fixture
def obs() -> Observation:
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.4, 3.0, SHAPE)
    depth[:2] = 0.0
    return Observation(
        depth,
        rng.integers(0, 4, SHAPE),
        K,
        look_at((0.5, 0.2, 0.7)),
        rng.integers(0, 255, (*SHAPE, 3), dtype=np.uint8),
        Plane([0, 0.1, 1.0], 0.03),
    )


def raw_depth() -> np.ndarray:
    raw = np.random.default_rng(1).integers(400, 3000, SHAPE).astype(np.uint16)
    raw[0, :3] = 0
    return raw


def write(path, image) -> None:
    Image.fromarray(image).save(path)


@pytest.fixture
def folder(tmp_path):
    write(tmp_path / "depth.png", raw_depth())
    (tmp_path / "camera.json").write_text(json.dumps(CAMERA))
    return tmp_path


@pytest.fixture
def scene(tmp_path):
    """A BOP scene with images 3 and 7; image 7 is posed and has objects 0 and 2."""
    for name in ("depth", "mask_visib", "rgb"):
        (tmp_path / name).mkdir()
    for image in (3, 7):
        write(tmp_path / "depth" / f"{image:06d}.png", raw_depth() + image)
    write(tmp_path / "rgb" / "000007.png", np.full((*SHAPE, 3), 9, np.uint8))
    first, second = np.zeros((2, *SHAPE), np.uint8)
    first[2:5, 2:5] = second[6:9, 7:10] = 255
    write(tmp_path / "mask_visib" / "000007_000000.png", first)
    write(tmp_path / "mask_visib" / "000007_000002.png", second)
    world_to_camera = invert_transform(look_at((0.5, 0.2, 0.7)))
    cameras = {
        "3": {"cam_K": K.ravel().tolist(), "depth_scale": 0.1},
        "7": {
            "cam_K": K.ravel().tolist(),
            "depth_scale": 0.1,
            "cam_R_w2c": world_to_camera[:3, :3].ravel().tolist(),
            "cam_t_w2c": (1000 * world_to_camera[:3, 3]).tolist(),
        },
    }
    (tmp_path / "scene_camera.json").write_text(json.dumps(cameras))
    return tmp_path


def assert_same(a: Observation, b: Observation, depth_tolerance: float = 0.0) -> None:
    np.testing.assert_allclose(a.depth, b.depth, atol=depth_tolerance, rtol=0)
    for name in ("labels", "intrinsics", "T_world_camera", "color"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert a.max_range == b.max_range
    if b.plane is None:
        assert a.plane is None
    else:
        np.testing.assert_allclose(a.plane.normal, b.plane.normal, atol=1e-15)
        assert abs(a.plane.offset - b.plane.offset) < 1e-15


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_npz_round_trip_is_exact(obs, tmp_path, dtype):
    obs = replace(obs, depth=obs.depth.astype(dtype))
    save_observation(obs, tmp_path / "view.npz")
    loaded = load_observation(tmp_path / "view.npz")
    assert_same(loaded, obs)
    assert loaded.depth.dtype == dtype
    assert [p.name for p in tmp_path.iterdir()] == ["view.npz"]


@pytest.mark.parametrize("name", ["view.npz", "view"])
def test_the_range_is_kept(obs, tmp_path, name):
    far = replace(obs, depth=np.round(obs.depth * 5, 3), max_range=20.0)
    assert far.depth.max() > 10.0
    save_observation(far, tmp_path / name)
    assert_same(load_observation(tmp_path / name), far, 0.5001e-3)


def test_folder_round_trip_keeps_a_tenth_of_a_millimetre(obs, tmp_path):
    save_observation(obs, tmp_path / "view")
    assert_same(load_observation(str(tmp_path / "view")), obs, 0.5001e-4)
    far = replace(obs, depth=obs.depth * 10, max_range=50.0)
    assert far.depth.max() > 10.0
    save_observation(far, tmp_path / "view")
    assert_same(load_observation(tmp_path / "view"), far, 0.5001e-3)


def test_saving_again_leaves_nothing_of_the_old(obs, tmp_path):
    save_observation(obs, tmp_path / "view")
    bare = Observation(np.round(obs.depth, 3), None, K)
    save_observation(bare, tmp_path / "view")
    assert_same(load_observation(tmp_path / "view"), bare, 1e-9)
    assert sorted(p.name for p in (tmp_path / "view").iterdir()) == ["camera.json", "depth.png"]


def test_interrupted_save_leaves_no_loadable_folder_and_no_scraps(obs, tmp_path, monkeypatch):
    save_observation(obs, tmp_path / "view")

    def fail(*args, **kwargs):
        raise OSError("disk full")

    monkeypatch.setattr(Image.Image, "save", fail)
    with pytest.raises(OSError, match="disk full"):
        save_observation(obs, tmp_path / "view")
    names = sorted(p.name for p in (tmp_path / "view").iterdir())
    assert names == ["color.png", "depth.png", "labels.png"]
    with pytest.raises(ObservationError, match=r"camera\.json is missing"):
        load_observation(tmp_path / "view")


def test_interrupted_npz_keeps_the_old_file(obs, tmp_path, monkeypatch):
    path = tmp_path / "view.npz"
    save_observation(obs, path)
    before = path.read_bytes()

    def fail(path, **kwargs):
        path.write_bytes(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez_compressed", fail)
    with pytest.raises(OSError, match="disk full"):
        save_observation(obs, path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["view.npz"]


def test_folder_in_metres(folder):
    obs = load_observation(folder)
    np.testing.assert_allclose(obs.depth, raw_depth() * 0.001)
    np.testing.assert_allclose(obs.intrinsics, K)
    assert obs.labels is None
    assert not obs.posed


@pytest.mark.parametrize("dtype", [np.uint16, np.int32])
def test_the_largest_raw_value_is_no_return(folder, dtype):
    raw = raw_depth()
    raw[3:6, 4:9] = 65535
    if dtype is np.uint16:
        write(folder / "depth.png", raw)
    else:  # 16 bits that arrive as 32
        Image.fromarray(raw.astype(dtype)).save(folder / "depth.png", format="TIFF")
    obs = load_observation(folder)
    np.testing.assert_allclose(obs.depth, np.where(raw == 65535, 0, raw) * 0.001)
    assert obs.warnings == ()


def test_depth_image_with_siblings(folder):
    write(folder / "frame0-depth.png", raw_depth())
    write(folder / "frame0-color.png", np.full((*SHAPE, 3), 7, np.uint8))
    write(folder / "frame0-labels.png", np.full(SHAPE, 2, np.uint8))
    obs = load_observation(folder / "frame0-depth.png")
    assert obs.object_ids == (2,)
    assert (obs.color == 7).all()
    assert load_observation(folder / "depth.png").labels is None


def test_bop_scene_in_metres(scene):
    first = load_observation(scene)
    np.testing.assert_allclose(first.depth, (raw_depth() + 3) * 1e-4)
    assert first.object_ids == ()
    blind = raw_depth()
    blind[4, 5] = 65535
    write(scene / "depth" / "000003.png", blind)
    assert load_observation(scene).depth[4, 5] == 0.0
    assert load_observation(scene).warnings == ()
    assert first.color is None
    obs = load_observation(scene, frame=7)
    assert obs.object_ids == (1, 3)
    assert obs.labels[3, 3] == 1
    assert obs.labels[7, 8] == 3
    np.testing.assert_allclose(obs.pose, look_at((0.5, 0.2, 0.7)), atol=1e-12)
    assert (obs.color == 9).all()


def test_bop_scene_without_masks_is_unlabelled(scene):
    for mask in (scene / "mask_visib").iterdir():
        mask.unlink()
    (scene / "mask_visib").rmdir()
    assert load_observation(scene, frame=7).labels is None


def edit(path, **changes) -> None:
    content = json.loads(path.read_text())
    content.update(changes)
    path.write_text(json.dumps({k: v for k, v in content.items() if v != "remove"}))


FOLDER_FAULTS = {
    "no depth": (lambda f: (f / "depth.png").unlink(), r"no depth\.png"),
    "no camera": (lambda f: (f / "camera.json").unlink(), r"camera\.json is missing"),
    "broken json": (lambda f: (f / "camera.json").write_text("{"), "not readable JSON"),
    "json list": (lambda f: (f / "camera.json").write_text("[]"), "holds a list"),
    "no focal": (lambda f: edit(f / "camera.json", fx="remove"), "'fx' is missing"),
    "text focal": (lambda f: edit(f / "camera.json", fy="x"), "'fy' is 'x'"),
    "singular": (lambda f: edit(f / "camera.json", fx=0), "singular"),
    "no scale": (lambda f: edit(f / "camera.json", depth_scale="remove"), "'depth_scale' is miss"),
    "zero scale": (lambda f: edit(f / "camera.json", depth_scale=0), r"must be .* above 0"),
    "millimetres": (lambda f: edit(f / "camera.json", depth_scale=1), "millimetres"),
    "other size": (lambda f: edit(f / "camera.json", width=640), "'width' is 640"),
    "pose shape": (lambda f: edit(f / "camera.json", T_world_camera=[1, 2]), "has 2 numbers"),
    "pose text": (lambda f: edit(f / "camera.json", T_world_camera="x"), "not a matrix"),
    "plane": (lambda f: edit(f / "camera.json", plane=[1]), "has 1 numbers"),
    "8-bit depth": (
        lambda f: write(f / "depth.png", np.ones(SHAPE, np.uint8)),
        "pixel format L.*16-bit",
    ),
    "color depth": (
        lambda f: write(f / "depth.png", np.ones((*SHAPE, 3), np.uint8)),
        "pixel format RGB",
    ),
    "not an image": (lambda f: (f / "depth.png").write_bytes(b"junk"), "not a readable image"),
    "cut short": (
        lambda f: (f / "depth.png").write_bytes((f / "depth.png").read_bytes()[:200]),
        "not a readable image",
    ),
    "labels shape": (
        lambda f: write(f / "labels.png", np.ones((3, 3), np.uint8)),
        r"labels have shape \(3, 3\)",
    ),
    "labels with alpha": (
        lambda f: write(f / "labels.png", np.ones((*SHAPE, 2), np.uint8)),
        "pixel format LA.*object ids",
    ),
    "color depth 16": (lambda f: write(f / "color.png", raw_depth()), "8-bit RGB"),
}


@pytest.mark.parametrize("name", FOLDER_FAULTS)
def test_faulty_folder(folder, name):
    spoil, message = FOLDER_FAULTS[name]
    spoil(folder)
    with pytest.raises(ObservationError, match=message) as caught:
        load_observation(folder)
    assert "\n" not in str(caught.value)
    assert str(folder) in str(caught.value)


BOP_FAULTS = {
    "no depth": (lambda s: (s / "depth" / "000003.png").unlink(), r"000003\.png is missing"),
    "no K": (lambda s: edit(s / "scene_camera.json", **{"3": {}}), "no 'cam_K'"),
    "short K": (lambda s: edit(s / "scene_camera.json", **{"3": {"cam_K": [1]}}), "has 1 numbers"),
    "empty": (lambda s: (s / "scene_camera.json").write_text("{}"), "lists no image"),
    "half a pose": (
        lambda s: edit(
            s / "scene_camera.json",
            **{"3": {"cam_K": K.ravel().tolist(), "cam_t_w2c": [0, 0, 0]}},
        ),
        "half a pose: 'cam_R_w2c'",
    ),
    "mask shape": (
        lambda s: write(s / "mask_visib" / "000003_000000.png", np.ones((2, 2), np.uint8)),
        r"shape \(2, 2\)",
    ),
    "mask name": (
        lambda s: write(s / "mask_visib" / "000003_x.png", np.ones(SHAPE, np.uint8)),
        "not named",
    ),
}


@pytest.mark.parametrize("name", BOP_FAULTS)
def test_faulty_bop_scene(scene, name):
    spoil, message = BOP_FAULTS[name]
    spoil(scene)
    with pytest.raises(ObservationError, match=message) as caught:
        load_observation(scene)
    assert "\n" not in str(caught.value)


def test_frame_must_exist_and_needs_a_scene(scene, obs, tmp_path):
    with pytest.raises(ObservationError, match="no image 4; it has 3, 7"):
        load_observation(scene, frame=4)
    save_observation(obs, tmp_path / "view.npz")
    with pytest.raises(ObservationError, match="not a BOP scene"):
        load_observation(tmp_path / "view.npz", frame=0)


def test_unknown_paths_are_explained(tmp_path):
    with pytest.raises(ObservationError, match="does not exist"):
        load_observation(tmp_path / "nothing")
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(ObservationError, match="is not an observation"):
        load_observation(tmp_path / "notes.txt")


def test_files_that_were_not_used_are_named(folder):
    write(folder / "labels.png", np.ones(SHAPE, np.uint8))
    np.save(folder / "labels.npy", np.ones(SHAPE, int))
    (folder / "camera_info.yaml").write_text("width: 3")
    (folder / "notes.txt").write_text("x")
    write(folder / "frame0-depth.png", raw_depth())  # another view's
    write(folder / "color.png", np.ones((*SHAPE, 3), np.uint8))
    (warning,) = load_observation(folder).warnings
    assert warning == f"not used: camera_info.yaml, labels.npy in {folder}; was it meant to be?"


def test_arrays_that_were_not_used_are_named(tmp_path):
    arrays = {"depth": np.ones(SHAPE), "K": K, "masks_raw": np.ones(3), "note": np.ones(2)}
    np.savez(tmp_path / "view.npz", **arrays)
    (warning,) = load_observation(tmp_path / "view.npz").warnings
    assert "not used: masks_raw in" in warning


def test_a_view_names_what_is_its_own_only(folder):
    for name in ("a-depth.png", "a-labels.png", "a-mask.png", "b-depth.png", "b-labels.png"):
        write(folder / name, raw_depth())
    (warning,) = load_observation(folder / "a-depth.png").warnings
    assert "not used: a-mask.png in" in warning


def test_a_folder_of_views(obs, tmp_path):
    save_observation(obs, tmp_path / "one")
    save_observation(obs, tmp_path / "two.npz")
    (tmp_path / "notes").mkdir()
    assert views_in(tmp_path) == [tmp_path / "one", tmp_path / "two.npz"]
    assert views_in(tmp_path / "one") == [tmp_path / "one"]
    with pytest.raises(ObservationError, match=r"it holds 2 views, give one: one, two\.npz"):
        load_observation(tmp_path)
    (tmp_path / "two.npz").unlink()
    assert_same(load_observation(tmp_path), obs, 0.5001e-4)


def test_images_with_poses_are_a_folder_of_views(folder):
    (folder / "depth.png").unlink()
    for name in ("a.", "b-"):
        write(folder / f"{name}depth.png", raw_depth())
        np.save(folder / f"{name}labels.npy", np.ones(SHAPE, int))
        np.save(folder / f"{name}pose.npy", look_at((0.5, 0.2, 0.7)))
    np.save(folder / "c-points.npy", np.ones((100, 3)))
    found = views_in(folder)
    assert [path.name for path in found] == ["a.depth.png", "b-depth.png", "c-points.npy"]
    for path in found[:2]:
        view = load_observation(path)
        assert view.object_ids == (1,)
        np.testing.assert_allclose(view.pose, look_at((0.5, 0.2, 0.7)))


def test_background_ids_are_asked_of_any_form(scene, folder):
    write(folder / "depth.png", raw_depth())
    write(folder / "labels.png", np.arange(192, dtype=np.uint8).reshape(SHAPE) % 3)
    (folder / "scene_camera.json").rename(folder / "kept.json")
    (folder / "camera.json").write_text(json.dumps(CAMERA))
    assert load_observation(folder, background_ids=[2]).object_ids == (1,)
    (folder / "kept.json").rename(folder / "scene_camera.json")
    assert load_observation(scene, frame=7, background_ids=[3]).object_ids == (1,)


def test_bop_data_of_several_scenes_or_cameras_is_listed(scene, tmp_path):
    (scene / "scene_camera.json").rename(scene / "scene_camera_left.json")
    (scene / "scene_camera_right.json").write_text("{}")
    with pytest.raises(ObservationError, match=r"2 scenes or cameras.*_left\.json.*_right\.json"):
        load_observation(scene)
    with pytest.raises(ObservationError, match="lists no image"):
        load_observation(scene / "scene_camera_right.json")


def test_points_need_to_know_where_their_camera_was(tmp_path):
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    np.save(tmp_path / "a-points.npy", points)
    with pytest.raises(ObservationError, match=r"where the camera was.*'camera_position'"):
        load_observation(tmp_path / "a-points.npy")
    pose = {"T_world_camera": look_at((0.0, -2.5, 1.0)).tolist()}
    (tmp_path / "camera.json").write_text(json.dumps(pose))
    seen = load_observation(tmp_path / "a-points.npy")
    np.testing.assert_allclose(seen.pose, look_at((0.0, -2.5, 1.0)), atol=1e-12)


def test_labels_of_points_are_a_column_or_a_file(tmp_path):
    points = np.random.default_rng(0).uniform((-1, -1, 2), (1, 1, 4), (500, 3))
    ids = (np.arange(500) % 3).astype(float)
    np.save(tmp_path / "points.npy", np.column_stack([points, ids]))
    seen = load_observation(tmp_path)
    assert seen.object_ids == (1, 2)
    np.save(tmp_path / "points.npy", np.column_stack([points, ids + 0.5]))
    with pytest.raises(ObservationError, match="no whole ids"):
        load_observation(tmp_path)
    np.save(tmp_path / "points.npy", points)
    np.save(tmp_path / "labels.npy", ids.astype(int) * 7)
    assert load_observation(tmp_path).object_ids == (7, 14)
    np.save(tmp_path / "points.npy", points[:, :2])
    with pytest.raises(ObservationError, match=r"shape \(500, 2\); points are"):
        load_observation(tmp_path)


def test_a_mesh_is_no_view(tmp_path):
    trimesh.creation.box().export(tmp_path / "box.ply")
    with pytest.raises(ObservationError, match="is a mesh or empty"):
        load_observation(tmp_path / "box.ply")


def test_a_lens_is_undone_in_labels_of_any_form(folder):
    labels = np.zeros(SHAPE, int)
    labels[:4] = 1
    content = {**CAMERA, "distortion": [0.9, 0.0, 0.0, 0.0]}
    (folder / "camera.json").write_text(json.dumps(content))
    np.save(folder / "labels.npy", labels)
    ids = load_observation(folder)
    np.save(folder / "labels.npy", (labels == 1)[None])
    np.testing.assert_array_equal(load_observation(folder).labels, ids.labels)
    assert (ids.labels != labels).any()


def test_topics_are_asked_of_recordings_only(folder):
    for asked in ({"depth": "/x"}, {"at": 1.0}, {"frame": "base"}):
        with pytest.raises(ObservationError, match="no recording"):
            load_observation(folder, **asked)


def test_faulty_npz(tmp_path):
    path = tmp_path / "view.npz"
    path.write_bytes(b"junk")
    with pytest.raises(ObservationError, match=r"view\.npz.*not a readable"):
        load_observation(path)
    np.savez(path, depth=np.ones((3, 3)))
    with pytest.raises(ObservationError, match=r"no 'intrinsics' \(found: depth\)"):
        load_observation(path)
    np.savez(path, depth=np.array([None]), intrinsics=K)
    with pytest.raises(ObservationError, match="without pickle"):
        load_observation(path)
    np.savez(path, depth=np.full((12, 16), -np.inf), intrinsics=K)
    with pytest.raises(ObservationError, match="infinite everywhere"):
        load_observation(path)
    for wrong in (np.ones(2), 0.0, "far"):
        np.savez(path, depth=np.ones((12, 16)), intrinsics=K, max_range=wrong)
        with pytest.raises(ObservationError, match="max_range"):
            load_observation(path)
    with path.open("wb") as stream:
        np.save(stream, np.ones(3))
    with pytest.raises(ObservationError, match="bare"):
        load_observation(path)
    path.write_bytes(b"")
    with pytest.raises(ObservationError, match="not a readable"):
        load_observation(path)


def test_npz_cut_anywhere_is_refused(obs, tmp_path):
    path = tmp_path / "view.npz"
    save_observation(obs, path)
    whole = path.read_bytes()
    for length in range(0, len(whole), len(whole) // 40):
        path.write_bytes(whole[:length])
        with pytest.raises(ObservationError):
            load_observation(path)


def test_what_cannot_be_saved_is_explained(obs, tmp_path):
    with pytest.raises(ObservationError, match="not a folder"):
        save_observation(obs, tmp_path / "no" / "view.npz")
    with pytest.raises(ObservationError, match="cannot be written"):
        save_observation(obs, tmp_path / "view.txt")
    (tmp_path / "taken").write_text("x")
    with pytest.raises(ObservationError, match="cannot be written"):
        save_observation(obs, tmp_path / "taken")
    with pytest.raises(ObservationError, match="16 bits of millimetres"):
        save_observation(replace(obs, depth=obs.depth * 25, max_range=100.0), tmp_path / "far")
    tiny = obs.depth.copy()
    tiny[5, 5] = 1e-6
    with pytest.raises(ObservationError, match="no return"):
        save_observation(replace(obs, depth=tiny), tmp_path / "near")
    with pytest.raises(ObservationError, match="label 70000"):
        save_observation(replace(obs, labels=np.full(SHAPE, 70000)), tmp_path / "many")
    assert [p.name for p in tmp_path.iterdir()] == ["taken"]
