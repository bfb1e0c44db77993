# SPDX-License-Identifier: BSD-3-Clause
"""Read an observation from the forms in which people keep them, and write two of these.

Units become metres here, once: 16-bit depth is multiplied by its scale, BOP's millimetres by
0.001. Lens distortion that a camera file states is undone: maps know pinholes only.
"""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Float

from vprism_plan import _files
from vprism_plan._arguments import number
from vprism_plan.errors import ObservationError
from vprism_plan.perception.camera import invert_transform, undistort
from vprism_plan.perception.observation import (
    DEFAULT_MAX_RANGE,
    Observation,
    check_intrinsics,
    check_pose,
)
from vprism_plan.perception.plane import Plane

_KEYS = ("depth", "labels", "intrinsics", "T_world_camera", "color", "plane")
_NPZ_KEYS = (*_KEYS, "robot_spheres", "max_range")
_MOST_PIXELS = 2**25  # of an image that is read: 33 million
_MOST_UNPACKED = 16 * _MOST_PIXELS  # bytes of an archive: float64 with labels and color
# PIL has readers for fifty formats, some of which start other programs.
_IMAGE_FORMATS = ("PNG", "TIFF", "JPEG", "PPM", "BMP")
_DEPTH_MODES = ("I;16", "I;16B", "I;16L", "I;16N", "I")
_LABEL_MODES = (*_DEPTH_MODES, "L", "P", "1")
_UINT16_MAX = 65535
_MILLIMETRE = 0.001
_FORMS = (
    "a .npz file, a folder with depth.png and camera.json, a BOP scene folder with "
    "scene_camera.json, or a depth image named *depth.png with camera.json beside it"
)
_LENS_KEYS = ("distortion", "D", "coeffs", "dist_coeffs", "distortion_coefficients")
_LENS_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
# What OpenCV, ROS, RealSense and others call the polynomial of `undistort`.
_LENS_MODELS = ("plumb_bob", "rational_polynomial", "brown_conrady", "opencv", "radtan", "pinhole")


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
    - a depth image `X-depth.png`: `camera.json` beside it, optional `X-color.png`, `X-labels.png`.

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
    with _files.reading(source, "a readable observation", ObservationError):
        try:
            if is_bop:
                return _load_bop(source, frame)
            if source.is_dir():
                if not (source / "depth.png").is_file():
                    raise ObservationError(f"{source} has no depth.png; give {_FORMS}")
                return _load_images(source / "depth.png", "")
            if source.suffix == ".npz":
                return _load_npz(source)
            if source.stem.endswith("depth"):
                return _load_images(source, source.stem[: -len("depth")])
        except ObservationError as error:
            if str(source) in str(error):
                raise
            raise ObservationError(f"{source}: {error}") from error
    raise ObservationError(f"{source} is not an observation; give {_FORMS}")


