# SPDX-License-Identifier: BSD-3-Clause
"""What the cameras saw, what they could not see, and where they did not look.

A cell counts as seen only if one view sees all of it: every pixel that its image
touches has a return, and the nearest of them lies no more than the tolerance in front
of the cell's far side. So shadows are never too small, whatever the cell's size.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from scipy.spatial import cKDTree

from vprism_plan._kernels import world as kernels
from vprism_plan._threads import run_chunked
from vprism_plan.mapping.strays import BLOCK, points_around
from vprism_plan.perception import Observation, Plane
from vprism_plan.perception.camera import depth_sigma, height_sigma, transform_points

# Codes of points.
SEEN, OCCLUDED, UNOBSERVED, OUTSIDE = 0, 1, 2, 3
# Of a point, a kernel's "partly" means that some pixel around it has the point in shadow.
_OF_POINT = np.array([SEEN, OCCLUDED, OCCLUDED, UNOBSERVED], dtype=np.uint8)
_BLOCK = 8
# Metres above the support plane: what is no higher hides nothing.
_THIN = 0.003
# Cells around the robot that it takes with it. Inside a cavity of occluded cells a field
# whose nodes are two cells apart falls short of the distance by 2.8 cells at most.
_ROOM = 2.0


@dataclass(frozen=True)
class View:
    """One depth image, ready to be asked what it says of a cell.

    Attributes:
        camera: (3, 4) world to camera.
        optics: fx, fy, cx, cy, pixels.
        reach: (levels, H, W) sparse tables: entry (k, v, u) is the minimum over the
            2^k x 2^k window that begins at (v, u) of depth plus tolerance; infinite
            where there is no return or the support plane was seen.
        holes: the same, 0 where there is no return and 1 elsewhere.
        robot: (S, 4) balls that held the robot, world, metres: nothing else is there.
    """

    camera: Float[np.ndarray, "3 4"]
    optics: Float[np.ndarray, " 4"]
    reach: Float32[np.ndarray, "levels h w"]
    holes: Float32[np.ndarray, "levels h w"]
    robot: Float[np.ndarray, "s 4"] = field(default_factory=lambda: np.empty((0, 4)))


def _sparse_tables(image: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "levels h w"]:
    """Window minima for every power of two, so that any window takes a few look-ups."""
    tables = [np.ascontiguousarray(image, dtype=np.float32)]
    size = 1
    while 2 * size <= min(image.shape):
        last = tables[-1]
        rows = last.copy()
        np.minimum(last[:-size], last[size:], out=rows[:-size])
        both = rows.copy()
        np.minimum(rows[:, :-size], rows[:, size:], out=both[:, :-size])
        tables.append(both)
        size *= 2
    return np.stack(tables)


def make_view(observation: Observation, tolerance: float, plane: Plane | None = None) -> View:
    """Prepare an observation; `tolerance` (metres) is how far behind a return shadow begins.

    The tolerance grows with the noise of the sensor: three standard deviations. A ray
    that ends on the support plane (within that noise) or under it has passed through
    free space only, as far as space above the plane goes: such pixels cast no shadow,
    or the coarse cells on a table seen at a glance would all hide behind one another.
    The robot casts one always, however low it is.
    """
    K = observation.intrinsics
    depth = np.asarray(observation.depth, dtype=np.float64)
    valid = depth > 0
    reach = np.where(valid, depth + np.maximum(tolerance, 3.0 * depth_sigma(depth)), np.inf)
    if plane is not None:
        points = observation.point_image()[valid]
        sigma = height_sigma(points - observation.camera_center, depth[valid], plane.normal)
        # Four, not three: one pixel in 700 would leave a speck on every open table.
        threshold = np.maximum(_THIN, 4.0 * sigma)
        on_plane = plane.signed_distance(points) < threshold
        if observation.labels is not None:
            on_plane &= observation.labels[valid] == 0
        on_plane &= ~observation.sees_robot[valid]
        reach[valid] = np.where(on_plane, np.inf, reach[valid])
    rotation = observation.pose[:3, :3].T
    camera = np.column_stack([rotation, -rotation @ observation.pose[:3, 3]])
    return View(
        camera=np.ascontiguousarray(camera),
        optics=np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]], dtype=np.float64),
        reach=_sparse_tables(reach.astype(np.float32)),
        holes=_sparse_tables(valid.astype(np.float32)),
        robot=_robot_balls(observation),
    )


def _robot_balls(observation: Observation) -> Float[np.ndarray, "s 4"]:
    """The observation's robot in world coordinates."""
    if observation.robot_spheres is None:
        return np.empty((0, 4))
    spheres: np.ndarray = observation.robot_spheres.copy()
    spheres[:, :3] = transform_points(observation.pose, spheres[:, :3])
    return spheres


