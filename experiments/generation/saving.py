# SPDX-License-Identifier: BSD-3-Clause
"""Mesh scenes on disk, in the BOP layout; what is saved loads again bit for bit.

    scene_camera.json, depth/, rgb/, mask_visib/   what `load_observation` reads
    scene_gt.json, scene_gt_info.json, mask/,
    models/                                        ground truth in BOP's terms
    ground_truth.json                              ground truth exactly, for `load_scene`

Millimetres, 16-bit depth in steps of 0.1 mm, image number 0. Models lie inside the
scene folder, so that a scene is one folder, and obj_id counts from 1 in each: several
scenes in one split of a BOP dataset need their models numbered anew and put beside the
split. Nothing that plans reads the ground truth.
"""

import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.generation.raycasting import DEPTH_UNIT, metres
from experiments.generation.scene import MeshObject, MeshScene
from experiments.generation.shapes import from_millimetres, to_millimetres
from experiments.generation.silhouettes import silhouettes
from vprism_plan._files import read_json, reading, replacing, write_text
from vprism_plan.errors import ObservationError
from vprism_plan.perception import load_observation
from vprism_plan.perception.camera import invert_transform
from vprism_plan.perception.observation import check_pose
from vprism_plan.simulation.camera import Camera
from vprism_plan.simulation.scene_io import GROUND_TRUTH, view_from_dict, view_to_dict

_FORMAT = "vprism_plan mesh scene, version 1"
_MILLIMETRE = 0.001
_STEM = "000000"  # of the one image


