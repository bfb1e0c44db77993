# SPDX-License-Identifier: BSD-3-Clause
"""Costs that are a potential of the gaps around a robot's spheres: clearance, self-collision."""

from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from vprism_plan._arguments import choice, number
from vprism_plan._kernels import trajopt as kernels
from vprism_plan.collision import CollisionChecker
from vprism_plan.collision.config import contact_rules
from vprism_plan.errors import ConfigError
from vprism_plan.robots.pairs import pair_room
from vprism_plan.trajopt._field import grown, union_field
from vprism_plan.trajopt.cost import (
    SHORT,
    PathKernels,
    Samples,
    Subdivision,
    TrajectoryCost,
    compiled_per_sphere,
    require_dof,
    sample_paths,
)


def hinge(gap: Float[Tensor, "*shape"], margin: float) -> Float[Tensor, "*shape"]:
    """CHOMP's obstacle potential of a gap, metres: 0 from `margin` on, slope -1 below 0.

    (margin - gap)^2 / (2 margin) between, so that its derivative is continuous (Zucker et
    al., IJRR 32, 2013, section 3.4).
    """
    short = (margin - gap).clamp(min=0.0)
    return torch.where(gap < 0.0, 0.5 * margin - gap, short.square() / (2.0 * margin))


def soft_contact(depth: Float[Tensor, "*shape"], cut: float) -> Float[Tensor, "*shape"]:
    """ln(1 + e^x) (1 - e^-(x + cut))^2 of a depth x in units of softness; 0 below -cut.

    A logistic hazard whose tail ends, so that what is far away costs nothing.
    """
    kept = -torch.expm1(-(depth + cut).clamp(min=0.0))
    return torch.nn.functional.softplus(depth, threshold=40.0) * kept.square()


class SphereCost(TrajectoryCost):
    """A potential of each sphere, averaged over time or integrated over its centre's way.

    Subclasses implement `_potential`, or a `_kernel` of whole trajectories beside it, or
    `_costs`. For the arguments see `ClearanceCost`; `rules` are those of `pack_robot`.
    """

    _kernel: Any = None

    def __init__(
        self,
        robot: Any,
        rules: Int[np.ndarray, " l"] | None = None,
        *,
        spacing: float,
        subsamples: int | None,
        backend: str,
        weight: float,
        name: str,
        arc_length: bool = False,
    ) -> None:
        super().__init__(weight, name)
        self.robot, self.arc_length = robot, bool(arc_length)
        self.subdivision = Subdivision(spacing, subsamples)
        self._checked = np.arange(len(robot.arrays.sphere_radius))
        self._compiled: PathKernels | None = None
        if choice("backend", backend, ("auto", "torch")) == "auto":
            self._compiled = PathKernels(robot, rules)

    def evaluate(self, q: Float[Tensor, "*batch time dof"]) -> Float[Tensor, "*batch"]:
        """Return the cost without its weight."""
        require_dof(self.robot, q)
        flat = q.reshape(-1, *q.shape[-2:])
        fast = self._compiled if q.device.type == "cpu" else None
        if fast is not None and self._kernel is not None and not self.arc_length:
            plain = partial(self._costs, fast=None)
            costs = fast.costs(flat, self.subdivision, self._kernel, plain)
        else:
            costs = self._costs(flat, fast)
        return costs.reshape(q.shape[:-2])

    def _costs(self, q: Tensor, fast: PathKernels | None) -> Tensor:
        """Costs (b,) of (b, time, dof); with kernels, if there are any."""
        samples, centers = self._spheres(q, fast)
        values = self._potential(centers, fast is not None)
        if self.arc_length:
            return samples.total((values * samples.ways(centers)).sum(dim=1))
        return samples.total(samples.weight * values.sum(dim=1))

    def _spheres(self, q: Tensor, fast: PathKernels | None) -> tuple[Samples, Tensor]:
        """Samples, and the centres (m, s, 3) of the checked spheres at them."""
        if fast is not None:
            samples = sample_paths(self.robot, q, self.subdivision, fast.sphere_centers)
            return samples, fast.sphere_centers(samples.q, self._checked)
        samples = sample_paths(self.robot, q, self.subdivision)
        columns = torch.as_tensor(self._checked, device=q.device)
        return samples, self.robot.sphere_centers(samples.q)[:, columns]

    def _potential(self, centers: Float[Tensor, "m s 3"], fast: bool) -> Float[Tensor, "m s"]:
        """Potential of each checked sphere; with kernels, if `fast`."""
        raise NotImplementedError(f"{type(self).__name__} has no potential of its spheres")


