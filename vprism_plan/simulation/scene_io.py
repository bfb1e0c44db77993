# SPDX-License-Identifier: BSD-3-Clause
"""Scenes on disk: what the camera saw, and beside it, apart, what is really there.

`ground_truth.json` is never read by `load_observation`: nothing that plans sees it.
"""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from vprism_plan._files import read_json, reading, write_text
from vprism_plan.errors import ObservationError
from vprism_plan.simulation.camera import Camera, DepthNoise
from vprism_plan.simulation.scenes import Scene
from vprism_plan.simulation.solids import solid_from_dict

_FORMAT = "vprism_plan scene, version 1"
GROUND_TRUTH = "ground_truth.json"


def view_to_dict(camera: Camera, noise: DepthNoise | None) -> dict[str, Any]:
    """Return `camera` and `noise`, JSON-ready and exact."""
    pose, intrinsics = camera.T_world_camera.tolist(), camera.intrinsics.tolist()
    return {
        "camera": {**vars(camera), "T_world_camera": pose, "intrinsics": intrinsics},
        "noise": None if noise is None else asdict(noise),
    }


def view_from_dict(data: dict[str, Any]) -> tuple[Camera, DepthNoise | None]:
    """Rebuild what `view_to_dict` described."""
    camera = dict(data["camera"])
    for name in ("T_world_camera", "intrinsics"):
        camera[name] = np.asarray(camera[name], dtype=np.float64)
    return Camera(**camera), None if data["noise"] is None else DepthNoise(**data["noise"])


def save_scene(scene: Scene, path: str | Path) -> None:
    """Write the observation (folder, or `.npz` by suffix) and the ground truth beside it.

    For a folder the truth is `<folder>/ground_truth.json`, for `scene.npz` it is
    `scene.ground_truth.json`.
    """
    from vprism_plan.perception import save_observation

    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_observation(scene.observation, path)
    truth = {
        "format": _FORMAT,
        "name": scene.name,
        "seed": scene.seed,
        "labels": list(scene.labels),
        "solids": [solid.to_dict() for solid in scene.solids],
        **view_to_dict(scene.camera, scene.noise),
    }
    write_text(_truth_path(path), json.dumps(truth, indent=1) + "\n")


def load_ground_truth(path: str | Path) -> Scene:
    """Return the scene that was saved at `path` (the same path as given to `save_scene`)."""
    truth = _truth_path(Path(path))
    if not truth.is_file():
        raise ObservationError(f"{truth} does not exist; a scene is written by save_scene")
    with reading(truth, "the truth of a scene", ObservationError):
        data = read_json(truth, ObservationError)
        if data.get("format") != _FORMAT:
            raise ObservationError(
                f"ground truth has format {data.get('format')!r}; this version reads {_FORMAT!r}"
            )
        solids, labels = tuple(map(solid_from_dict, data["solids"])), tuple(data["labels"])
        return Scene(solids, labels, *view_from_dict(data), data["seed"], data["name"])


def _truth_path(path: Path) -> Path:
    if path.suffix == ".npz":
        return path.with_name(f"{path.stem}.{GROUND_TRUTH}")
    return path / GROUND_TRUTH
