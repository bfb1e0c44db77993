# SPDX-License-Identifier: BSD-3-Clause
"""Read an observation from the forms in which people keep them.

Units become metres here, once: 16-bit depth is multiplied by its scale, BOP's
millimetres are divided by 1000.
"""

from pathlib import Path
from typing import Any

import numpy as np

from vprism_plan._files import reading
from vprism_plan.errors import ObservationError
from vprism_plan.perception import _files
from vprism_plan.perception._bop import load_bop
from vprism_plan.perception._distortion import read_distortion, undistort
from vprism_plan.perception.observation import DEFAULT_MAX_RANGE, Observation
from vprism_plan.perception.plane import Plane

_NPZ_KEYS = (
    "depth",
    "labels",
    "intrinsics",
    "T_world_camera",
    "color",
    "plane",
    "robot_spheres",
    "max_range",
)
# Bytes of all arrays of an archive: the largest image in float64 with labels and color.
_MOST_UNPACKED = 16 * _files.MOST_PIXELS
_FORMS = (
    "a .npz file, a folder with depth.png and camera.json, a BOP scene folder with "
    "scene_camera.json, or a depth image named *depth.png with camera.json beside it"
)


def load_observation(path: str | Path, *, frame: int | None = None) -> Observation:
    """Load an observation; its form is recognised from the path.

    - `.npz` (read without pickle): `depth` (metres, float) and `intrinsics` (3x3);
      optional `labels`, `T_world_camera`, `color`, `plane` (normal and offset),
      `robot_spheres` (rows x, y, z, radius; camera frame), `max_range` (metres).
    - a folder: `depth.png` (16-bit), `camera.json` with `fx fy cx cy` (pixels) and
      `depth_scale` (metres per raw unit), optional `T_world_camera` (4x4), `plane`,
      `robot_spheres` and `max_range`; optional `labels.png` and `color.png`.
      A lens's `distortion` (OpenCV's k1 k2 p1 p2 k3, or 8 numbers) is undone by nearest pixel.
    - a BOP scene folder (`scene_camera.json`, `depth/`, millimetres): `frame` picks the
      image, default the first; labels are the ground-truth index + 1 from
      `mask_visib/`, the pose comes from `cam_R_w2c`, `cam_t_w2c` where present.
    - a depth image `X-depth.png`: `camera.json` beside it, and optional `X-color.png`,
      `X-labels.png`.

    Raw depth that is the largest its pixel type holds (65535) is no return.

    Raises:
        ObservationError: one line that names the file, what is wrong and what is valid.
    """
    source = Path(path)
    if not source.exists():
        raise ObservationError(f"{source} does not exist; give {_FORMS}")
    is_bop = source.is_dir() and (source / "scene_camera.json").is_file()
    if frame is not None and not is_bop:
        raise ObservationError(f"frame {frame} was asked of {source}, which is not a BOP scene")
    if is_bop:
        return _named(source, lambda: load_bop(source, frame))
    if source.is_dir():
        return _named(source, lambda: _load_folder(source))
    if source.suffix == ".npz":
        return _named(source, lambda: _load_npz(source))
    if source.stem.endswith("depth"):
        return _named(source, lambda: _load_depth_image(source))
    raise ObservationError(f"{source} is not an observation; give {_FORMS}")


def _named(source: Path, load: Any) -> Observation:
    """Run a loader; an error about the content gets the path in front."""
    with reading(source, "a readable observation", ObservationError):
        try:
            observation: Observation = load()
        except ObservationError as error:
            if str(source) in str(error):
                raise
            raise ObservationError(f"{source}: {error}") from error
        return observation


def _load_npz(path: Path) -> Observation:
    with (
        reading(path, "a readable .npz without pickle", ObservationError),
        path.open("rb") as stream,  # numpy leaves a damaged file open
    ):
        if stream.read(6) == b"\x93NUMPY":
            raise ObservationError(f"{path} is a bare .npy array; save it with np.savez")
        stream.seek(0)
        archive = np.load(stream, allow_pickle=False)
        # What a member says it unpacks to is all that is ever unpacked of it.
        members = [m for m in archive.zip.infolist() if m.filename[:-4] in _NPZ_KEYS]
        unpacked = sum(member.file_size for member in members)
        if unpacked > _MOST_UNPACKED:
            raise ObservationError(
                f"{path} unpacks to {unpacked:,} bytes; an observation has at most "
                f"{_MOST_UNPACKED:,}"
            )
        content = {key: archive[key] for key in _NPZ_KEYS if key in archive.files}
        found = list(archive.files)
    for key in ("depth", "intrinsics"):
        if key not in content:
            raise ObservationError(
                f"has no {key!r} (found: {', '.join(found) or 'nothing'}); an observation needs "
                "depth (metres) and intrinsics (3x3)"
            )
    return Observation(
        content["depth"],
        content.get("labels"),
        content["intrinsics"],
        content.get("T_world_camera"),
        content.get("color"),
        _plane(content.get("plane"), "plane"),
        content.get("robot_spheres"),
        max_range=float(
            _files.matrix(content.get("max_range", DEFAULT_MAX_RANGE), (), "max_range")
        ),
    )


def _plane(value: Any, what: str) -> Plane | None:
    if value is None:
        return None
    numbers = _files.matrix(value, (4,), what)
    return Plane(numbers[:3], float(numbers[3]))


def _load_folder(folder: Path) -> Observation:
    if not (folder / "depth.png").is_file():
        raise ObservationError(f"{folder} has no depth.png; give {_FORMS}")
    return _assemble(
        folder / "depth.png", folder / "camera.json", folder / "labels.png", folder / "color.png"
    )


def _load_depth_image(path: Path) -> Observation:
    prefix = path.stem[: -len("depth")]
    return _assemble(
        path,
        path.with_name("camera.json"),
        path.with_name(f"{prefix}labels{path.suffix}"),
        path.with_name(f"{prefix}color{path.suffix}"),
    )


def _assemble(depth: Path, camera: Path, labels: Path, color: Path) -> Observation:
    content = _files.read_json(camera)
    raw = _files.read_depth_image(depth)
    for key, size in (("width", raw.shape[1]), ("height", raw.shape[0])):
        if key in content and content[key] != size:
            raise ObservationError(
                f"{camera}: {key!r} is {content[key]} but {depth.name} is {raw.shape[1]}x"
                f"{raw.shape[0]}; scale the intrinsics to the image's resolution"
            )
    focal = [_files.number(content, key, camera) for key in ("fx", "fy", "cx", "cy")]
    intrinsics = np.array([[focal[0], 0, focal[2]], [0, focal[1], focal[3]], [0, 0, 1.0]])
    scale = _files.positive_number(content, "depth_scale", camera)
    pose = content.get("T_world_camera")
    if pose is not None:
        pose = _files.matrix(pose, (4, 4), f"{camera}: 'T_world_camera'")
    lens = read_distortion(content, camera)
    return Observation(
        undistort(raw * np.float64(scale), lens, intrinsics),
        undistort(_files.read_label_image(labels), lens, intrinsics) if labels.is_file() else None,
        intrinsics,
        pose,
        undistort(_files.read_color_image(color), lens, intrinsics) if color.is_file() else None,
        _plane(content.get("plane"), f"{camera}: 'plane'"),
        content.get("robot_spheres"),
        max_range=_files.positive_number(content, "max_range", camera, default=DEFAULT_MAX_RANGE),
    )
