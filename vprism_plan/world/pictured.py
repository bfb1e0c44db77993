# SPDX-License-Identifier: BSD-3-Clause
"""A robot in the picture: where it stood nothing else was, unless a camera says otherwise.

Hidden space within the robot's balls is free, because the robot was there. That is somebody's
word, and what was seen outranks it: where a camera shows something else in or near those
balls, all that lies behind it stays hidden.
"""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool, Float

from vprism_plan._kernels import world as kernels
from vprism_plan.perception import Observation
from vprism_plan.perception.balls import within_balls
from vprism_plan.perception.camera import transform_points

# Metres: what was seen so near to the robot's balls may reach into them where nobody sees it.
_NEAR = 0.1


def free_balls(observations: Iterable[Observation]) -> Float[np.ndarray, "s 4"]:
    """Balls (world, metres) in which there was nothing but the pictured robot."""
    found = [np.empty((0, 4))]
    for observation in observations:
        if observation.robot_spheres is not None:
            rows = observation.robot_spheres
            middles = transform_points(observation.pose, rows[:, :3])
            found.append(np.column_stack([middles, rows[:, -1]])[rows[:, -1] > 0.0])
    return np.concatenate(found)


def speaking_against(
    observation: Observation, things: Bool[np.ndarray, "h w"], balls: Float[np.ndarray, "s 4"]
) -> Float[np.ndarray, "h w"]:
    """Depth (metres) of the pixels behind which the balls are not believed, inf elsewhere.

    These are what shows a thing within 10 cm of a ball, and all that shows the same object.

    Args:
        observation: a view.
        things: pixels that show neither the robot nor the support surface.
        balls: of `free_balls`, all views together.
    """
    near = np.zeros(observation.shape, dtype=bool)
    if not len(balls):
        return np.full(observation.shape, np.inf)
    wide = balls + np.array([0.0, 0.0, 0.0, _NEAR])
    near[things] = within_balls(observation.point_image()[things], wide)
    if observation.labels is not None:
        objects = np.unique(observation.labels[near])
        near |= things & np.isin(observation.labels, objects[objects > 0])
    return np.where(near, np.asarray(observation.depth, dtype=np.float64), np.inf)


def cells_within(
    balls: Float[np.ndarray, "s 4"],
    origin: Float[np.ndarray, " 3"],
    spacing: float,
    shape: tuple[int, int, int],
) -> tuple[tuple[slice, slice, slice], Bool[np.ndarray, "x y z"]]:
    """Part of a lattice around the balls, and its cells that lie wholly in one of them."""
    low = np.floor(((balls[:, :3] - balls[:, 3:]).min(axis=0) - origin) / spacing)
    high = np.ceil(((balls[:, :3] + balls[:, 3:]).max(axis=0) - origin) / spacing)
    low = np.clip(low, 0, shape).astype(np.int64)
    high = np.clip(high, low, shape).astype(np.int64)
    x, y, z = (slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
    marked = np.zeros(tuple(high - low), dtype=bool)
    kernels.mark_cells_within(balls, origin + spacing * low, spacing, marked)
    return (x, y, z), marked
