# SPDX-License-Identifier: BSD-3-Clause
"""What is odd about views, once their support plane is known: refused, mended or named."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import ndimage

from vprism_plan._shapes import Chosen, Points, Vector
from vprism_plan.errors import ObservationError
from vprism_plan.perception.camera import inlier_band, pixel_rays
from vprism_plan.perception.masks import mend
from vprism_plan.perception.observation import Observation
from vprism_plan.perception.plane import Plane, in_grid, least_squares_plane
from vprism_plan.perception.several_views import agree

_TILTED, _NO_TABLE = 15.0, 45.0  # degrees off the world's z: named, refused
_HIGHEST = 6.0  # metres that a camera can be above the surface it looks at
_UPRIGHT = 10.0  # degrees within which another reading of a pose fits
_OFF_CENTRE = 0.25  # of the image's size, for the principal point
_SQUARE, _LENS = (0.8, 1.25), (0.3, 4.0)  # fy / fx, and focal length over the image's width
_WIDE = 0.8  # metres; objects on a table are rarely larger
_BENT = 0.003  # metres rms that a table may be bent before it is asked why
_CELL, _THROUGH = 0.02, 0.03  # metres of a grid, and below the surface that was seen there

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_LINK = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


def examine(
    views: Sequence[Observation],
    plane: Plane,
    earlier: Sequence[Observation] = (),
    compared: bool = False,
) -> tuple[tuple[Observation, ...], tuple[str, ...]]:
    """Return views fit for use, mended where possible, and a sentence for each thing odd in them.

    Run once for every view that a map learns from, after its support plane is known.

    Args:
        views: posed as the map will have them.
        plane: support surface, world frame.
        earlier: views of the same scene that went through this before.
        compared: whether all of them have been compared with one another already.

    Raises:
        ObservationError: a view that cannot be right.
    """
    found: list[str] = []
    for view in views:
        found += [*_pose(view, plane), *_lens(view), *_bend(view, plane), *_sizes(view)]
    given = views
    views = tuple(_without_what_is_behind_the_surface(view, plane) for view in views)
    views = tuple(map(_known_clear, given, mend(views, plane, len(earlier))))
    views = views if compared else agree(views, earlier)
    found += [text for view in views for text in view.warnings]
    return views, tuple(dict.fromkeys(found))


def _pose(view: Observation, plane: Plane) -> list[str]:
    """Name a table that is not level; refuse what can be none."""
    height = float(plane.signed_distance(view.camera_center))
    if height > _HIGHEST:
        remedy = "give depth and T_world_camera in metres: is one in millimetres, or scaled?"
        where = f"the camera is {height:.1f} m above the support surface"
        raise ObservationError(f"{where}, more than {_HIGHEST:g} m; {remedy}")
    if not view.posed:
        return []
    tilt = _angle(plane.normal)
    if height > 0.0 and tilt <= _TILTED:
        return []
    where = f"the support surface is {tilt:.0f} degrees off the world's horizontal"
    if height <= 0.0:
        where += f" and {-height:.2f} m above the camera"
    remedy = _other_reading(view, plane)
    if height <= 0.0 or tilt > _NO_TABLE:
        raise ObservationError(
            f"{where}: no table; T_world_camera must map the optical frame (x right, y down, z "
            f"forward) to a world whose z points up{remedy}"
        )
    return [f"{where}; check T_world_camera{remedy}"]


def _angle(normal: Vector) -> float:
    """Degrees between a direction and the world's z."""
    return float(np.degrees(np.arccos(np.clip(normal[2], -1.0, 1.0))))


def _other_reading(view: Observation, plane: Plane) -> str:
    """Say under which other reading of the pose the table would be level."""
    T = view.pose
    seen = T[:3, :3].T @ plane.normal  # camera frame
    readings = {
        "it looks inverted: give np.linalg.inv(T_world_camera)": np.linalg.inv(T),
        "its axes look like OpenGL's (y up, z backward): give T_world_camera @ "
        "np.diag([1, -1, -1, 1])": T @ _FLIP,
        "its axes look like those of a camera link (x forward, z up): give the pose of the "
        "optical frame": T @ _LINK,
        "the world looks y-up: turn it by 90 degrees about x": _Y_UP @ T,
        "the world looks y-up and its axes like OpenGL's": _Y_UP @ T @ _FLIP,
    }
    fits = [text for text, pose in readings.items() if _angle(pose[:3, :3] @ seen) < _UPRIGHT]
    return f"; {fits[0]}" if fits else ""


