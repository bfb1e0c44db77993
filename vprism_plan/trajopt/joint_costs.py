# SPDX-License-Identifier: BSD-3-Clause
"""Costs of joint values: smoothness, joint limits, and poses of links."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import ArrayLike
from torch import Tensor

from vprism_plan._arguments import number, rigid_pose
from vprism_plan.errors import RobotError
from vprism_plan.robots.kinematics import TorchKinematics
from vprism_plan.trajopt.cost import TrajectoryCost, require_dof


class SmoothnessCost(TrajectoryCost):
    """Squared velocity, acceleration and jerk, integrated along the trajectory.

    With T waypoints at equal times over `duration`, step h = duration / (T - 1) and the
    n-th differences D^n q of the waypoints, each term is

        sum_t |D^n q_t|^2 / h^(2 n - 1),

    the integral of the squared n-th derivative, whatever the number of waypoints: rad^2 / s,
    rad^2 / s^3 and rad^2 / s^5; metres for sliding joints. A trajectory with too few waypoints
    for a difference has none of it. O(T dof).

    Args:
        velocity, acceleration, jerk: factors of the terms.
        robot: with it, trajectories of another number of joints are refused.
        duration: seconds from the first waypoint to the last.
        joint_weights: (dof,) factors on the squared differences; None is 1.
        weight, name: see `TrajectoryCost`.
    """

    def __init__(
        self,
        *,
        velocity: float = 1.0,
        acceleration: float = 0.0,
        jerk: float = 0.0,
        robot: Any = None,
        duration: float = 1.0,
        joint_weights: Sequence[float] | None = None,
        weight: float = 1.0,
        name: str = "smoothness",
    ) -> None:
        super().__init__(weight, name)
        self.factors = (
            number("velocity", velocity, 0.0),
            number("acceleration", acceleration, 0.0),
            number("jerk", jerk, 0.0),
        )
        self.duration = number("duration", duration, 0.0, unit="seconds", above=True)
        self.robot = robot
        self.joint_weights: tuple[float, ...] | None = None
        if joint_weights is not None:
            self.joint_weights = tuple(number("joint_weights", w, 0.0) for w in joint_weights)

    def evaluate(self, q: Float[Tensor, "*batch time dof"]) -> Float[Tensor, "*batch"]:
        """Return the cost without its weight."""
        if self.robot is not None:
            require_dof(self.robot, q)
        difference = q.diff(dim=-2)
        factors: Any = 1.0
        if self.joint_weights is not None:
            if len(self.joint_weights) != q.shape[-1]:
                raise RobotError(
                    f"q has {q.shape[-1]} joints, joint_weights has {len(self.joint_weights)}"
                )
            factors = q.new_tensor(self.joint_weights)
        total = 0.0 * q.sum(dim=(-2, -1))
        step = self.duration / max(1, q.shape[-2] - 1)
        for order, factor in enumerate(self.factors, start=1):
            if factor > 0.0 and difference.shape[-2] > 0:
                squares = difference.square() * factors
                total = total + factor / step ** (2 * order - 1) * squares.sum(dim=(-2, -1))
            difference = difference.diff(dim=-2)
        return total


class JointLimitCost(TrajectoryCost):
    """Squared distance of joints beyond their limits less a margin, averaged over waypoints.

        mean_t sum_j max(0, lower_j + m - q_tj)^2 + max(0, q_tj - upper_j + m)^2,

    rad^2 (m^2 for sliding joints). Continuous joints have no limits. Where a range is
    narrower than two margins, m is half of it. O(T dof).

    Args:
        robot: whose limits.
        margin: m, radians or metres.
        weight, name: see `TrajectoryCost`.
    """

    def __init__(
        self,
        robot: Any,
        *,
        margin: float = 0.05,
        weight: float = 1.0,
        name: str = "joint limits",
    ) -> None:
        super().__init__(weight, name)
        self.robot = robot
        self.margin = number("margin", margin, 0.0, unit="radians or metres")

    def evaluate(self, q: Float[Tensor, "*batch time dof"]) -> Float[Tensor, "*batch"]:
        """Return the cost without its weight."""
        require_dof(self.robot, q)
        robot = self.robot
        margin = np.minimum(self.margin, 0.5 * (robot.upper - robot.lower))
        limits = (
            np.where(robot.continuous, -np.inf, robot.lower + margin),
            np.where(robot.continuous, np.inf, robot.upper - margin),
        )
        lower, upper = (torch.as_tensor(ends, dtype=q.dtype, device=q.device) for ends in limits)
        below, above = (lower - q).clamp(min=0.0), (q - upper).clamp(min=0.0)
        return (below.square() + above.square()).sum(dim=-1).mean(dim=-1)


class PoseCost(TrajectoryCost):
    """Squared distance of a link from a wanted pose, at one waypoint.

        w_p |t(q) - t*|^2 + w_r 2 (1 - cos angle(R(q), R*)),

    metres^2 and, for small angles, radians^2: the second term is half the squared Frobenius
    distance of the rotations. Its gradient falls to 0 half a turn away.

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
        self.position_weight = number("position_weight", position_weight, 0.0)
        self.rotation_weight = number("rotation_weight", rotation_weight, 0.0)
        self._wanted = rigid_pose("pose", pose)
        if link not in robot.links:
            raise RobotError(f"no link {link!r} in {robot.name}; links: {sorted(robot.links)}")
        sits = robot.links[link]
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