def save_scene(scene: MeshScene, path: str | Path) -> None:
    """Write a scene to a folder, whole or not at all.

    A folder that holds a mesh scene is replaced.

    Raises:
        ObservationError: `path` is a file, or a folder that holds something else.
    """
    target = Path(path)
    if target.exists() and not _replaceable(target):
        raise ObservationError(
            f"{target} exists and is no mesh scene; give a new folder, or remove it"
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{target.name}-", dir=target.parent) as work:
        new, old = Path(work) / "new", Path(work) / "old"
        _write_view(scene, new)
        _write_truth(scene, new)
        if target.exists():
            target.rename(old)
        try:
            new.rename(target)
        except OSError:
            if old.exists():
                old.rename(target)
            raise


def load_scene(path: str | Path) -> MeshScene:
    """Return the scene that `save_scene` wrote: the same bits in every array.

    Raises:
        ObservationError: the folder holds no mesh scene of this version, or a part of
            it is missing or damaged.
    """
    folder = Path(path)
    data = _read_truth(folder)
    with reading(folder / GROUND_TRUTH, "whole", ObservationError):
        return _assembled(folder, data)


def _assembled(folder: Path, data: dict[str, Any]) -> MeshScene:
    objects = []
    for index, entry in enumerate(data["objects"]):
        vertices, faces = _read_model(_model(folder, index))
        pose = np.array(entry["pose"], dtype=np.float64)
        objects.append(MeshObject(entry["name"], vertices, faces, pose))
    seen = load_observation(folder)
    camera, noise = view_from_dict(data)
    # A camera that the generator did not round differs from its file in the last bits.
    observation = replace(seen, T_world_camera=camera.T_world_camera, intrinsics=camera.intrinsics)
    return MeshScene(
        tuple(objects), camera, observation, noise, data["seed"], data["name"], data["kind"]
    )


def as_saved(camera: Camera) -> Camera:
    """Return a camera as `load_observation` reads it from a saved scene, to the last bit.

    It differs from the given one by less than a nanometre.
    """
    world_to_camera = np.eye(4)
    rotation, translation = _world_to_camera(camera)
    world_to_camera[:3, :3] = rotation
    world_to_camera[:3, 3] = translation * _MILLIMETRE
    return replace(camera, T_world_camera=invert_transform(check_pose(world_to_camera)))


def _world_to_camera(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation and translation (millimetres, rounded to a nanometre)."""
    inverse = invert_transform(camera.T_world_camera)
    return inverse[:3, :3], np.round(inverse[:3, 3] / _MILLIMETRE, 6)


def _replaceable(target: Path) -> bool:
    if not target.is_dir():
        return False
    if not any(target.iterdir()):
        return True
    truth = target / GROUND_TRUTH
    return truth.is_file() and _FORMAT in truth.read_text(encoding="utf-8")


def _write_view(scene: MeshScene, folder: Path) -> None:
    """Write what the camera saw."""
    seen = scene.observation
    raw = np.rint(seen.depth / metres(np.ones(1))[0]).astype(np.uint16)
    _write_png(folder / "depth" / f"{_STEM}.png", raw)
    _write_png(folder / "rgb" / f"{_STEM}.png", seen.color)
    for label in scene.object_ids:
        mask = np.where(seen.labels == label, 255, 0).astype(np.uint8)
        _write_png(folder / "mask_visib" / f"{_STEM}_{label - 1:06d}.png", mask)
    rotation, translation = _world_to_camera(scene.camera)
    camera = {
        "cam_K": scene.camera.intrinsics.ravel().tolist(),
        "depth_scale": DEPTH_UNIT,
        "cam_R_w2c": rotation.ravel().tolist(),
        "cam_t_w2c": translation.tolist(),
    }
    _write_json(folder / "scene_camera.json", {"0": camera})


def _write_truth(scene: MeshScene, folder: Path) -> None:
    """Write models and poses in BOP's terms, and the exact description."""
    (folder / "models").mkdir()
    to_camera = invert_transform(scene.camera.T_world_camera)
    poses, models = [], {}
    for index, body in enumerate(scene.objects):
        pose = to_camera @ body.pose
        poses.append(
            {
                "cam_R_m2c": pose[:3, :3].ravel().tolist(),
                "cam_t_m2c": (pose[:3, 3] / _MILLIMETRE).tolist(),
                "obj_id": index + 1,
            }
        )
        models[str(index + 1)] = _model_info(body.vertices / _MILLIMETRE)
        _write_model(body, _model(folder, index))
    _write_json(folder / "scene_gt.json", {"0": poses})
    masks, figures = silhouettes(scene)
    for index, mask in enumerate(masks):
        _write_png(folder / "mask" / f"{_STEM}_{index:06d}.png", 255 * mask.astype(np.uint8))
    _write_json(folder / "scene_gt_info.json", {"0": figures})
    _write_json(folder / "models" / "models_info.json", models)
    _write_json(folder / GROUND_TRUTH, _description(scene))


def _description(scene: MeshScene) -> dict[str, Any]:
    return {
        "format": _FORMAT,
        "name": scene.name,
        "kind": scene.kind,
        "seed": scene.seed,
        **view_to_dict(scene.camera, scene.noise),
        "objects": [{"name": body.name, "pose": body.pose.tolist()} for body in scene.objects],
    }


def _read_truth(folder: Path) -> dict[str, Any]:
    truth = folder / GROUND_TRUTH
    if not truth.is_file():
        raise ObservationError(f"{truth} does not exist; a mesh scene is written by its save()")
    data = read_json(truth, ObservationError)
    if data.get("format") != _FORMAT:
        raise ObservationError(
            f"{truth} has format {data.get('format')!r}; this version reads {_FORMAT!r}"
        )
    return data


def _model(folder: Path, index: int) -> Path:
    return folder / "models" / f"obj_{index + 1:06d}.ply"


def _model_info(corners: np.ndarray) -> dict[str, float]:
    """Return what BOP says of a model: box and diameter, millimetres."""
    from scipy.spatial import ConvexHull
    from scipy.spatial.distance import pdist

    low, size = corners.min(axis=0), np.ptp(corners, axis=0)
    outer = corners[ConvexHull(corners).vertices]
    info = {"diameter": float(pdist(outer).max())}
    for axis, name in enumerate("xyz"):
        info[f"min_{name}"] = float(low[axis])
        info[f"size_{name}"] = float(size[axis])
    return info


def _write_model(body: MeshObject, path: Path) -> None:
    import trimesh

    mesh = trimesh.Trimesh(to_millimetres(body.vertices), body.faces, process=False)
    content: Any = mesh.export(file_type="ply", vertex_normal=False)
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def _read_model(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (metres) and faces."""
    import trimesh

    if not path.is_file():
        raise ObservationError(f"{path} is missing; the scene is not whole")
    try:
        mesh = trimesh.load_mesh(path, process=False)
    # The reader fails in many ways on a damaged file.
    except Exception as error:
        raise ObservationError(f"{path} is not a readable PLY file: {error}") from error
    corners = from_millimetres(np.asarray(mesh.vertices).astype(np.float32))
    return corners, np.ascontiguousarray(mesh.faces, dtype=np.int64)


def _write_png(path: Path, image: np.ndarray) -> None:
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        Image.fromarray(image).save(temporary, format="PNG")


def _write_json(path: Path, content: dict[str, Any]) -> None:
    write_text(path, json.dumps(content, indent=1) + "\n")
