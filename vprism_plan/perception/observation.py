# SPDX-License-Identifier: BSD-3-Clause
"""One view of the scene: depth, labels and a known camera."""

from dataclasses import InitVar, dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float, Int32

from vprism_plan._arguments import number, rigid_pose
from vprism_plan._shapes import Image, Pixels, PointImage, Points, Pose, Vector
from vprism_plan.errors import ObservationError
from vprism_plan.perception.camera import backproject, transform_points, within_balls
from vprism_plan.perception.labels import label_image, to_numpy
from vprism_plan.perception.plane import Plane

# Metres. Sensors for table tops end before it, and stereo knows nothing of centimetres there.
DEFAULT_MAX_RANGE = 10.0
# Metres that no table-top sensor measures: medians beyond are millimetres, or depth scaled twice.
MIN_MEDIAN_DEPTH, MAX_MEDIAN_DEPTH = 0.005, 50.0
_USABLE_SHARE = 0.05  # of returns within the sensor's range: with fewer, the unit is wrong
_INFINITE = float(np.finfo(np.float32).max)  # what np.nan_to_num makes of infinity
_RIGID = 1e-3  # by how much a rotation may be off orthonormal


@dataclass(frozen=True, eq=False)
class Observation:
    """One segmented depth image with its camera, validated once, here.

    Arrays, nested lists and torch tensors are accepted, and copied: drivers reuse buffers.

    Attributes:
        depth: (H, W) float32 or float64, metres along the optical axis (not along the ray),
            0 = no return. NaN, infinities and what lies beyond `max_range` become 0.
        labels: (H, W) int32, 0 = background, positive = object id; None = not segmented. Given
            may also be masks (N, H, W), colours, and SAM's and COCO's lists: see `label_image`.
        intrinsics: (3, 3) float64 pinhole matrix, pixels, pixel centres at whole numbers.
        T_world_camera: (4, 4) float64, maps camera to world coordinates; None = unposed,
            and then the world frame *is* the camera frame.
        color: (H, W, 3) uint8 RGB, or None.
        plane: support plane in the world frame if it is known.
        robot_spheres: (S, 4) float64 rows (x, y, z, radius), metres, *camera* frame: balls
            of the robot when the image was taken (`ignore_self` and `ignore_robot` set them);
            None = nobody said where it was. What an unlabelled pixel shows within `radius` is
            the robot. Nothing else was within a fifth number, `free`, of the middle: hidden
            space there is free (left out: the radius). Labels outrank the balls.
        warnings: what is usable but odd about this view, one sentence each with its remedy;
            handed on to the map, the world and every verdict.
        max_range: metres of depth beyond which a return is none: what lies there is a driver's
            value for "no data", or a mirror, and must not make all before it free.
        time: seconds of any clock, when the image was taken; None = nobody said.
        clear: (H, W) metres of optical axis to which a ray is still known to be free, 0 = nowhere;
            None = up to `depth`. Updates set it in views of a scene that has changed since:
            where `depth` is 0 the surface has gone, and what lies beyond `clear` is hidden.
        background_ids: only given: ids among `labels` that are no object; they become 0.

    Raises:
        ObservationError: what is wrong, what would be valid, and the remedy.
    """

    depth: Any
    labels: Any
    intrinsics: Any
    T_world_camera: Any = None
    color: Any = None
    plane: Any = None
    robot_spheres: Any = None
    warnings: tuple[str, ...] = ()
    max_range: float = DEFAULT_MAX_RANGE
    time: Any = None
    clear: Any = None
    background_ids: InitVar[Any] = ()

    def __post_init__(self, background_ids: Any) -> None:
        max_range = number("max_range", self.max_range, 0.0, above=True, error=ObservationError)
        depth, found = check_depth(self.depth, max_range, empty=self.clear is not None)
        checked: dict[str, Any] = {
            "max_range": max_range,
            "depth": depth,
            "intrinsics": check_intrinsics(self.intrinsics, depth.shape),
        }
        if self.labels is not None:
            shape = (depth.shape[0], depth.shape[1])
            checked["labels"], said = label_image(self.labels, shape, background_ids)
            found += said
        if self.T_world_camera is not None:
            checked["T_world_camera"] = check_pose(self.T_world_camera)
        if self.color is not None:
            checked["color"] = check_color(self.color, depth.shape)
        if self.plane is not None and not isinstance(self.plane, Plane):
            raise ObservationError(f"plane is a {type(self.plane).__name__}; give a Plane or None")
        if self.robot_spheres is not None:
            checked["robot_spheres"] = check_robot_spheres(self.robot_spheres)
        if self.time is not None:
            checked["time"] = number("time", self.time, unit="seconds", error=ObservationError)
        if self.clear is not None:
            checked["clear"] = check_clear(self.clear, depth)
        checked["warnings"] = tuple(dict.fromkeys([*map(str, self.warnings), *found]))
        for name, value in checked.items():
            object.__setattr__(self, name, value)

    @classmethod
    def from_points(
        cls,
        points: Any,
        labels: Any,
        camera_position: Any,
        intrinsics: Any = None,
        **more: Any,
    ) -> "Observation":
        """Return the view that a point cloud is, as its camera saw it.

        Args:
            points: metres; NaN and (0, 0, 0) are no points. (H, W, 3), organised, is one point per
                pixel: intrinsics, and the turn of the camera, are recovered from the grid; if it
                is no pinhole image, a warning says so and it is taken as unorganised. (N, 3),
                unorganised, is looked at from `camera_position` in an image in which surfaces
                have no holes. A pixel has the nearest of its points.
            labels: for (H, W, 3) what `labels` may be, for (N, 3) ids (N,); None = not segmented.
            camera_position: (3,) in the frame of the points, metres, or (4, 4), the pose of the
                optical frame in it. That frame is the view's world, z up. Only if the camera is at
                its origin and all points have z > 0 are they taken to be in the optical frame
                itself: the view is unposed.
            intrinsics: (3, 3), pixels, if known; for (N, 3) those of the image to make.
            more: other attributes of a view: `plane`, `max_range`, `background_ids`, `color`
                (organised points only), `warnings`.

        Raises:
            ObservationError: what is wrong, what would be valid, and the remedy.
        """
        from vprism_plan.perception.point_clouds import image_of

        seen = image_of(points, labels, camera_position, intrinsics)
        seen["warnings"] += tuple(more.pop("warnings", ()))
        return cls(**seen, **more)

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W) of the images, pixels."""
        return int(self.depth.shape[0]), int(self.depth.shape[1])

    @property
    def posed(self) -> bool:
        """Whether the camera's pose in the world is known."""
        return self.T_world_camera is not None

    @property
    def pose(self) -> Pose:
        """Camera-to-world transform; the identity if unposed."""
        return np.eye(4) if self.T_world_camera is None else self.T_world_camera.copy()

    @property
    def camera_center(self) -> Vector:
        """Optical centre in the world frame, metres."""
        return self.pose[:3, 3]

    @property
    def free_depth(self) -> Image:
        """(H, W) metres of optical axis up to which a ray is free, 0 = nowhere."""
        return np.asarray(self.depth if self.clear is None else self.clear)

    @cached_property
    def sees_robot(self) -> Pixels:
        """Pixels without a label whose point lies in one of `robot_spheres`.

        They see neither an object nor background; what lies behind is hidden.
        """
        seen = np.zeros(self.shape, dtype=bool)
        if self.robot_spheres is None:
            return seen
        asked = self.depth > 0
        if self.labels is not None:
            asked &= self.labels == 0
        points = backproject(self.depth, self.intrinsics)[asked]
        seen[asked] = within_balls(points, self.robot_spheres[:, :4])
        return seen

    @cached_property
    def object_ids(self) -> tuple[int, ...]:
        """Sorted positive labels that occur on at least one pixel with a return."""
        if self.labels is None:
            return ()
        return tuple(np.unique(self.labels[(self.depth > 0) & (self.labels > 0)]).tolist())

    def require_objects(self) -> tuple[int, ...]:
        """Return `object_ids`, or explain why there is nothing to map.

        Raises:
            ObservationError: unlabelled, all background, or labelled only where depth is 0.
        """
        if self.labels is None:
            raise ObservationError("the observation has no labels; use segment_tabletop(obs)")
        if not self.object_ids:
            where = (
                "every labelled pixel has no depth return (registered images?)"
                if (self.labels > 0).any()
                else "every label is 0 (background)"
            )
            noted = "".join(f" ({text})" for text in self.warnings)
            raise ObservationError(
                f"the observation shows no object: {where}; objects need positive labels, "
                f"or use segment_tabletop(obs){noted}"
            )
        return self.object_ids

    def point_image(self) -> PointImage:
        """World point (metres) behind every pixel, NaN where there is no return."""
        return transform_points(self.pose, backproject(self.depth, self.intrinsics))

    def points(self) -> tuple[Points, Int32[np.ndarray, " n"]]:
        """World points (metres) of the pixels with a return, row by row, and their labels.

        Labels are all 0 if the observation is not segmented. Points of the robot are among them.
        Both are read-only.
        """
        return _points(self)


