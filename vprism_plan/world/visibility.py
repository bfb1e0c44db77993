# SPDX-License-Identifier: BSD-3-Clause
"""What the cameras saw, what they could not see, and where they did not look.

A cell counts as seen only if one view sees all of it: every pixel that its image touches has a
return, and the nearest of them lies no more than the tolerance in front of the cell's far side. So
shadows are never too small, whatever the cell's size.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from scipy.ndimage import (
    binary_dilation,
    distance_transform_edt,
    maximum_filter,
    minimum_filter,
    uniform_filter,
)
from scipy.spatial import cKDTree

from vprism_plan._kernels import world as kernels
from vprism_plan._threads import run_chunked
from vprism_plan.mapping.training_data import BLOCK, points_around
from vprism_plan.perception import Observation, Plane
from vprism_plan.perception.camera import depth_sigma, height_sigma, transform_points, within_balls
from vprism_plan.world.config import WorldConfig
from vprism_plan.world.distance import bounding
from vprism_plan.world.grid import Balls, Chosen, Image, Mask, Points, Values, Vector, window

# Metres: what was seen so near to the robot's balls may reach into them where nobody sees it.
_NEAR = 0.1


def free_balls(observations: Iterable[Observation]) -> Balls:
    """Balls (world, metres) in which there was nothing but the pictured robot."""
    found = [np.empty((0, 4))]
    for observation in observations:
        if observation.robot_spheres is not None:
            rows = observation.robot_spheres
            middles = transform_points(observation.pose, rows[:, :3])
            found.append(np.column_stack([middles, rows[:, -1]])[rows[:, -1] > 0.0])
    return np.concatenate(found)


def speaking_against(
    observation: Observation, things: Bool[np.ndarray, "h w"], balls: Balls
) -> Image:
    """Depth (metres) of the pixels behind which the balls are not believed, inf elsewhere: what
    of the things (neither robot nor support surface) shows something within 10 cm of a ball of
    any view, and all that shows the same object."""
    near = np.zeros(observation.shape, dtype=bool)
    if not len(balls):
        return np.full(observation.shape, np.inf)
    wide = balls + np.array([0.0, 0.0, 0.0, _NEAR])
    near[things] = within_balls(observation.point_image()[things], wide)
    if observation.labels is not None:
        objects = np.unique(observation.labels[near])
        near |= things & np.isin(observation.labels, objects[objects > 0])
    return np.where(near, np.asarray(observation.depth, dtype=np.float64), np.inf)


# Codes of points, and the names of space that nobody has seen.
SEEN, OCCLUDED, UNOBSERVED, OUTSIDE = 0, 1, 2, 3
UNSEEN = {OCCLUDED: "occluded", UNOBSERVED: "unobserved", OUTSIDE: "outside"}
# Of a point, a kernel's "partly" means that some pixel around it has the point in shadow.
_OF_POINT = np.array([SEEN, OCCLUDED, OCCLUDED, UNOBSERVED], dtype=np.uint8)
_BLOCK = 8
# Metres above the support plane: what is no higher hides nothing.
THIN = 0.003
_LONE = 0.03  # see `WorldConfig.lone_share`
_STEP = 0.01  # metres nearer, and farther, beside a flying pixel


@dataclass(frozen=True)
class View:
    """One depth image, ready to be asked what it says of a cell."""

    camera: Float[np.ndarray, "3 4"]  # world to camera
    optics: Float[np.ndarray, " 4"]  # fx, fy, cx, cy, pixels
    # sparse tables: entry (k, v, u) is the minimum over the 2^k x 2^k window that begins at (v,
    # u) of depth plus tolerance; infinite where there is no return or the support plane was seen
    reach: Float32[np.ndarray, "levels h w"]
    holes: Float32[np.ndarray, "levels h w"]  # the same, 0 where there is no return and 1 elsewhere
    # balls that held the robot, world, metres: nothing else is there
    robot: Balls = field(default_factory=lambda: np.empty((0, 4)))
    # ... but behind what this view shows in or near any view's balls: like `reach`, infinite
    # elsewhere. None if there is nothing of the kind
    against: Float32[np.ndarray, "levels h w"] | None = None


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


def make_views(
    observations: Sequence[Observation], tolerance: float, plane: Plane | None = None
) -> list[View]:
    """Prepare observations of one scene; what one shows counts against the others' robots, too."""
    robots = free_balls(observations)
    return [make_view(observation, tolerance, plane, robots) for observation in observations]


