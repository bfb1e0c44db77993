# SPDX-License-Identifier: BSD-3-Clause
"""Costs of what a map's posterior says of the space that a robot passes through."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vprism_plan._kernels import trajopt as kernels
from vprism_plan._threads import run_chunked
from vprism_plan.errors import ConfigError
from vprism_plan.trajopt._compiled import Pull, compiled
from vprism_plan.trajopt._field import SplineField, grown, union_field
from vprism_plan.trajopt._map_field import MapField
from vprism_plan.trajopt._potential import soft_contact
from vprism_plan.trajopt._scene import map_and_scene
from vprism_plan.trajopt._spheres import SphereCost
from vprism_plan.trajopt.cost import at_least

MEASURES = ("hazard", "probability")

_MIN_SUPPORT = 0.5  # kernel mass, where no world says
_CUT = 8.0  # softnesses of gap from which certain obstacles do not count
_SOFTNESS = 0.5  # of the world's resolution: how blurred certain obstacles are


def _hazard(log_p: Float[Tensor, "n k"], free: Bool[Tensor, " k"]) -> Float[Tensor, " n"]:
    return -torch.logsumexp(log_p[:, free], dim=1)


def _occupancy(log_p: Float[Tensor, "n k"], free: Bool[Tensor, " k"]) -> Float[Tensor, " n"]:
    return log_p[:, ~free].exp().sum(dim=1)


def _entropy(log_p: Float[Tensor, "n k"], free: Bool[Tensor, " k"]) -> Float[Tensor, " n"]:
    return -(log_p.exp() * log_p).sum(dim=1)


class _PosteriorCost(SphereCost):
    """A cost that reads the posterior at a robot's spheres."""

    def __init__(
        self,
        world: Any,
        robot: Any,
        reading: Any,
        *,
        exact: bool,
        resolution: float,
        **options: Any,
    ) -> None:
        self._map, scene = map_and_scene(world, robot)
        super().__init__(scene, **options)
        self.exact = bool(exact)
        step = at_least("resolution", resolution, 0.0, "metres", strictly=True)
        least = _MIN_SUPPORT if scene.world is None else scene.world.config.min_support
        self._reading = MapField(
            self._map, scene.rules, reading, least, None if self.exact else step
        )

    def potential(self, centers: Float[Tensor, "m s 3"], fast: bool) -> Float[Tensor, "m s"]:
        """Return the reading's average over each checked sphere."""
        return self._reading(centers, self._radii, self._rules, fast)