def _lens(view: Observation) -> list[str]:
    """Name intrinsics that are hardly those of the image."""
    K = view.intrinsics
    (height, width), found = view.shape, []
    off = np.abs([K[0, 2] - (width - 1) / 2, K[1, 2] - (height - 1) / 2]) / [width, height]
    scale = "; intrinsics must be scaled with the image's resolution"
    if off.max() > _OFF_CENTRE:
        found.append(
            f"the principal point ({K[0, 2]:.0f}, {K[1, 2]:.0f}) is {100 * off.max():.0f} % of the "
            f"{width}x{height} image off its middle{scale}"
        )
    if not _SQUARE[0] <= K[1, 1] / K[0, 0] <= _SQUARE[1]:
        found.append(f"focal lengths are {K[0, 0]:.0f} and {K[1, 1]:.0f} pixels: no square pixels")
    if not _LENS[0] <= K[0, 0] / width <= _LENS[1]:
        found.append(f"the focal length is {K[0, 0] / width:.2f} of the image's width{scale}")
    return found


def _bend(view: Observation, plane: Plane) -> list[str]:
    """Name depth that bends the table as lengths of rays do when they are taken for z."""
    valid = view.depth > 0
    band = 2.0 * inlier_band(view.depth, 0.01)
    table = valid & ~view.sees_robot
    if view.labels is not None:
        table &= view.labels == 0
    points = view.points()[0][table[valid]]
    table[table] = np.abs(plane.signed_distance(points)) < band[table]
    index = np.flatnonzero(table)[:: max(1, int(table.sum()) // 5000)]
    if len(index) < 500:
        return []
    rays = pixel_rays(view.shape, view.intrinsics).reshape(-1, 3)[index]
    as_given = rays * view.depth.reshape(-1)[index, None].astype(np.float64)
    as_length = as_given / np.linalg.norm(rays, axis=1, keepdims=True)
    weights = np.ones(len(index))
    given, length = (
        float(np.sqrt(np.mean(least_squares_plane(p, weights).signed_distance(p) ** 2)))
        for p in (as_given, as_length)
    )
    if given < _BENT or length > 0.5 * given:
        return []
    return [
        f"the table is bent by {1000 * given:.0f} mm, and by {1000 * length:.0f} mm if depth is "
        "the length of each ray: depth must be z along the optical axis; divide it by the length "
        "of the ray at z = 1"
    ]


def _sizes(view: Observation) -> list[str]:
    """Name objects far larger than what stands on tables."""
    points, labels = view.points()
    found = []
    for object_id in view.object_ids:
        low, high = np.quantile(points[labels == object_id], [0.02, 0.98], axis=0)
        size = float((high - low).max())
        if size > _WIDE:
            found.append(
                f"object {object_id} measures {size:.2f} m: is depth in metres, and the label one "
                "object's?"
            )
    return found


def _without_what_is_behind_the_surface(view: Observation, plane: Plane) -> Observation:
    """Take returns from below the seen surface for none: mirrors, refraction."""
    depth = view.depth.astype(np.float64)
    (points, _), valid = view.points(), view.depth > 0
    height = np.full(view.shape, np.inf)
    height[valid] = plane.signed_distance(points)
    below = height < -np.maximum(_THROUGH, 3.0 * inlier_band(depth, 0.01))
    if view.labels is not None:
        below &= view.labels == 0
    if not below.any():
        return view
    on = np.abs(height) < inlier_band(depth, 0.01)
    eye = view.camera_center
    above = float(plane.signed_distance(eye))
    share = above / (above - height[below])  # of the way to the return, to the surface
    crossing = eye + share[:, None] * (points[below[valid]] - eye)
    below[below] = _enclosed(plane, points[on[valid]], crossing)
    if not below.any():
        return view
    text = (
        f"{int(below.sum())} pixels show something up to {-height[below].min():.2f} m below the "
        "support surface, through what was seen of it: a mirror or glass? They count as no return"
    )
    return replace(view, depth=np.where(below, 0.0, view.depth), warnings=(*view.warnings, text))


def _known_clear(before: Observation, view: Observation) -> Observation:
    """Take rays for unknown whose return was taken away: they end anywhere."""
    if view.clear is None:
        return view
    return replace(view, clear=np.where((before.depth > 0) & (view.depth == 0), 0.0, view.clear))


def _enclosed(plane: Plane, seen: Points, asked: Points) -> Chosen:
    """Which points of a plane lie inside what was seen of it, or in a hole of that."""
    if len(seen) == 0:
        return np.zeros(len(asked), dtype=bool)
    flat, others = seen @ plane.axes().T, asked @ plane.axes().T
    low = flat.min(axis=0) - 2 * _CELL
    grid = np.zeros(np.ceil((flat.max(axis=0) - low) / _CELL).astype(int) + 3, dtype=bool)
    grid[tuple(np.floor((flat - low) / _CELL).astype(int).T)] = True
    grid = ndimage.binary_fill_holes(ndimage.binary_closing(grid))
    grid = ndimage.binary_erosion(grid, iterations=2)
    return in_grid(grid, np.floor((others - low) / _CELL).astype(int))
