# SPDX-License-Identifier: BSD-3-Clause
"""Read an observation from the forms in which people keep them, and write two of these.

Units become metres here, once: whole numbers are multiplied by their scale, BOP's millimetres by
0.001. Lens distortion that a camera file states is undone: maps know pinholes only.
"""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vprism_plan import _files
from vprism_plan.errors import ObservationError
from vprism_plan.perception.bop import cameras_in, load_bop
from vprism_plan.perception.camera_files import (
    MATRICES,
    NAMES,
    camera_of,
    check_size,
    matrix,
    read_camera,
)
from vprism_plan.perception.cloud_files import read_cloud
from vprism_plan.perception.images import (
    MOST_UNPACKED,
    UINT16_MAX,
    metric,
    read_color,
    read_depth,
    read_labels,
    straight,
    without_no_data,
)
from vprism_plan.perception.observation import Observation
from vprism_plan.perception.recordings import is_recording, load_recording

_SAVED = (
    "depth", "labels", "intrinsics", "T_world_camera", "color", "plane", "robot_spheres",
    "max_range",
)  # fmt: skip
# What arrays and files are called; the first name is ours.
_LABELS = ("labels", "label", "masks", "mask", "segmentation", "segmap", "seg", "instances")
_ALIASES = {
    "points": ("points", "xyz", "point_cloud", "pc"),
    "labels": _LABELS,
    "color": ("color", "rgb"),
}
_POINTS = ("points", "xyz", "cloud", "point_cloud")
_IMAGES, _LABEL_FILES = (".png", ".tif", ".tiff"), (".png", ".tif", ".tiff", ".npy", ".json")
_DEPTH_FILES, _CLOUDS = (*_IMAGES, ".npy"), (".pcd", ".ply", ".npy")
# A file of these words and types is meant for a reader: if it was not used, that is said.
_MEANT = ("depth", "label", "mask", "seg", "camera", "intrinsic", "extrinsic", "pose", "calib",
          "points", "xyz", "cloud", "instance")  # fmt: skip
_MEANT_TYPES = (*_LABEL_FILES, *_CLOUDS, ".npz", ".yaml", ".yml", ".mat", ".txt", ".exr", ".jpg")
_FORMS = (
    "a .npz file, a folder with depth.png and camera.json, a BOP scene folder with "
    "scene_camera.json, a depth image named *depth.png with camera.json beside it, a point cloud "
    "(.pcd, .ply, .npy), or a recording (.bag, .mcap, .db3)"
)


def load_observation(
    path: str | Path,
    *,
    frame: int | str | None = None,
    depth: str | None = None,
    at: float | None = None,
    background_ids: Iterable[int] = (),
) -> Observation:
    """Load an observation; its form is recognised from the path.

    - `.npz` (read without pickle): `depth` (metres, float; or whole numbers with
      `depth_scale`) and `intrinsics` (3x3), or `points` with `camera_position`; optional `labels`,
      `T_world_camera`, `color`, `plane` (normal and offset), `robot_spheres` (rows x, y, z,
      radius; camera frame), `max_range` (metres).
    - a folder: `depth.png` (also .tif, .npy; 16-bit, or float metres) and `camera.json` with
      `fx fy cx cy` (pixels) and `depth_scale` (metres per raw unit), optional keys as above;
      or ROS's, Open3D's, OpenCV's, GraspNet's camera file. Optional `labels.*`, `color.png`,
      `pose.txt` (4x4, camera to world). OpenCV's lens distortion is undone by nearest pixel.
    - `X-depth.png`, with `X-labels.*` and so on, and `camera.json` beside it.
    - `.pcd`, `.ply`, `.npy` with points (in a folder `points.*`): labels are a field or a file
      beside it; so is where the camera was (`camera_position` or `T_world_camera`).
    - BOP data, millimetres: `frame` picks the image, default the first; labels are the
      ground-truth index + 1.
    - a recording, ROS 1 or 2, MCAP or RealSense: see `recordings.load_recording`; `depth` is the
      topic, `at` the time in seconds from its start, `frame` the TF frame that is the world.

    Labels may be of any form that `label_image` takes; raw depth that is the largest its
    pixel type holds (65535) is no return. Ids among `background_ids` become 0.

    Raises:
        ObservationError: one line that names the file, what is wrong and what is valid.
        MissingDependencyError: the form needs a library of the extra `formats`.
    """
    source = Path(path)
    if not source.exists():
        raise ObservationError(f"{source} does not exist; give {_FORMS}")
    more = {"background_ids": tuple(background_ids)}
    recording = is_recording(source)
    bop = [] if recording else cameras_in(source)
    if not recording and (depth is not None or at is not None):
        raise ObservationError(f"a topic or time was asked of {source}, which is no recording")
    if frame is not None and not recording and not (bop and isinstance(frame, int)):
        what = "not a BOP scene" if isinstance(frame, int) else "no recording"
        raise ObservationError(f"frame {frame} was asked of {source}, which is {what}")
    with _files.reading(source, "a readable observation", ObservationError):
        try:
            if recording:
                return load_recording(source, depth, frame, at, more)
            if bop:
                return load_bop(bop, frame, more)
            if source.is_dir():
                return _load_folder(source, more)
            if source.suffix == ".npz":
                return _load_npz(source, more)
            if (parts := _main_file(source)) is not None:
                return _load_files(source, *parts, more)
        except ObservationError as error:
            if str(source) in str(error):
                raise
            raise ObservationError(f"{source}: {error}") from error
    raise ObservationError(f"{source} is not an observation; give {_FORMS}")


