# SPDX-License-Identifier: BSD-3-Clause
"""Cameras as files state them: our own, ROS, RealSense, Open3D, OpenCV, BOP, GraspNet."""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from vprism_plan import _files
from vprism_plan._arguments import number
from vprism_plan._shapes import Matrix, Pose
from vprism_plan.errors import ObservationError
from vprism_plan.perception.camera import invert_transform
from vprism_plan.perception.observation import DEFAULT_MAX_RANGE, check_pose
from vprism_plan.perception.plane import Plane

NAMES = (
    "camera.json", "camera.yaml", "camera.yml", "camera_info.yaml", "camera_info.yml",
    "camera_info.json", "intrinsics.json", "intrinsics.yaml", "intrinsic.json",
    "camera_intrinsic.json", "meta.mat",
)  # fmt: skip
MATRICES = (
    "intrinsics", "intrinsic_matrix", "camera_matrix", "cam_K", "K", "k", "camera_intrinsics",
)  # fmt: skip
_LENS_KEYS = ("distortion", "D", "d", "coeffs", "dist_coeffs", "distortion_coefficients")
_LENS_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
# What OpenCV, ROS, RealSense and others call the polynomial of `undistort`.
_LENS_MODELS = ("plumb_bob", "rational_polynomial", "brown_conrady", "opencv", "radtan", "pinhole")
MILLIMETRE = 0.001
_MAT_HEADER, _MAT_MATRIX, _MAT_COMPRESSED = 128, 14, 15
_MAT_TYPES = {**dict(enumerate(("<i1", "<u1", "<i2", "<u2", "<i4", "<u4", "<f4"), 1)),
              9: "<f8", 12: "<i8", 13: "<u8"}  # fmt: skip
_MOST_TEXT, _MOST_MAT = 2**14, 2**20  # bytes; YAML takes the square of that to read


@dataclass(frozen=True)
class CameraFile:
    """What a file states about a camera, metres and pixels; None = nothing."""

    intrinsics: Matrix | None
    lens: Float[np.ndarray, " 8"] | None  # k1 k2 p1 p2 k3 k4 k5 k6 (OpenCV's order)
    depth_scale: float | None  # metres per raw unit
    pose: Pose | None  # camera to world
    position: Float[np.ndarray, " 3"] | None  # of the camera in the frame of a point cloud
    rest: dict[str, Any]  # other attributes of a view


def read_camera(path: Path) -> dict[str, Any]:
    """Return what is in a camera file: JSON, YAML (its first document) or GraspNet's `meta.mat`.

    Raises:
        ObservationError: it holds no object, or cannot be read.
    """
    if path.suffix == ".json" or not path.is_file():
        return _files.read_json(path, ObservationError)
    most = _MOST_MAT if path.suffix == ".mat" else _MOST_TEXT
    with _files.reading(path, "a readable camera file", ObservationError, most):
        if path.suffix == ".mat":
            return _matlab(path.read_bytes()[_MAT_HEADER:])
        import yaml  # type: ignore[import-untyped]

        text = path.read_text(encoding="utf-8")
        if any(isinstance(token, yaml.AliasToken) for token in yaml.scan(text)):
            raise ObservationError(f"{path} has YAML aliases (*name); write the values out")
        content = next(yaml.safe_load_all(text), None)
        if not isinstance(content, dict):
            raise ObservationError(f"{path} holds a {type(content).__name__}; give keys and values")
        return content


def _matlab(data: bytes) -> dict[str, Any]:
    """Return the real matrices of a MAT 5 file without its header, by name.

    `scipy.io.loadmat` reads beyond memory where a type is damaged, and the process dies.
    """

    def elements(data: bytes, align: int) -> Iterator[tuple[int, bytes]]:
        at = 0
        while at + 8 <= len(data):
            kind, size = struct.unpack_from("<II", data, at)
            if kind >> 16:  # both in one word, the content in the next
                yield kind & 0xFFFF, data[at + 4 : at + 4 + min(kind >> 16, 4)]
                size = 0
            else:
                yield kind, data[at + 8 : at + 8 + size]
            at += 8 + size + -size % align

    found: dict[str, Any] = {}
    for kind, inner in elements(data, 1):
        if kind == _MAT_COMPRESSED:
            whole = zlib.decompressobj().decompress(inner, _MOST_MAT)
            kind, inner = next(elements(whole, 1), (0, b""))  # noqa: PLW2901
        parts = list(elements(inner, 8)) if kind == _MAT_MATRIX else []
        if len(parts) == 4 and parts[3][0] in _MAT_TYPES:  # flags, size, name, numbers
            values = np.frombuffer(parts[3][1], _MAT_TYPES[parts[3][0]])
            shape = np.frombuffer(parts[1][1], "<i4")
            found[parts[2][1].decode()] = values.reshape(shape, order="F").tolist()
    return found


