# SPDX-License-Identifier: BSD-3-Clause
"""The cost of colliding in worlds drawn from the posterior."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vprism_plan._kernels import trajopt as kernels
from vprism_plan._threads import run_chunked
from vprism_plan.errors import ConfigError
from vprism_plan.trajopt._compiled import PathKernels, Pull, checked_backend, compiled
from vprism_plan.trajopt._draw_field import draw_field
from vprism_plan.trajopt._draw_torch import survival_losses
from vprism_plan.trajopt._field import SplineField, grown, union_field
from vprism_plan.trajopt._samples import Subdivision, require_dof
from vprism_plan.trajopt._scene import map_and_scene
from vprism_plan.trajopt._spheres import checked_spheres
from vprism_plan.trajopt.cost import TrajectoryCost, at_least
from vprism_plan.world import PosteriorWorlds

_CUT = 8.0  # temperatures of clearance from which a contact does not count at all
_ROOM = 3.0  # voxels between a sphere and the reach of the draws; see `PosteriorWorlds`


class RiskCost(TrajectoryCost):
    """Relaxed probability of touching anything along the path, jointly over posterior draws.

    S worlds are drawn from the posterior once (`PosteriorWorlds`: draw s occupies a voxel
    where its 1 - p_0 > 1/2), and the same draws judge every trajectory: a smooth function
    with gradients free of sampling noise. The same draw holds for the whole path, as in
    `CollisionChecker.collision_probability`. With m the depth of a sphere (its radius less the
    signed distance of its centre, metres), tau the temperature and all samples and spheres i,

        odds_s = sum_i g(m_is),    g(m) = exp(m / tau) (1 - exp(-(m + c) / tau))^2,
        P = 1 - mean_s 1 / (1 + odds_s),    cost = -ln(1 - P)  nats,

    with g = 0 for m < -c. A draw's odds lie between exp(max_i m_is / tau) (nearly) and N times
    that, N the number of contacts counted: with tau to 0 and dense samples P tends to the share
    of draws that are touched, and for tau > 0 it errs upwards for draws that are not. c is
    8 tau, so that many distant spheres do not add up to a contact.

    Where all draws are hit, P is 1 and flat, but the cost is not: it grows by 1 / tau per metre
    of depth in the draw that is hit least. For small risk it equals P.

    With a `World` or a `CollisionChecker`, what is an obstacle whatever the posterior says
    (`World.certain_field`, support surface, half-spaces) is so in every draw; with a
    `VPrismMap` only its objects count. A checker's margin counts as part of the spheres, and
    objects that a link may touch are left out for it. Links that no joint moves do not count.

    The draws are baked: signed distances on nodes, 2 bytes per node and draw, read by the
    spline of `ClearanceCost` and erring to contact by the same bound. Baking takes seconds.

    Args:
        world: a `VPrismMap`, a `World` or a `CollisionChecker`.
        robot: the robot; a checker brings its own.
        n_worlds: S, a multiple of 64.
        seed: of the draws. An estimate of the result needs another seed, as `plan` does.
        temperature: tau, metres, above 0.
        spacing, subsamples, backend: see `ClearanceCost`.
        resolution: of the voxels, metres; None is the world's (0.01 for a map alone).
        weight, name: see `TrajectoryCost`.

    Raises:
        ConfigError: a value outside its range, no robot, or the tables would be too large.
        WorldError: see `PosteriorWorlds`.
    """

    def __init__(
        self,
        world: Any,
        robot: Any = None,
        *,
        n_worlds: int = 64,
        seed: int = 0,
        temperature: float = 0.005,
        spacing: float = 0.05,
        subsamples: int | None = None,
        resolution: float | None = None,
        backend: str = "auto",
        weight: float = 1.0,
        name: str = "risk",
    ) -> None:
        super().__init__(weight, name)
        self.temperature = at_least("temperature", temperature, 0.0, "metres", strictly=True)
        self.subdivision = Subdivision(spacing, subsamples)
        map_, scene = map_and_scene(world, robot)
        self.robot = scene.robot
        self._checked = (scene.sphere_rules >= 0).nonzero()[0]
        self._rules = scene.sphere_rules[self._checked]
        self._radii = scene.radii[self._checked]
        largest = float(self._radii.max(initial=0.0))
        draws = _draws(map_, scene.world, n_worlds, seed, resolution, largest)
        self._grown = grown(self._radii, draws.resolution)
        self._cut = _CUT * self.temperature
        self._planes = np.empty((0, 4))
        fields: list[Any] = []
        if scene.world is not None:
            self._planes = scene.world.planes.copy()
            fields = [scene.world.certain_field(ids) for ids in scene.rules]
        reach = float(self._grown.max(initial=0.0)) + self._cut
        self._draws = draw_field(draws, scene.rules, fields, self._planes, reach)
        self._certain: SplineField | None = union_field(fields, self._planes) if fields else None
        self._compiled: PathKernels | None = None
        if checked_backend(backend) == "auto":
            self._compiled = PathKernels(self.robot, self.subdivision)

    def probability(self, q: Float[Tensor, "*batch time dof"]) -> Float[Tensor, "*batch"]:
        """Return P, the relaxed probability of touching anything."""
        return -torch.expm1(-self.evaluate(q))

    def evaluate(self, q: Float[Tensor, "*batch time dof"]) -> Float[Tensor, "*batch"]:
        """Return the cost without its weight."""
        require_dof(self.robot, q)
        flat = q.reshape(-1, *q.shape[-2:])
        samples, centers, fast = checked_spheres(
            self.robot, self._compiled, flat, self.subdivision, self._checked
        )

        def plain(x: Tensor) -> Tensor:
            return survival_losses(
                x, samples.trajectory, samples.count, self._rules, self._grown, self._radii,
                self._draws, self._certain, self._planes, self.temperature, self._cut,
            )  # fmt: skip

        if not fast:
            return plain(centers).reshape(q.shape[:-2])
        starts = torch.searchsorted(samples.trajectory, torch.arange(samples.count + 1)).tolist()

        def work(x: np.ndarray) -> tuple[np.ndarray, Pull]:
            return self._losses(x, starts)

        return compiled(centers, work, plain).reshape(q.shape[:-2])

    def _losses(self, centers: np.ndarray, starts: list[int]) -> tuple[np.ndarray, Pull]:
        losses, force = np.empty(len(starts) - 1), np.zeros(centers.shape)
        draws, certain = self._draws, self._certain
        nodes, blocks = np.ones((1, 2, 2, 2), np.float32), np.ones((1, 1, 1, 1), np.float32)
        packed = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
        if certain is not None:
            nodes, blocks = certain.values, certain.blocks
            packed = certain.packed(0.0, 0.0, self._planes)

        def piece(part: slice) -> None:
            for b in range(part.start, part.stop):
                own = slice(starts[b], starts[b + 1])
                losses[b] = kernels.risk(
                    centers[own], self._rules, self._grown, self._radii, draws.steps,
                    draws.blocks, draws.grid, draws.unit, nodes, blocks, packed,
                    certain is not None, self.temperature, self._cut, force[own],
                )  # fmt: skip

        run_chunked(piece, len(losses), 4)
        owner = np.repeat(np.arange(len(losses)), np.diff(starts))
        return losses, lambda output: output[owner, None, None] * force


def _draws(
    map_: Any, world: Any, n_worlds: int, seed: int, resolution: float | None, largest: float
) -> PosteriorWorlds:
    """The draws: the world's own, so that a checker's and a cost's are drawn once."""
    step = 0.01 if resolution is None else resolution
    own = world is not None and resolution in (None, float(world.field.spacing))
    if own:
        step = float(world.field.spacing)
    reach = max(largest + _ROOM * step, 2.0 * step)
    if own:
        return world.posterior_worlds(n_worlds, seed, reach=reach)
    if world is not None:
        raise ConfigError(
            f"resolution is {resolution}; a world's draws have its own, {world.field.spacing} m: "
            "leave it out"
        )
    return PosteriorWorlds(map_, n_worlds, seed, step, reach)
