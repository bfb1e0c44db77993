# SPDX-License-Identifier: BSD-3-Clause
"""Checks on what a user hands over; each names the value, what is valid, and the remedy."""

from typing import Any

import numpy as np

from vprism_plan.errors import ObservationError

# No table-top sensor measures this far: a median above it means millimetres.
MAX_MEDIAN_DEPTH = 50.0
# No depth sensor measures this near: a median below it means depth was scaled twice.
MIN_MEDIAN_DEPTH = 0.005
# With fewer returns within the sensor's range than this share, the unit is wrong, not the rest.
_USABLE_SHARE = 0.05
# What np.nan_to_num writes for infinity in single precision; no depth is as large.
_INFINITE = float(np.finfo(np.float32).max)
_RIGID_TOLERANCE = 1e-3


def to_numpy(value: Any, name: str) -> np.ndarray:
    """Return a fresh array from an array, nested list or torch tensor (any device)."""
    if hasattr(value, "detach"):
        value = value.detach().cpu().numpy()
    try:
        array = np.array(value)
    except (ValueError, TypeError) as error:
        raise ObservationError(f"{name} is not an array: {error}") from error
    if array.dtype == object:
        raise ObservationError(
            f"{name} holds Python objects ({type(value).__name__}); give a numeric array"
        )
    return array


def check_max_range(value: Any) -> float:
    """Return the farthest depth that counts as a return, metres."""
    is_number = isinstance(value, int | float | np.integer | np.floating)
    if not is_number or isinstance(value, bool) or not (np.isfinite(value) and value > 0):
        raise ObservationError(f"max_range is {value!r}; it must be a positive number of metres")
    return float(value)


def check_depth(value: Any, max_range: float) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return depth as a (H, W) float32 or float64 array in metres, 0 = no return.

    NaN, infinity and what lies beyond `max_range` (metres) are no returns; the latter, which a
    sensor or a driver made up, is named in the second value.
    """
    depth = to_numpy(value, "depth")
    if depth.ndim != 2 or 0 in depth.shape:
        raise ObservationError(f"depth has shape {depth.shape}; it must be one image (H, W)")
    if depth.dtype.kind in "iub":
        raise ObservationError(
            f"depth is {depth.dtype}, so it holds raw sensor units; give metres as float: "
            "depth * scale (0.001 for millimetres)"
        )
    if depth.dtype not in (np.float32, np.float64):
        if depth.dtype.kind != "f":
            raise ObservationError(f"depth is {depth.dtype}; it must be float32 or float64 metres")
        depth = depth.astype(np.float32 if depth.dtype.itemsize <= 4 else np.float64)
    _check_signs(depth)
    depth[~(depth < _INFINITE)] = 0.0  # NaN compares false
    valid = depth[depth > 0]
    _check_scale(valid, max_range)
    beyond = depth > max_range
    if not beyond.any():
        return np.ascontiguousarray(depth), ()
    found = (
        f"{int(beyond.sum())} depth returns ({100 * beyond.sum() / valid.size:.2g} %) lie beyond "
        f"max_range = {max_range:g} m, the farthest at {valid.max():.4g} m; they count as no "
        "return: is it the sensor's value for 'no data'? If they are real, raise max_range"
    )
    depth[beyond] = 0.0
    return np.ascontiguousarray(depth), (found,)


def _check_signs(depth: np.ndarray) -> None:
    bad = depth < 0
    if not bad.any():
        return
    row, col = np.argwhere(bad)[0]
    infinite = depth[row, col] <= -_INFINITE
    raise ObservationError(
        f"depth is {'-inf' if infinite else format(depth[row, col], 'g')} at row {row}, column "
        f"{col} ({int(bad.sum())} negative pixels); it must be positive metres along the optical "
        "axis, or 0 where there is no return"
        + ("; np.nan_to_num(depth, posinf=0, neginf=0) says so" if infinite else "")
    )


def _check_scale(valid: np.ndarray, max_range: float) -> None:
    """Refuse returns (metres, all positive) that are in other units."""
    if valid.size == 0:
        raise ObservationError(
            "depth is 0, NaN or infinite everywhere: the sensor returned nothing to map"
        )
    usable = valid[valid <= max_range]
    # A value for "no data" may be in most pixels; it is the largest there is.
    body = valid[valid < valid.max()]
    median = float(np.median(body if body.size else valid))
    if median > MAX_MEDIAN_DEPTH and usable.size < _USABLE_SHARE * valid.size:
        raise ObservationError(
            f"median depth is {median:g} m, more than {MAX_MEDIAN_DEPTH:g} m: it looks like "
            "millimetres; multiply by 0.001"
        )
    if usable.size == 0:
        raise ObservationError(
            f"every depth return lies beyond max_range = {max_range:g} m, the nearest at "
            f"{valid.min():g} m: is depth in metres? If it is, raise max_range"
        )
    median = float(np.median(usable))
    if median < MIN_MEDIAN_DEPTH:
        raise ObservationError(
            f"median depth is {median:g} m, less than {MIN_MEDIAN_DEPTH:g} m: it looks as if "
            "depth was scaled twice; give metres"
        )


def check_labels(value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return labels as a (H, W) int32 array of the depth's shape, 0 = background."""
    labels = to_numpy(value, "labels")
    if labels.shape != shape:
        raise ObservationError(
            f"labels have shape {labels.shape} but depth has {shape}; they must be one image "
            "registered to the depth"
        )
    if labels.dtype.kind not in "iub":
        raise ObservationError(
            f"labels are {labels.dtype}; they must be integers: 0 background, 1, 2, ... objects"
        )
    if labels.dtype.kind == "i" and labels.min() < 0:
        raise ObservationError(
            f"labels contain {labels.min()}; they must be 0 (background) or positive object ids"
        )
    if labels.max() > np.iinfo(np.int32).max:
        raise ObservationError(f"labels contain {labels.max()}; object ids must fit in int32")
    return np.ascontiguousarray(labels, dtype=np.int32)


