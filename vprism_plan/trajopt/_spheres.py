# SPDX-License-Identifier: BSD-3-Clause
"""Costs that are a potential at the centres of a robot's spheres."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from vprism_plan.trajopt._compiled import PathKernels, checked_backend
from vprism_plan.trajopt._samples import Samples, Subdivision, require_dof, sample_paths
from vprism_plan.trajopt._scene import Scene
from vprism_plan.trajopt.cost import TrajectoryCost


class SphereCost(TrajectoryCost):
    """A potential of each sphere, averaged over time or integrated over its centre's way.

    Only spheres that joints move count. Subclasses implement `potential`.

    Args:
        scene: robot and obstacles.
        arc_length: whether to integrate over ways, metres, instead of averaging over time.
        spacing, subsamples: see `Subdivision`.
        backend: "auto" or "torch".
        weight, name: see `TrajectoryCost`.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        arc_length: bool,
        spacing: float,
        subsamples: int | None,
        backend: str,
        weight: float,
        name: str,
    ) -> None:
        super().__init__(weight, name)
        self.robot: Any = scene.robot
        self.arc_length = bool(arc_length)
        self.subdivision = Subdivision(spacing, subsamples)
        self._scene = scene
        self._checked = (scene.sphere_rules >= 0).nonzero()[0]
        self._rules = scene.sphere_rules[self._checked]
        self._radii = scene.radii[self._checked]
        self._compiled: PathKernels | None = None
        if checked_backend(backend) == "auto":
            self._compiled = PathKernels(self.robot, self.subdivision)

    def potential(self, centers: Float[Tensor, "m s 3"], fast: bool) -> Float[Tensor, "m s"]:
        """Return the potential of each checked sphere; with kernels, if `fast`."""
        raise NotImplementedError(f"{type(self).__name__} has no potential(centers, fast)")

    def evaluate(self, q: Float[Tensor, "*batch time dof"]) -> Float[Tensor, "*batch"]:
        """Return the cost without its weight."""
        require_dof(self.robot, q)
        samples, centers, fast = self._spheres(q.reshape(-1, *q.shape[-2:]))
        values = self.potential(centers, fast)
        if self.arc_length:
            total = samples.total((values * samples.ways(centers)).sum(dim=1))
        else:
            total = samples.total(samples.weight * values.sum(dim=1))
        return total.reshape(q.shape[:-2])

    def _spheres(
        self, q: Float[Tensor, "b time dof"]
    ) -> tuple[Samples, Float[Tensor, "m s 3"], bool]:
        """Samples, centres of the checked spheres at them, and whether kernels may be used."""
        return checked_spheres(self.robot, self._compiled, q, self.subdivision, self._checked)


def checked_spheres(
    robot: Any,
    kernels: PathKernels | None,
    q: Float[Tensor, "b time dof"],
    subdivision: Subdivision,
    checked: Int[np.ndarray, " s"],
) -> tuple[Samples, Float[Tensor, "m s 3"], bool]:
    """Samples of trajectories, the centres of some spheres at them, and whether by kernels."""
    if kernels is not None and q.device.type == "cpu":
        samples = sample_paths(robot, q, subdivision, kernels.sphere_centers)
        return samples, kernels.sphere_centers(samples.q, checked), True
    samples = sample_paths(robot, q, subdivision)
    columns = torch.as_tensor(checked, device=q.device)
    return samples, robot.sphere_centers(samples.q)[:, columns], False
