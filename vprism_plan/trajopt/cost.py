# SPDX-License-Identifier: BSD-3-Clause
"""What every cost of a trajectory is, how costs add up, at which configurations they look, and how
those that compiled kernels compute become functions that autograd knows."""

import copy
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain, count, pairwise, starmap
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from vprism_plan._arguments import number, whole
from vprism_plan._kernels import trajopt as kernels
from vprism_plan._threads import run_chunked
from vprism_plan.collision.packing import pack_robot
from vprism_plan.errors import ConfigError, RobotError


class TrajectoryCost(torch.nn.Module):
    """A number per trajectory, differentiable in its waypoints.

    Costs compose: `a + b` and `2.0 * a` are costs again. Subclasses implement `evaluate`.
    They hold no parameters; constants follow the device and dtype of what they are given.
    Half precisions are computed in float32.

    Args:
        weight: factor on the cost, finite and at least 0, else ConfigError.
        name: what `terms` calls it.
    """

    def __init__(self, weight: float = 1.0, name: str = "cost") -> None:
        super().__init__()
        self.weight = number("weight", weight, 0.0)
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
        scaled.weight = number("weight", self.weight * factor, 0.0)
        return scaled

    __rmul__ = __mul__

    def extra_repr(self) -> str:
        """Return what `repr` shows."""
        return f"weight={self.weight:g}"


class SumCost(TrajectoryCost):
    """The sum of several costs; sums inside it are taken apart, equal names are numbered.

    Raises:
        ConfigError: there is no cost, or something is none.
    """

    def __init__(self, *costs: TrajectoryCost) -> None:
        super().__init__(1.0, "sum")
        wrong = [type(cost).__name__ for cost in costs if not isinstance(cost, TrajectoryCost)]
        if not costs or wrong:
            raise ConfigError(
                f"a sum needs at least one TrajectoryCost and nothing else; got {wrong or 'none'}"
            )
        self.costs = torch.nn.ModuleList()
        self._names: list[str] = []
        for cost in costs:
            parts = [part * cost.weight for part in cost] if isinstance(cost, SumCost) else [cost]
            self.costs.extend(parts)
            for part in parts:
                names = chain([part.name], (f"{part.name} {n}" for n in count(2)))
                self._names.append(next(name for name in names if name not in self._names))

    def __iter__(self) -> Iterator[Any]:
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
        """Return each weighted cost of each trajectory."""
        named = zip(self._names, self.costs, strict=True)
        return {name: self.weight * cost(q) for name, cost in named}


# --- samples along trajectories ---------------------------------------------------------

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
        number("spacing", self.spacing, 0.0, unit="metres", above=True)
        if self.parts is not None:
            whole("subsamples", self.parts, 1, MAX_PARTS)


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

    @property
    def parts(self) -> list[slice]:
        """Where the samples of each trajectory are."""
        ends = torch.bincount(self.trajectory, minlength=self.count).cumsum(0).tolist()
        return list(starmap(slice, pairwise([0, *ends])))

    def total(self, values: Float[Tensor, " m"]) -> Float[Tensor, " b"]:
        """Return the sum of the samples' values for each trajectory."""
        return values.new_zeros(self.count).index_add(0, self.trajectory, values)

    def ways(self, centers: Float[Tensor, "m s 3"]) -> Float[Tensor, "m s"]:
        """Return half the way from the sample before plus half the way to the next, metres."""
        if len(centers) == 0:
            return torch.zeros_like(centers[..., 0])
        squares = centers.diff(dim=0).square().sum(dim=-1) + SHORT**2
        way = 0.5 * (squares.sqrt() - SHORT)
        joined = (self.trajectory[1:] == self.trajectory[:-1])[:, None]
        way = torch.where(joined, way, 0.0)
        none = way.new_zeros(1, centers.shape[1])
        return torch.cat([way, none]) + torch.cat([none, way])


def require_dof(robot: Any, q: Tensor) -> None:
    """Raise RobotError unless the last axis of q has the robot's joints."""
    if q.shape[-1] != robot.dof:
        raise RobotError(
            f"q has shape {tuple(q.shape)}; {robot.name} needs (..., T, {robot.dof}): "
            f"{', '.join(robot.joint_names)}"
        )


