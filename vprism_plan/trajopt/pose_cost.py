# SPDX-License-Identifier: BSD-3-Clause
"""The cost of a link being elsewhere than wanted."""

import dataclasses
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import ArrayLike
from torch import Tensor

from vprism_plan.errors import ConfigError, RobotError
from vprism_plan.robots.kinematics import TorchKinematics
from vprism_plan.trajopt._samples import require_dof
from vprism_plan.trajopt.cost import TrajectoryCost, at_least


class PoseCost(TrajectoryCost):
    """Squared distance of a link from a wanted pose, at one waypoint.

        w_p |t(q) - t*|^2 + w_r 2 (1 - cos angle(R(q), R*)),

    metres^2 and, for small angles, radians^2: the second term is half the squared Frobenius
    distance of the rotations, smooth everywhere. Its gradient falls to 0 half a turn away, where
    all ways back are equally long.

    Args:
        robot: the robot.
        link: name of any link, with or without spheres.
        pose: (4, 4) wanted pose of the link in the world.
        at: number of the waypoint; negative from the end.
        position_weight: w_p.
        rotation_weight: w_r; 0 asks for the position alone.
        weight, name: see `TrajectoryCost`.

    Raises:
        RobotError: no such link.
        ConfigError: the pose is not a rigid motion, or a weight is negative.
    """

    def __init__(
        self,
        robot: Any,
        link: str,
        pose: ArrayLike,
        *,
        at: int = -1,
        position_weight: float = 1.0,
        rotation_weight: float = 1.0,
        weight: float = 1.0,
        name: str = "pose",
    ) -> None:
        super().__init__(weight, name)
        self.robot, self.link, self.at = robot, link, int(at)
        self.position_weight = at_least("position_weight", position_weight, 0.0)
        self.rotation_weight = at_least("rotation_weight", rotation_weight, 0.0)
        self._wanted = np.array(pose, dtype=np.float64)
        if not (
            self._wanted.shape == (4, 4)
            and np.allclose(self._wanted[:3, :3] @ self._wanted[:3, :3].T, np.eye(3), atol=1e-6)
            and np.linalg.det(self._wanted[:3, :3]) > 0.0
            and np.allclose(self._wanted[3], [0.0, 0.0, 0.0, 1.0])
            and np.isfinite(self._wanted).all()
        ):
            raise ConfigError(
                f"pose is {self._wanted.tolist()}; it must be (4, 4): a rotation, metres, and "
                "a last row of 0, 0, 0, 1"
            )
        if link not in robot._links:
            raise RobotError(f"no link {link!r} in {robot.name}; links: {sorted(robot._links)}")
        sits = robot._links[link]
        # Its origin and the ends of its axes move with the link's frame, as spheres do.
        ends = np.vstack([np.zeros(3), np.eye(3)]) @ sits.T[:3, :3].T + sits.T[:3, 3]
        self._points = TorchKinematics(
            dataclasses.replace(
                robot.arrays,
                sphere_center=np.ascontiguousarray(ends),
                sphere_frame=np.full(4, sits.frame, dtype=np.int64),
                sphere_radius=np.zeros(4),
                sphere_link=np.zeros(4, dtype=np.int64),
            )
        )

    def poses(
        self, q: Float[Tensor, "*batch dof"]
    ) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3 3"]]:
        """Return position (metres) and rotation of the link in the world."""
        points = self._points.sphere_centers(q.reshape(-1, q.shape[-1]))
        base = torch.tensor(self.robot.base_pose).to(points)
        points = (points @ base[:3, :3].T + base[:3, 3]).reshape(*q.shape[:-1], 4, 3)
        axes = points[..., 1:, :] - points[..., :1, :]
        return points[..., 0, :], axes.transpose(-1, -2)

    def evaluate(self, q: Float[Tensor, "*batch time dof"]) -> Float[Tensor, "*batch"]:
        """Return the cost without its weight."""
        require_dof(self.robot, q)
        if not -q.shape[-2] <= self.at < q.shape[-2]:
            raise RobotError(f"no waypoint {self.at} in a trajectory of {q.shape[-2]}")
        position, rotation = self.poses(q[..., self.at, :])
        wanted = torch.as_tensor(self._wanted).to(position)
        away = (position - wanted[:3, 3]).square().sum(dim=-1)
        turned = 0.5 * (rotation - wanted[:3, :3]).square().sum(dim=(-2, -1))
        return self.position_weight * away + self.rotation_weight * turned
