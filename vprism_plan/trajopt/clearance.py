# SPDX-License-Identifier: BSD-3-Clause
"""The cost of coming near obstacles."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from vprism_plan.trajopt._field import grown, union_field
from vprism_plan.trajopt._samples import Subdivision, sample_paths
from vprism_plan.trajopt._scene import scene_of
from vprism_plan.trajopt.cost import TrajectoryCost, at_least


def hinge(gap: Float[Tensor, "*shape"], margin: float) -> Float[Tensor, "*shape"]:
    """CHOMP's obstacle potential of a gap, metres: 0 from `margin` on, slope -1 below 0.

    (margin - gap)^2 / (2 margin) between, so that its derivative is continuous (Zucker et
    al., IJRR 32, 2013, section 3.4).
    """
    short = (margin - gap).clamp(min=0.0)
    return torch.where(gap < 0.0, 0.5 * margin - gap, short.square() / (2.0 * margin))


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
    are compared with the fields that its allowed contacts (and `max_risk`, which leaves the
    posterior's objects to `RiskCost`) give them.

    The gap to the baked obstacles comes from a quadratic B-spline of the signed distance
    (`SplineField`), less a radius so much larger that a positive gap proves the sphere free
    at that configuration. Inside obstacles the gap falls with slope 1 towards the inside, as
    far as they go: there is no depth at which the gradient is cut off. It is zero only on
    ridges where several ways out are equally long. What lies between samples is left to
    verification.

    Args:
        world: a `World`, or a `CollisionChecker`.
        robot: the robot; a checker brings its own.
        margin: metres, above 0.
        arc_length: see above.
        spacing: of samples, metres; see `Subdivision`.
        subsamples: parts of every edge, instead of `spacing`.
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
        self._planes = self._scene.world.planes
        self._field = union_field(self._scene.fields(), self._planes)
        self._radii = self._scene.radii[self._checked]
        self._grown = grown(self._radii, self._field.spacing)

    def evaluate(self, q: Float[Tensor, "*batch time dof"]) -> Float[Tensor, "*batch"]:
        """Return the cost without its weight."""
        samples = sample_paths(self.robot, q.reshape(-1, *q.shape[-2:]), self.subdivision)
        centers = self.robot.sphere_centers(samples.q)[:, torch.as_tensor(self._checked)]
        short = self._potential(centers)
        if self.arc_length:
            values = (short * samples.ways(centers)).sum(dim=1)
        else:
            values = samples.weight * short.sum(dim=1)
        return samples.total(values).reshape(q.shape[:-2])

    def _potential(self, centers: Float[Tensor, "m s 3"]) -> Float[Tensor, "m s"]:
        rules = self._scene.sphere_rules[self._checked]
        gap = self._field(centers, rules) - torch.as_tensor(self._grown).to(centers)
        total = hinge(gap, self.margin)
        for row in torch.as_tensor(self._planes).to(centers):
            away = centers @ row[:3] - row[3] - torch.as_tensor(self._radii).to(centers)
            total = total + hinge(away, self.margin)
        return total
