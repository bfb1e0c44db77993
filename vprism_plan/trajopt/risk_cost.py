# SPDX-License-Identifier: BSD-3-Clause
"""The cost of colliding in worlds drawn from the posterior."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vprism_plan._arguments import number
from vprism_plan._kernels import trajopt as kernels
from vprism_plan._threads import run_chunked
from vprism_plan.errors import ConfigError
from vprism_plan.trajopt._field import (
    SplineField,
    block_least,
    grown,
    spline_weights,
    union_field,
)
from vprism_plan.trajopt.cost import PathKernels, Pull, Samples, compiled
from vprism_plan.trajopt.sphere_costs import SceneCost
from vprism_plan.world import PosteriorWorlds
from vprism_plan.world.distance import Lattice, NodeDistances, distance_to_lattice, finish
from vprism_plan.world.grid import Grid

_STEPS = 512.0  # stored per voxel: 64 voxels either way fit 16 bits
_MOST = 2 << 30  # bytes
_AROUND = 2.6  # steps from a point to the farthest node that its spline reads
_AT_ONCE = 1 << 24  # numbers
_CUT = 8.0  # temperatures of clearance from which a contact does not count at all
_ROOM = 3.0  # voxels between a sphere and the reach of the draws; see `PosteriorWorlds`


class _DrawField:
    """Signed distance to the union of a draw's voxels and what is certain, for every draw.

    A voxel that a draw occupies counts as the ball inscribed in it: coarser than `PosteriorWorlds`.
    The nodes cover all that is nearer than `reach` to any voxel that any draw may occupy.
    Distances are cut off so far beyond it that the spline is itself up to there.

    Attributes:
        steps: (rules, nx, ny, nz, S) int16: distance in multiples of `unit` metres.
        blocks: (rules, bx, by, bz) least distance of any draw; see `block_least`.
        grid: origin and spacing, metres.

    Args:
        worlds: the draws.
        rules: ids of objects that may be touched, one set per contact rule.
        certain: distance field of what is an obstacle in every draw, per rule; empty if nothing.
        planes: half-spaces.
        reach: distances up to this are told apart, metres.

    Raises:
        ConfigError: that would take more than 2 GB, or `reach` is more than 57 voxels.
    """

    def __init__(
        self,
        worlds: PosteriorWorlds,
        rules: Sequence[frozenset[int]],
        certain: Sequence[Any],
        planes: Float[np.ndarray, "p 4"],
        reach: float,
    ) -> None:
        h, n_worlds = worlds.resolution, worlds.n_worlds
        self.unit = h / _STEPS
        row, _, first = worlds.owner_tables
        possible = np.argwhere(row >= 0)
        if len(possible) == 0:
            possible = np.zeros((1, 3), dtype=np.int64)
        halo = int(np.ceil(reach / h)) + 2
        low = possible.min(axis=0) + first - halo
        nx, ny, nz = map(int, possible.max(axis=0) + first + halo + 1 - low)
        if reach + _AROUND * h > 60.0 * h:
            raise ConfigError(
                f"contacts up to {reach:.3f} m matter, but {60.0 * h:.3f} m is as far as voxels of "
                f"{h} m tell; lower the temperature, or use a coarser resolution"
            )
        size = 2 * len(rules) * nx * ny * nz * n_worlds
        if size > _MOST:
            raise ConfigError(
                f"n_worlds is {n_worlds}: {len(rules)} tables of {nx} x {ny} x {nz} nodes would "
                f"take {size / 2**30:.1f} GB (at most 2); use fewer worlds, or a coarser "
                "resolution of the world"
            )
        grid = Grid(h, low, (nx, ny, nz))
        nodes = grid.slab(0, nx)
        inner = tuple(slice(halo, n - halo) for n in grid.shape)
        index = np.moveaxis(np.indices([s.stop - s.start for s in inner]), 0, -1).reshape(-1, 3)
        owners = worlds.owners(index + low + halo)
        # Free, the map's classes, and the class of objects that nobody saw.
        ids = [None, *worlds.map.object_ids, "unseen"]
        self.steps = np.empty((len(rules), *grid.shape, n_worlds), dtype=np.int16)
        for g, gone in enumerate(rules):
            counts = np.array([k is not None and k not in gone for k in ids])
            floor = np.full(len(nodes), np.inf)
            for plane in planes:
                np.minimum(floor, nodes @ plane[:3] - plane[3], out=floor)
            if certain:
                np.minimum(floor, certain[g].lower_bound(nodes), out=floor)
            fixed = np.maximum(floor, 0.0).astype(np.float32).reshape(grid.shape)
            for s in range(n_worlds):
                marks = np.zeros(grid.shape, dtype=np.uint8)
                marks[inner] = counts[owners[:, s]].reshape(marks[inner].shape)
                away, _ = distance_to_lattice(Lattice(marks, low, 1), grid)
                away = np.minimum(np.maximum(away - np.float32(0.5 * h), 0.0), fixed)
                none = np.zeros(grid.shape, dtype=np.int16)
                signed = finish(NodeDistances(away, none), grid, (), solid_outside=False).distance
                cut = np.clip(signed, -60.0 * h, reach + _AROUND * h)
                self.steps[g, ..., s] = np.floor(cut / self.unit)
        self.blocks = block_least(self.steps.min(axis=4) * np.float32(self.unit))
        self.grid = np.array([*grid.origin, h])

    def near(self, centers: Tensor, rules: np.ndarray, enough: np.ndarray) -> tuple[Any, Any]:
        """(sample, sphere) of centres (m, s, 3) where a draw may be nearer than enough (s,)."""
        grid = torch.as_tensor(self.grid).to(centers)
        top = torch.tensor(self.steps.shape[1:4], device=centers.device) - 1
        scaled = (centers - grid[:3]) / grid[3]
        rows, columns = ((scaled >= 0.0) & (scaled <= top)).all(dim=-1).nonzero(as_tuple=True)
        x, y, z = (scaled[rows, columns].long() >> 2).unbind(dim=1)
        own = torch.as_tensor(rules, device=centers.device)[columns]
        least = torch.from_numpy(self.blocks).to(centers)[own, x, y, z]
        near = least < torch.as_tensor(enough).to(centers)[columns]
        return rows[near], columns[near]

    def distances(self, points: Tensor, rules: np.ndarray, table: Tensor) -> Tensor:
        """Spline (n, S) of every draw's signed distance, metres; `table` is `steps` by node."""
        grid = torch.as_tensor(self.grid).to(points)
        sizes = self.steps.shape[1:4]
        around, weights = spline_weights((points - grid[:3]) / grid[3], sizes)
        first = torch.as_tensor(rules, device=points.device) * int(np.prod(sizes))
        total = points.new_zeros(len(points), self.steps.shape[4])
        for i, j, k in np.ndindex(3, 3, 3):
            row = (around[:, 0, i] * sizes[1] + around[:, 1, j]) * sizes[2] + around[:, 2, k]
            share = weights[:, 0, i] * weights[:, 1, j] * weights[:, 2, k]
            total = total + share[:, None] * (self.unit * table[first + row].to(points))
        return total


