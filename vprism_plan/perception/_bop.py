# SPDX-License-Identifier: BSD-3-Clause
"""BOP scene folders (bop_toolkit, `docs/bop_datasets_format.md`).

`scene_camera.json` maps an image number to `cam_K` (9 numbers, row by row),
`depth_scale` (raw * scale = millimetres) and optionally `cam_R_w2c`, `cam_t_w2c` (mm).
"""

from pathlib import Path
from typing import Any

import numpy as np

from vprism_plan.errors import ObservationError
from vprism_plan.perception import _files
from vprism_plan.perception._distortion import read_distortion, undistort
from vprism_plan.perception._validation import check_pose
from vprism_plan.perception.camera import invert_transform
from vprism_plan.perception.observation import Observation

_MILLIMETRE = 0.001


def load_bop(scene: Path, frame: int | None) -> Observation:
    """Load one image of a BOP scene; object label = ground-truth index + 1."""
    path = scene / "scene_camera.json"
    cameras = _files.read_json(path)
    key = _frame_key(cameras, frame, path)
    camera = cameras[key]
    if not isinstance(camera, dict) or "cam_K" not in camera:
        raise ObservationError(f"{path}: image {key} has no 'cam_K' (9 numbers)")
    stem = f"{int(key):06d}"
    raw = _files.read_depth_image(_existing(scene / "depth", stem, (".png", ".tif")))
    scale = _files.positive_number(camera, "depth_scale", path, default=1.0)
    color = _optional(scene / "rgb", stem, (".png", ".jpg"))
    intrinsics = _files.matrix(camera["cam_K"], (3, 3), f"{path}: image {key} 'cam_K'")
    lens = read_distortion(camera, path)
    return Observation(
        undistort(raw * (scale * _MILLIMETRE), lens, intrinsics),
        undistort(_labels(scene / "mask_visib", stem, raw.shape), lens, intrinsics),
        intrinsics,
        _pose(camera, f"{path}: image {key}"),
        undistort(None if color is None else _files.read_color_image(color), lens, intrinsics),
    )


def _frame_key(cameras: dict[str, Any], frame: int | None, path: Path) -> str:
    numbers = {int(key): key for key in cameras if key.isdecimal()}
    if not numbers:
        raise ObservationError(f"{path} lists no image; keys must be image numbers")
    if frame is None:
        return numbers[min(numbers)]
    if frame not in numbers:
        listed = ", ".join(str(n) for n in sorted(numbers)[:10])
        more = ", ..." if len(numbers) > 10 else ""
        raise ObservationError(f"{path} has no image {frame}; it has {listed}{more}")
    return numbers[frame]


def _optional(folder: Path, stem: str, suffixes: tuple[str, ...]) -> Path | None:
    for suffix in suffixes:
        if (folder / f"{stem}{suffix}").is_file():
            return folder / f"{stem}{suffix}"
    return None


def _existing(folder: Path, stem: str, suffixes: tuple[str, ...]) -> Path:
    found = _optional(folder, stem, suffixes)
    if found is None:
        raise ObservationError(f"{folder / (stem + suffixes[0])} is missing")
    return found


def _labels(folder: Path, stem: str, shape: tuple[int, ...]) -> np.ndarray | None:
    """Merge the visible masks of one image, or None if the scene has no masks at all."""
    if not folder.is_dir():
        return None
    labels = np.zeros(shape, dtype=np.int32)
    for mask in sorted(folder.glob(f"{stem}_*.png")):
        index = mask.stem.split("_")[1]
        if not index.isdecimal():
            raise ObservationError(f"{mask} is not named IMAGE_INDEX.png (six digits each)")
        visible = _files.read_label_image(mask) > 0
        if visible.shape != shape:
            raise ObservationError(f"{mask} has shape {visible.shape} but depth has {shape}")
        labels[visible] = int(index) + 1
    return labels


def _pose(camera: dict[str, Any], what: str) -> np.ndarray | None:
    if "cam_R_w2c" not in camera and "cam_t_w2c" not in camera:
        return None
    for key in ("cam_R_w2c", "cam_t_w2c"):
        if key not in camera:
            raise ObservationError(f"{what} has only half a pose: {key!r} is missing")
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = _files.matrix(camera["cam_R_w2c"], (3, 3), f"{what} 'cam_R_w2c'")
    world_to_camera[:3, 3] = (
        _files.matrix(camera["cam_t_w2c"], (3,), f"{what} 'cam_t_w2c'") * _MILLIMETRE
    )
    return invert_transform(check_pose(world_to_camera))