def _load_npz(path: Path) -> Observation:
    with (
        _files.reading(path, "a readable .npz without pickle", ObservationError),
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
            most = f"an observation has at most {_MOST_UNPACKED:,}"
            raise ObservationError(f"{path} unpacks to {unpacked:,} bytes; {most}")
        content = {key: archive[key] for key in _NPZ_KEYS if key in archive.files}
        found = ", ".join(archive.files) or "nothing"
    for key in ("depth", "intrinsics"):
        if key not in content:
            wanted = "an observation needs depth (metres) and intrinsics (3x3)"
            raise ObservationError(f"has no {key!r} (found: {found}); {wanted}")
    content["plane"] = _plane(content.get("plane"), "plane")
    content["max_range"] = float(
        _matrix(content.get("max_range", DEFAULT_MAX_RANGE), (), "max_range")
    )
    return Observation(**{"labels": None, **content})


def _load_images(depth: Path, prefix: str) -> Observation:
    camera = depth.with_name("camera.json")
    content, raw = _files.read_json(camera, ObservationError), _read_depth(depth)
    for key, size in (("width", raw.shape[1]), ("height", raw.shape[0])):
        if key in content and content[key] != size:
            found = f"{key!r} is {content[key]} but {depth.name} is {raw.shape[1]}x{raw.shape[0]}"
            remedy = "scale the intrinsics to the image's resolution"
            raise ObservationError(f"{camera}: {found}; {remedy}")
    fx, fy, cx, cy = (_number(content, key, camera) for key in ("fx", "fy", "cx", "cy"))
    scale = _number(content, "depth_scale", camera)
    pose = content.get("T_world_camera")
    if pose is not None:
        pose = _matrix(pose, (4, 4), f"{camera}: 'T_world_camera'")
    labels, color = (depth.with_name(f"{prefix}{n}{depth.suffix}") for n in ("labels", "color"))
    given = {
        "depth": raw * np.float64(scale),
        "labels": _read_labels(labels) if labels.is_file() else None,
        "intrinsics": np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]),
        "T_world_camera": pose,
        "color": _read_color(color) if color.is_file() else None,
        "plane": _plane(content.get("plane"), f"{camera}: 'plane'"),
        "robot_spheres": content.get("robot_spheres"),
        "max_range": _number(content, "max_range", camera, DEFAULT_MAX_RANGE),
    }
    return _straight(given, _read_distortion(content, camera))


def _plane(value: Any, what: str) -> Plane | None:
    if value is None:
        return None
    numbers = _matrix(value, (4,), what)
    return Plane(numbers[:3], float(numbers[3]))


# ---------------------------------------------------------------------------------------- BOP
def _load_bop(scene: Path, frame: int | None) -> Observation:
    """Load one image of a BOP scene (bop_toolkit, `docs/bop_datasets_format.md`)."""
    path = scene / "scene_camera.json"
    cameras = _files.read_json(path, ObservationError)
    keys = {int(key): key for key in cameras if key.isdecimal()}
    if not keys:
        raise ObservationError(f"{path} lists no image; keys must be image numbers")
    chosen = min(keys) if frame is None else frame
    if chosen not in keys:
        listed = ", ".join(map(str, sorted(keys)[:10])) + (", ..." if len(keys) > 10 else "")
        raise ObservationError(f"{path} has no image {frame}; it has {listed}")
    key, stem = keys[chosen], f"{chosen:06d}"
    camera = cameras[key]
    if not isinstance(camera, dict) or "cam_K" not in camera:
        raise ObservationError(f"{path}: image {key} has no 'cam_K' (9 numbers)")
    depth = _existing(scene / "depth" / stem, ".png", ".tif")
    if depth is None:
        raise ObservationError(f"{scene / 'depth' / stem}.png is missing")
    raw, color = _read_depth(depth), _existing(scene / "rgb" / stem, ".png", ".jpg")
    what = f"{path}: image {key}"
    given = {
        "depth": raw * (_number(camera, "depth_scale", path, 1.0) * _MILLIMETRE),
        "labels": _bop_labels(scene / "mask_visib", stem, raw.shape),
        "intrinsics": _matrix(camera["cam_K"], (3, 3), f"{what} 'cam_K'"),
        "T_world_camera": _bop_pose(camera, what),
        "color": None if color is None else _read_color(color),
    }
    return _straight(given, _read_distortion(camera, path))


def _existing(stem: Path, *suffixes: str) -> Path | None:
    paths = (stem.with_name(stem.name + suffix) for suffix in suffixes)
    return next(filter(Path.is_file, paths), None)


