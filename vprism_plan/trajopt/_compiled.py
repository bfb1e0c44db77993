# SPDX-License-Identifier: BSD-3-Clause
"""Costs by compiled kernels on the CPU, as functions that autograd knows."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from vprism_plan._kernels import trajopt as kernels
from vprism_plan._threads import run_chunked
from vprism_plan.collision.packing import pack_robot
from vprism_plan.errors import ConfigError, RobotError
from vprism_plan.trajopt.cost import MAX_PARTS, MAX_TURN, Subdivision

# (waypoints, change along each edge, parts of each edge, gradient to add to) -> cost
Kernel = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], float]
Plain = Callable[[Tensor], Tensor]
Pull = Callable[[np.ndarray], np.ndarray]
Work = Callable[[np.ndarray], tuple[np.ndarray, Pull]]

BACKENDS = ("auto", "torch")
_AT_ONCE = 4  # trajectories per piece of work
_ROWS_AT_ONCE = 512


def checked_backend(backend: str) -> str:
    """Return the name of a backend; ConfigError if there is none of that name."""
    if backend not in BACKENDS:
        raise ConfigError(
            f"backend is {backend!r}; it must be 'auto' (compiled kernels on the CPU, torch "
            "elsewhere) or 'torch'"
        )
    return backend


class PathKernels:
    """A robot packed for the kernels, and how its edges are divided.

    Args:
        robot: the robot.
        subdivision: of the edges.
        rules: (links,) which field each link is compared with; see `pack_robot`.
    """

    def __init__(
        self, robot: Any, subdivision: Subdivision, rules: Int[np.ndarray, " l"] | None = None
    ) -> None:
        packed = pack_robot(robot.arrays, rules=rules)
        self.floats, self.ints = packed.floats, packed.ints
        self._robot = robot
        self._subdivision = subdivision
        turns = np.zeros(robot.dof, dtype=np.bool_)
        turns[robot.arrays.q_index[robot.arrays.kind == 1]] = True
        self._turns = turns

    def divide(
        self, Q: Float[np.ndarray, "time dof"]
    ) -> tuple[Float[np.ndarray, "steps dof"], Int[np.ndarray, " steps"]]:
        """Return the change of the joints along each edge, and into how many it is divided."""
        delta = np.diff(Q, axis=0)
        division = self._subdivision
        parts = np.full(len(delta), division.parts or 1, dtype=np.int64)
        if division.parts is None and len(delta):
            kernels.subdivide(
                Q, delta, self.floats, self.ints, self._turns,
                division.spacing, MAX_TURN, MAX_PARTS, parts,
            )  # fmt: skip
        return delta, parts

    def __call__(
        self, q: Float[Tensor, "b time dof"], kernel: Kernel, plain: Plain
    ) -> Float[Tensor, " b"]:
        """Return the cost of each trajectory; second derivatives are those of `plain`.

        Raises:
            RobotError: q is not finite.
        """
        require_finite(q)

        def work(Q: np.ndarray) -> tuple[np.ndarray, Pull]:
            values, grad = np.empty(len(Q)), np.zeros(Q.shape)

            def piece(part: slice) -> None:
                for b in range(part.start, part.stop):
                    values[b] = kernel(Q[b], *self.divide(Q[b]), grad[b])

            run_chunked(piece, len(Q), _AT_ONCE)
            return values, lambda output: output[:, None, None] * grad

        return compiled(q, work, plain)

    def sphere_centers(
        self, q: Float[Tensor, "n dof"], spheres: Int[np.ndarray, " s"] | None = None
    ) -> Float[Tensor, "n s 3"]:
        """Return `robot.sphere_centers` of some spheres (None is all), metres.

        Raises:
            RobotError: q is not finite.
        """
        require_finite(q)
        if spheres is None:
            spheres = np.arange(int(self.ints[1]))
        frames = self._robot.arrays.sphere_frame[spheres]
        robot = self.floats, self.ints

        def work(Q: np.ndarray) -> tuple[np.ndarray, Pull]:
            poses = np.empty((len(Q), int(self.ints[0]), 12))
            centers = np.empty((len(Q), len(spheres), 3))

            def piece(part: slice) -> None:
                kernels.place_all(Q[part], *robot, spheres, poses[part], centers[part])

            run_chunked(piece, len(Q), _ROWS_AT_ONCE)

            def pull(output: np.ndarray) -> np.ndarray:
                grad = np.empty(Q.shape)

                def piece(part: slice) -> None:
                    kernels.pull_all(
                        poses[part], centers[part], frames, output[part], *robot, grad[part]
                    )

                run_chunked(piece, len(Q), _ROWS_AT_ONCE)
                return grad

            return centers, pull

        def plain(x: Tensor) -> Tensor:
            return self._robot.sphere_centers(x)[:, torch.from_numpy(spheres)]

        return compiled(q, work, plain)


def require_finite(q: Tensor) -> None:
    """Raise RobotError unless q is finite."""
    if not bool(torch.isfinite(q.detach()).all()):
        raise RobotError("q holds NaN or infinite values; give finite joint values")


def compiled(x: Tensor, work: Work, plain: Plain) -> Tensor:
    """Return what `work` makes of an array, as a function of the tensor x on the CPU.

    Args:
        x: any float dtype; `work` gets float64.
        work: returns a value and what pulls a gradient of it back to x.
        plain: the same in torch, which is asked for second derivatives.
    """
    return _Compiled.apply(x, work, plain)


class _Compiled(torch.autograd.Function):
    """Value and gradient from kernels; differentiated twice, it is the plain graph instead."""

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
            return found, None, None
        return (
            torch.from_numpy(ctx.pull(output.to(torch.float64).contiguous().numpy())).to(x.dtype),
            None,
            None,
        )
