# SPDX-License-Identifier: BSD-3-Clause
"""Distance to the obstacles on a grid of nodes, and bounds between the nodes."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Float32, Int16, UInt8

from vprism_plan._kernels import world as kernels
from vprism_plan._threads import run_chunked
from vprism_plan.errors import WorldError
from vprism_plan.world.grid import Grid, Index, Nodes, Points, Values, Vector

if TYPE_CHECKING:
    import torch

_MAX_LATTICE = 400_000_000


@dataclass(frozen=True)
class Lattice:
    """Marked nodes of a lattice finer than the grid: where obstacles are."""

    # 0 = not an obstacle. Obstacles are unions of cells, and all corners of such a cell are
    # marked; the point of a cell nearest to any lattice node is one of its corners, so distances
    # to marked nodes are exactly the distances to the cells
    labels: UInt8[np.ndarray, "x y z"]
    # position of labels[0, 0, 0] in lattice steps from the world origin
    corner: Index
    factor: int  # lattice steps per grid step


def lattice_nodes(shape: Index, what: str) -> UInt8[np.ndarray, "x y z"]:
    """Return unmarked nodes of a lattice; WorldError if it would be too large to be of use."""
    if math.prod(int(n) for n in shape) > _MAX_LATTICE:
        raise WorldError(
            f"{what} spans {' x '.join(str(int(n)) for n in shape)} lattice nodes (at most "
            f"{_MAX_LATTICE:,}); use a coarser resolution"
        )
    return np.zeros(tuple(shape), dtype=np.uint8)


def distance_to_lattice(
    lattice: Lattice, grid: Grid
) -> tuple[Nodes, UInt8[np.ndarray, "nx ny nz"]]:
    """Exact distance (metres, rounded down) from every node to the marked cells, and their label.
    Infinite, with label 0, if nothing is marked."""
    first = [int(v) for v in grid.first * lattice.factor - lattice.corner]
    nx, ny, nz = grid.shape
    X = len(lattice.labels)
    step = lattice.factor
    labels = np.ascontiguousarray(lattice.labels)
    d_y, l_y = np.empty((X, ny, nz), np.int32), np.empty((X, ny, nz), np.uint8)
    run_chunked(
        lambda s: kernels.edt_layers(labels, *first[1:], step, d_y, l_y, s.start, s.stop), X, 16
    )
    distance, nearest = np.empty((nx, ny, nz), np.float32), np.empty((nx, ny, nz), np.uint8)
    run_chunked(
        lambda s: kernels.edt_pass_x(
            d_y, l_y, first[0], step, grid.spacing / step, distance, nearest, s.start, s.stop
        ),
        ny, 8,
    )  # fmt: skip
    return distance, nearest


def round_down(values: Float[np.ndarray, "*shape"]) -> Float32[np.ndarray, "*shape"]:
    """Nearest float32 that is not above the value: a lower bound stays one."""
    flat, single = np.ascontiguousarray(values).reshape(-1), np.empty(values.size, np.float32)
    run_chunked(lambda s: kernels.round_down(flat[s], single[s]), flat.size, 1 << 18)
    return single.reshape(values.shape)


@dataclass(frozen=True, eq=False)
class DistanceField:
    """Lower bounds of the signed distance to a set of obstacles, at the nodes of a grid.

    All obstacles lie inside the grid's box, or in `beyond`, or else (if `solid_outside`) everything
    outside of the box is an obstacle too.

    Attributes:
        origin: (3,) world position of node (0, 0, 0), metres.
        spacing: between nodes, metres.
        distance: (nx, ny, nz) float32 metres, rounded down. Outside the obstacles the exact
            distance to the cells that cover them; inside, at most the negative distance to the
            nearest point outside.
        source: (nx, ny, nz) int16, index into `sources` of the nearest obstacle; -1 everywhere if
            there is none.
        sources: names of the obstacles.
        solid_outside: whether space outside the grid is an obstacle.
        beyond: a coarser field of the obstacles outside the grid's box, whose bounds the nodes here
            already hold; None if there are none.
    """

    origin: Vector
    spacing: float
    distance: Nodes
    source: Int16[np.ndarray, "nx ny nz"]
    sources: tuple[str, ...]
    solid_outside: bool = False
    beyond: "DistanceField | None" = None
    _tensors: dict[Any, Any] = field(default_factory=dict, repr=False)

    @property
    def upper(self) -> Vector:
        """World position of the last node, metres."""
        return self.origin + self.spacing * (np.array(self.distance.shape) - 1)

    def lower_bound(self, points: Points) -> Values:
        """Lower bound of the signed distance from world points to the obstacles, metres.

        Never above the true distance. Between nodes it uses that the squared distance less |x|^2 is
        concave, d(x)^2 >= sum_i w_i d_i^2 - sum_i w_i |x - x_i|^2 with the trilinear weights w_i,
        and near or inside obstacles that the signed distance changes by at most the way travelled,
        d(x) >= max_i d_i - |x - x_i|. WorldError if a point is not finite.
        """
        points = checked_points(points)
        out = lower_bounds(points, self, self.distance, self.solid_outside)
        if self.beyond is not None:
            outside = ((points < self.origin) | (points > self.upper)).any(axis=1)
            if outside.any():
                out[outside] = np.minimum(out[outside], self.beyond.lower_bound(points[outside]))
        return out

    def source_at(self, points: Points) -> Int16[np.ndarray, " n"]:
        """Index into `sources` of the obstacle nearest to the grid node nearest to each point;
        WorldError if one is not finite."""
        steps = np.rint((checked_points(points) - self.origin) / self.spacing).astype(np.int64)
        nodes = np.clip(steps, 0, np.array(self.distance.shape) - 1)
        return self.source[tuple(nodes.T)]

    def distance_at(self, points: "torch.Tensor") -> "torch.Tensor":
        """Trilinear interpolation of the node distances, differentiable; (..., 3) to (...,).

        For gradients, not for verdicts: it may exceed the true distance by up to a voxel. Outside
        the grid: the distance to the box combined with the distance at its nearest point, as for
        `lower_bound`.
        """
        import torch

        values = self._tensor(points)
        size = torch.tensor(self.distance.shape, device=points.device)
        origin = torch.as_tensor(self.origin, dtype=points.dtype, device=points.device)
        upper = torch.as_tensor(self.upper, dtype=points.dtype, device=points.device)
        inside = torch.minimum(torch.maximum(points, origin), upper)
        scaled = (inside - origin) / self.spacing
        cell = torch.minimum(scaled.detach().floor().long().clamp(min=0), size - 2)
        fraction = scaled - cell
        total = torch.zeros_like(points[..., 0])
        for corner in range(8):
            bits = torch.tensor([corner >> 2 & 1, corner >> 1 & 1, corner & 1], device=cell.device)
            weight = torch.where(bits.bool(), fraction, 1.0 - fraction).prod(dim=-1)
            node = cell + bits
            flat = (node[..., 0] * size[1] + node[..., 1]) * size[2] + node[..., 2]
            total = total + weight * values[flat]
        away = (points - inside).square().sum(dim=-1)
        if self.solid_outside:
            return torch.where(away > 0, -(away + 1e-18).sqrt(), total)
        beyond = (away + total.clamp(min=0.0).square() + 1e-18).sqrt()
        return torch.where(away > 0, beyond, total)

    def _tensor(self, points: "torch.Tensor") -> "torch.Tensor":
        """Node distances on the device and in the precision of the points."""
        import torch

        key = (points.device, points.dtype)
        if key not in self._tensors:
            flat = torch.from_numpy(self.distance.reshape(-1))
            self._tensors[key] = flat.to(device=points.device, dtype=points.dtype)
        return self._tensors[key]


def lower_bounds(points: Points, grid: Any, distance: Nodes, solid_outside: bool = False) -> Values:
    """`DistanceField.lower_bound` for distances at the nodes of a grid, nothing beyond it."""
    out = np.empty(len(points))

    def look(piece: slice) -> None:
        kernels.lower_bounds(
            points, grid.origin, grid.spacing, distance, solid_outside, out,
            piece.start, piece.stop,
        )  # fmt: skip

    run_chunked(look, len(points), 1 << 14)
    return out


def checked_points(points: Any) -> Points:
    """Contiguous, writeable float64 points (n, 3) as kernels take them; WorldError if they are
    not that, or not finite."""
    array = np.require(points, np.float64, ["C", "W"])
    if array.ndim != 2 or array.shape[1] != 3:
        raise WorldError(f"points have shape {array.shape}; they must be (n, 3), metres")
    if not np.isfinite(array).all():
        bad = int(np.flatnonzero(~np.isfinite(array).all(axis=1))[0])
        raise WorldError(f"point {bad} is {array[bad].tolist()}; all points must be finite")
    return array


@dataclass(frozen=True)
class NodeDistances:
    """Unsigned distance from every node to one obstacle set, and which part is nearest."""

    distance: Nodes
    source: Int16[np.ndarray, "nx ny nz"]


def combine(parts: Sequence[NodeDistances], grid: Grid) -> NodeDistances:
    """Nearest of several obstacle sets; the first one wins a tie."""
    distance = np.full(grid.shape, np.inf, dtype=np.float32)
    source = np.full(grid.shape, -1, dtype=np.int16)
    for part in parts:
        closer = part.distance < distance
        np.copyto(distance, part.distance, where=closer)
        np.copyto(source, part.source, where=closer)
    return NodeDistances(distance, source)


def at_nodes(grid: Grid, bound: Callable[[np.ndarray], np.ndarray]) -> Nodes:
    """Bounds of a distance at all nodes, at least 0 and rounded down."""
    distance = np.empty(grid.shape, dtype=np.float32)

    def look(layers: slice) -> None:
        outside = np.maximum(bound(grid.slab(layers.start, layers.stop)), 0.0)
        distance[layers] = round_down(outside).reshape(-1, *grid.shape[1:])

    run_chunked(look, grid.shape[0], 8)
    return distance


_STRIDE = 4  # nodes


def bounds_on(field: DistanceField, grid: Grid) -> NodeDistances:
    """Lower bounds of a field's distances at the nodes of another grid, and their sources.

    The field is asked at every fourth node. In between holds, axis by axis, what
    `DistanceField.lower_bound` says of the squared distance: half a millimetre less on average.
    """
    first = grid.first // _STRIDE
    last = (grid.first + np.array(grid.shape) - 1) // _STRIDE + 1
    wide = Grid(_STRIDE * grid.spacing, first, tuple((last - first + 1).tolist()))
    square = at_nodes(wide, field.lower_bound).astype(np.float64) ** 2
    for axis, start in enumerate(grid.first - _STRIDE * first):
        ends = np.moveaxis(square, axis, 0)
        steps = [
            (1.0 - t) * ends[:-1] + t * ends[1:] - t * (1.0 - t) * wide.spacing**2
            for t in np.arange(_STRIDE) / _STRIDE
        ]
        every = np.stack(steps, axis=1).reshape(-1, *ends.shape[1:])
        square = np.moveaxis(every[start : start + grid.shape[axis]], 0, axis)
    distance = round_down(np.sqrt(np.maximum(square, 0.0)) * (1.0 - 1e-12))
    ends = (np.stack([grid.origin, grid.upper]) - field.origin) / field.spacing
    nearest = [
        np.clip(np.rint(np.linspace(first, last, n)), 0, size - 1).astype(int)
        for first, last, n, size in zip(*ends, grid.shape, field.source.shape, strict=True)
    ]
    return NodeDistances(distance, field.source[np.ix_(*nearest)])


def finish(
    nodes: NodeDistances,
    grid: Grid,
    sources: tuple[str, ...],
    solid_outside: bool,
    beyond: DistanceField | None = None,
) -> DistanceField:
    """Give nodes inside obstacles their depth and make the field: a node at distance 0 is at
    most as far from open space as from the nearest node with a positive distance."""
    distance = nodes.distance.copy()
    inside = distance <= 0.0
    reach = float(np.linalg.norm(grid.upper - grid.origin)) + grid.spacing
    if inside.any():
        box = bounding(inside, 1)
        part = Grid(grid.spacing, grid.first + np.array([s.start for s in box]), inside[box].shape)
        # Nodes on the rim of the box are the nearest outside ones only if they are outside.
        depth, _ = distance_to_lattice(
            Lattice((~inside[box]).astype(np.uint8), part.first, 1), part
        )
        depth[~np.isfinite(depth)] = reach
        depth = np.nextafter(depth, np.float32(np.inf))
        distance[box] = np.where(inside[box], -depth, distance[box])
    # Nothing anywhere: any finite number is a bound, and arithmetic stays finite.
    distance[np.isinf(distance)] = reach
    return DistanceField(
        grid.origin, grid.spacing, np.ascontiguousarray(distance), nodes.source, sources,
        solid_outside, beyond,
    )  # fmt: skip


def bounding(mask: np.ndarray, margin: int) -> tuple[slice, ...]:
    """Slices of the box of the true entries, grown by a margin within the array."""
    axes = range(mask.ndim)
    hits = [np.flatnonzero(mask.any(axis=tuple(b for b in axes if b != a))) for a in axes]
    return tuple(
        slice(max(0, int(where[0]) - margin), min(n, int(where[-1]) + 1 + margin))
        for where, n in zip(hits, mask.shape, strict=True)
    )
