# SPDX-License-Identifier: BSD-3-Clause
"""Costs of what a map's posterior says of the space that a robot passes through."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from vprism_plan._kernels import trajopt as kernels
from vprism_plan._threads import run_chunked
from vprism_plan.errors import ConfigError
from vprism_plan.trajopt._compiled import Pull, compiled
from vprism_plan.trajopt._field import SplineField, grown, union_field
from vprism_plan.trajopt.cost import at_least
from vprism_plan.trajopt.sphere_costs import SphereCost, map_and_scene, soft_contact

# Log probabilities of all classes (n, K), and which classes are no obstacle (K,), to values (n,).
Reading = Callable[[Tensor, Tensor], Tensor]

_AT_ONCE = 1 << 16  # points


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


class MapField:
    """A reading of a map's posterior, averaged over balls by a quadrature of 15 points.

    Where the kernel mass s is small, the map repeats its prior: readings count by
    1 - exp(-s / min_support), so not at all where no kernel reaches.

    Args:
        map_: a `VPrismMap`.
        rules: sets of objects that are no obstacle, one per contact rule.
        reading: what to read.
        min_support: kernel mass from which a reading means something, above 0.
        resolution: None asks the posterior itself; metres bake the reading on nodes so far
            apart and read a quadratic B-spline (`SplineField`) of them.
    """

    def __init__(
        self,
        map_: Any,
        rules: Sequence[frozenset[int]],
        reading: Reading,
        min_support: float,
        resolution: float | None,
    ) -> None:
        self._map = map_
        self._min_support = max(float(min_support), 1e-6)
        self._reading = reading
        self._free = np.array([[k == 0 or map_.object_ids[k - 1] in gone
                                for k in range(map_.n_classes)] for gone in rules])  # fmt: skip
        self._nodes, self._weights = ball_quadrature()
        lower, upper = (np.asarray(corner, dtype=np.float64) for corner in map_.support_bounds())
        self._lower, self._upper = lower, upper
        self._baked: SplineField | None = None
        if resolution is not None:
            self._baked = self._bake(resolution)

    def __call__(
        self,
        centers: Float[Tensor, "m s 3"],
        radii: Float[np.ndarray, " s"],
        rules: Int[np.ndarray, " s"],
        fast: bool,
    ) -> Float[Tensor, "m s"]:
        """Average over the ball around each centre; with kernels, if `fast`."""
        if self._baked is None or not fast:
            return self._plain(centers, radii, rules)
        baked = self._baked

        def work(x: np.ndarray) -> tuple[np.ndarray, Pull]:
            value, slopes = np.empty(x.shape[:2]), np.empty(x.shape)
            grid = np.array([*baked.origin, baked.spacing])

            def piece(part: slice) -> None:
                kernels.ball_averages(
                    x[part], rules, radii, baked.values, grid,
                    self._nodes, self._weights, value[part], slopes[part],
                )  # fmt: skip

            run_chunked(piece, len(x), 512)
            return value, lambda output: output[..., None] * slopes

        return compiled(centers, work, lambda x: self._plain(x, radii, rules))

    def _plain(
        self,
        centers: Float[Tensor, "m s 3"],
        radii: Float[np.ndarray, " s"],
        rules: Int[np.ndarray, " s"],
    ) -> Float[Tensor, "m s"]:
        total = 0.0 * centers[..., 0]  # also far away a number with a gradient, which is 0
        if not np.isfinite(self._lower).all():
            return total
        reach = torch.as_tensor(radii).to(centers)[None, :, None]
        lower, upper = (torch.as_tensor(c).to(centers) for c in self._box())
        x = centers.detach()
        meets = ((x > lower - reach) & (x < upper + reach)).all(dim=-1)
        for rule in range(len(self._free)):
            of_rule = torch.as_tensor(rules == rule, device=centers.device)
            rows, columns = (meets & of_rule).nonzero(as_tuple=True)
            if len(rows) == 0:
                continue
            offsets = reach[0, columns, :, None] * torch.as_tensor(self._nodes.T).to(centers)
            points = (centers[rows, columns][:, :, None] + offsets).transpose(1, 2)
            values = self._read(points.reshape(-1, 3), rule).reshape(len(rows), -1)
            mean = (values * torch.as_tensor(self._weights).to(centers)).sum(dim=1)
            total = total.index_put((rows, columns), mean)
        return total

    def _box(self) -> tuple[np.ndarray, np.ndarray]:
        """Outside of this box the reading is 0."""
        if self._baked is None:
            return self._lower, self._upper
        size = np.array(self._baked.values.shape[1:]) - 1
        return self._baked.origin, self._baked.origin + self._baked.spacing * size

    def _read(self, points: Float[Tensor, "n 3"], rule: int) -> Float[Tensor, " n"]:
        lower, upper = (torch.as_tensor(c).to(points) for c in self._box())
        x = points.detach()
        inside = ((x > lower) & (x < upper)).all(dim=1)
        total = points.new_zeros(len(points))
        near = points[inside]
        if self._baked is not None:
            which = np.array([rule], dtype=np.int64)
            return total.masked_scatter(inside, self._baked(near[:, None], which)[:, 0])
        free = torch.as_tensor(self._free[rule], device=points.device)
        parts = []
        for some in near.split(_AT_ONCE):
            log_p, support = self._map.log_proba_and_support(some)
            parts.append(self._reading(log_p, free) * self._counts(support))
        return total.masked_scatter(inside, torch.cat(parts))

    def _counts(self, support: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        return -torch.expm1(-support / self._min_support)

    def _values_at(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "g n"]:
        log_p, support = map(torch.from_numpy, self._map.log_proba_and_support(points))
        counts = self._counts(support)
        found = [self._reading(log_p, torch.from_numpy(free)) * counts for free in self._free]
        return torch.stack(found).numpy()

    def _bake(self, resolution: float) -> SplineField | None:
        if not np.isfinite(self._lower).all():
            return None
        # Two nodes beyond the support on every side: the spline ends in zeros.
        first = np.floor(self._lower / resolution).astype(np.int64) - 2
        shape = np.ceil(self._upper / resolution).astype(np.int64) + 3 - first
        values = np.empty((len(self._free), *shape), dtype=np.float32)
        slab = np.moveaxis(np.indices((1, int(shape[1]), int(shape[2]))), 0, -1).reshape(-1, 3)
        step = max(1, _AT_ONCE // len(slab))
        for start in range(0, int(shape[0]), step):
            stop = min(start + step, int(shape[0]))
            nodes = np.concatenate([slab + np.array([i, 0, 0]) for i in range(start, stop)])
            found = self._values_at(resolution * (nodes + first))
            values[:, start:stop] = found.reshape(len(found), stop - start, *shape[1:])
        return SplineField(values, resolution * first.astype(np.float64), resolution)


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