def camera_of(content: dict[str, Any], what: str, unit: float = 1.0) -> CameraFile:
    """Understand what a file says about a camera, by the names that are in use.

    Args:
        content: of the file, or of one image's entry in it.
        what: it is, for messages.
        unit: metres per unit of lengths and depths in it.

    Raises:
        ObservationError: a value that cannot be used, or half of a matrix or pose.
    """
    if isinstance(content.get("intrinsic"), dict):  # Open3D's camera parameters
        content = content | content["intrinsic"]
    scale = content.get("depth_scale")
    if scale is not None:
        scale = positive(f"{what}: 'depth_scale'", scale) * unit
    elif "factor_depth" in content:
        factor = matrix(content["factor_depth"], (1,), f"{what}: 'factor_depth'")
        scale = 1.0 / positive(f"{what}: 'factor_depth'", float(factor[0]))
    plane, position = content.get("plane"), content.get("camera_position")
    if plane is not None:
        normal = matrix(plane, (4,), f"{what}: 'plane'")
        plane = Plane(normal[:3], float(normal[3]))
    if position is not None:
        position = matrix(position, (3,), f"{what}: 'camera_position'") * unit
    reach = content.get("max_range", DEFAULT_MAX_RANGE)
    return CameraFile(
        _intrinsics(content, what),
        _lens(content, what),
        scale,
        _pose(content, what, unit),
        position,
        {
            "plane": plane,
            "robot_spheres": content.get("robot_spheres"),
            "max_range": positive(f"{what}: 'max_range'", reach),
        },
    )


def check_size(content: dict[str, Any], shape: tuple[int, ...], what: str) -> None:
    """Refuse a file that states another size than the image (H, W) has.

    Raises:
        ObservationError: both sizes, and the remedy.
    """
    for key, size in (("width", shape[1]), ("height", shape[0])):
        stated = content.get(key, content.get(f"image_{key}", size))
        if stated != size:
            found = f"{key!r} is {stated} but the depth is {shape[1]}x{shape[0]}"
            remedy = "scale the intrinsics to the image's resolution"
            raise ObservationError(f"{what}: {found}; {remedy}")


def _intrinsics(content: dict[str, Any], what: str) -> Matrix | None:
    key = next((name for name in MATRICES if content.get(name) is not None), None)
    if key is not None:
        value = content[key]
        value = value.get("data") if isinstance(value, dict) else value
        found = matrix(value, (3, 3), f"{what} {key!r}")
        # Open3D writes columns, and nobody else has a zero there.
        return found.T if key == "intrinsic_matrix" and found[2, :2].any() else found
    names = ("fx", "fy", "cx", "cy")
    if not any(name in content for name in names):
        return None
    for name in names:
        if name not in content:
            raise ObservationError(f"{what}: {name!r} is missing; it must be a finite number")
    fx, fy, cx, cy = (
        number(f"{what}: {name!r}", content[name], error=ObservationError) for name in names
    )
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def _pose(content: dict[str, Any], what: str, unit: float) -> Pose | None:
    """Return camera to world, if the file states it."""
    if content.get("T_world_camera") is not None:
        return matrix(content["T_world_camera"], (4, 4), f"{what}: 'T_world_camera'")
    if content.get("extrinsic") is not None:  # Open3D: world to camera, by columns
        return invert_transform(
            check_pose(matrix(content["extrinsic"], (4, 4), f"{what}: 'extrinsic'").T)
        )
    keys = ("cam_R_w2c", "cam_t_w2c")
    missing = [key for key in keys if key not in content]
    if len(missing) == 2:
        return None
    if missing:
        raise ObservationError(f"{what} has only half a pose: {missing[0]!r} is missing")
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = matrix(content[keys[0]], (3, 3), f"{what} {keys[0]!r}")
    world_to_camera[:3, 3] = matrix(content[keys[1]], (3,), f"{what} {keys[1]!r}") * unit
    return invert_transform(check_pose(world_to_camera))


def _lens(content: dict[str, Any], what: str) -> Float[np.ndarray, " 8"] | None:
    key = next((key for key in _LENS_KEYS if content.get(key) is not None), None)
    if key is None:
        given = [content.get(name, 0.0) for name in _LENS_NAMES]
        values = np.array(
            [
                number(f"{what}: {name!r}", value, error=ObservationError)
                for name, value in zip(_LENS_NAMES, given, strict=True)
            ]
        )
    else:
        value = content[key]
        value = value.get("data") if isinstance(value, dict) else value
        try:
            values = np.array(value, dtype=np.float64).ravel()
        except (TypeError, ValueError) as error:
            raise ObservationError(f"{what}: {key!r} is not a list of numbers: {error}") from error
    if not np.isfinite(values).all():
        raise ObservationError(f"{what}: distortion {values.tolist()} is not finite")
    if not values.any():
        return None
    named = (content.get(key) for key in ("distortion_model", "camera_model", "model"))
    model = next((name for name in named if name is not None), "opencv")
    known = str(model).lower().replace(" ", "_") in _LENS_MODELS
    if not known or len(values) not in (4, 5, 8):
        raise ObservationError(
            f"{what}: the lens ({model}) is distorted by {values.tolist()}; what is undone here "
            "is OpenCV's 'plumb_bob' (4 or 5 numbers) and 'rational_polynomial' (8). Undistort "
            "depth and labels by nearest pixel first (cv2.remap), and leave the numbers out"
        )
    return np.pad(values, (0, 8 - len(values)))


def positive(what: str, value: Any) -> float:
    """Return a finite number above 0."""
    return number(what, value, 0.0, above=True, error=ObservationError)


def matrix(value: Any, shape: tuple[int, ...], what: str) -> np.ndarray:
    """Return a float64 array of the given shape from a flat or nested list."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ObservationError(f"{what} is not a matrix of numbers: {error}") from error
    if array.size != int(np.prod(shape)):
        wanted = f"it must have {int(np.prod(shape))} ({shape})"
        raise ObservationError(f"{what} has {array.size} numbers; {wanted}")
    return array.reshape(shape)
