# SPDX-License-Identifier: BSD-3-Clause
"""One view of the scene: depth, labels and a known camera."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int32

from vprism_plan.errors import ObservationError
from vprism_plan.perception import _validation
from vprism_plan.perception.balls import within_balls
from vprism_plan.perception.camera import backproject, point_image
from vprism_plan.perception.plane import Plane

# Metres. Sensors for table tops end before it, and stereo knows nothing of centimetres there.
DEFAULT_MAX_RANGE = 10.0


@dataclass(frozen=True, eq=False)
class Observation:
    """One segmented depth image with its camera, validated once, here.

    Arrays, nested lists and torch tensors are accepted and copied, so a camera driver
    that reuses its buffers cannot change an observation.

    Attributes:
        depth: (H, W) float32 or float64, metres along the optical axis (not along the ray),
            0 = no return. NaN, infinity and what lies beyond `max_range` become 0.
        labels: (H, W) int32, 0 = background, positive = object id; None = not segmented.
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
            value for "no data", or a mirror. A ray that ends nowhere has seen nothing, one that
            ends 65 m away has "seen" all before it free.

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

    def __post_init__(self) -> None:
        max_range = _validation.check_max_range(self.max_range)
        depth, found = _validation.check_depth(self.depth, max_range)
        checked: dict[str, Any] = {
            "max_range": max_range,
            "depth": depth,
            "intrinsics": _validation.check_intrinsics(self.intrinsics, depth.shape),
        }
        if self.labels is not None:
            checked["labels"] = _validation.check_labels(self.labels, depth.shape)
        if self.T_world_camera is not None:
            checked["T_world_camera"] = _validation.check_pose(self.T_world_camera)
        if self.color is not None:
            checked["color"] = _validation.check_color(self.color, depth.shape)
        if self.plane is not None and not isinstance(self.plane, Plane):
            raise ObservationError(f"plane is a {type(self.plane).__name__}; give a Plane or None")
        if self.robot_spheres is not None:
            checked["robot_spheres"] = _validation.check_robot_spheres(self.robot_spheres)
        checked["warnings"] = tuple(dict.fromkeys([*map(str, self.warnings), *found]))
        for name, value in checked.items():
            object.__setattr__(self, name, value)

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W) of the images, pixels."""
        return int(self.depth.shape[0]), int(self.depth.shape[1])

    @property
    def posed(self) -> bool:
        """Whether the camera's pose in the world is known."""
        return self.T_world_camera is not None

    @property
    def pose(self) -> Float[np.ndarray, "4 4"]:
        """Camera-to-world transform; the identity if unposed."""
        return np.eye(4) if self.T_world_camera is None else self.T_world_camera.copy()

    @property
    def camera_center(self) -> Float[np.ndarray, " 3"]:
        """Optical centre in the world frame, metres."""
        return self.pose[:3, 3]

    @cached_property
    def sees_robot(self) -> Bool[np.ndarray, "h w"]:
        """Pixels without a label whose point lies in one of `robot_spheres`.

        What they see is neither an object nor background: it moves. The ray up to it is
        free, and what lies behind it is hidden.
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
        ids = np.unique(self.labels[self.depth > 0])
        return tuple(int(i) for i in ids if i > 0)

    def require_objects(self) -> tuple[int, ...]:
        """Return `object_ids`, or explain why there is nothing to map.

        Raises:
            ObservationError: unlabelled, all background, or labelled only where depth is 0.
        """
        if self.labels is None:
            raise ObservationError(
                "the observation has no labels; segment it first: segment_tabletop(obs)"
            )
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

    def point_image(self) -> Float[np.ndarray, "h w 3"]:
        """World point (metres) behind every pixel, NaN where there is no return."""
        return point_image(self.depth, self.intrinsics, self.pose)

    def points(self) -> tuple[Float[np.ndarray, "n 3"], Int32[np.ndarray, " n"]]:
        """World points (metres) of the pixels with a return, row by row, and their labels.

        Labels are all 0 if the observation is not segmented. Points of the robot
        (`sees_robot`) are among them, with label 0.
        """
        valid = self.depth > 0
        points = self.point_image()[valid]
        if self.labels is None:
            return points, np.zeros(len(points), dtype=np.int32)
        return points, self.labels[valid]