def views_in(path: str | Path) -> list[Path]:
    """Return the views that a folder holds, sorted by name; of anything else the path itself.

    They are folders, `.npz` files, depth images `X-depth.png` and point clouds.
    """
    source = Path(path)
    if not source.is_dir() or _is_view(source):
        return [source]
    inside = sorted(source.iterdir())
    return [
        inner
        for inner in inside
        if (inner.is_dir() and _is_view(inner)) or inner.suffix == ".npz" or _main_file(inner)
    ]


def _is_view(folder: Path) -> bool:
    return bool(is_recording(folder) or cameras_in(folder) or _main_of(folder))


def _main_of(folder: Path) -> Path | None:
    """Return the depth or the points of a folder that is one view."""
    names = [("depth", _DEPTH_FILES), *((name, _CLOUDS) for name in _POINTS)]
    paths = (folder / f"{name}{suffix}" for name, suffixes in names for suffix in suffixes)
    return next(filter(Path.is_file, paths), None)


def _main_file(path: Path) -> tuple[str, bool] | None:
    """Return what names of files that belong to a view begin with, and whether it is a cloud."""
    if path.is_file() and path.stem.endswith("depth") and path.suffix in _DEPTH_FILES:
        return path.stem.removesuffix("depth"), False
    if not path.is_file() or path.suffix not in _CLOUDS:
        return None
    word = next((word for word in _POINTS if path.stem.endswith(word)), "")
    prefix = path.stem.removesuffix(word)
    if not word and path.suffix == ".npy" and any(w in path.stem.lower() for w in _MEANT):
        return None  # X-labels.npy, X-pose.npy
    return (prefix if word else f"{path.stem}-"), True


def _load_folder(folder: Path, more: dict[str, Any]) -> Observation:
    main = _main_of(folder)
    if main is None:
        inside = views_in(folder)
        if len(inside) == 1:
            return load_observation(inside[0], **more)
        some = ", ".join(view.name for view in inside[:5])
        held = f"; it holds {len(inside)} views, give one: {some}" if inside else ""
        raise ObservationError(f"{folder} has no depth.png{held}; give {_FORMS}")
    parts = _main_file(main)
    assert parts is not None
    return _load_files(main, *parts, more)


