# SPDX-License-Identifier: BSD-3-Clause
"""The cost of coming near obstacles."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vprism_plan._kernels import trajopt as kernels
from vprism_plan.trajopt._compiled import PathKernels, checked_backend
from vprism_plan.trajopt._field import grown, union_field
from vprism_plan.trajopt._potential import hinge
from vprism_plan.trajopt._samples import Subdivision, require_dof, sample_paths
from vprism_plan.trajopt._scene import scene_of
from vprism_plan.trajopt.cost import TrajectoryCost, at_least


class ClearanceCost(TrajectoryCost):
    """How much the robot's spheres lack of a margin from all obstacles of a world.

    With e the gap of a sphere and c CHOMP's potential (c = 0 from `margin` on,
    (margin - e)^2 / (2 margin) down to contact, margin / 2 - e below), the cost is

        sum over spheres of the average over time of c(e_field) + sum over half-spaces c(e_plane),

    metres; or, with `arc_length`, the sum over spheres of the integral of c over the way
    that the sphere's centre travels, metres^2 (CHOMP's weighting: going faster through an
    obstacle does not help). Time is the number of the waypoint, the rule the trapezoid's.

    Covers what a checker checks: objects, background, occluded and unobserved space by
    policy, known geometry, support surface and half-spaces. Links that no joint moves are
    left out. With a `CollisionChecker`, its margin counts as part of each sphere, and links
    are compared with the fields that its allowed contacts and `max_risk` give them: with a bound
    on risk from the world's `level` on, the posterior's objects are left to `RiskCost`.

    The gap to the baked obstacles comes from a quadratic B-spline of the signed distance
    (`SplineField`), less a radius so much larger that a positive gap proves the sphere free
    at that configuration. Inside obstacles the gap falls with slope 1 towards the inside, as
    far as they go: there is no depth at which the gradient is cut off. It is zero only on
    ridges where several ways out are equally long. What lies between samples, and what was
    seen outside the world's grid, is left to verification.

    Args:
        world: a `World`, or a `CollisionChecker`.
        robot: the robot; a checker brings its own.
        margin: metres, above 0.
        arc_length: see above.
        spacing: of samples, metres; see `Subdivision`.
        subsamples: parts of every edge, instead of `spacing`.
        backend: "auto" uses compiled kernels on the CPU; "torch" never does.
        weight, name: see `TrajectoryCost`.

    Raises:
        ConfigError: a value outside its range, or no robot.
    """

    def __init__(
        self,
        world: Any,
        robot: Any = None,
        *,
        margin: float = 0.02,
        arc_length: bool = False,
        spacing: float = 0.05,
        subsamples: int | None = None,
        backend: str = "auto",
        weight: float = 1.0,
        name: str = "clearance",
    ) -> None:
        super().__init__(weight, name)
        self.margin = at_least("margin", margin, 0.0, "metres", strictly=True)
        self.arc_length = bool(arc_length)
        self.subdivision = Subdivision(spacing, subsamples)
        self._scene = scene_of(world, robot)
        self.robot = self._scene.robot
        self._checked = (self._scene.sphere_rules >= 0).nonzero()[0]
        self._planes = self._scene.world.planes.copy()
        self._field = union_field(self._scene.fields(), self._planes)
        self._radii = self._scene.radii
        self._grown = grown(self._radii, self._field.spacing)
        self._packed = self._field.packed(self.margin, self._scene.margin, self._planes)
        self._compiled: PathKernels | None = None
        if checked_backend(backend) == "auto":
            self._compiled = PathKernels(
                self.robot, self.subdivision, np.maximum(self._scene.link_rules, 0)
            )

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
        kernel = kernels.clearance_by_length if self.arc_length else kernels.clearance
        return kernel(
            Q, delta, parts, self._compiled.floats, self._compiled.ints, self._field.values,
            self._field.blocks, self._packed, self._radii, self._grown, grad,
        )  # fmt: skip

    def _plain(self, q: Float[Tensor, "b time dof"]) -> Float[Tensor, " b"]:
        samples = sample_paths(self.robot, q, self.subdivision)
        checked = torch.as_tensor(self._checked, device=q.device)
        centers = self.robot.sphere_centers(samples.q)[:, checked]
        short = self._potential(centers)
        if self.arc_length:
            return samples.total((short * samples.ways(centers)).sum(dim=1))
        return samples.total(samples.weight * short.sum(dim=1))

    def _potential(self, centers: Float[Tensor, "m s 3"]) -> Float[Tensor, "m s"]:
        rules = self._scene.sphere_rules[self._checked]
        gap = self._field(centers, rules) - torch.as_tensor(self._grown[self._checked]).to(centers)
        total = hinge(gap, self.margin)
        for row in torch.as_tensor(self._planes).to(centers):
            away = (
                centers @ row[:3] - row[3] - torch.as_tensor(self._radii[self._checked]).to(centers)
            )
            total = total + hinge(away, self.margin)
        return total