@lru_cache(maxsize=2)  # a map and its world ask a dozen times; all views at once may not fit
def _points(view: Observation) -> tuple[Points, Int32[np.ndarray, " n"]]:
    valid = view.depth > 0
    points = view.point_image()[valid]
    labels = np.zeros(len(points), dtype=np.int32) if view.labels is None else view.labels[valid]
    points.setflags(write=False)
    labels.setflags(write=False)
    return points, labels


# ------------------------------------------------------------------------------------- checks
def check_depth(
    value: Any, max_range: float, empty: bool = False
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return depth as a (H, W) float32 or float64 array in metres, 0 = no return.

    NaN, infinities and what lies beyond `max_range` (metres) are no returns. Named in the second
    value: -inf (REP 117: too near to measure), and what lies beyond, which a sensor made up.
    """
    depth = to_numpy(value, "depth")
    if depth.ndim != 2 or 0 in depth.shape:
        raise ObservationError(f"depth has shape {depth.shape}; it must be one image (H, W)")
    if depth.dtype.kind != "f":
        raise ObservationError(
            f"depth is {depth.dtype}, so it holds raw sensor units; give metres as float: "
            "depth * scale (0.001 for millimetres)"
        )
    if depth.dtype not in (np.float32, np.float64):
        depth = depth.astype(np.float32 if depth.dtype.itemsize <= 4 else np.float64)
    near = depth <= -_INFINITE
    negative = (depth < 0) & ~near
    if negative.any():
        row, col = np.argwhere(negative)[0]
        raise ObservationError(
            f"depth is {depth[row, col]:g} at row {row}, column {col} ({int(negative.sum())} "
            "negative pixels); it must be positive metres along the optical axis, or 0 where there "
            "is no return"
        )
    found: tuple[str, ...] = ()
    if near.any():
        found = (
            f"depth is -inf at {int(near.sum())} pixels, nearer than the sensor measures: they "
            "count as no return, so that what stands there is not in the map",
        )
    depth[near | ~(depth < _INFINITE)] = 0.0  # NaN compares false
    valid = depth[depth > 0]
    if len(valid) or not empty:
        _check_scale(valid, max_range)
    beyond = depth > max_range
    depth = np.ascontiguousarray(depth)
    if not beyond.any():
        return depth, found
    found += (
        f"{int(beyond.sum())} depth returns ({100 * beyond.sum() / valid.size:.2g} %) lie beyond "
        f"max_range = {max_range:g} m, the farthest at {valid.max():.4g} m; they count as no "
        "return: is it the sensor's value for 'no data'? If they are real, raise max_range",
    )
    depth[beyond] = 0.0
    return depth, found


def _check_scale(valid: np.ndarray, max_range: float) -> None:
    """Refuse returns (metres, all positive) that are in other units."""
    if valid.size == 0:
        raise ObservationError("depth is 0, NaN or infinite everywhere: there is nothing to map")
    usable = valid[valid <= max_range]
    # A value for "no data" may be in most pixels; it is the largest there is.
    body = valid[valid < valid.max()]
    median = float(np.median(body if body.size else valid))
    if median > MAX_MEDIAN_DEPTH and usable.size < _USABLE_SHARE * valid.size:
        found = f"median depth is {median:g} m, more than {MAX_MEDIAN_DEPTH:g} m"
        raise ObservationError(f"{found}: it looks like millimetres; multiply by 0.001")
    if usable.size == 0:
        raise ObservationError(
            f"every depth return lies beyond max_range = {max_range:g} m, the nearest at "
            f"{valid.min():g} m: is depth in metres? If it is, raise max_range"
        )
    median = float(np.median(usable))
    if median < MIN_MEDIAN_DEPTH:
        found = f"median depth is {median:g} m, less than {MIN_MEDIAN_DEPTH:g} m"
        raise ObservationError(f"{found}: it looks as if depth was scaled twice; give metres")


def check_intrinsics(value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return a (3, 3) float64 pinhole matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], pixels."""
    matrix = to_numpy(value, "intrinsics")
    wanted = "it must be the 3x3 pinhole matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels"
    if matrix.shape != (3, 3):
        raise ObservationError(f"intrinsics: the matrix has shape {matrix.shape}; {wanted}")
    matrix = matrix.astype(np.float64)
    if not np.isfinite(matrix).all():
        raise ObservationError(f"intrinsics are not finite: {matrix.tolist()}")
    if not np.allclose(matrix[-1], [0, 0, 1], atol=1e-9):
        found = f"intrinsics: the matrix has the last row {matrix[-1].tolist()}"
        raise ObservationError(f"{found}; {wanted} (is it transposed?)")
    (fx, skew, cx), (other_skew, fy, cy), _ = matrix
    if fx <= 0 or fy <= 0:
        found = f"focal lengths fx = {fx:g}, fy = {fy:g}"
        raise ObservationError(f"intrinsics are singular: {found} must be positive pixels")
    if max(abs(skew), abs(other_skew)) > 1e-6 * fx:
        remedy = "only a pinhole camera without is supported: rectify the image first"
        raise ObservationError(f"intrinsics have skew ({skew:g}, {other_skew:g}); {remedy}")
    matrix[0, 1] = matrix[1, 0] = 0.0
    height, width = shape
    if not (0 <= cx <= width and 0 <= cy <= height):
        raise ObservationError(
            f"principal point (cx, cy) = ({cx:g}, {cy:g}) lies outside the {width}x{height} "
            "image; scale the intrinsics to the image's resolution"
        )
    return matrix


def check_pose(value: Any) -> Float[np.ndarray, "4 4"]:
    """Return a rigid (4, 4) float64 transform; small rounding is removed, more is an error."""
    value = to_numpy(value, "T_world_camera")
    pose = rigid_pose("T_world_camera", value, tolerance=_RIGID, error=ObservationError)
    rotation = pose[:3, :3]
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > 1e-12:
        u, _, vt = np.linalg.svd(rotation)
        pose[:3, :3] = u @ vt
    return pose


def check_clear(value: Any, depth: np.ndarray) -> np.ndarray:
    """Return a (H, W) float image, metres: nowhere beyond the depth (H, W) that was seen."""
    clear = to_numpy(value, "clear")
    if clear.shape != depth.shape or clear.dtype.kind != "f" or not (clear >= 0.0).all():
        found = f"clear has shape {clear.shape} and type {clear.dtype}, or holds NaN or what is < 0"
        raise ObservationError(f"{found}; it must be metres, {depth.shape}")
    beyond = int((~np.isfinite(clear) | ((depth > 0.0) & (clear > depth))).sum())
    if beyond:
        raise ObservationError(
            f"clear reaches beyond the depth seen there, or to infinity, in {beyond} pixels; a ray "
            "is free up to its surface at most"
        )
    return np.ascontiguousarray(clear)


def check_color(value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return a (H, W, 3) uint8 image of the depth's shape."""
    color = to_numpy(value, "color")
    if color.shape != (*shape, 3) or color.dtype != np.uint8:
        found = f"color has shape {color.shape} and type {color.dtype}"
        raise ObservationError(f"{found}; it must be RGB uint8 of shape {(*shape, 3)}")
    return np.ascontiguousarray(color)


def check_robot_spheres(value: Any) -> np.ndarray:
    """Return float64 rows (x, y, z, radius) or (x, y, z, radius, free), metres."""
    spheres = to_numpy(value, "robot_spheres")
    if spheres.ndim != 2 or spheres.shape[1] not in (4, 5):
        wanted = "they must be rows (x, y, z, radius) or (x, y, z, radius, free), metres"
        raise ObservationError(f"robot_spheres have shape {spheres.shape}; {wanted}")
    spheres = spheres.astype(np.float64)
    radii = spheres[:, 3:]
    bad = ~np.isfinite(spheres).all(axis=1) | (radii < 0.0).any(axis=1) | ~(radii > 0.0).any(axis=1)
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        wanted = "centre and radius must be finite and the radius positive"
        raise ObservationError(f"row {row} of robot_spheres is {spheres[row].tolist()}; {wanted}")
    return np.ascontiguousarray(spheres)
