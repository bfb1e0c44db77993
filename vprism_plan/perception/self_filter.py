# SPDX-License-Identifier: BSD-3-Clause
"""Tell the robot in the picture from the scene, or it would be an obstacle to itself."""

import logging
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from vprism_plan._arguments import number
from vprism_plan._shapes import Points, Values
from vprism_plan.errors import ObservationError
from vprism_plan.perception.camera import (
    backproject,
    invert_transform,
    project,
    stereo_noise,
    transform_points,
    within_balls,
)
from vprism_plan.perception.image_graph import flying_pixels, surface_image
from vprism_plan.perception.observation import Observation, to_numpy

logger = logging.getLogger(__name__)

Balls = Float[np.ndarray, "_ 4"]

# A label is the robot's if so much of what it shows is on the robot's surface: within three
# standard deviations of the depth noise, and 3 mm by which balls miss a solid's edges.
_OWN_SHARE, _EDGES = 0.9, 0.003
# Shares from which on a label beside the robot, or seeing through the robot, is odd.
_MANY, _SEEN_THROUGH = 0.05, 0.1


def ignore_robot(
    observation: Observation,
    centers: Any,
    radii: Any,
    padding: float = 0.01,
    *,
    room: float = 0.0,
    remove_flying: bool = True,
) -> Observation:
    """Mark the pixels that see the robot, given balls that it filled when the image was taken.

    Unlabelled pixels within the padded balls become neither objects nor background
    obstacles, and do not vote for the support plane. The rays up to them remain free space,
    and what lies behind them is occluded. Hidden space in the balls themselves, without
    padding, is free: the robot was there.

    That is your word. Balls that stand out of the robot give away space that nobody saw: for a
    robot with a URDF, use `ignore_self`. What is seen outranks it: a label within the balls
    stays and is an obstacle, and behind what was seen in the balls or within 10 cm of them no
    hidden space is free.

    Called again (a second robot, a tool), it adds to what is marked. Call it after labelling.

    Args:
        observation: Posed, or else `centers` are in the camera frame.
        centers: (S, 3) world, metres; array or tensor.
        radii: (S,) metres.
        padding: Metres beyond the balls in which a pixel still sees the robot: the error of the
            camera's pose, and the sensor's noise.
        room: Metres beyond the balls in which hidden space is free, by your word: the checker's
            margin and twice the world's resolution make the pictured configuration valid.
        remove_flying: Whether flying pixels, which sensors invent between the robot and what
            lies behind it, become "no return" within two pixels of one that sees the robot:
            they would be obstacles in mid-air.

    Returns:
        The observation with `robot_spheres` set, and a warning if `room` is above 0.

    Raises:
        ObservationError: centres or radii do not fit each other or are not finite.
        ConfigError: a padding or room that is negative or not finite.
    """
    number("padding", padding, 0.0, unit="metres")
    number("room", room, 0.0, unit="metres")
    places, sizes = to_numpy(centers, "centers"), to_numpy(radii, "radii")
    if places.ndim != 2 or places.shape[1:] != (3,) or sizes.shape != places.shape[:1]:
        found = f"centers have shape {places.shape} and radii {sizes.shape}"
        raise ObservationError(f"{found}; they must be (S, 3) and (S,), metres")
    sizes = np.where(sizes > 0, sizes.astype(np.float64), -np.inf)  # no padding mends these
    marked = _with_balls(observation, places, sizes + padding, sizes + room)
    if room > 0.0:
        text = f"{room:g} m around the pictured robot's balls count as free by your word"
        marked = replace(marked, warnings=(*marked.warnings, text))
    return _finished(observation, marked, remove_flying)


def ignore_self(
    observation: Observation,
    robot: Any,
    q: Any,
    padding: float = 0.01,
    *,
    room: float | None = None,
    remove_flying: bool = True,
) -> Observation:
    """`ignore_robot` for a robot that stood in configuration `q` when the image was taken.

    What counts is the robot's own solids (`Robot.solid_balls`): the URDF's collision geometry
    and the meshes of attached objects, without padding and scale. An unlabelled pixel sees the
    robot if its point is within `padding` and three standard deviations of the depth noise
    of a solid. Hidden space inside the solids is free; beside and behind them it stays hidden.
    A label of which nine tenths lie on the surface of the solids, within the noise, is the
    robot's and becomes 0. All others stay, and are obstacles.

    The collision spheres of a checker stand out of the solids, so in the shadow of its own
    links the pictured configuration is usually refused as "occluded". `room` is your word
    that nothing is there: hidden space within the collision spheres (of the robot that will be
    checked, with its padding and what it holds) and `room` metres around them is free, but not
    behind things that were seen near it. The checker's margin and twice the world's resolution
    are enough (0.02 by default).

    Args:
        observation: Posed in the world in which the robot's base stands, and labelled if it
            will be.
        robot: A `Robot`; of anything else `sphere_centers(q)` (torch tensor (dof,) -> (S, 3),
            world, metres) and `sphere_radii` (S,) count.
        q: (dof,) radians or metres.
        padding, remove_flying: See `ignore_robot`.
        room: Metres around the collision spheres, or None for no such word.

    Returns:
        The observation with `robot_spheres` set, and `warnings` of what is odd: links without
        solids (spheres only, or a mesh file that is missing) are their collision spheres.

    Raises:
        RobotError: q is not a configuration of the robot.
        ObservationError: the observation is not posed, so nobody knows where the robot is.
        ConfigError: a padding or room that is negative or not finite.
    """
    import torch

    number("padding", padding, 0.0, unit="metres")
    number("room", 0.0 if room is None else room, 0.0, unit="metres")
    if not observation.posed:
        raise ObservationError(
            "the observation has no T_world_camera, so the robot cannot be placed in it; give "
            "its pose, or ignore_robot with centres in the camera frame"
        )
    centers = robot.sphere_centers(torch.as_tensor(np.asarray(q, dtype=np.float64)))
    if not hasattr(robot, "solid_balls"):
        return ignore_robot(
            observation, centers, robot.sphere_radii, padding,
            room=room or 0.0, remove_flying=remove_flying
        )  # fmt: skip
    solid = robot.solid_balls(q)
    said: list[str] = []
    marked, rows = observation, solid.spheres
    if len(rows):
        marked = _with_balls(marked, rows[:, :3], rows[:, 3] + padding, rows[:, 3])
        said.append(
            f"the links {list(solid.without)} have no solids that can be read, so their collision "
            "spheres, which may stand out of them, are taken for the pictured robot; give them "
            "<collision> geometry or a mesh"
        )
    inner = solid.inner
    noise = 3.0 * stereo_noise(_in_camera(observation, inner[:, :3])[:, 2])
    marked = _with_balls(marked, inner[:, :3], inner[:, 3] + padding + noise, inner[:, 3])
    if room is not None:
        places, sizes = to_numpy(centers, "centers"), to_numpy(robot.sphere_radii, "radii")
        marked = _with_balls(marked, places, np.zeros(len(sizes)), sizes + room)
        said.append(
            f"hidden space within the pictured robot's collision spheres and {room:g} m around "
            "them counts as free by your word (room)"
        )
    rows = np.column_stack([_in_camera(observation, inner[:, :3]), inner[:, 3]])
    marked = _without_own_labels(marked, rows, noise + _EDGES)
    said += _seen_through(observation, rows, padding + noise)
    marked = replace(marked, warnings=(*marked.warnings, *said))
    return _finished(observation, marked, remove_flying)