def _bop_labels(folder: Path, stem: str, shape: tuple[int, ...]) -> np.ndarray | None:
    """Merge the visible masks of one image, or None if the scene has no masks at all."""
    if not folder.is_dir():
        return None
    labels = np.zeros(shape, dtype=np.int32)
    for mask in sorted(folder.glob(f"{stem}_*.png")):
        index = mask.stem.split("_")[1]
        if not index.isdecimal():
            raise ObservationError(f"{mask} is not named IMAGE_INDEX.png (six digits each)")
        visible = _read_labels(mask) > 0
        if visible.shape != shape:
            raise ObservationError(f"{mask} has shape {visible.shape} but depth has {shape}")
        labels[visible] = int(index) + 1
    return labels


def _bop_pose(camera: dict[str, Any], what: str) -> np.ndarray | None:
    keys = ("cam_R_w2c", "cam_t_w2c")
    missing = [key for key in keys if key not in camera]
    if len(missing) == 2:
        return None
    if missing:
        raise ObservationError(f"{what} has only half a pose: {missing[0]!r} is missing")
    turn, shift = (
        _matrix(camera[key], shape, f"{what} {key!r}")
        for key, shape in zip(keys, ((3, 3), (3,)), strict=True)
    )
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3], world_to_camera[:3, 3] = turn, shift * _MILLIMETRE
    return invert_transform(check_pose(world_to_camera))


# --------------------------------------------------------------------------------------- lens
def _straight(given: dict[str, Any], lens: Float[np.ndarray, " 8"] | None) -> Observation:
    """Return the observation of what a lens of this distortion shows."""
    for name in ("depth", "labels", "color"):
        image = given[name]
        if lens is not None and image is not None:
            intrinsics = check_intrinsics(given["intrinsics"], image.shape[:2])
            given[name] = undistort(image, lens, intrinsics)
    return Observation(**given)


def _read_distortion(content: dict[str, Any], path: Path) -> Float[np.ndarray, " 8"] | None:
    """Return k1 k2 p1 p2 k3 k4 k5 k6 (OpenCV's order) of a camera file; None if it states none."""
    key = next((key for key in _LENS_KEYS if content.get(key) is not None), None)
    if key is None:
        values = np.array([_number(content, name, path, 0.0) for name in _LENS_NAMES])
    else:
        value = content[key]
        value = value.get("data") if isinstance(value, dict) else value
        try:
            values = np.array(value, dtype=np.float64).ravel()
        except (TypeError, ValueError) as error:
            raise ObservationError(f"{path}: {key!r} is not a list of numbers: {error}") from error
    if not np.isfinite(values).all():
        raise ObservationError(f"{path}: distortion {values.tolist()} is not finite")
    if not values.any():
        return None
    named = (content.get(key) for key in ("distortion_model", "camera_model", "model"))
    model = next((name for name in named if name is not None), "opencv")
    known = str(model).lower().replace(" ", "_") in _LENS_MODELS
    if not known or len(values) not in (4, 5, 8):
        raise ObservationError(
            f"{path}: the lens ({model}) is distorted by {values.tolist()}; what is undone here "
            "is OpenCV's 'plumb_bob' (4 or 5 numbers) and 'rational_polynomial' (8). Undistort "
            "depth and labels by nearest pixel first (cv2.remap), and leave the numbers out"
        )
    return np.pad(values, (0, 8 - len(values)))


# ------------------------------------------------------------------------- images and numbers
def _read_image(path: Path, modes: tuple[str, ...], wanted: str) -> tuple[np.ndarray, str]:
    """Return an image in one of some pixel formats (PIL's modes), and which."""
    from PIL import Image

    if not path.is_file():
        raise ObservationError(f"{path} is missing")
    with (
        _files.reading(path, "a readable image", ObservationError),
        Image.open(path, formats=_IMAGE_FORMATS) as image,
    ):
        if image.width * image.height > _MOST_PIXELS:
            size = f"{image.width} x {image.height} pixels; at most {_MOST_PIXELS:,} are read"
            raise ObservationError(f"{path} is an image of {size}")
        pixels, mode = np.array(image), image.mode
    if mode not in modes:
        raise ObservationError(f"{path} has pixel format {mode}; {wanted}")
    return pixels, mode