def check_intrinsics(value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return a (3, 3) float64 pinhole matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], pixels."""
    matrix = to_numpy(value, "intrinsics")
    if matrix.shape != (3, 3) or matrix.dtype.kind not in "fiu":
        raise ObservationError(
            f"intrinsics have shape {matrix.shape} and type {matrix.dtype}; they must be the "
            "3x3 pinhole matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels"
        )
    matrix = matrix.astype(np.float64)
    if not np.isfinite(matrix).all():
        raise ObservationError(f"intrinsics are not finite: {matrix.tolist()}")
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    if not np.allclose(matrix[2], [0.0, 0.0, 1.0], atol=1e-9):
        raise ObservationError(
            f"intrinsics' last row is {matrix[2].tolist()}; a pinhole matrix ends in [0, 0, 1]"
        )
    if fx <= 0 or fy <= 0:
        raise ObservationError(
            f"intrinsics are singular: focal lengths fx = {fx:g}, fy = {fy:g} must be positive "
            "pixels"
        )
    if abs(matrix[0, 1]) > 1e-6 * fx or abs(matrix[1, 0]) > 1e-6 * fx:
        raise ObservationError(
            f"intrinsics have skew ({matrix[0, 1]:g}, {matrix[1, 0]:g}); only a pinhole camera "
            "without skew is supported: rectify the image first"
        )
    matrix[0, 1] = matrix[1, 0] = 0.0
    height, width = shape
    if not (0 <= cx <= width and 0 <= cy <= height):
        raise ObservationError(
            f"principal point (cx, cy) = ({cx:g}, {cy:g}) lies outside the {width}x{height} "
            "image; scale the intrinsics to the image's resolution"
        )
    return matrix


def check_pose(value: Any) -> np.ndarray:
    """Return a rigid (4, 4) float64 transform; small rounding is removed, more is an error."""
    pose = to_numpy(value, "T_world_camera")
    if pose.shape != (4, 4) or pose.dtype.kind not in "fiu":
        raise ObservationError(
            f"T_world_camera has shape {pose.shape} and type {pose.dtype}; it must be a 4x4 "
            "rigid transform from camera to world coordinates, or None"
        )
    pose = pose.astype(np.float64)
    if not np.isfinite(pose).all():
        raise ObservationError(f"T_world_camera is not finite: {pose.tolist()}")
    if not np.allclose(pose[3], [0.0, 0.0, 0.0, 1.0], atol=1e-9):
        raise ObservationError(
            f"T_world_camera's last row is {pose[3].tolist()}; it must be [0, 0, 0, 1] (is the "
            "matrix transposed?)"
        )
    rotation = pose[:3, :3]
    error = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if error > _RIGID_TOLERANCE:
        raise ObservationError(
            f"T_world_camera is not rigid: its rotation is off orthonormal by {error:.2g} "
            f"(at most {_RIGID_TOLERANCE:g}); remove scale and shear"
        )
    if np.linalg.det(rotation) < 0:
        raise ObservationError(
            "T_world_camera is not rigid: its rotation mirrors (determinant -1); flip one axis"
        )
    if error > 1e-12:
        u, _, vt = np.linalg.svd(rotation)
        pose[:3, :3] = u @ vt
    return pose


def check_color(value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return a (H, W, 3) uint8 image of the depth's shape."""
    color = to_numpy(value, "color")
    if color.shape != (*shape, 3) or color.dtype != np.uint8:
        raise ObservationError(
            f"color has shape {color.shape} and type {color.dtype}; it must be RGB uint8 of "
            f"shape {(*shape, 3)}, registered to the depth"
        )
    return np.ascontiguousarray(color)


def check_robot_spheres(value: Any) -> np.ndarray:
    """Return float64 rows (x, y, z, radius) or (x, y, z, radius, free), metres."""
    spheres = to_numpy(value, "robot_spheres")
    if spheres.ndim != 2 or spheres.shape[1] not in (4, 5) or spheres.dtype.kind not in "fiu":
        raise ObservationError(
            f"robot_spheres have shape {spheres.shape} and type {spheres.dtype}; they must be "
            "rows (x, y, z, radius) or (x, y, z, radius, free) in metres, camera frame"
        )
    spheres = spheres.astype(np.float64)
    radii = spheres[:, 3:]
    bad = ~np.isfinite(spheres).all(axis=1) | (radii < 0.0).any(axis=1) | ~(radii > 0.0).any(axis=1)
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        raise ObservationError(
            f"row {row} of robot_spheres is {spheres[row].tolist()}; centre and radius must be "
            "finite and the radius positive"
        )
    return np.ascontiguousarray(spheres)