class SceneCost(SphereCost):
    """A cost of spheres among obstacles: those of a checker, of a world, or of a map alone.

    Only spheres that joints move count: `_rules` (s,) are their contact rules, `_radii` (s,)
    their radii with the checker's margin, metres. `_allowed` are the sets of objects that may be
    touched, one per rule; `_world` is None where there is only a map.

    Raises:
        ConfigError: a robot is missing, or another one than the checker's is given; or `world`
            is none of the three.
    """

    def __init__(self, world: Any, robot: Any, **options: Any) -> None:
        checker = world if isinstance(world, CollisionChecker) else None
        if checker is not None:
            if robot is not None and robot is not checker.robot:
                raise ConfigError("a checker brings its own robot; leave `robot` out")
            robot, world = checker.robot, checker.world
        if robot is None:
            raise ConfigError("a world alone has no robot; pass one, or pass a CollisionChecker")
        map_ = world.map if hasattr(world, "certain_field") else world
        if not hasattr(map_, "log_proba_and_support"):
            raise ConfigError(
                f"got a {type(world).__name__}; pass a VPrismMap, a World or a CollisionChecker"
            )
        arrays = robot.arrays
        sets, index = contact_rules(robot, checker.config.allowed_contacts if checker else {})
        super().__init__(robot, index, **options)
        self._checker, self._map = checker, map_
        self._world: Any = None if map_ is world else world
        self._allowed = sets
        self._room = 0.0 if checker is None else float(checker.config.margin)
        self._checked = (~arrays.link_fixed[arrays.sphere_link]).nonzero()[0]
        self._rules = index[arrays.sphere_link][self._checked]
        self._radii = arrays.sphere_radius[self._checked] + self._room
        self._planes = np.empty((0, 4)) if self._world is None else self._world.planes.copy()

    def _certain_fields(self) -> list[Any]:
        """What is an obstacle whatever the posterior says, per rule; empty for a map."""
        if self._world is None:
            return []
        return [self._world.certain_field(ids) for ids in self._allowed]

    def _plane_gaps(self, centers: Float[Tensor, "m s 3"]) -> list[Tensor]:
        radii = torch.as_tensor(self._radii).to(centers)
        planes = torch.as_tensor(self._planes).to(centers)
        return [centers @ row[:3] - row[3] - radii for row in planes]


class ClearanceCost(SceneCost):
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
    at that configuration. Inside obstacles the gap falls with slope 1 as far as they go; the
    gradient is zero only on ridges where several ways out are equally long. What lies between
    samples, and what was seen outside the world's grid, is left to verification.

    Args:
        world: a `World`, or a `CollisionChecker`.
        robot: the robot; a checker brings its own.
        margin: metres, above 0.
        arc_length: see above.
        spacing: the most that a sphere's centre moves between two samples, metres.
        subsamples: parts of every edge, instead of `spacing`; at most 64.
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
        super().__init__(
            world, robot, arc_length=arc_length, spacing=spacing, subsamples=subsamples,
            backend=backend, weight=weight, name=name,
        )  # fmt: skip
        self.margin = number("margin", margin, 0.0, unit="metres", above=True)
        fields = [self._world.field] if self._checker is None else self._checker.fields
        self._field = union_field(fields, self._planes)
        self._packed = self._field.packed(self.margin, self._room, self._planes)
        radii = self.robot.arrays.sphere_radius + self._room
        self._both = radii, grown(radii, self._field.spacing)

    def _kernel(self, grad: np.ndarray, *samples: np.ndarray) -> float:
        assert self._compiled is not None
        return kernels.clearance(
            *samples, self._compiled.floats, self._compiled.ints, self._field.values,
            self._field.blocks, self._packed, *self._both, grad,
        )  # fmt: skip

    def _potential(self, centers: Float[Tensor, "m s 3"], fast: bool) -> Float[Tensor, "m s"]:
        need = grown(self._radii, self._field.spacing)

        def fill(x: np.ndarray, value: np.ndarray, slopes: np.ndarray) -> None:
            kernels.certain_potentials(
                x, self._rules, self._field.values, self._field.blocks, self._packed,
                self._radii, need, 0.0, 0.0, value, slopes,
            )  # fmt: skip

        def plain(x: Tensor) -> Tensor:
            gap = self._field(x, self._rules) - torch.as_tensor(need).to(x)
            gaps = [gap, *self._plane_gaps(x)]
            return torch.stack([hinge(gap, self.margin) for gap in gaps]).sum(dim=0)

        return compiled_per_sphere(centers, fill, plain) if fast else plain(centers)


_AT_ONCE = 1 << 22  # sphere pairs in memory at once


class SelfCollisionCost(SphereCost):
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
        kept = 0.0
        if isinstance(robot, CollisionChecker):
            kept, robot = float(robot.config.self_margin), robot.robot
        super().__init__(
            robot, spacing=spacing, subsamples=subsamples, backend=backend, weight=weight, name=name
        )
        self.margin = number("margin", margin, 0.0, unit="metres", above=True)
        self._kept = kept
        arrays = robot.arrays
        rows, reach = [np.empty((0, 2), np.int64)], [np.empty(0)]
        for (a, b), room in zip(arrays.pairs, pair_room(arrays, arrays.pairs), strict=True):
            spheres = [np.arange(arrays.link_start[k], arrays.link_start[k + 1]) for k in (a, b)]
            rows.append(np.stack(np.meshgrid(*spheres, indexing="ij"), axis=-1).reshape(-1, 2))
            both = arrays.sphere_radius[rows[-1]].sum(axis=1) + kept
            reach.append(both - room)
        self._pairs, self._reach = np.concatenate(rows), np.concatenate(reach)

    def _kernel(self, grad: np.ndarray, *samples: np.ndarray) -> float:
        assert self._compiled is not None
        robot = self._compiled.floats, self._compiled.ints
        return kernels.self_collision(*samples, *robot, self.margin, self._kept, grad)

    def _potential(self, centers: Float[Tensor, "m s 3"], fast: bool) -> Float[Tensor, "m 1"]:
        pairs = torch.as_tensor(self._pairs, device=centers.device)
        reach = torch.as_tensor(self._reach).to(centers)
        values = []
        for part in centers.split(max(1, _AT_ONCE // max(1, len(pairs)))):
            apart = part[:, pairs[:, 0]] - part[:, pairs[:, 1]]
            gap = (apart.square().sum(dim=-1) + SHORT**2).sqrt() - reach
            values.append(hinge(gap, self.margin).sum(dim=1, keepdim=True))
        return torch.cat(values)
