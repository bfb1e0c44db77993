# SPDX-License-Identifier: BSD-3-Clause
"""Costs that are a potential of the gaps around a robot's spheres: clearance, self-collision."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from vprism_plan._kernels import trajopt as kernels
from vprism_plan.collision import CollisionChecker
from vprism_plan.errors import ConfigError
from vprism_plan.trajopt._compiled import PathKernels, checked_backend
from vprism_plan.trajopt._field import grown, union_field
from vprism_plan.trajopt.cost import (
    SHORT,
    Samples,
    Subdivision,
    TrajectoryCost,
    at_least,
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


@dataclass(frozen=True, eq=False)
class Scene:
    """A robot among obstacles, as one checker (or a checker without settings) sees them.

    Attributes:
        world: the world; None where there is only a map.
        robot: the robot.
        rules: sets of objects that may be touched, one per contact rule.
        link_rules: (L,) the rule of each link; -1 where no joint moves it: such links are not
            checked against the world.
        margin: metres that the checker wants spheres to keep.
        checker: the checker, if there is one.
    """

    world: Any
    robot: Any
    rules: tuple[frozenset[int], ...]
    link_rules: Int[np.ndarray, " l"]
    margin: float
    checker: CollisionChecker | None

    @property
    def sphere_rules(self) -> Int[np.ndarray, " s"]:
        """(S,) the rule of each sphere; -1 is not checked."""
        return self.link_rules[self.robot.arrays.sphere_link]

    @property
    def radii(self) -> Float[np.ndarray, " s"]:
        """(S,) radii of the spheres with the checker's margin, metres."""
        return self.robot.arrays.sphere_radius + self.margin

    def fields(self) -> list[Any]:
        """Return the distance field of each rule: the one verdicts are given by."""
        if self.checker is None:
            return [self.world.field]
        arrays = self.robot.arrays
        found: list[Any] = [None] * len(self.rules)
        for link in range(len(arrays.link_frame)):
            found[self.rules.index(self.checker.allowed_objects(link))] = (
                self.checker.verdict_field(link)
            )
        return found


def scene_of(world: Any, robot: Any) -> Scene:
    """Put a scene together from a checker, or from a world (or None) and a robot.

    Raises:
        ConfigError: a robot is missing, or another one than the checker's is given.
    """
    if isinstance(world, CollisionChecker):
        if robot is not None and robot is not world.robot:
            raise ConfigError(
                "a checker brings its own robot; leave `robot` out, or build a checker for this one"
            )
        robot = world.robot
        per_link = [world.allowed_objects(k) for k in range(len(robot.arrays.link_frame))]
        rules = tuple(dict.fromkeys(per_link))
        index = np.array([rules.index(own) for own in per_link], dtype=np.int64)
        margin, checker, world = float(world.config.margin), world, world.world
    else:
        if robot is None:
            raise ConfigError("a world alone has no robot; pass one, or pass a CollisionChecker")
        rules, margin, checker = (frozenset[int](),), 0.0, None
        index = np.zeros(len(robot.arrays.link_frame), dtype=np.int64)
    index = np.where(robot.arrays.link_fixed, -1, index)
    return Scene(world, robot, rules, index, margin, checker)


def map_and_scene(world: Any, robot: Any) -> tuple[Any, Scene]:
    """Return the map of a checker, a world, or itself, and the scene: without a world for a map.

    Raises:
        ConfigError: it is none of them, or see `scene_of`.
    """
    if isinstance(world, CollisionChecker) or hasattr(world, "certain_field"):
        scene = scene_of(world, robot)
        return scene.world.map, scene
    if not hasattr(world, "log_proba_and_support"):
        raise ConfigError(
            f"got a {type(world).__name__}; pass a VPrismMap, a World or a CollisionChecker"
        )
    return world, scene_of(None, robot)


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
