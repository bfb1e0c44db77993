# SPDX-License-Identifier: BSD-3-Clause
"""Views of BOP data sets (bop_toolkit, `docs/bop_datasets_format.md`), industrial ones too."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from vprism_plan import _files
from vprism_plan.errors import ObservationError
from vprism_plan.perception.camera_files import MILLIMETRE, camera_of
from vprism_plan.perception.images import read_color, read_depth, read_labels, straight
from vprism_plan.perception.observation import Observation

_CAMERAS = "scene_camera*.json"
_LISTED = 10


def cameras_in(path: Path) -> list[Path]:
    """Return the camera files of the scenes that a path is or holds; empty if it is no BOP data.

    A scene of one camera has `scene_camera.json`, of several (industrial sets)
    `scene_camera_NAME.json` with `depth_NAME/`; a data set has scenes in its splits.
    """
    if path.is_file():
        return [path] if path.match(_CAMERAS) else []
    for pattern in (_CAMERAS, f"*/{_CAMERAS}", f"*/*/{_CAMERAS}"):
        if found := sorted(path.glob(pattern)):
            return found
    return []


def load_bop(cameras: list[Path], image: Any, more: dict[str, Any]) -> Observation:
    """Load one image of a scene; labels are the ground-truth index + 1.

    Args:
        cameras: of `cameras_in`; there must be one.
        image: number; default the first.
        more: other attributes of the observation.

    Raises:
        ObservationError: what is missing or cannot be used, and what there is.
    """
    path = cameras[0]
    if len(cameras) > 1:
        raise ObservationError(
            f"there are {len(cameras)} scenes or cameras; give the file of one: {_some(cameras)}"
        )
    scene, sensor = path.parent, path.stem.removeprefix("scene_camera")
    content = _files.read_json(path, ObservationError)
    keys = {int(key): key for key in content if key.isdecimal()}
    if not keys:
        raise ObservationError(f"{path} lists no image; keys must be image numbers")
    chosen = min(keys) if image is None else image
    if chosen not in keys:
        raise ObservationError(f"{path} has no image {image}; it has {_some(sorted(keys))}")
    entry, stem = content[keys[chosen]], f"{chosen:06d}"
    if not isinstance(entry, dict) or "cam_K" not in entry:
        raise ObservationError(f"{path}: image {keys[chosen]} has no 'cam_K' (9 numbers)")
    camera = camera_of({"depth_scale": 1.0} | entry, f"{path}: image {keys[chosen]}", MILLIMETRE)
    depth = _existing(scene / f"depth{sensor}" / stem)
    if depth is None:
        raise ObservationError(f"{scene / f'depth{sensor}' / stem}.png is missing")
    raw = read_depth(depth)
    assert camera.depth_scale is not None
    color = _existing(scene / f"rgb{sensor}" / stem) or _existing(scene / f"gray{sensor}" / stem)
    masks = scene / f"mask_visib{sensor}"
    found: tuple[str, ...] = ()
    if not masks.is_dir() and (whole := scene / f"mask{sensor}").is_dir():
        masks = whole
        found = (
            f"{scene} has no mask_visib{sensor}/: labels are whole silhouettes from mask{sensor}/, "
            "and where they overlap the smaller one's",
        )
    given = {
        "depth": raw * camera.depth_scale,
        "labels": _labels(masks, stem, raw.shape),
        "T_world_camera": camera.pose,
        "color": None if color is None else read_color(color),
        "warnings": found,
    }
    return straight(given | more, camera)


def _some(names: Iterable[Any]) -> str:
    listed = [str(name) for name in names]
    return ", ".join(listed[:_LISTED]) + (", ..." if len(listed) > _LISTED else "")


def _existing(stem: Path) -> Path | None:
    paths = (stem.with_name(stem.name + suffix) for suffix in (".png", ".tif", ".jpg"))
    return next(filter(Path.is_file, paths), None)


def _labels(folder: Path, stem: str, shape: tuple[int, ...]) -> dict[int, np.ndarray] | None:
    """Masks of one image by id, or None if the scene has no masks at all."""
    if not folder.is_dir():
        return None
    masks = {}
    for path in sorted(folder.glob(f"{stem}_*.png")):
        index = path.stem.split("_")[1]
        if not index.isdecimal():
            raise ObservationError(f"{path} is not named IMAGE_INDEX.png (six digits each)")
        mask = np.asarray(read_labels(path))
        if mask.shape != shape:
            raise ObservationError(f"{path} has shape {mask.shape} but depth has {shape}")
        masks[int(index) + 1] = mask > 0
    return masks
