# SPDX-License-Identifier: BSD-3-Clause
"""The cost of links that come near each other."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vprism_plan._kernels import trajopt as kernels
from vprism_plan.collision import CollisionChecker
from vprism_plan.trajopt._compiled import PathKernels, checked_backend
from vprism_plan.trajopt._potential import hinge
from vprism_plan.trajopt._samples import SHORT, Subdivision, require_dof, sample_paths
from vprism_plan.trajopt.cost import TrajectoryCost, at_least

_AT_ONCE = 1 << 22  # sphere pairs in memory at once


class SelfCollisionCost(TrajectoryCost):
    """How much the gaps between links lack of a margin.

    With e the gap of two spheres of a pair of links that are checked against each other
    (padding not counted) and c CHOMP's potential as in `ClearanceCost`,

        average over time of the sum over sphere pairs of c(e),

    metres. Slope 1 however deep spheres overlap (and 0 only where two centres coincide).
    Samples between waypoints as for the world. O(samples x sphere pairs) at worst; the
    kernels skip links and spheres that are far apart.

    Args:
        robot: the robot, or a `CollisionChecker`, whose `self_margin` then counts as part
            of the spheres.
        margin: metres, above 0.
        spacing, subsamples, backend: see `ClearanceCost`.
        weight, name: see `TrajectoryCost`.

    Raises:
        ConfigError: a value outside its range.
    """

    def __init__(
        self,
        robot: Any,
        *,
        margin: float = 0.02,
        spacing: float = 0.05,
        subsamples: int | None = None,
        backend: str = "auto",
        weight: float = 1.0,
        name: str = "self-collision",
    ) -> None:
        super().__init__(weight, name)
        self.margin = at_least("margin", margin, 0.0, "metres", strictly=True)
        self._kept = 0.0
        if isinstance(robot, CollisionChecker):
            self._kept, robot = float(robot.config.self_margin), robot.robot
        self.robot = robot
        self.subdivision = Subdivision(spacing, subsamples)
        arrays = robot.arrays
        rows, reach = [np.empty((0, 2), np.int64)], [np.empty(0)]
        for a, b in arrays.pairs:
            spheres = [np.arange(arrays.link_start[k], arrays.link_start[k + 1]) for k in (a, b)]
            rows.append(np.stack(np.meshgrid(*spheres, indexing="ij"), axis=-1).reshape(-1, 2))
            both = arrays.sphere_radius[rows[-1]].sum(axis=1) + self._kept
            reach.append(both - arrays.link_padding[a] - arrays.link_padding[b])
        self._pairs, self._reach = np.concatenate(rows), np.concatenate(reach)
        self._compiled: PathKernels | None = None
        if checked_backend(backend) == "auto":
            self._compiled = PathKernels(robot, self.subdivision)

    def evaluate(self, q: Float[Tensor, "*batch time dof"]) -> Float[Tensor, "*batch"]:
        """Return the cost without its weight."""
        require_dof(self.robot, q)
        flat = q.reshape(-1, *q.shape[-2:])
        if self._compiled is not None and q.device.type == "cpu":
            return self._compiled(flat, self._kernel, self._plain).reshape(q.shape[:-2])
        return self._plain(flat).reshape(q.shape[:-2])

    def _kernel(
        self, Q: np.ndarray, delta: np.ndarray, parts: np.ndarray, grad: np.ndarray
    ) -> float:
        assert self._compiled is not None
        return kernels.self_collision(
            Q, delta, parts, self._compiled.floats, self._compiled.ints, self.margin, self._kept,
            grad,
        )  # fmt: skip

    def _plain(self, q: Float[Tensor, "b time dof"]) -> Float[Tensor, " b"]:
        samples = sample_paths(self.robot, q, self.subdivision)
        centers = self.robot.sphere_centers(samples.q)
        pairs = torch.as_tensor(self._pairs, device=q.device)
        reach = torch.as_tensor(self._reach).to(centers)
        values = []
        for part in centers.split(max(1, _AT_ONCE // max(1, len(pairs)))):
            apart = part[:, pairs[:, 0]] - part[:, pairs[:, 1]]
            gap = (apart.square().sum(dim=-1) + SHORT**2).sqrt() - reach
            values.append(hinge(gap, self.margin).sum(dim=1))
        return samples.total(samples.weight * torch.cat(values))
