# SPDX-License-Identifier: BSD-3-Clause
"""Configurations between waypoints, so that costs see what lies between them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from vprism_plan.errors import ConfigError, RobotError
from vprism_plan.trajopt.cost import at_least

MAX_TURN = 0.5  # radians of any joint between two samples: keeps arcs from hiding behind chords
MAX_PARTS = 64  # of an edge: a wild step of an optimiser must not fill the memory
SHORT = 1e-6  # metres: below it a way counts quadratically, so that standing still is smooth


@dataclass(frozen=True)
class Subdivision:
    """How edges are divided: by how far spheres move, or a fixed number of times.

    An edge gets the smallest number of parts for which no sphere centre's chord exceeds
    `spacing` metres per part and no joint turns by more than half a radian per part, at
    most 64; each edge for itself, so that a trajectory's cost does not depend on its
    company. `parts` fixes the number for all edges instead.
    """

    spacing: float
    parts: int | None = None

    def __post_init__(self) -> None:
        """Refuse what is no subdivision."""
        at_least("spacing", self.spacing, 0.0, "metres", strictly=True)
        if self.parts is not None and not 1 <= int(self.parts) <= MAX_PARTS:
            raise ConfigError(
                f"subsamples is {self.parts!r}; give 1 to {MAX_PARTS} parts per edge, or None"
            )


@dataclass(frozen=True)
class Samples:
    """Configurations along a batch of trajectories, one trajectory after the other.

    Attributes:
        q: (M, dof), attached to the waypoints.
        trajectory: (M,) which trajectory each belongs to.
        weight: (M,) its share of the time (trapezoid rule); sums to 1 per trajectory.
        count: number of trajectories.
    """

    q: Float[Tensor, "m dof"]
    trajectory: Int[Tensor, " m"]
    weight: Float[Tensor, " m"]
    count: int

    def total(self, values: Float[Tensor, " m"]) -> Float[Tensor, " b"]:
        """Return the sum of the samples' values for each trajectory."""
        zeros = values.new_zeros(self.count)
        return zeros.index_add(0, self.trajectory, values)

    def ways(self, centers: Float[Tensor, "m s 3"]) -> Float[Tensor, "m s"]:
        """Return half the way from the sample before plus half the way to the next, metres."""
        if len(centers) == 0:
            return torch.zeros_like(centers[..., 0])
        steps = centers[1:] - centers[:-1]
        squares = steps.square().sum(dim=-1) + SHORT**2
        way = 0.5 * (squares.sqrt() - SHORT)
        joined = (self.trajectory[1:] == self.trajectory[:-1])[:, None]
        way = torch.where(joined, way, torch.zeros_like(way))
        none = way.new_zeros(1, centers.shape[1])
        return torch.cat([way, none]) + torch.cat([none, way])


def require_dof(robot: Any, q: Tensor) -> None:
    """Raise RobotError unless the last axis of q has the robot's joints."""
    if q.shape[-1] != robot.dof:
        raise RobotError(
            f"q has shape {tuple(q.shape)}; {robot.name} needs (..., T, {robot.dof}): "
            f"{', '.join(robot.joint_names)}"
        )


def sample_paths(
    robot: Any,
    q: Float[Tensor, "b time dof"],
    subdivision: Subdivision,
    centers_of: Callable[[Tensor], Tensor] | None = None,
) -> Samples:
    """Divide the edges of trajectories as the subdivision says.

    Args:
        robot: the robot.
        q: waypoints.
        subdivision: of the edges.
        centers_of: (n, dof) to sphere centres (n, S, 3); None is the robot's own.
    """
    centers_of = robot.sphere_centers if centers_of is None else centers_of
    count, time, dof = q.shape
    require_dof(robot, q)
    delta = q.diff(dim=-2)
    parts = _parts(robot, q.detach(), delta.detach(), subdivision, centers_of)
    # The last waypoint is an edge that goes nowhere.
    parts = torch.cat([parts, parts.new_ones(count, 1)], dim=1)
    delta = torch.cat([delta, torch.zeros_like(q[:, :1])], dim=1)
    span = torch.ones_like(parts, dtype=q.dtype) / (parts * max(1, time - 1))
    span[:, -1] = 0.0
    before = torch.cat([torch.zeros_like(span[:, :1]), span[:, :-1]], dim=1)
    flat = parts.reshape(-1)
    edge = torch.repeat_interleave(torch.arange(len(flat), device=q.device), flat)
    number = torch.arange(len(edge), device=q.device) - (flat.cumsum(0) - flat)[edge]
    fraction = number.to(q.dtype) / flat[edge]
    own, previous = span.reshape(-1)[edge], before.reshape(-1)[edge]
    weight = 0.5 * (own + torch.where(number > 0, own, previous))
    if time == 1:
        weight = torch.ones_like(weight)
    rows = q.reshape(-1, dof)[edge] + fraction[:, None] * delta.reshape(-1, dof)[edge]
    return Samples(rows, edge // time, weight, count)


def _parts(
    robot: Any,
    q: Float[Tensor, "b time dof"],
    delta: Float[Tensor, "b steps dof"],
    subdivision: Subdivision,
    centers_of: Callable[[Tensor], Tensor],
) -> Int[Tensor, "b steps"]:
    if subdivision.parts is not None:
        return torch.full(delta.shape[:2], subdivision.parts, dtype=torch.int64, device=q.device)
    if delta.shape[1] == 0:
        return torch.zeros(delta.shape[:2], dtype=torch.int64, device=q.device)
    arrays = robot.arrays
    with torch.no_grad():
        centers = centers_of(q.reshape(-1, q.shape[-1]))
    centers = centers.reshape(*q.shape[:2], *centers.shape[1:])
    way = centers.diff(dim=1).square().sum(dim=-1).amax(dim=-1).sqrt()
    turning = torch.zeros(q.shape[-1], dtype=torch.bool, device=q.device)
    turning[torch.as_tensor(arrays.q_index[arrays.kind == 1], device=q.device)] = True
    turn = torch.where(turning, delta.abs(), 0.0).amax(dim=-1)
    wanted = torch.maximum(way / subdivision.spacing, turn / MAX_TURN)
    return wanted.clamp(max=MAX_PARTS).ceil().clamp(min=1).long()