def _load_files(main: Path, prefix: str, cloud: bool, more: dict[str, Any]) -> Observation:
    """Load a depth image or a point cloud with what belongs to it in the same folder."""
    folder, used = main.parent, {main}

    def beside(names: Sequence[str], suffixes: Sequence[str], *starts: str) -> Path | None:
        paths = (folder / f"{s}{n}{x}" for s in (prefix, *starts) for n in names for x in suffixes)
        found = next(filter(Path.is_file, paths), None)
        used.update({found} if found else ())
        return found

    camera_path = beside(NAMES, ("",), "")
    labels, color = beside(_LABELS, _LABEL_FILES), beside(("color", "rgb"), (*_IMAGES, ".jpg"))
    pose = beside(("pose",), (".txt", ".npy"))
    if camera_path is None and not cloud:
        raise ObservationError(f"{folder / 'camera.json'} is missing")
    content = {} if camera_path is None else read_camera(camera_path)
    camera = camera_of(content, str(camera_path))
    given: dict[str, Any] = {
        "labels": None if labels is None else read_labels(labels),
        "T_world_camera": camera.pose if pose is None else _read_pose(pose),
        **camera.rest,
        **more,
    }
    left = (path.name for path in folder.iterdir() if path not in used)
    own = (name for name in left if name.startswith(prefix) and name.endswith(_MEANT_TYPES))
    given["warnings"] = _unused(own, prefix, folder)
    if cloud:
        points, own_labels, position = read_cloud(main)
        given["labels"] = own_labels if labels is None else given["labels"]
        position = position if camera.position is None else camera.position
        return _cloud(points, position, camera.intrinsics, given)
    if camera.intrinsics is None:
        raise ObservationError(f"{camera_path}: 'fx' is missing; give fx, fy, cx, cy or K (3x3)")
    raw = read_depth(main)
    if "fx" in content and camera.depth_scale is None and raw.dtype.kind != "f":
        raise ObservationError(
            f"{camera_path}: 'depth_scale' is missing; it must be a finite number"
        )
    check_size(content, raw.shape, str(camera_path))
    given["depth"], assumed = metric(raw, camera, str(camera_path))
    given["warnings"] += assumed
    given["color"] = None if color is None else read_color(color)
    return straight(given, camera)


def _read_pose(path: Path) -> np.ndarray:
    with _files.reading(path, "a readable pose (4x4 numbers)", ObservationError, _files.MOST_TEXT):
        value = np.load(path, allow_pickle=False) if path.suffix == ".npy" else np.loadtxt(path)
    return matrix(value, (4, 4), str(path))


def _unused(names: Iterable[str], prefix: str, place: Path) -> tuple[str, ...]:
    """Name files or arrays that were not read, of those that look like parts of a view."""
    left = sorted(name for name in names if name.removeprefix(prefix).lower().startswith(_MEANT))
    return (f"not used: {', '.join(left)} in {place}; was it meant to be?",) if left else ()


# ------------------------------------------------------------------------------------- clouds
def _cloud(
    points: np.ndarray, position: Any, intrinsics: Any, given: dict[str, Any]
) -> Observation:
    """Return the view of points; where the camera was may have to be guessed."""
    pose = given.pop("T_world_camera", None)
    if pose is not None:
        position = pose
    if position is None:
        position = np.zeros(3)
        shown = np.isfinite(points).all(-1) & points.any(-1)
        if not (points[shown][:, 2] > 0).all():
            raise ObservationError(
                "nothing says where the camera was, and the points are not all before it (z > 0) "
                "as in its own optical frame; give 'camera_position' (x, y, z) in the frame of the "
                "points, in camera.json beside the file or in the .npz"
            )
    return Observation.from_points(points, given.pop("labels"), position, intrinsics, **given)


# --------------------------------------------------------------------------------------- .npz
def _load_npz(path: Path, more: dict[str, Any]) -> Observation:
    known = (*_SAVED, "camera_position", "depth_scale", *MATRICES, *sum(_ALIASES.values(), ()))
    with (
        _files.reading(path, "a readable .npz without pickle", ObservationError),
        path.open("rb") as stream,  # numpy leaves a damaged file open
    ):
        if stream.read(6) == b"\x93NUMPY":
            raise ObservationError(f"{path} is a bare .npy array; save it with np.savez")
        stream.seek(0)
        archive = np.load(stream, allow_pickle=False)
        # What a member says it unpacks to is all that is ever unpacked of it.
        members = [m for m in archive.zip.infolist() if m.filename[:-4] in known]
        unpacked = sum(member.file_size for member in members)
        if unpacked > MOST_UNPACKED:
            most = f"an observation has at most {MOST_UNPACKED:,}"
            raise ObservationError(f"{path} unpacks to {unpacked:,} bytes; {most}")
        content = {key: archive[key] for key in known if key in archive.files}
        found = ", ".join(archive.files) or "nothing"
        unused = _unused((name for name in archive.files if name not in known), "", path)
    arrays = {
        key: next((content[name] for name in names if name in content), None)
        for key, names in _ALIASES.items()
    }
    points, depth = arrays.pop("points"), content.pop("depth", None)
    camera = camera_of(content, str(path))
    given = {**arrays, "T_world_camera": camera.pose, **camera.rest, **more, "warnings": unused}
    if points is not None and (depth is None or camera.intrinsics is None):
        return _cloud(points, camera.position, camera.intrinsics, given)
    for key, value in (("depth", depth), ("intrinsics", camera.intrinsics)):
        if value is None:
            wanted = "an observation needs depth (metres) and intrinsics (3x3), or points"
            raise ObservationError(f"has no {key!r} (found: {found}); {wanted}")
    if camera.depth_scale is not None:
        depth = without_no_data(np.asarray(depth)) * camera.depth_scale
    return straight(given | {"depth": depth}, camera)