def make_view(
    observation: Observation,
    tolerance: float,
    plane: Plane | None = None,
    robots: Balls | None = None,
) -> View:
    """Prepare an observation; `tolerance` (metres) is how far behind a return shadow begins.

    `robots` are the balls of the robots in all views of the scene; None: in this one. The tolerance
    grows with the noise of the sensor: three standard deviations. A ray that ends on the support
    plane (within that noise) or under it has passed through free space only, as far as space above
    the plane goes: such pixels cast no shadow, or the coarse cells on a table seen at a glance
    would all hide behind one another. The robot casts one always.
    """
    depth = np.asarray(observation.depth, dtype=np.float64)
    valid, free = depth > 0, np.asarray(observation.free_depth, dtype=np.float64)
    reach = np.where(free > 0, free + np.maximum(tolerance, 3.0 * depth_sigma(free)), np.inf)
    if plane is not None:
        points, _ = observation.points()
        sigma = height_sigma(points - observation.camera_center, depth[valid], plane.normal)
        # Four, not three: one pixel in 700 would leave a speck on every open table.
        threshold = np.maximum(THIN, 4.0 * sigma)
        on_plane = plane.signed_distance(points) < threshold
        if observation.labels is not None:
            on_plane &= observation.labels[valid] == 0
        on_plane &= ~observation.sees_robot[valid] & (free == depth)[valid]
        reach[valid] = np.where(on_plane, np.inf, reach[valid])
    view, own = _view(observation, reach, free > 0), free_balls([observation])
    things = valid & np.isfinite(reach) & ~observation.sees_robot
    against = speaking_against(observation, things, own if robots is None else robots)
    tables = _sparse_tables(against.astype(np.float32)) if np.isfinite(against).any() else None
    return replace(view, robot=own, against=tables)


def _view(observation: Observation, reach: Image, valid: Bool[np.ndarray, "h w"]) -> View:
    K, rotation = observation.intrinsics, observation.pose[:3, :3].T
    camera = np.column_stack([rotation, -rotation @ observation.pose[:3, 3]])
    return View(
        camera=np.ascontiguousarray(camera),
        optics=np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]], dtype=np.float64),
        reach=_sparse_tables(reach.astype(np.float32)),
        holes=_sparse_tables(valid.astype(np.float32)),
    )


def shadow_behind(observation: Observation, start: Image) -> View:
    """A view by which exactly what lies behind the depth `start` (metres, inf for nothing) of a
    pixel is hidden."""
    return _view(observation, start, np.ones(start.shape, dtype=bool))


def classify_cells_around(
    views: Sequence[View],
    below: Sequence[View],
    plane: Plane,
    origin: Vector,
    spacing: float,
    shape: tuple[int, int, int],
) -> UInt8[np.ndarray, "nx ny nz"]:
    """`classify_cells` for a support plane that ends somewhere: above it as `views` say, for
    which it casts no shadow; below, wherever a cell reaches there, as the `below` views say, for
    which it hides things like any surface."""
    status = classify_cells(views, None, origin, spacing, shape)
    under = classify_cells(below, None, origin, spacing, shape)
    low = 0.5 * spacing * np.abs(plane.normal).sum()
    middle = plane.signed_distance(origin + 0.5 * spacing)
    x, y, z = (spacing * n * np.arange(k) for n, k in zip(plane.normal, shape, strict=True))
    for layer in range(shape[0]):
        reaches = middle + x[layer] + y[:, None] + z < low
        np.copyto(status[layer], under[layer], where=reaches)
    return status