_NOTHING = SplineField(np.full((1, 2, 2, 2), np.inf, np.float32), np.zeros(3), 1.0)


class RiskCost(SceneCost):
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
    of depth in the draw that is hit least. For small risk it equals P. What is certain (see
    `OccupancyCost`) is an obstacle in every draw.

    The draws are baked: signed distances on nodes, 2 bytes per node and draw, read by the
    spline of `ClearanceCost` and erring to contact by the same bound. Baking takes seconds.

    Args:
        world, robot: see `OccupancyCost`.
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
        super().__init__(
            world, robot, spacing=spacing, subsamples=subsamples, backend=backend, weight=weight,
            name=name,
        )  # fmt: skip
        self.temperature = number("temperature", temperature, 0.0, unit="metres", above=True)
        self._cut = _CUT * self.temperature
        worlds = self._worlds(n_worlds, seed, resolution)
        self._grown = grown(self._radii, worlds.resolution)
        fields = self._certain_fields()
        reach = float(self._grown.max(initial=0.0)) + self._cut
        self._draws = _DrawField(worlds, self._allowed, fields, self._planes, reach)
        self._certain = union_field(fields, self._planes) if fields else None

    def _worlds(self, n_worlds: int, seed: int, resolution: float | None) -> PosteriorWorlds:
        """The draws: the world's own, so that a checker's and a cost's are drawn once."""
        own = 0.01 if self._world is None else float(self._world.field.spacing)
        step = own if resolution is None else resolution
        reach = max(float(self._radii.max(initial=0.0)) + _ROOM * step, 2.0 * step)
        if self._world is None:
            return PosteriorWorlds(self._map, n_worlds, seed, step, reach)
        if step != own:
            raise ConfigError(
                f"resolution is {resolution}; a world's draws have its own, {own} m: leave it out"
            )
        return self._world.posterior_worlds(n_worlds, seed, reach=reach)

    def probability(self, q: Float[Tensor, "*batch time dof"]) -> Float[Tensor, "*batch"]:
        """Return P, the relaxed probability of touching anything."""
        return -torch.expm1(-self.evaluate(q))

    def _costs(self, q: Tensor, fast: PathKernels | None) -> Tensor:
        samples, centers = self._spheres(q, fast)
        if fast is None:
            return self._plain(centers, samples)
        work = partial(self._losses, samples=samples)
        return compiled(centers, work, partial(self._plain, samples=samples))

    def _losses(self, centers: np.ndarray, samples: Samples) -> tuple[np.ndarray, Pull]:
        losses, force = np.empty(samples.count), np.zeros(centers.shape)
        draws, certain = self._draws, _NOTHING if self._certain is None else self._certain
        packed, parts = certain.packed(0.0, 0.0, self._planes), samples.parts

        def piece(some: slice) -> None:
            for b in range(some.start, some.stop):
                own = parts[b]
                losses[b] = kernels.risk(
                    centers[own], self._rules, self._grown, self._radii, draws.steps,
                    draws.blocks, draws.grid, draws.unit, certain.values, certain.blocks, packed,
                    self.temperature, self._cut, force[own],
                )  # fmt: skip

        run_chunked(piece, len(losses), 4)
        owner = samples.trajectory.numpy()
        return losses, lambda output: output[owner, None, None] * force

    def _plain(self, centers: Float[Tensor, "m s 3"], samples: Samples) -> Float[Tensor, " b"]:
        """-ln mean_s 1 / (1 + odds_s) of each trajectory."""
        tau, draws, n_worlds = self.temperature, self._draws, self._draws.steps.shape[-1]
        need = torch.as_tensor(self._grown).to(centers)
        owners: list[Tensor] = []
        depths: list[Tensor] = []
        rows, columns = draws.near(centers.detach(), self._rules, self._grown + self._cut)
        if len(rows) == 0 and self._certain is None:
            return (0.0 * centers.sum()).expand(samples.count)
        table = torch.from_numpy(draws.steps.reshape(-1, n_worlds)).to(centers.device)
        step = max(1, _AT_ONCE // (27 * n_worlds))
        for i, s in zip(rows.split(step), columns.split(step), strict=True):
            owners.append(samples.trajectory[i])
            away = draws.distances(centers[i, s], self._rules[s.cpu().numpy()], table)
            depths.append(need[s, None] - away)
        if self._certain is not None:  # contacts that every draw has
            gaps = [self._certain(centers, self._rules) - need, *self._plane_gaps(centers)]
            for gap in gaps:
                owners.append(samples.trajectory.repeat_interleave(gap.shape[1]))
                depths.append(-gap.reshape(-1, 1).expand(-1, n_worlds))
        owner, depth = torch.cat(owners), torch.cat(depths)
        high = depth.new_zeros(samples.count, n_worlds)
        index = owner[:, None].expand(-1, n_worlds)
        high = high.scatter_reduce(0, index, depth.detach() / tau, "amax", include_self=True)
        soft = -torch.expm1(-(depth + self._cut).clamp(min=0.0) / tau)
        grown_odds = torch.exp(depth / tau - high[owner]) * soft.square()
        odds = torch.zeros_like(high).index_add(0, owner, grown_odds)
        loss = high + torch.log(torch.exp(-high) + odds)
        return -(torch.logsumexp(-loss, dim=1) - float(np.log(n_worlds)))
