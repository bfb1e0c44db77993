# SPDX-License-Identifier: BSD-3-Clause
"""The cost of colliding in worlds drawn from the posterior."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Int, Int16
from torch import Tensor

from vprism_plan._kernels import trajopt as kernels
from vprism_plan._threads import run_chunked
from vprism_plan.errors import ConfigError
from vprism_plan.trajopt._compiled import PathKernels, Pull, checked_backend, compiled
from vprism_plan.trajopt._field import SplineField, grown, spline_weights, union_field
from vprism_plan.trajopt.cost import Subdivision, TrajectoryCost, at_least, require_dof
from vprism_plan.trajopt.sphere_costs import checked_spheres, map_and_scene
from vprism_plan.world import PosteriorWorlds
from vprism_plan.world.distance import Lattice, NodeDistances, distance_to_lattice, finish
from vprism_plan.world.grid import Grid

_STEPS = 512.0  # stored per voxel: 64 voxels either way fit 16 bits
_MOST = 2 << 30  # bytes
_AROUND = 2.6  # steps from a point to the farthest node that its spline reads


@dataclass(frozen=True, eq=False)
class DrawField:
    """Signed distance to the union of a draw's voxels and what is certain, for every draw.

    A voxel that a draw occupies counts as the ball inscribed in it, as in `PosteriorWorlds`.
    The nodes cover all that is nearer than `reach` to any voxel that any draw may occupy.
    Distances are cut off so far beyond it that the spline is itself up to there.

    Attributes:
        steps: (rules, nx, ny, nz, S) int16: distance in multiples of `unit`, one table per
            contact rule.
        blocks: (rules, bx, by, bz) least distance of any draw in blocks of 4 x 4 x 4 cells.
        grid: origin and spacing, metres.
        unit: metres.
        reach: metres.
    """

    steps: Int16[np.ndarray, "g nx ny nz s"]
    blocks: Float32[np.ndarray, "g bx by bz"]
    grid: Float[np.ndarray, " 4"]
    unit: float
    reach: float


def draw_field(
    worlds: PosteriorWorlds,
    rules: Sequence[frozenset[int]],
    certain: Sequence[Any],
    planes: Float[np.ndarray, "p 4"],
    reach: float,
) -> DrawField:
    """Bake the draws.

    Args:
        worlds: the draws.
        rules: ids of objects that may be touched, one set per contact rule.
        certain: distance field of what is an obstacle in every draw, per rule; empty if nothing.
        planes: half-spaces.
        reach: distances up to this are told apart, metres.

    Raises:
        ConfigError: that would take more than 2 GB, or `reach` is more than 57 voxels.
    """
    h = worlds.resolution
    unit = h / _STEPS
    row, _, first = worlds.owner_tables
    possible = np.argwhere(row >= 0)
    if len(possible) == 0:
        possible = np.zeros((1, 3), dtype=np.int64)
    whole = int(np.ceil(reach / h)) + 2
    low = possible.min(axis=0) + first - whole
    shape = tuple(int(n) for n in possible.max(axis=0) + first + whole + 1 - low)
    if reach + _AROUND * h > 60.0 * h:
        raise ConfigError(
            f"contacts up to {reach:.3f} m matter, but {60.0 * h:.3f} m is as far as voxels of "
            f"{h} m tell; lower the temperature, or use a coarser resolution"
        )
    size = 2 * len(rules) * int(np.prod(shape)) * worlds.n_worlds
    if size > _MOST:
        raise ConfigError(
            f"n_worlds is {worlds.n_worlds}: {len(rules)} tables of {' x '.join(map(str, shape))} "
            f"nodes would take {size / 2**30:.1f} GB (at most 2); use fewer worlds, or a coarser "
            "resolution of the world"
        )
    grid = Grid(h, low, (shape[0], shape[1], shape[2]))
    nodes = grid.slab(0, shape[0])
    inner = tuple(slice(whole, n - whole) for n in shape)
    index = np.moveaxis(np.indices([s.stop - s.start for s in inner]), 0, -1).reshape(-1, 3)
    owners = worlds.owners(index + low + whole)
    ids = [0, *worlds.map.object_ids]
    steps = np.empty((len(rules), *shape, worlds.n_worlds), dtype=np.int16)
    for g, gone in enumerate(rules):
        counts = np.array([k > 0 and ids[k] not in gone for k in range(len(ids))])
        floor = np.full(len(nodes), np.inf)
        for plane in planes:
            np.minimum(floor, nodes @ plane[:3] - plane[3], out=floor)
        if certain:
            np.minimum(floor, certain[g].lower_bound(nodes), out=floor)
        fixed = np.maximum(floor, 0.0).astype(np.float32).reshape(shape)
        for s in range(worlds.n_worlds):
            marks = np.zeros(shape, dtype=np.uint8)
            marks[inner] = counts[owners[:, s]].reshape(marks[inner].shape)
            away, _ = distance_to_lattice(Lattice(marks, low, 1), grid)
            away = np.minimum(np.maximum(away - np.float32(0.5 * h), 0.0), fixed)
            none = np.zeros(shape, dtype=np.int16)
            signed = finish(NodeDistances(away, none), grid, (), solid_outside=False).distance
            steps[g, ..., s] = np.floor(np.clip(signed, -60.0 * h, reach + _AROUND * h) / unit)
    lowest = steps.min(axis=4) * np.float32(unit)
    return DrawField(steps, _block_least(lowest), np.array([*grid.origin, h]), unit, reach)


def _block_least(
    values: Float32[np.ndarray, "g nx ny nz"],
) -> Float32[np.ndarray, "g bx by bz"]:
    for axis, n in enumerate(values.shape[1:], start=1):
        starts = 4 * np.arange((n - 1) // 4 + 1)[:, None]
        # A point between nodes i and i + 1 hears of i - 1 to i + 2.
        rows = np.clip(starts + np.arange(-1, 6), 0, n - 1)
        values = np.take(values, rows, axis=axis).min(axis=axis + 1)
    return np.ascontiguousarray(values, dtype=np.float32)


_AT_ONCE = 1 << 24  # numbers


def survival_losses(
    centers: Float[Tensor, "m s 3"],
    trajectory: Int[Tensor, " m"],
    count: int,
    rules: Int[np.ndarray, " s"],
    grown: Float[np.ndarray, " s"],
    radii: Float[np.ndarray, " s"],
    draws: DrawField,
    certain: SplineField | None,
    planes: Float[np.ndarray, "p 4"],
    tau: float,
    cut: float,
) -> Float[Tensor, " b"]:
    """Return -ln mean_s 1 / (1 + odds_s) of each trajectory; see `RiskCost`."""
    n_worlds = draws.steps.shape[-1]
    owners: list[Tensor] = []
    depths: list[Tensor] = []
    rows, columns = _near(centers.detach(), rules, grown + cut, draws)
    table = torch.from_numpy(draws.steps.reshape(-1, n_worlds)).to(centers.device)
    step = max(1, _AT_ONCE // (27 * n_worlds))
    for start in range(0, len(rows), step):
        i, s = rows[start : start + step], columns[start : start + step]
        away = _distances(centers[i, s], rules[s.cpu().numpy()], draws, table)
        owners.append(trajectory[i])
        depths.append(torch.as_tensor(grown).to(centers)[s, None] - away)
    if certain is not None:
        gap = certain(centers, rules) - torch.as_tensor(grown).to(centers)
        owners, depths = _with_common(owners, depths, -gap, trajectory, n_worlds)
        for row in torch.as_tensor(planes).to(centers):
            away = centers @ row[:3] - row[3] - torch.as_tensor(radii).to(centers)
            owners, depths = _with_common(owners, depths, -away, trajectory, n_worlds)
    if not owners:
        return (0.0 * centers.sum()).expand(count)
    owner, depth = torch.cat(owners), torch.cat(depths)
    high = depth.new_zeros(count, n_worlds)
    index = owner[:, None].expand(-1, n_worlds)
    high = high.scatter_reduce(0, index, depth.detach() / tau, "amax", include_self=True)
    soft = -torch.expm1(-(depth + cut).clamp(min=0.0) / tau)
    grown_odds = torch.exp(depth / tau - high[owner]) * soft.square()
    odds = torch.zeros_like(high).index_add(0, owner, grown_odds)
    loss = high + torch.log(torch.exp(-high) + odds)
    return -(torch.logsumexp(-loss, dim=1) - float(np.log(n_worlds)))


def _with_common(
    owners: list[Tensor],
    depths: list[Tensor],
    depth: Float[Tensor, "m s"],
    trajectory: Int[Tensor, " m"],
    n_worlds: int,
) -> tuple[list[Tensor], list[Tensor]]:
    """Add contacts that every draw has."""
    flat = depth.reshape(-1, 1).expand(-1, n_worlds)
    owner = trajectory[:, None].expand(depth.shape).reshape(-1)
    return [*owners, owner], [*depths, flat]


def _near(
    centers: Float[Tensor, "m s 3"],
    rules: Int[np.ndarray, " s"],
    enough: Float[np.ndarray, " s"],
    draws: DrawField,
) -> tuple[Tensor, Tensor]:
    """(sample, sphere) where a draw may be near enough to count."""
    grid = torch.as_tensor(draws.grid).to(centers)
    top = torch.tensor(draws.steps.shape[1:4], device=centers.device) - 1
    scaled = (centers - grid[:3]) / grid[3]
    inside = ((scaled >= 0.0) & (scaled <= top)).all(dim=-1)
    rows, columns = inside.nonzero(as_tuple=True)
    block = scaled[rows, columns].long() >> 2
    blocks = torch.from_numpy(draws.blocks).to(centers)
    own = torch.as_tensor(rules, device=centers.device)[columns]
    least = blocks[own, block[:, 0], block[:, 1], block[:, 2]]
    near = least < torch.as_tensor(enough).to(centers)[columns]
    return rows[near], columns[near]


def _distances(
    points: Float[Tensor, "n 3"], rules: Int[np.ndarray, " n"], draws: DrawField, table: Any
) -> Float[Tensor, "n d"]:
    """Spline of every draw's signed distance, metres."""
    grid = torch.as_tensor(draws.grid).to(points)
    sizes = draws.steps.shape[1:4]
    around, weights = spline_weights((points - grid[:3]) / grid[3], sizes)
    first = torch.as_tensor(rules, device=points.device) * int(np.prod(sizes))
    total = points.new_zeros(len(points), draws.steps.shape[-1])
    for i in range(3):
        for j in range(3):
            for k in range(3):
                row = (around[:, 0, i] * sizes[1] + around[:, 1, j]) * sizes[2] + around[:, 2, k]
                share = weights[:, 0, i] * weights[:, 1, j] * weights[:, 2, k]
                total = total + share[:, None] * (draws.unit * table[first + row].to(points))
    return total


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
