# SPDX-License-Identifier: BSD-3-Clause
"""What every cost of a trajectory is, and how costs add up."""

import copy
from typing import Any

import torch
from jaxtyping import Float
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
