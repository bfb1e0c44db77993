# SPDX-License-Identifier: BSD-3-Clause
"""What every cost of a trajectory is, how costs add up, and at which configurations they look."""

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from vprism_plan.errors import ConfigError, RobotError


class TrajectoryCost(torch.nn.Module):
    """A number per trajectory, differentiable in its waypoints.

    Costs compose: `a + b` and `2.0 * a` are costs again. Subclasses implement `evaluate`.
    They hold no parameters; constants follow the device and dtype of what they are given.
    Half precisions are computed in float32.

    Args:
        weight: factor on the cost, finite and at least 0.
        name: what `terms` calls it.

    Raises:
        ConfigError: the weight is not that.
    """

    def __init__(self, weight: float = 1.0, name: str = "cost") -> None:
        super().__init__()
        self.weight = _checked_weight(weight)
        self.name = str(name)

    def evaluate(self, q: Float[Tensor, "*batch time dof"]) -> Float[Tensor, "*batch"]:
        """Return the cost without its weight."""
        raise NotImplementedError(f"{type(self).__name__} has no evaluate(q)")

    def forward(self, q: Tensor) -> Tensor:
        """Return the weighted cost of each trajectory: (..., T, dof) to (...).

        Args:
            q: waypoints, radians or metres, any floating dtype and device.

        Raises:
            RobotError: q has no axes for time and joints, or is not of a floating dtype.
        """
        if q.ndim < 2 or q.shape[-2] < 1:
            raise RobotError(
                f"q has shape {tuple(q.shape)}; trajectories are (..., T, dof) with T >= 1"
            )
        if not q.dtype.is_floating_point:
            raise RobotError(f"q has dtype {q.dtype}; use a floating dtype")
        if q.dtype in (torch.float16, torch.bfloat16):
            return (self.weight * self.evaluate(q.float())).to(q.dtype)
        return self.weight * self.evaluate(q)

    def terms(self, q: Float[Tensor, "*batch time dof"]) -> dict[str, Any]:
        """Return the weighted cost of each trajectory by name: one entry, or one per term."""
        return {self.name: self(q)}

    def __add__(self, other: "TrajectoryCost") -> "SumCost":
        if not isinstance(other, TrajectoryCost):
            return NotImplemented
        return SumCost(self, other)

    def __mul__(self, factor: float) -> "TrajectoryCost":
        if isinstance(factor, bool) or not isinstance(factor, int | float):
            return NotImplemented
        scaled = copy.copy(self)
        scaled.weight = _checked_weight(self.weight * factor)
        return scaled

    __rmul__ = __mul__

    def extra_repr(self) -> str:
        """Return what `repr` shows."""
        return f"weight={self.weight:g}"


class SumCost(TrajectoryCost):
    """The sum of several costs; sums inside it are taken apart.

    Args:
        costs: at least one.

    Raises:
        ConfigError: there is none, or something is not a cost.
    """

    def __init__(self, *costs: TrajectoryCost) -> None:
        super().__init__(1.0, "sum")
        wrong = [type(cost).__name__ for cost in costs if not isinstance(cost, TrajectoryCost)]
        if not costs or wrong:
            raise ConfigError(
                f"a sum needs at least one TrajectoryCost and nothing else; got {wrong or 'none'}"
            )
        flat: list[TrajectoryCost] = []
        for cost in costs:
            flat += [part * cost.weight for part in cost] if isinstance(cost, SumCost) else [cost]
        self.costs = torch.nn.ModuleList(flat)
        self._names = _distinct([cost.name for cost in flat])

    def __iter__(self) -> Any:
        return iter(self.costs)

    def __len__(self) -> int:
        return len(self.costs)

    def evaluate(self, q: Float[Tensor, "*batch time dof"]) -> Float[Tensor, "*batch"]:
        """Return the sum of the weighted costs."""
        first, *rest = self.costs
        total = first(q)
        for cost in rest:
            total = total + cost(q)
        return total

    def terms(self, q: Float[Tensor, "*batch time dof"]) -> dict[str, Any]:
        """Return each weighted cost of each trajectory; equal names are numbered."""
        return {
            name: self.weight * cost(q) for name, cost in zip(self._names, self.costs, strict=True)
        }


def _distinct(names: list[str]) -> list[str]:
    """Number the names that occur again."""
    found: list[str] = []
    for name in names:
        number, candidate = 1, name
        while candidate in found:
            number += 1
            candidate = f"{name} {number}"
        found.append(candidate)
    return found


def _checked_weight(weight: float) -> float:
    value = float(weight)
    if not 0.0 <= value < float("inf"):
        raise ConfigError(f"weight is {weight!r}; it must be finite and at least 0")
    return value


def at_least(name: str, value: float, low: float, unit: str = "", strictly: bool = False) -> float:
    """Return a finite number above (or at least) `low`; ConfigError if it is not that."""
    number = float(value)
    if not (low < number if strictly else low <= number) or number == float("inf"):
        word = "above" if strictly else "at least"
        raise ConfigError(
            f"{name} is {value!r}; it must be finite and {word} {low:g} {unit}".strip()
        )
    return number


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
