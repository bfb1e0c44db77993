# SPDX-License-Identifier: BSD-3-Clause
"""Lens distortion that a camera file states: undone on reading, since maps know pinholes only.

By nearest pixel: to blend the depths or the ids of two sides of an edge would invent surfaces.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from vprism_plan.errors import ObservationError
from vprism_plan.perception import _files
from vprism_plan.perception._validation import check_intrinsics
from vprism_plan.perception.camera import pixel_rays

_KEYS = ("distortion", "D", "coeffs", "dist_coeffs", "distortion_coefficients")
_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
# What OpenCV, ROS, RealSense and others call the polynomial below.
_MODELS = ("plumb_bob", "rational_polynomial", "brown_conrady", "opencv", "radtan", "pinhole")


def read_distortion(content: dict[str, Any], path: Path) -> Float[np.ndarray, " 8"] | None:
    """Return k1 k2 p1 p2 k3 k4 k5 k6 (OpenCV's order) of a camera file; None if it states none.

    Raises:
        ObservationError: another lens model, or what is no list of 4, 5 or 8 numbers.
    """
    key = next((key for key in _KEYS if content.get(key) is not None), None)
    if key is None:
        values = np.array([_files.number(content, name, path, 0.0) for name in _NAMES])
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
    known = str(model).lower().replace(" ", "_") in _MODELS
    if not known or len(values) not in (4, 5, 8):
        raise ObservationError(
            f"{path}: the lens ({model}) is distorted by {values.tolist()}; what is undone here "
            "is OpenCV's 'plumb_bob' (4 or 5 numbers) and 'rational_polynomial' (8). Undistort "
            "depth and labels by nearest pixel first (cv2.remap), and leave the numbers out"
        )
    return np.pad(values, (0, 8 - len(values)))


def undistort(
    image: np.ndarray | None,
    coefficients: Float[np.ndarray, " 8"] | None,
    intrinsics: Float[np.ndarray, "3 3"],
) -> np.ndarray | None:
    """Return an image (H, W, ...) as a pinhole camera of the same intrinsics sees it.

    Pixels that the lens did not see are 0: no return, background.
    """
    if image is None or coefficients is None:
        return image
    rows, columns, seen = _sources((image.shape[0], image.shape[1]), coefficients, intrinsics)
    straight = image[rows, columns]
    straight[~seen] = 0
    return straight


def _sources(
    shape: tuple[int, int],
    coefficients: Float[np.ndarray, " 8"],
    intrinsics: Float[np.ndarray, "3 3"],
) -> tuple[Int[np.ndarray, "h w"], Int[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Row and column of the distorted image that each straight pixel shows, and which exist."""
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients
    (fx, _, cx), (_, fy, cy), _ = check_intrinsics(intrinsics, shape)
    rays = pixel_rays(shape, intrinsics)
    x, y = rays[..., 0], rays[..., 1]
    square = x**2 + y**2

    def stretch(s: np.ndarray) -> np.ndarray:
        above = 1.0 + s * (k1 + s * (k2 + s * k3))
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(above / (1.0 + s * (k4 + s * (k5 + s * k6))))

    # Far out the polynomial may turn back and show a pixel twice; from there on it is void.
    radii = np.linspace(0.0, float(np.sqrt(square.max())), 1000)
    grows = np.diff(radii * stretch(radii**2)) > 0.0
    reach = np.inf if grows.all() else float(radii[np.argmin(grows)])
    factor = np.where(np.sqrt(square) < reach, stretch(square), 1e9)
    column = np.rint((x * factor + 2 * p1 * x * y + p2 * (square + 2 * x**2)) * fx + cx)
    row = np.rint((y * factor + 2 * p2 * x * y + p1 * (square + 2 * y**2)) * fy + cy)
    seen = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
    row, column = np.where(seen, row, 0.0), np.where(seen, column, 0.0)
    return row.astype(np.int64), column.astype(np.int64), seen