class OccupancyCost(_PosteriorCost):
    """How probably the space that the robot passes through is occupied.

    With P(occupied) from the posterior, averaged over the ball of each sphere by a
    quadrature of 15 points (degree 5), the cost is the average over time, or with
    `arc_length` the integral over the way of the sphere's centre, of the sum over spheres of

        "hazard":       the ball's average of -ln(1 - P), nats;
        "probability":  the ball's average of P.

    Both are weighted by 1 - exp(-s / min_support), s the kernel mass: where no kernel reaches,
    the map has nothing to say. The hazard does not saturate: where P rounds to 1 its slope is
    that of the logit. Both follow the posterior's own hills and valleys, so the way out of an
    object need not be downhill (for that there is `ClearanceCost`).

    With a `VPrismMap`, only its objects count. With a `World` or a `CollisionChecker`, so
    does what is an obstacle whatever the posterior says (`World.certain_field`, support
    surface, half-spaces), as an independent cause with -ln(1 - P) = ln(1 + exp(-e / w)), e the
    sphere's gap as in `ClearanceCost` and w half a voxel: slope 1 / w however deep, and led to
    0 at a gap of 8 w. A checker's margin counts as part of the spheres, and objects that a link
    may touch do not count for it.

    Args:
        world: a `VPrismMap`, a `World` or a `CollisionChecker`.
        robot: the robot; a checker brings its own.
        exact: True asks the posterior itself (5 to 20 us per point of the quadrature within
            the map's reach); False a quadratic B-spline of its values on nodes.
        measure: see above.
        arc_length, spacing, subsamples, backend: see `ClearanceCost`.
        resolution: of the nodes, metres.
        weight, name: see `TrajectoryCost`.

    Raises:
        ConfigError: a value outside its range, or no robot.
    """

    def __init__(
        self,
        world: Any,
        robot: Any = None,
        *,
        exact: bool = True,
        measure: str = "hazard",
        arc_length: bool = False,
        spacing: float = 0.05,
        subsamples: int | None = None,
        resolution: float = 0.01,
        backend: str = "auto",
        weight: float = 1.0,
        name: str = "occupancy",
    ) -> None:
        if measure not in MEASURES:
            raise ConfigError(f"measure is {measure!r}; it must be one of {MEASURES}")
        super().__init__(
            world, robot, _hazard if measure == "hazard" else _occupancy, exact=exact,
            resolution=resolution, arc_length=arc_length, spacing=spacing,
            subsamples=subsamples, backend=backend, weight=weight, name=name,
        )  # fmt: skip
        self.measure = measure
        self._certain: SplineField | None = None
        self._planes = np.empty((0, 4))
        if self._scene.world is not None:
            self._planes = self._scene.world.planes.copy()
            fields = [self._scene.world.certain_field(ids) for ids in self._scene.rules]
            self._certain = union_field(fields, self._planes)
            self._softness = _SOFTNESS * self._certain.spacing
            self._grown = grown(self._radii, self._certain.spacing)

    def potential(self, centers: Float[Tensor, "m s 3"], fast: bool) -> Float[Tensor, "m s"]:
        """Return hazard or probability of each checked sphere."""
        posterior = super().potential(centers, fast)
        if self._certain is None:
            return posterior
        certain = self._certain_hazard(centers, fast)
        if self.measure == "hazard":
            return posterior + certain
        return 1.0 - (1.0 - posterior) * (-certain).exp()

    def _certain_hazard(self, centers: Float[Tensor, "m s 3"], fast: bool) -> Float[Tensor, "m s"]:
        assert self._certain is not None
        certain = self._certain
        if not fast:
            return self._plain_hazard(centers)

        def work(x: np.ndarray) -> tuple[np.ndarray, Pull]:
            value, slopes = np.empty(x.shape[:2]), np.empty(x.shape)

            def piece(part: slice) -> None:
                kernels.certain_hazards(
                    x[part], self._rules, certain.values, certain.blocks,
                    certain.packed(0.0, 0.0, self._planes), self._radii, self._grown,
                    self._softness, _CUT, value[part], slopes[part],
                )  # fmt: skip

            run_chunked(piece, len(x), 512)
            return value, lambda output: output[..., None] * slopes

        return compiled(centers, work, self._plain_hazard)

    def _plain_hazard(self, centers: Float[Tensor, "m s 3"]) -> Float[Tensor, "m s"]:
        assert self._certain is not None
        gap = self._certain(centers, self._rules) - torch.as_tensor(self._grown).to(centers)
        total = soft_contact(-gap / self._softness, _CUT)
        for row in torch.as_tensor(self._planes).to(centers):
            gap = centers @ row[:3] - row[3] - torch.as_tensor(self._radii).to(centers)
            total = total + soft_contact(-gap / self._softness, _CUT)
        return total


class EntropyCost(_PosteriorCost):
    """How unsure the map is of the space that the robot passes through.

    The entropy of the class probabilities (nats), averaged over the ball of each sphere,
    summed over spheres and averaged over time, or with `arc_length` integrated over the way
    of the sphere's centre; weighted by kernel mass as in `OccupancyCost`. It is a matter of the
    map alone, whatever it is given: obstacles do not enter. It is highest on the surfaces of
    objects and falls on both sides of them, so it says nothing of collisions: add
    `ClearanceCost` or `RiskCost`.

    Args:
        world, robot, exact, arc_length, spacing, subsamples, resolution, backend: see
            `OccupancyCost`.
        weight, name: see `TrajectoryCost`.

    Raises:
        ConfigError: a value outside its range, or no robot.
    """

    def __init__(
        self,
        world: Any,
        robot: Any = None,
        *,
        exact: bool = True,
        arc_length: bool = False,
        spacing: float = 0.05,
        subsamples: int | None = None,
        resolution: float = 0.01,
        backend: str = "auto",
        weight: float = 1.0,
        name: str = "entropy",
    ) -> None:
        super().__init__(
            world, robot, _entropy, exact=exact, resolution=resolution, arc_length=arc_length,
            spacing=spacing, subsamples=subsamples, backend=backend, weight=weight, name=name,
        )  # fmt: skip