def _read_depth(path: Path) -> np.ndarray:
    """Return raw sensor units (H, W) of a 16-bit image, 0 = no return, also for "no data"."""
    remedy = "an 8-bit image has lost the metric depth: export the raw one"
    wanted = f"depth must be a 16-bit single-channel PNG ({remedy})"
    raw, _ = _read_image(path, _DEPTH_MODES, wanted)
    # 16 bits may arrive in a wider type.
    largest = _UINT16_MAX if raw.max() == _UINT16_MAX else np.iinfo(raw.dtype).max
    return np.where(raw == largest, 0, raw).astype(raw.dtype)


def _read_labels(path: Path) -> np.ndarray:
    """Return integer ids (H, W) of a single-channel image, palette images by index."""
    wanted = "labels must be a single-channel 8- or 16-bit PNG of object ids, 0 for background"
    return _read_image(path, _LABEL_MODES, wanted)[0].astype(np.int32)


def _read_color(path: Path) -> np.ndarray:
    """Return (H, W, 3) uint8 RGB; grey images are repeated, alpha is dropped."""
    raw, mode = _read_image(path, ("L", "RGB", "RGBA"), "color must be an 8-bit RGB image")
    return np.repeat(raw[..., None], 3, 2) if mode == "L" else np.ascontiguousarray(raw[..., :3])


def _number(content: dict[str, Any], key: str, path: Path, default: float | None = None) -> float:
    """Return a finite number from a JSON object, or name what is missing."""
    low = 0.0 if key in ("depth_scale", "max_range") else -np.inf
    if key in content:
        value = content[key]
        return number(f"{path}: {key!r}", value, low, above=True, error=ObservationError)
    if default is None:
        raise ObservationError(f"{path}: {key!r} is missing; it must be a finite number")
    return default


def _matrix(value: Any, shape: tuple[int, ...], what: str) -> np.ndarray:
    """Return a float64 array of the given shape from a flat or nested JSON list."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ObservationError(f"{what} is not a matrix of numbers: {error}") from error
    if array.size != int(np.prod(shape)):
        wanted = f"it must have {int(np.prod(shape))} ({shape})"
        raise ObservationError(f"{what} has {array.size} numbers; {wanted}")
    return array.reshape(shape)


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
        content = {key: getattr(obs, key) for key in _NPZ_KEYS} | {"plane": plane}
        arrays = {key: np.asarray(value) for key, value in content.items() if value is not None}
        write_atomically(
            target, lambda stream: np.savez_compressed(stream, allow_pickle=False, **arrays)
        )
    elif target.is_dir() or (target.suffix == "" and not target.is_file()):
        _save_folder(obs, plane, target)
    else:
        raise ObservationError(f"{target} cannot be written; give a .npz file or a folder")


def _save_folder(obs: Observation, plane: list[float] | None, folder: Path) -> None:
    from PIL import Image

    scale = 1e-4 if float(obs.depth.max()) < 1e-4 * (_UINT16_MAX - 1) else 1e-3
    raw = np.rint(obs.depth.astype(np.float64) / scale)
    if raw.max() >= _UINT16_MAX:  # the largest value means "no data"
        far = f"depth reaches {obs.depth.max():g} m, more than 16 bits of millimetres hold"
        raise ObservationError(f"{far}; save as .npz")
    if ((raw == 0) & (obs.depth > 0)).any():
        near = f"depth of {obs.depth[obs.depth > 0].min():g} m would round to 'no return'"
        raise ObservationError(f"{near}; save as .npz")
    if obs.labels is not None and obs.labels.max() > _UINT16_MAX:
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
            write_atomically(path, partial(Image.fromarray(pixels).save, format="PNG"))
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


def write_atomically(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Write through a temporary file beside `path`, so no half-written file ever remains."""
    with _files.replacing(path) as temporary, temporary.open("wb") as stream:
        write(stream)
