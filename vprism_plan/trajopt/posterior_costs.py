# SPDX-License-Identifier: BSD-3-Clause
"""Costs of what a map's posterior says of the space that a robot passes through."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vprism_plan._arguments import choice, number
from vprism_plan._kernels import trajopt as kernels
from vprism_plan.trajopt._field import SplineField, grown, union_field
from vprism_plan.trajopt.cost import compiled_per_sphere
from vprism_plan.trajopt.sphere_costs import SceneCost, soft_contact

MEASURES = ("hazard", "probability")

_AT_ONCE = 1 << 16  # points
_MIN_SUPPORT = 0.5  # kernel mass, where no world says
_CUT = 8.0  # softnesses of gap from which certain obstacles do not count
_SOFTNESS = 0.5  # of the world's resolution: how blurred certain obstacles are


def ball_quadrature() -> tuple[Float[np.ndarray, "p 3"], Float[np.ndarray, " p"]]:
    """Return points and weights that average polynomials of degree 5 over the unit ball.

    The centre, six points on the axes and eight on the diagonals, all at sqrt(5/7): with
    equal distances R the moments <x^2> = 1/5, <x^4> = 3/35 and <x^2 y^2> = 1/35 ask for
    2 / R^2 + 3 / R^2 = 7.
    """
    R = np.sqrt(5.0 / 7.0)
    axes = np.vstack([np.eye(3), -np.eye(3)])
    corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T / np.sqrt(3.0)
    on_axis, on_corner = 1.0 / (35.0 * R**4), 9.0 / (280.0 * R**4)
    weights = np.concatenate([[0.0], np.full(6, on_axis), np.full(8, on_corner)])
    weights[0] = 1.0 - weights.sum()
    return np.vstack([np.zeros((1, 3)), R * axes, R * corners]), weights


# Log probabilities of all classes, and which are no obstacle, to values.
def _hazard(log_p: Float[Tensor, "n k"], free: Bool[Tensor, " k"]) -> Float[Tensor, " n"]:
    return -torch.logsumexp(log_p[:, free], dim=1)


def _occupancy(log_p: Float[Tensor, "n k"], free: Bool[Tensor, " k"]) -> Float[Tensor, " n"]:
    return log_p[:, ~free].exp().sum(dim=1)


def _entropy(log_p: Float[Tensor, "n k"], free: Bool[Tensor, " k"]) -> Float[Tensor, " n"]:
    return -(log_p.exp() * log_p).sum(dim=1)


class _PosteriorCost(SceneCost):
    """A reading of the map's posterior, averaged over spheres by a quadrature of 15 points.

    Where the kernel mass s is small, the map repeats its prior: readings count by
    1 - exp(-s / min_support), so not at all where no kernel reaches. See `OccupancyCost`.
    """

    def __init__(
        self, world: Any, robot: Any, reading: Any, exact: bool, resolution: float, **options: Any
    ) -> None:
        super().__init__(world, robot, **options)
        self.exact = bool(exact)
        step = number("resolution", resolution, 0.0, unit="metres", above=True)
        least = _MIN_SUPPORT if self._world is None else self._world.config.min_support
        self._reading = reading
        self._min_support = max(float(least), 1e-6)
        ids = [None, *self._map.object_ids]
        self._free = np.array([[k is None or k in gone for k in ids] for gone in self._allowed])
        self._nodes, self._weights = ball_quadrature()
        self._box = tuple(np.asarray(end, dtype=np.float64) for end in self._map.support_bounds())
        self._baked: SplineField | None = None
        if not self.exact and np.isfinite(self._box[0]).all():
            self._baked = self._bake(step)
            size = np.array(self._baked.values.shape[1:]) - 1
            self._box = self._baked.origin, self._baked.origin + self._baked.spacing * size

    def _potential(self, centers: Float[Tensor, "m s 3"], fast: bool) -> Float[Tensor, "m s"]:
        if self._baked is None or not fast:
            return self._plain(centers)
        baked = self._baked
        grid = np.array([*baked.origin, baked.spacing])

        def fill(x: np.ndarray, value: np.ndarray, slopes: np.ndarray) -> None:
            kernels.ball_averages(
                x, self._rules, self._radii, baked.values, grid, self._nodes, self._weights,
                value, slopes,
            )  # fmt: skip

        return compiled_per_sphere(centers, fill, self._plain)

    def _plain(self, centers: Float[Tensor, "m s 3"]) -> Float[Tensor, "m s"]:
        total = 0.0 * centers[..., 0]  # also far away a number with a gradient, which is 0
        if not np.isfinite(self._box[0]).all():
            return total
        reach = torch.as_tensor(self._radii).to(centers)[None, :, None]
        lower, upper = (torch.as_tensor(end).to(centers) for end in self._box)
        x = centers.detach()
        meets = ((x > lower - reach) & (x < upper + reach)).all(dim=-1)
        for rule in range(len(self._free)):
            of_rule = torch.as_tensor(self._rules == rule, device=centers.device)
            rows, columns = (meets & of_rule).nonzero(as_tuple=True)
            if len(rows) == 0:
                continue
            offsets = reach[0, columns, :, None] * torch.as_tensor(self._nodes.T).to(centers)
            points = (centers[rows, columns][:, :, None] + offsets).transpose(1, 2).reshape(-1, 3)
            inside = ((points.detach() > lower) & (points.detach() < upper)).all(dim=1)
            values = points.new_zeros(len(points))
            values = values.masked_scatter(inside, self._read(points[inside], rule))
            weights = torch.as_tensor(self._weights).to(centers)
            mean = (values.reshape(len(rows), -1) * weights).sum(dim=1)
            total = total.index_put((rows, columns), mean)
        return total

    def _read(self, points: Float[Tensor, "n 3"], rule: int) -> Float[Tensor, " n"]:
        """Reading at points inside the box."""
        if self._baked is not None:
            return self._baked(points[:, None], np.array([rule], dtype=np.int64))[:, 0]
        free = torch.as_tensor(self._free[rule], device=points.device)
        parts = []
        for some in points.split(_AT_ONCE):
            log_p, support = self._map.log_proba_and_support(some)
            parts.append(self._reading(log_p, free) * self._counts(support))
        return torch.cat(parts)

    def _counts(self, support: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        return -torch.expm1(-support / self._min_support)

    def _bake(self, resolution: float) -> SplineField:
        lower, upper = self._box
        # Two nodes beyond the support on every side: the spline ends in zeros.
        first = np.floor(lower / resolution).astype(np.int64) - 2
        shape = np.ceil(upper / resolution).astype(np.int64) + 3 - first
        values = np.empty((len(self._free), *shape), dtype=np.float32)
        step = max(1, _AT_ONCE // int(shape[1] * shape[2]))
        for start in range(0, int(shape[0]), step):
            part = values[:, start : start + step]
            nodes = np.moveaxis(np.indices(part.shape[1:]), 0, -1).reshape(-1, 3)
            nodes = nodes + first + np.array([start, 0, 0])
            read = self._map.log_proba_and_support(resolution * nodes)
            log_p, support = map(torch.from_numpy, read)
            counts = self._counts(support)
            for own, free in zip(part, self._free, strict=True):
                found = self._reading(log_p, torch.from_numpy(free)) * counts
                own[:] = found.numpy().reshape(own.shape)
        return SplineField(values, resolution * first.astype(np.float64), resolution)


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
    object need not be downhill (for that there is `ClearanceCost`). Links that no joint moves
    are left out.

    With a `VPrismMap`, only its objects count. With a `World` or a `CollisionChecker`, so
    does what is an obstacle whatever the posterior says (`World.certain_field`, support
    surface, half-spaces), as an independent cause with -ln(1 - P) = ln(1 + exp(-e / w)), e the
    sphere's gap as in `ClearanceCost` and w half a voxel: slope 1 / w however deep, and led to
    0 at a gap of 8 w. A checker's margin counts as part of the spheres, and objects that a link
    may touch do not count for it. Objects that nobody saw (`WorldConfig.hidden_objects`) are none
    of these: only draws hold them.

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
        choice("measure", measure, MEASURES)
        super().__init__(
            world, robot, _hazard if measure == "hazard" else _occupancy, exact, resolution,
            arc_length=arc_length, spacing=spacing, subsamples=subsamples, backend=backend,
            weight=weight, name=name,
        )  # fmt: skip
        self.measure = measure
        self._certain: SplineField | None = None
        if self._world is not None:
            self._certain = union_field(self._certain_fields(), self._planes)
            self._softness = _SOFTNESS * self._certain.spacing
            self._grown = grown(self._radii, self._certain.spacing)

    def _potential(self, centers: Float[Tensor, "m s 3"], fast: bool) -> Float[Tensor, "m s"]:
        posterior = super()._potential(centers, fast)
        certain = self._certain
        if certain is None:
            return posterior
        packed = certain.packed(0.0, 0.0, self._planes)

        def fill(x: np.ndarray, value: np.ndarray, slopes: np.ndarray) -> None:
            kernels.certain_potentials(
                x, self._rules, certain.values, certain.blocks, packed, self._radii, self._grown,
                self._softness, _CUT, value, slopes,
            )  # fmt: skip

        def plain(x: Tensor) -> Tensor:
            gap = certain(x, self._rules) - torch.as_tensor(self._grown).to(x)
            total = soft_contact(-gap / self._softness, _CUT)
            for gap in self._plane_gaps(x):
                total = total + soft_contact(-gap / self._softness, _CUT)
            return total

        hazard = compiled_per_sphere(centers, fill, plain) if fast else plain(centers)
        if self.measure == "hazard":
            return posterior + hazard
        return 1.0 - (1.0 - posterior) * (-hazard).exp()


class EntropyCost(_PosteriorCost):
    """How unsure the map is of the space that the robot passes through.

    The entropy of the class probabilities (nats), averaged over the ball of each sphere,
    summed and averaged as in `OccupancyCost`. It is a matter of the map alone, whatever it is
    given: obstacles do not enter. It is highest on the surfaces of objects and falls on both
    sides of them, so it says nothing of collisions: add `ClearanceCost` or `RiskCost`.

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
            world, robot, _entropy, exact, resolution, arc_length=arc_length, spacing=spacing,
            subsamples=subsamples, backend=backend, weight=weight, name=name,
        )  # fmt: skip