def classify_cells(
    views: Sequence[View],
    plane: Plane | None,
    origin: Vector,
    spacing: float,
    shape: tuple[int, int, int],
) -> UInt8[np.ndarray, "nx ny nz"]:
    """Status of every cell of a lattice: FREE, OCCLUDED, PARTLY or UNOBSERVED (`kernels`).

    Cell (i, j, k) spans spacing metres from origin + spacing * (i, j, k). A view that sees a cell
    outweighs any number that do not. Cells wholly under the support plane are called FREE: the
    half-space answers for them. So are cells wholly in a ball of the robot in any view, where no
    view shows something else before them.
    """
    status = np.full(shape, kernels.UNOBSERVED, dtype=np.uint8)
    blocks = -(-shape[0] // _BLOCK)
    for view in views:

        def look(piece: slice, view: View = view) -> None:
            kernels.classify_cells(
                origin, spacing, view.camera, view.optics, view.reach, view.holes, status,
                piece.start, piece.stop,
            )  # fmt: skip

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
    _clear_robots(views, origin, spacing, status)
    return status


def robot_balls(views: Sequence[View]) -> Balls:
    """Balls of the robots in all views."""
    return np.concatenate([np.empty((0, 4)), *(view.robot for view in views)])


def _clear_robots(
    views: Sequence[View], origin: Vector, spacing: float, status: UInt8[np.ndarray, "nx ny nz"]
) -> None:
    """Call the cells free in which a pictured robot was."""
    balls = robot_balls(views)
    if not len(balls):
        return
    low = np.floor(((balls[:, :3] - balls[:, 3:]).min(axis=0) - origin) / spacing)
    high = np.ceil(((balls[:, :3] + balls[:, 3:]).max(axis=0) - origin) / spacing)
    low = np.clip(low, 0, status.shape).astype(np.int64)
    part = status[window(low, np.clip(high, low, status.shape))]
    corner, robot = origin + spacing * low, np.zeros(part.shape, dtype=bool)
    kernels.mark_cells_within(balls, corner, spacing, robot)
    robot &= part != kernels.FREE
    if not robot.any():
        return
    for view in views:
        if view.against is not None:
            code = np.full(part.shape, kernels.UNOBSERVED, dtype=np.uint8)
            kernels.classify_cells(
                corner, spacing, view.camera, view.optics, view.against, view.holes, code,
                0, -(-part.shape[0] // _BLOCK),
            )  # fmt: skip
            robot &= (code != kernels.OCCLUDED) & (code != kernels.PARTLY)
    part[robot] = kernels.FREE


def classify_points(views: Sequence[View], points: Points) -> UInt8[np.ndarray, " n"]:
    """Status of every point: SEEN, OCCLUDED or UNOBSERVED; SEEN also where the robot was."""
    points = np.ascontiguousarray(points, dtype=np.float64)
    status = np.full(len(points), kernels.UNOBSERVED, dtype=np.uint8)
    for view in views:

        def look(piece: slice, view: View = view) -> None:
            kernels.classify_points(
                points, view.camera, view.optics, view.reach, view.holes, status,
                piece.start, piece.stop,
            )  # fmt: skip

        run_chunked(look, len(points), 1 << 14)
    balls = robot_balls(views)
    hidden = np.flatnonzero(status != kernels.FREE) if len(balls) else np.empty(0, dtype=int)
    robot = hidden[within_balls(points[hidden], balls)]
    for view in views:
        if view.against is not None and len(robot):
            code = np.full(len(robot), kernels.UNOBSERVED, dtype=np.uint8)
            kernels.classify_points(
                points[robot], view.camera, view.optics, view.against, view.holes, code,
                0, len(robot),
            )  # fmt: skip
            robot = robot[(code != kernels.OCCLUDED) & (code != kernels.PARTLY)]
    status[robot] = kernels.FREE
    return _OF_POINT[status]


def beside(points: Points, dense: Chosen) -> Chosen:
    """Which points (m) are dense, or within half a block of one that is."""
    if dense.all() or not dense.any():
        return dense
    gap, _ = cKDTree(points[dense]).query(points[~dense], distance_upper_bound=0.5 * BLOCK)
    found = dense.copy()
    found[~dense] = np.isfinite(gap)
    return found


def _at_step(view: Observation) -> Bool[np.ndarray, "h w"]:
    """Which pixels have, within two pixels, both a nearer and a farther return."""
    depth = np.asarray(view.depth, dtype=np.float64)
    near = minimum_filter(np.where(depth > 0, depth, np.inf), 5)
    far = maximum_filter(depth, 5)
    return (near < depth - _STEP) & (far > depth + _STEP)


@lru_cache(maxsize=8)  # a world asks twice, and the world of the next view again
def clutter_pixels(
    view: Observation,
    plane: Plane | None,
    height: float,
    lone_share: float | None = None,
    bounded: bool = False,
) -> Bool[np.ndarray, "h w"]:
    """Which pixels show unlabelled things off the support plane.

    "Off" is `height` metres, or three standard deviations of the depth noise along the normal, if
    that is more; below the plane as well if the support is `bounded`. Without a plane every
    unlabelled pixel is. Pixels of the robot are not clutter, nor are points that with all others
    off the plane fill less than `lone_share` of what a surface facing the camera would show in the
    3 cm around them: flying pixels. A rod 1 mm thick fills 3 percent. What lies within 1.5 cm of a
    point that is none stays: tips and edges lack half their surroundings. None: 3 percent, and only
    of points between a nearer and a farther one, two pixels away at most: there such pixels come
    from, while a wire's have nothing nearer beside them.
    """
    points, labels = view.points()
    valid = view.depth > 0
    depth = np.asarray(view.depth, dtype=np.float64)[valid]
    chosen = (labels == 0) & ~view.sees_robot[valid]
    if plane is not None:
        sigma = height_sigma(points - view.camera_center, depth, plane.normal)
        threshold = np.maximum(height, 3.0 * sigma)
        away = plane.signed_distance(points)
        off = (np.abs(away) if bounded else away) > threshold
        chosen &= off
        share = _LONE if lone_share is None else lone_share
        if share > 0.0:
            focal = min(float(view.intrinsics[0, 0]), float(view.intrinsics[1, 1]))
            whole = (BLOCK * focal / depth[off]) ** 2
            dense = beside(points[off], points_around(points[off]) >= share * whole)
            if lone_share is None:
                dense |= ~_at_step(view)[valid][off]
            chosen[off] &= dense
    found = np.zeros(view.shape, dtype=bool)
    found[valid] = chosen
    found.setflags(write=False)
    return found


def background_points(
    views: Sequence[Observation],
    plane: Plane | None,
    height: float,
    lone_share: float | None = None,
    bounded: bool = False,
) -> tuple[Points, Values]:
    """Points of the `clutter_pixels`, and half the width of their pixels, metres."""
    kept, widths = [np.empty((0, 3))], [np.empty(0)]
    for view in views:
        chosen = clutter_pixels(view, plane, height, lone_share, bounded)
        focal = min(float(view.intrinsics[0, 0]), float(view.intrinsics[1, 1]))
        kept.append(view.points()[0][chosen[view.depth > 0]])
        widths.append(0.5 * np.asarray(view.depth, dtype=np.float64)[chosen] / focal)
    return np.concatenate(kept), np.concatenate(widths)


_FRAY = 2  # pixels by which masks and depth images are frayed along every outline
_LOCAL = 11  # pixels


def without_fringe(found: Mask, others: Mask) -> Mask:
    """Leave out found pixels that reach no farther than `_FRAY` from others, where these are more
    in the `_LOCAL` pixels around: a fringe of theirs, and not a thing with specks."""
    if not found.any():
        return found
    box = bounding(found, _LOCAL)
    near, beside_it, left = found[box], others[box], found.copy()
    if beside_it.any():
        deep = near & (distance_transform_edt(~beside_it) > _FRAY)
        kept = binary_dilation(deep, np.ones((3, 3), dtype=bool), iterations=_FRAY)
        more = uniform_filter(near.astype(np.float64) - beside_it, _LOCAL, mode="constant") > 0.0
        left[box] &= kept | more
    return left


def clutter_depth(view: Observation, plane: Plane | None, config: WorldConfig) -> Image:
    """Depth (metres) from which unlabelled clutter, or the pictured robot, hides what is behind it,
    inf elsewhere.

    A fringe that a mask left out hides what its object hides.
    """
    bounded = config.support == "seen"
    chosen = clutter_pixels(view, plane, config.background_height, config.lone_share, bounded)
    if view.labels is not None:
        chosen = without_fringe(chosen, view.labels > 0)
    chosen = chosen | view.sees_robot
    return np.where(chosen, np.asarray(view.depth, dtype=np.float64), np.inf)