def turning_joints(robot: Any) -> Bool[np.ndarray, " dof"]:
    """Return which joints turn (and do not slide) a frame."""
    turning = np.zeros(robot.dof, dtype=np.bool_)
    turning[robot.arrays.q_index[robot.arrays.kind == 1]] = True
    return turning


def sample_paths(
    robot: Any,
    q: Float[Tensor, "b time dof"],
    subdivision: Subdivision,
    centers_of: Callable[[Tensor], Tensor] | None = None,
) -> Samples:
    """Divide the edges of trajectories; `centers_of` (n, dof) to (n, S, 3), None: the robot's."""
    trajectories, time, dof = q.shape
    require_dof(robot, q)
    delta = q.diff(dim=-2)
    parts = _parts(robot, q.detach(), delta.detach(), subdivision, centers_of)
    # The last waypoint is an edge that goes nowhere.
    parts = torch.cat([parts, parts.new_ones(trajectories, 1)], dim=1)
    delta = torch.cat([delta, torch.zeros_like(q[:, :1])], dim=1)
    span = torch.ones_like(parts, dtype=q.dtype) / (parts * max(1, time - 1))
    span[:, -1] = 0.0
    before = torch.cat([torch.zeros_like(span[:, :1]), span[:, :-1]], dim=1)
    flat = parts.reshape(-1)
    edge = torch.repeat_interleave(torch.arange(len(flat), device=q.device), flat)
    place = torch.arange(len(edge), device=q.device) - (flat.cumsum(0) - flat)[edge]
    fraction = place.to(q.dtype) / flat[edge]
    own, previous = span.reshape(-1)[edge], before.reshape(-1)[edge]
    weight = 0.5 * (own + torch.where(place > 0, own, previous))
    if time == 1:
        weight = torch.ones_like(weight)
    rows = q.reshape(-1, dof)[edge] + fraction[:, None] * delta.reshape(-1, dof)[edge]
    return Samples(rows, edge // time, weight, trajectories)


def _parts(
    robot: Any, q: Tensor, delta: Tensor, subdivision: Subdivision, centers_of: Any
) -> Int[Tensor, "b steps"]:
    if subdivision.parts is not None or delta.shape[1] == 0:
        return delta.new_full(delta.shape[:2], subdivision.parts or 0, dtype=torch.int64)
    with torch.no_grad():
        centers = (centers_of or robot.sphere_centers)(q.reshape(-1, q.shape[-1]))
    centers = centers.reshape(*q.shape[:2], *centers.shape[1:])
    x, y, z = centers.diff(dim=1).unbind(dim=-1)  # nine times as fast as a sum over three
    way = (x * x + y * y + z * z).amax(dim=-1).sqrt()
    turning = torch.as_tensor(turning_joints(robot), device=q.device)
    turn = torch.where(turning, delta.abs(), 0.0).amax(dim=-1)
    wanted = torch.maximum(way / subdivision.spacing, turn / MAX_TURN)
    return wanted.clamp(max=MAX_PARTS).ceil().clamp(min=1).long()


# --- compiled kernels on the CPU --------------------------------------------------------

# (gradient to add to, and of the samples q, edge, fraction, weight) -> cost
Kernel = Callable[..., float]
Plain = Callable[[Tensor], Tensor]
Pull = Callable[[np.ndarray], np.ndarray]
Work = Callable[[np.ndarray], tuple[np.ndarray, Pull]]

_AT_ONCE = 4  # trajectories per piece of work
_ROWS_AT_ONCE = 512


class PathKernels:
    """A robot packed for the kernels; `rules`: see `pack_robot`.

    Its functions raise RobotError where q is not finite.
    """

    def __init__(self, robot: Any, rules: Int[np.ndarray, " l"] | None = None) -> None:
        self.floats, self.ints = pack_robot(robot.arrays, rules=rules)
        self._robot = robot
        self._turns = turning_joints(robot)

    def costs(
        self, q: Float[Tensor, "b time dof"], division: Subdivision, kernel: Kernel, plain: Plain
    ) -> Float[Tensor, " b"]:
        """Return costs of trajectories; second derivatives are those of `plain`."""
        _require_finite(q)
        spacing, fixed = float(division.spacing), int(division.parts or 0)
        how = self._turns, spacing, MAX_TURN, MAX_PARTS, fixed

        def work(Q: np.ndarray) -> tuple[np.ndarray, Pull]:
            values, grad = np.empty(len(Q)), np.zeros(Q.shape)

            def piece(some: slice) -> None:
                for b in range(some.start, some.stop):
                    samples = kernels.divide(Q[b], self.floats, self.ints, *how)
                    values[b] = kernel(grad[b], *samples)

            run_chunked(piece, len(Q), _AT_ONCE)
            return values, lambda output: output[:, None, None] * grad

        return compiled(q, work, plain)

    def sphere_centers(
        self, q: Float[Tensor, "n dof"], spheres: Int[np.ndarray, " s"] | None = None
    ) -> Float[Tensor, "n s 3"]:
        """Return `robot.sphere_centers` of some spheres (None is all), metres."""
        _require_finite(q)
        chosen = np.arange(int(self.ints[1])) if spheres is None else spheres
        frames = self._robot.arrays.sphere_frame[chosen]
        robot = self.floats, self.ints

        def work(Q: np.ndarray) -> tuple[np.ndarray, Pull]:
            poses = np.empty((len(Q), int(self.ints[0]), 12))
            centers = np.empty((len(Q), len(chosen), 3))

            def place(part: slice) -> None:
                kernels.place_all(Q[part], *robot, chosen, poses[part], centers[part])

            def pull(output: np.ndarray) -> np.ndarray:
                grad = np.empty(Q.shape)

                def piece(part: slice) -> None:
                    kernels.pull_all(
                        poses[part], centers[part], frames, output[part], *robot, grad[part]
                    )

                run_chunked(piece, len(Q), _ROWS_AT_ONCE)
                return grad

            run_chunked(place, len(Q), _ROWS_AT_ONCE)
            return centers, pull

        def plain(x: Tensor) -> Tensor:
            return self._robot.sphere_centers(x)[:, torch.from_numpy(chosen)]

        return compiled(q, work, plain)


def _require_finite(q: Tensor) -> None:
    if not bool(torch.isfinite(q.detach()).all()):
        raise RobotError("q holds NaN or infinite values; give finite joint values")


def compiled_per_sphere(
    centers: Float[Tensor, "m s 3"],
    fill: Callable[[np.ndarray, np.ndarray, np.ndarray], None],
    plain: Plain,
) -> Float[Tensor, "m s"]:
    """Return a function of each centre: `fill` gets them, and the values and slopes to fill."""

    def work(x: np.ndarray) -> tuple[np.ndarray, Pull]:
        value, slopes = np.empty(x.shape[:2]), np.empty(x.shape)
        run_chunked(lambda k: fill(x[k], value[k], slopes[k]), len(x), _ROWS_AT_ONCE)
        return value, lambda output: output[..., None] * slopes

    return compiled(centers, work, plain)


class _Compiled(torch.autograd.Function):
    """What `work` makes of an array, as a function of a tensor of any float dtype on the CPU.

    `work` gets float64, and returns a value and what pulls a gradient of it back; `plain`, the
    same in torch, is asked for second derivatives.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, work: Work, plain: Plain) -> Tensor:
        values, ctx.pull = work(np.ascontiguousarray(x.detach().to(torch.float64).numpy()))
        ctx.plain = plain
        ctx.save_for_backward(x)
        return torch.from_numpy(np.ascontiguousarray(values)).to(x.dtype)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> Any:
        (output,) = grad_outputs
        (x,) = ctx.saved_tensors
        if torch.is_grad_enabled():
            (found,) = torch.autograd.grad(ctx.plain(x), x, output, create_graph=True)
        else:
            pulled = ctx.pull(output.to(torch.float64).contiguous().numpy())
            found = torch.from_numpy(pulled).to(x.dtype)
        return found, None, None


compiled = _Compiled.apply