# ------------------------------------------------------------------------------------- saving
def save_observation(obs: Observation, path: str | Path) -> None:
    """Save to an `.npz` file (exact) or, for a path without a suffix, to a folder.

    The folder form rounds depth to 0.1 mm, or to 1 mm where it exceeds 6.5 m. Files are
    replaced one by one, each at once, `camera.json` last: a folder whose writing was
    interrupted has no `camera.json` and does not load.

    Raises:
        ObservationError: another suffix, no such parent folder or, in the folder form, depth
            beyond 65 m or labels beyond 65535.
    """
    target = Path(path)
    if not target.parent.is_dir():
        raise ObservationError(f"{target.parent} is not a folder; create it before saving")
    plane = None if obs.plane is None else [*obs.plane.normal.tolist(), obs.plane.offset]
    if target.suffix == ".npz":
        content = {key: getattr(obs, key) for key in _SAVED} | {"plane": plane}
        arrays = {key: np.asarray(value) for key, value in content.items() if value is not None}
        with _files.replacing(target) as temporary:
            np.savez_compressed(temporary, allow_pickle=False, **arrays)
    elif target.is_dir() or (target.suffix == "" and not target.is_file()):
        _save_folder(obs, plane, target)
    else:
        raise ObservationError(f"{target} cannot be written; give a .npz file or a folder")


def _save_folder(obs: Observation, plane: list[float] | None, folder: Path) -> None:
    from PIL import Image

    scale = 1e-4 if float(obs.depth.max()) < 1e-4 * (UINT16_MAX - 1) else 1e-3
    raw = np.rint(obs.depth.astype(np.float64) / scale)
    if raw.max() >= UINT16_MAX:  # the largest value means "no data"
        far = f"depth reaches {obs.depth.max():g} m, more than 16 bits of millimetres hold"
        raise ObservationError(f"{far}; save as .npz")
    if ((raw == 0) & (obs.depth > 0)).any():
        near = f"depth of {obs.depth[obs.depth > 0].min():g} m would round to 'no return'"
        raise ObservationError(f"{near}; save as .npz")
    if obs.labels is not None and obs.labels.max() > UINT16_MAX:
        raise ObservationError(f"label {obs.labels.max()} does not fit in 16 bits; save as .npz")
    folder.mkdir(exist_ok=True)
    (folder / "camera.json").unlink(missing_ok=True)
    labels = None if obs.labels is None else obs.labels.astype(np.uint16)
    images = {"depth": raw.astype(np.uint16), "labels": labels, "color": obs.color}
    for name, pixels in images.items():
        path = folder / f"{name}.png"
        if pixels is None:
            path.unlink(missing_ok=True)
        else:
            with _files.replacing(path) as temporary:
                Image.fromarray(pixels).save(temporary)
    (fx, _, cx), (_, fy, cy), _ = obs.intrinsics.tolist()
    content = {
        "width": obs.shape[1],
        "height": obs.shape[0],
        **{"fx": fx, "fy": fy, "cx": cx, "cy": cy},
        "depth_scale": scale,
        "max_range": obs.max_range,
        "T_world_camera": None if obs.T_world_camera is None else obs.T_world_camera.tolist(),
        "plane": plane,
        "robot_spheres": None if obs.robot_spheres is None else obs.robot_spheres.tolist(),
    }
    present = {key: value for key, value in content.items() if value is not None}
    _files.write_text(folder / "camera.json", json.dumps(present, indent=2) + "\n")
