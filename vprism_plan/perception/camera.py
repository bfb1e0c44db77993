# SPDX-License-Identifier: BSD-3-Clause
"""Pinhole camera geometry: pixels and depth to points, points to pixels.

Conventions: the camera frame is the optical one (x right, y down, z forward);
depth is measured along z, in metres; pixel (u, v) = (column, row), and a whole
number is the *centre* of a pixel (OpenCV).
"""

import numpy as np
from jaxtyping import Float, Num


def pixel_rays(
    shape: tuple[int, int], intrinsics: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "h w 3"]:
    """Return, for every pixel, the point of its ray at depth z = 1 (camera frame, metres).

    Multiply by depth to get points; the rays are *not* of unit length.
    """
    height, width = shape
    rays = np.ones((height, width, 3))
    rays[..., 0] = (np.arange(width) - intrinsics[0, 2]) / intrinsics[0, 0]
    rays[..., 1] = ((np.arange(height) - intrinsics[1, 2]) / intrinsics[1, 1])[:, None]
    return rays


def backproject(
    depth: Float[np.ndarray, "h w"], intrinsics: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "h w 3"]:
    """Turn a depth image into camera-frame points (metres), NaN where depth is 0 (no return)."""
    rays = pixel_rays((depth.shape[0], depth.shape[1]), intrinsics)
    return rays * np.where(depth > 0, depth, np.nan)[..., None].astype(np.float64)


def project(
    points: Float[np.ndarray, "n 3"], intrinsics: Float[np.ndarray, "3 3"]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    """Project camera-frame points (metres).

    Returns:
        Pixel coordinates (u, v), NaN for points in or behind the camera plane (z <= 0),
        and the depth z of every point (metres, may be negative).
    """
    z = points[:, 2].astype(np.float64)
    safe = np.where(z > 0, z, np.nan)
    u = intrinsics[0, 0] * points[:, 0] / safe + intrinsics[0, 2]
    v = intrinsics[1, 1] * points[:, 1] / safe + intrinsics[1, 2]
    return np.stack([u, v], axis=1), z


def depth_sigma(depth: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Axial standard deviation of a consumer depth camera, metres, at a depth in metres.

    Nguyen, Izadi and Lovell, "Modeling Kinect sensor noise" (3DIMPVT 2012), eq. 3.
    """
    return 0.0012 + 0.0019 * (np.asarray(depth, dtype=np.float64) - 0.4) ** 2


def height_sigma(
    rays: Float[np.ndarray, "n 3"],
    depth: Float[np.ndarray, " n"],
    normal: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, " n"]:
    """Standard deviation of the depth noise as it shows along a surface's normal, metres.

    Args:
        rays: from the camera to what it saw, metres, in the frame of `normal`.
        depth: of these points, metres.
        normal: unit vector.
    """
    return np.asarray(depth_sigma(depth) * (np.abs(rays @ normal) / depth))


def transform_points(
    transform: Float[np.ndarray, "4 4"], points: Num[np.ndarray, "*batch 3"]
) -> Float[np.ndarray, "*batch 3"]:
    """Apply a rigid transform to points: `T_a_b` maps coordinates in b to coordinates in a."""
    return np.asarray(points, dtype=np.float64) @ transform[:3, :3].T + transform[:3, 3]


def invert_transform(transform: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Return the inverse of a rigid transform, exactly rigid again."""
    inverse = np.eye(4)
    inverse[:3, :3] = transform[:3, :3].T
    inverse[:3, 3] = -transform[:3, :3].T @ transform[:3, 3]
    return inverse


def point_image(
    depth: Float[np.ndarray, "h w"],
    intrinsics: Float[np.ndarray, "3 3"],
    T_world_camera: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, "h w 3"]:
    """Return the world point (metres) behind every pixel, NaN where there is no return."""
    return transform_points(T_world_camera, backproject(depth, intrinsics))
