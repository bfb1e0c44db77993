# SPDX-License-Identifier: BSD-3-Clause
"""Tell the robot in the picture from the scene, or it would be an obstacle to itself."""

import logging
from dataclasses import replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool

from vprism_plan.errors import ConfigError, ObservationError
from vprism_plan.perception._image_graph import flying_pixels, surface_image
from vprism_plan.perception._validation import to_numpy
from vprism_plan.perception.camera import invert_transform, transform_points
from vprism_plan.perception.observation import Observation

logger = logging.getLogger(__name__)


@runtime_checkable
class SphereRobot(Protocol):
    """What `ignore_self` needs of a robot."""

    @property
    def sphere_radii(self) -> Any:
        """(S,) metres."""

    def sphere_centers(self, q: Any) -> Any:
        """Torch tensor (dof,) -> (S, 3), world, metres."""


def ignore_robot(
    observation: Observation,
    centers: Any,
    radii: Any,
    padding: float = 0.01,
    *,
    remove_flying: bool = True,
) -> Observation:
    """Mark the pixels that see the robot, given the balls that held it when the image was taken.

    Such pixels become neither objects nor background obstacles, and do not vote for the
    support plane. The rays up to them remain free space, and what lies behind them is
    occluded, as behind anything that was seen. The balls themselves, and a grid step
    around them, count as free although nobody saw through them: the robot was there.

    Between the robot and its padded balls that is an assumption. What hides there, or is
    held and not attached to the robot, is not seen, and a surface that was seen there is
    ignored. So keep `padding` small, but no smaller than the error of the camera's pose
    and the sensor's noise; and for the pictured configuration to be valid, no smaller than
    the checker's margin and half the world's resolution together.

    Flying pixels, which sensors invent along the robot's outline between it and what lies
    behind, are set to depth 0, "no return" (`remove_flying`): they would be obstacles in
    mid-air beside the arm. Only pixels within two of one that sees the robot are touched.

    Called again (a second robot, a tool), it adds to what is marked.

    Args:
        observation: Posed, or else `centers` are in the camera frame.
        centers: (S, 3) world, metres; array or tensor.
        radii: (S,) metres.
        padding: Metres added to every radius.
        remove_flying: Whether flying pixels along the outline are removed.

    Returns:
        The observation with `robot_spheres` set, and label 0 where it sees the robot.

    Raises:
        ObservationError: centres or radii do not fit each other or are not finite.
        ConfigError: a padding that is negative or not finite.
    """
    if not (np.isfinite(padding) and padding >= 0.0):
        raise ConfigError(f"padding is {padding}; it must be 0 or more (metres)")
    places, sizes = to_numpy(centers, "centers"), to_numpy(radii, "radii")
    if places.ndim != 2 or places.shape[1:] != (3,) or sizes.shape != places.shape[:1]:
        raise ObservationError(
            f"centers have shape {places.shape} and radii {sizes.shape}; they must be (S, 3) and "
            "(S,), metres"
        )
    in_camera = transform_points(invert_transform(observation.pose), places)
    spheres = np.column_stack([in_camera, sizes.astype(np.float64) + padding])
    if (sizes <= 0).any():
        spheres[sizes <= 0, 3] = -1.0  # padding must not make sense of a wrong radius
    before = observation.robot_spheres
    marked = replace(
        observation,
        robot_spheres=spheres if before is None else np.vstack([before, spheres]),
    )
    if remove_flying:
        flying = _flying_outline(marked)
        marked = replace(marked, depth=np.where(flying, 0.0, marked.depth))
        logger.info("%d flying pixels along the robot's outline removed", int(flying.sum()))
    _report(observation, marked)
    return marked


def ignore_self(
    observation: Observation,
    robot: SphereRobot,
    q: Any,
    padding: float = 0.01,
    *,
    remove_flying: bool = True,
) -> Observation:
    """`ignore_robot` for a robot that stood in configuration `q` when the image was taken.

    Give the robot that will be checked later: with its padding and with what it holds
    attached, or its own shadow would refuse the larger robot.

    Args:
        observation: Posed in the world in which the robot's base stands.
        robot: A `Robot`, or anything with its `sphere_centers` and `sphere_radii`.
        q: (dof,) radians or metres.
        padding: Metres added to every radius; see `ignore_robot`.
        remove_flying: See `ignore_robot`.

    Raises:
        RobotError: q is not a configuration of the robot.
        ObservationError: the observation is not posed, so nobody knows where the robot is.
    """
    import torch

    if not observation.posed:
        raise ObservationError(
            "the observation has no T_world_camera, so the robot cannot be placed in it; give "
            "its pose, or ignore_robot with centres in the camera frame"
        )
    configuration = torch.as_tensor(np.asarray(q, dtype=np.float64))
    return ignore_robot(
        observation,
        robot.sphere_centers(configuration),
        robot.sphere_radii,
        padding,
        remove_flying=remove_flying,
    )


def _flying_outline(observation: Observation) -> Bool[np.ndarray, "h w"]:
    """Flying pixels within two pixels of one that sees the robot."""
    from scipy import ndimage

    robot = observation.sees_robot
    beside = ndimage.binary_dilation(robot, np.ones((3, 3), dtype=bool), iterations=2) & ~robot
    if not beside.any():
        return beside
    # In place of height over a plane, which may be unknown: every jump in depth counts.
    image = surface_image(observation.depth, observation.intrinsics, observation.depth)
    return np.asarray(flying_pixels(image) & beside)


def _report(before: Observation, after: Observation) -> None:
    """Log what the robot covers; an object that vanishes under it is worth a warning."""
    logger.info("%d pixels see the robot", int(after.sees_robot.sum()))
    lost = sorted(set(before.object_ids) - set(after.object_ids))
    if lost:
        logger.warning(
            "every pixel of objects %s lies on the robot: they are ignored with it", lost
        )
