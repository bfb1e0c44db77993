# SPDX-License-Identifier: BSD-3-Clause
"""Pinhole camera geometry: pixels and depth to points, points to pixels; noise, distortion.

The camera frame is the optical one (x right, y down, z forward); depth is measured along z, in
metres; pixel (u, v) = (column, row), and a whole number is the *centre* of a pixel (OpenCV).
"""

import numpy as np
from jaxtyping import Float, Num
from scipy.spatial import cKDTree

from vprism_plan._shapes import Chosen, Image, Matrix, PointImage, Points, Pose, Values, Vector


def pixel_rays(shape: tuple[int, int], intrinsics: Matrix) -> PointImage:
    """Return, for every pixel, the point of its ray at depth z = 1 (camera frame, metres)."""

    height, width = shape
    rays = np.ones((height, width, 3))
    rays[..., 0] = (np.arange(width) - intrinsics[0, 2]) / intrinsics[0, 0]
    rays[..., 1] = ((np.arange(height) - intrinsics[1, 2]) / intrinsics[1, 1])[:, None]
    return rays


def backproject(depth: Image, intrinsics: Matrix) -> PointImage:
    """Turn a depth image into camera-frame points (metres), NaN where depth is 0 (no return)."""
    rays = pixel_rays((depth.shape[0], depth.shape[1]), intrinsics)
    return rays * np.where(depth > 0, depth, np.nan)[..., None].astype(np.float64)


def lift(depth: Image, intrinsics: Matrix, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Return the camera-frame points (metres) of some pixels, 0 where there is no return."""
    z = depth[row, column].astype(np.float64)
    x = (column - intrinsics[0, 2]) / intrinsics[0, 0] * z
    y = (row - intrinsics[1, 2]) / intrinsics[1, 1] * z
    return np.stack([x, y, z], axis=-1)


def project(points: Points, intrinsics: Matrix) -> tuple[Float[np.ndarray, "n 2"], Values]:
    """Project camera-frame points (metres) to pixels (u, v), NaN where z <= 0; return z as well."""
    z = points[:, 2].astype(np.float64)
    safe = np.where(z > 0, z, np.nan)
    u = intrinsics[0, 0] * points[:, 0] / safe + intrinsics[0, 2]
    v = intrinsics[1, 1] * points[:, 1] / safe + intrinsics[1, 2]
    return np.stack([u, v], axis=1), z


def transform_points(
    transform: Pose, points: Num[np.ndarray, "*batch 3"]
) -> Float[np.ndarray, "*batch 3"]:
    """Apply a rigid transform to points: `T_a_b` maps coordinates in b to coordinates in a."""
    return np.asarray(points, dtype=np.float64) @ transform[:3, :3].T + transform[:3, 3]


def invert_transform(transform: Pose) -> Pose:
    """Return the inverse of a rigid transform, exactly rigid again."""
    inverse = np.eye(4)
    inverse[:3, :3] = transform[:3, :3].T
    inverse[:3, 3] = -transform[:3, :3].T @ transform[:3, 3]
    return inverse


# ------------------------------------------------------------------------------------- robots
def within_balls(points: Points, balls: Float[np.ndarray, "s 4"]) -> Chosen:
    """Whether each point lies in a ball, its surface included.

    What is not finite is in no ball, and a radius below 0 holds nothing. A point is in a ball of
    radius r about c if |x - c|^2 + (R^2 - r^2) <= R^2: a nearest neighbour search in four
    dimensions, with the root of R^2 - r^2 as the fourth, answers that for all balls with radii
    up to R at once; down to half of R, so that the fourth does not outweigh the others.
    """
    inside = np.zeros(len(points), dtype=bool)
    left = np.flatnonzero(np.isfinite(points).all(axis=1))
    balls = balls[balls[:, 3] >= 0.0]
    balls = balls[np.argsort(-balls[:, 3], kind="stable")]
    while len(balls) and len(left):
        radius = float(balls[0, 3])
        count = int((balls[:, 3] >= 0.5 * radius).sum())
        group, balls = balls[:count], balls[count:]
        low = (group[:, :3] - group[:, 3:]).min(axis=0)
        high = (group[:, :3] + group[:, 3:]).max(axis=0)
        near = left[((points[left] >= low) & (points[left] <= high)).all(axis=1)]
        lifted = np.column_stack([group[:, :3], np.sqrt(radius**2 - group[:, 3] ** 2)])
        asked = np.column_stack([points[near], np.zeros(len(near))])
        # The bound of the search is exclusive, and roots round.
        away, _ = cKDTree(lifted).query(asked, distance_upper_bound=radius * (1.0 + 1e-9) + 1e-12)
        inside[near[np.isfinite(away)]] = True
        left = left[~inside[left]]
    return inside


# -------------------------------------------------------------------------------------- noise
# Three curves on purpose: what is certain must rest on a measured model (`depth_sigma`), while
# clusters are cut (`stereo_noise`) and planes gathered (`inlier_band`) generously, so that the
# worst of the cameras in use does not tear a surface apart.
def depth_sigma(depth: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Axial standard deviation of a consumer depth camera, metres, at a depth in metres.

    Nguyen, Izadi and Lovell, "Modeling Kinect sensor noise" (3DIMPVT 2012), eq. 3.
    """
    return 0.0012 + 0.0019 * (np.asarray(depth, dtype=np.float64) - 0.4) ** 2


def stereo_noise(depth: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Return the standard deviation of stereo depth (m): 2 mm at 1 m, growing as depth^2.

    The segmentation's own model: its slants and heights are tuned to it, not to `depth_sigma`.
    """
    return np.asarray(0.002 * np.maximum(0.5, np.asarray(depth, dtype=np.float64)) ** 2)


def inlier_band(depth: np.ndarray, threshold: float) -> np.ndarray:
    """Half-width (metres) of the band in which a point at this depth counts as on a plane.

    Several times the noise, as a table is not flat: `threshold` up to 1 m, beyond it
    `threshold * depth^2`, and from 2 m on `4 * threshold`, or else a band at 5 m would take in
    the table and the floor under it.
    """
    return np.asarray(threshold * np.clip(np.asarray(depth, dtype=np.float64), 1.0, 2.0) ** 2)


def height_sigma(rays: Points, depth: Values, normal: Vector) -> Values:
    """Standard deviation of the depth noise as it shows along a surface's normal, metres.

    `rays` go from the camera to what it saw at these depths, in the frame of the unit `normal`.
    """
    return np.asarray(depth_sigma(depth) * (np.abs(rays @ normal) / depth))


# --------------------------------------------------------------------------------- distortion
def undistort(
    image: np.ndarray, coefficients: Float[np.ndarray, " 8"], intrinsics: Matrix
) -> np.ndarray:
    """Return an image (H, W, ...) as a pinhole camera of the same intrinsics sees it.

    By nearest pixel: to blend the depths or the ids of two sides of an edge would invent
    surfaces. Pixels that the lens did not see are 0: no return, background. Coefficients are k1
    k2 p1 p2 k3 k4 k5 k6 (OpenCV's order).
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients
    (fx, _, cx), (_, fy, cy), _ = intrinsics
    rays = pixel_rays((image.shape[0], image.shape[1]), intrinsics)
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
    seen = (row >= 0) & (row < image.shape[0]) & (column >= 0) & (column < image.shape[1])
    straight = image[tuple(np.where(seen, i, 0.0).astype(np.int64) for i in (row, column))]
    straight[~seen] = 0
    return straight