def _in_camera(observation: Observation, places: Points) -> Points:
    return transform_points(invert_transform(observation.pose), places)


def _with_balls(
    observation: Observation, places: Points, radii: Values, free: Values
) -> Observation:
    """The observation with balls of a robot (world, metres) added to those that it has."""
    rows = np.column_stack([_in_camera(observation, places), radii, free])
    before = observation.robot_spheres
    if before is not None:
        rows = np.vstack([before[:, [0, 1, 2, 3, -1]], rows])
    return replace(observation, robot_spheres=rows)


def _without_own_labels(observation: Observation, inner: Balls, thick: Values) -> Observation:
    """Take away the labels that lie on balls of the robot (camera frame), within `thick`."""
    if observation.labels is None:
        return observation
    labels = observation.labels.copy()
    outer, core = (np.column_stack([inner[:, :3], inner[:, 3] + t]) for t in (thick, -thick))
    for label, own in _objects(observation):
        on_surface = within_balls(own, outer)
        on_surface[on_surface] = ~within_balls(own[on_surface], core)
        if on_surface.mean() >= _OWN_SHARE:
            labels[labels == label] = 0
    return replace(observation, labels=labels)


def _objects(observation: Observation) -> list[tuple[int, Points]]:
    """Ids, and points in the camera frame, of the objects."""
    points = backproject(observation.depth, observation.intrinsics)
    seen = observation.depth > 0
    return [(i, points[(observation.labels == i) & seen]) for i in observation.object_ids]


def _labels_on_robot(observation: Observation) -> list[str]:
    """Say which objects are seen in or on the robot."""
    found = []
    for label, own in _objects(observation):
        share = float(within_balls(own, observation.robot_spheres[:, :4]).mean())
        if share > _MANY:
            found.append(
                f"{share:.0%} of object {label} is seen in or on the pictured robot, and it stays "
                "an obstacle; if it is the robot or what that holds, set its label to 0"
            )
    return found


def _seen_through(observation: Observation, inner: Balls, tolerance: Values) -> list[str]:
    """Whether the camera saw past places where the robot should have been."""
    pixels, depth = project(inner[:, :3], observation.intrinsics)
    inside = (depth > 0) & (np.nan_to_num(pixels, nan=-1.0) >= 0).all(axis=1)
    column, row = np.rint(pixels[inside]).astype(np.int64).T
    kept = (row < observation.shape[0]) & (column < observation.shape[1])
    seen = np.asarray(observation.depth, dtype=np.float64)[row[kept], column[kept]]
    past = seen > (depth + inner[:, 3] + tolerance)[inside][kept]
    if not (seen > 0).any() or past[seen > 0].mean() <= _SEEN_THROUGH:
        return []
    return [
        f"the camera saw through {past[seen > 0].mean():.0%} of the places in the image that the "
        "robot should have filled; check q, base_pose and T_world_camera"
    ]


def _finished(before: Observation, marked: Observation, remove_flying: bool) -> Observation:
    said = dict.fromkeys([*marked.warnings, *_labels_on_robot(marked)])
    marked = replace(marked, warnings=tuple(said))
    robot, depth = marked.sees_robot, marked.depth
    beside = ndimage.binary_dilation(robot, np.ones((3, 3), dtype=bool), iterations=2) & ~robot
    if remove_flying and beside.any():
        # In place of height over a plane, which may be unknown: every jump in depth counts.
        flying = flying_pixels(surface_image(depth, marked.intrinsics, depth)) & beside
        marked = replace(marked, depth=np.where(flying, 0.0, depth))
        logger.info("%d flying pixels along the robot's outline removed", int(flying.sum()))
    logger.info("%d pixels see the robot", int(marked.sees_robot.sum()))
    own = sorted(set(before.object_ids) - set(marked.object_ids))
    if own:
        logger.warning("objects %s are the pictured robot: they are ignored with it", own)
    return marked
