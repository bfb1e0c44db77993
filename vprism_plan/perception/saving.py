# SPDX-License-Identifier: BSD-3-Clause
"""Write an observation so that `load_observation` reads it back."""

import json
from pathlib import Path

import numpy as np

from vprism_plan.errors import ObservationError
from vprism_plan.perception._files import write_atomically
from vprism_plan.perception.observation import Observation

_UINT16_MAX = 65535


def save_observation(obs: Observation, path: str | Path) -> None:
    """Save to an `.npz` file (exact) or, for a path without a suffix, to a folder.

    The folder form rounds depth to 0.1 mm, or to 1 mm where it exceeds 6.5 m. Files are
    replaced one by one, each at once, `camera.json` last: a folder whose writing was
    interrupted has no `camera.json` and does not load.

    Raises:
        ObservationError: another suffix, depth beyond 65 m or labels beyond 65535 in the
            folder form, or a parent folder that does not exist.
    """
    target = Path(path)
    if not target.parent.is_dir():
        raise ObservationError(f"{target.parent} is not a folder; create it before saving")
    if target.suffix == ".npz":
        _save_npz(obs, target)
    elif target.is_dir() or (target.suffix == "" and not target.is_file()):
        _save_folder(obs, target)
    else:
        raise ObservationError(f"{target} cannot be written; give a .npz file or a folder")


def _plane_numbers(obs: Observation) -> list[float] | None:
    return None if obs.plane is None else [*obs.plane.normal.tolist(), obs.plane.offset]


def _save_npz(obs: Observation, path: Path) -> None:
    arrays = {
        "depth": obs.depth,
        "labels": obs.labels,
        "intrinsics": obs.intrinsics,
        "T_world_camera": obs.T_world_camera,
        "color": obs.color,
        "plane": _plane_numbers(obs),
        "robot_spheres": obs.robot_spheres,
        "max_range": obs.max_range,
    }
    present = {key: np.asarray(value) for key, value in arrays.items() if value is not None}
    write_atomically(
        path, lambda stream: np.savez_compressed(stream, allow_pickle=False, **present)
    )


def _save_folder(obs: Observation, folder: Path) -> None:
    scale = 1e-4 if float(obs.depth.max()) < 1e-4 * (_UINT16_MAX - 1) else 1e-3
    raw = np.rint(obs.depth.astype(np.float64) / scale)
    if raw.max() >= _UINT16_MAX:  # the largest value means "no data"
        raise ObservationError(
            f"depth reaches {obs.depth.max():g} m, more than 16 bits of millimetres hold; save "
            "as .npz"
        )
    if ((raw == 0) & (obs.depth > 0)).any():
        raise ObservationError(
            f"depth of {obs.depth[obs.depth > 0].min():g} m would round to 'no return'; save as "
            ".npz"
        )
    if obs.labels is not None and obs.labels.max() > _UINT16_MAX:
        raise ObservationError(f"label {obs.labels.max()} does not fit in 16 bits; save as .npz")
    folder.mkdir(exist_ok=True)
    (folder / "camera.json").unlink(missing_ok=True)
    _write_png(folder / "depth.png", raw.astype(np.uint16))
    labels = None if obs.labels is None else obs.labels.astype(np.uint16)
    for name, image in (("labels.png", labels), ("color.png", obs.color)):
        if image is None:
            (folder / name).unlink(missing_ok=True)
        else:
            _write_png(folder / name, image)
    _write_camera(obs, scale, folder / "camera.json")


def _write_png(path: Path, image: np.ndarray) -> None:
    from PIL import Image

    write_atomically(path, lambda stream: Image.fromarray(image).save(stream, format="PNG"))


def _write_camera(obs: Observation, scale: float, path: Path) -> None:
    matrix = obs.intrinsics
    content: dict[str, object] = {
        "width": obs.shape[1],
        "height": obs.shape[0],
        "fx": matrix[0, 0],
        "fy": matrix[1, 1],
        "cx": matrix[0, 2],
        "cy": matrix[1, 2],
        "depth_scale": scale,
        "max_range": obs.max_range,
    }
    if obs.T_world_camera is not None:
        content["T_world_camera"] = obs.T_world_camera.tolist()
    if obs.plane is not None:
        content["plane"] = _plane_numbers(obs)
    if obs.robot_spheres is not None:
        content["robot_spheres"] = obs.robot_spheres.tolist()
    text = json.dumps(content, indent=2) + "\n"
    write_atomically(path, lambda stream: stream.write(text.encode()))