def classify_cells(
    views: Sequence[View],
    plane: Plane | None,
    origin: Float[np.ndarray, " 3"],
    spacing: float,
    shape: tuple[int, int, int],
) -> UInt8[np.ndarray, "nx ny nz"]:
    """Status of every cell of a lattice: FREE, OCCLUDED, PARTLY or UNOBSERVED (`kernels`).

    Cell (i, j, k) spans spacing metres from origin + spacing * (i, j, k). A view that
    sees a cell outweighs any number that do not. Cells wholly under the support plane
    are called FREE: the half-space answers for them. So are cells whose centre was inside
    the robot (`Observation.robot_spheres`) in any view, or within two cells of it: it was
    there, so nothing else is, and what a field of these cells rounds away must not refuse
    the robot the place where it stood.
    """
    status = np.full(shape, kernels.UNOBSERVED, dtype=np.uint8)
    blocks = -(-shape[0] // _BLOCK)
    for view in views:

        def look(piece: slice, view: View = view) -> None:
            kernels.classify_cells(
                origin,
                spacing,
                view.camera,
                view.optics,
                view.reach,
                view.holes,
                status,
                piece.start,
                piece.stop,
            )

        run_chunked(look, blocks, 2)
    if plane is not None:
        normal = plane.normal.copy()  # its own is read-only, a type of its own to kernels
        run_chunked(
            lambda piece: kernels.clear_below(
                normal, plane.offset, origin, spacing, status, piece.start, piece.stop
            ),
            shape[0],
            16,
        )
    for view in views:
        for ball in view.robot:
            _clear_ball(ball[:3], float(ball[3]) + _ROOM * spacing, origin, spacing, status)
    return status


def _clear_ball(
    middle: Float[np.ndarray, " 3"],
    reach: float,
    origin: Float[np.ndarray, " 3"],
    spacing: float,
    status: UInt8[np.ndarray, "nx ny nz"],
) -> None:
    """Call the cells whose centre lies in a ball free."""
    center, radius = (middle - origin) / spacing - 0.5, reach / spacing
    low = np.clip(np.ceil(center - radius), 0, status.shape).astype(np.int64)
    high = np.clip(np.floor(center + radius) + 1, low, status.shape).astype(np.int64)
    x, y, z = (np.arange(a, b) - c for a, b, c in zip(low, high, center, strict=True))
    square = x[:, None, None] ** 2 + y[:, None] ** 2 + z**2
    window = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    status[window][square <= radius**2] = kernels.FREE


def classify_points(
    views: Sequence[View], points: Float[np.ndarray, "n 3"]
) -> UInt8[np.ndarray, " n"]:
    """Status of every point: SEEN, OCCLUDED or UNOBSERVED; SEEN also where the robot was."""
    points = np.ascontiguousarray(points, dtype=np.float64)
    status = np.full(len(points), kernels.UNOBSERVED, dtype=np.uint8)
    for view in views:
        kernels.classify_points(
            points, view.camera, view.optics, view.reach, view.holes, status, 0, len(points)
        )
    for view in views:
        for ball in view.robot:
            square = ((points - ball[:3]) ** 2).sum(axis=1)
            status[square <= ball[3] ** 2] = kernels.FREE
    return _OF_POINT[status]


def _beside(
    points: Float[np.ndarray, "n 3"], dense: Bool[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Which points (m) are dense, or within half a block of one that is."""
    if dense.all() or not dense.any():
        return dense
    gap, _ = cKDTree(points[dense]).query(points, distance_upper_bound=0.5 * BLOCK)
    return np.asarray(np.isfinite(gap))


def background_points(
    views: Sequence[Observation], plane: Plane | None, height: float, lone_share: float = 0.0
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Unlabelled points off the support plane, and half the width of their pixels, metres.

    "Off" is `height` metres, or three standard deviations of the depth noise as it
    shows along the normal, if that is more. Without a plane every unlabelled point is.
    Points of the robot are not background, nor, if `lone_share` is above 0, are points
    that with all others off the plane fill less than that share of what a surface facing
    the camera would show in the 3 cm around them: flying pixels. A rod 1 mm thick fills
    3 percent. What lies within 1.5 cm of a point that is none stays: tips and edges lack
    half their surroundings.
    """
    kept, widths = [], []
    for view in views:
        points, labels = view.points()
        depth = np.asarray(view.depth, dtype=np.float64)[view.depth > 0]
        focal = min(float(view.intrinsics[0, 0]), float(view.intrinsics[1, 1]))
        chosen = (labels == 0) & ~view.sees_robot[view.depth > 0]
        if plane is not None:
            sigma = height_sigma(points - view.camera_center, depth, plane.normal)
            threshold = np.maximum(height, 3.0 * sigma)
            off = plane.signed_distance(points) > threshold
            chosen &= off
            if lone_share > 0.0:
                whole = (BLOCK * focal / depth[off]) ** 2
                dense = points_around(points[off]) >= lone_share * whole
                chosen[off] &= _beside(points[off], dense)
        kept.append(points[chosen])
        widths.append(0.5 * depth[chosen] / focal)
    if not kept:
        return np.empty((0, 3)), np.empty(0)
    return np.concatenate(kept), np.concatenate(widths)
