# SPDX-License-Identifier: BSD-3-Clause
"""Values on a grid as a function with a continuous gradient."""

import weakref
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from torch import Tensor

from vprism_plan.world.distance import NodeDistances, finish
from vprism_plan.world.grid import Grid

# Unions by their first field: optimisers make many costs of one world.
_unions: Any = weakref.WeakKeyDictionary()
# Variance of the spline's weights about the point, in squared grid steps, three axes.
SPREAD = 0.75


class SplineField:
    """Quadratic B-splines over the nodes of a grid: 27 nodes a point, continuous gradient.

    The weights are positive, sum to 1, average to the point and have the variance h^2 / 4
    per axis. So linear functions are reproduced, and where the nodes hold distances d_i to a
    set, |x|^2 - d(x)^2 being convex, the value D obeys D(x)^2 <= d(x)^2 + 3 h^2 / 4: it
    exceeds a distance by at most that (see `grown`).

    Outside the grid, a metres from its nearest point c: min(D(c), 0) + hypot(s a, max(D(c), 0)),
    which continues distances outwards, with s = 1 where D(c) >= h, falling to 1/2 at 0: where a
    half-space leaves the grid, the way down must not seem to lead out of it as fast as the
    half-space's own distance grows. Or D(c) - a, if everything outside is an obstacle.

    Args:
        values: (rules, nx, ny, nz) one set of node values per contact rule.
        origin: world position of node (0, 0, 0), metres.
        spacing: h, metres.
        solid_outside: see above.
    """

    def __init__(
        self,
        values: Float32[np.ndarray, "g nx ny nz"],
        origin: Float[np.ndarray, " 3"],
        spacing: float,
        solid_outside: bool = False,
    ) -> None:
        self.values = np.ascontiguousarray(values)
        self.origin = np.asarray(origin, dtype=np.float64)
        self.spacing = float(spacing)
        self.solid_outside = solid_outside
        self._tensors: dict[Any, Tensor] = {}

    def __call__(
        self, points: Float[Tensor, "m s 3"], rules: Int[np.ndarray, " s"]
    ) -> Float[Tensor, "m s"]:
        """Value at points (metres), under the rule of each column; any order differentiable."""
        device, dtype = points.device, points.dtype
        if (device, dtype) not in self._tensors:
            flat = torch.from_numpy(self.values.reshape(-1))
            self._tensors[device, dtype] = flat.to(device=device, dtype=dtype)
        values = self._tensors[device, dtype]
        sizes = self.values.shape[1:]
        top = torch.tensor(sizes, device=device).to(dtype) - 1.0
        origin = torch.as_tensor(self.origin, dtype=dtype, device=device)
        scaled = (points - origin) / self.spacing
        inside = torch.minimum(scaled.clamp(min=0.0), top)
        around, weights = spline_weights(inside, sizes)
        first = torch.as_tensor(rules, device=device) * int(np.prod(sizes))
        total = torch.zeros_like(points[..., 0])
        for i in range(3):
            for j in range(3):
                rows = (around[..., 0, i] * sizes[1] + around[..., 1, j]) * sizes[2] + first
                across = weights[..., 0, i] * weights[..., 1, j]
                along = sum(weights[..., 2, k] * values[rows + around[..., 2, k]] for k in range(3))
                total = total + across * along
        away = self.spacing**2 * (scaled - inside).square().sum(dim=-1)
        outside = away > 0.0
        way = torch.where(outside, away, 1.0)
        if self.solid_outside:
            return torch.where(outside, total - way.sqrt(), total)
        share = 0.5 + 0.5 * (total / self.spacing).clamp(0.0, 1.0)
        far = (share.square() * way + total.clamp(min=0.0).square()).sqrt()
        beyond = total.clamp(max=0.0) + far
        return torch.where(outside, beyond, total)

    @cached_property
    def blocks(self) -> Float32[np.ndarray, "g bx by bz"]:
        """Lower bound of the value in each block; see `block_least`."""
        return block_least(self.values)

    def packed(
        self, margin: float, room: float, planes: Float[np.ndarray, "p 4"]
    ) -> Float[np.ndarray, " w"]:
        """Return what the kernels read beside the values: grid, margins (m) and planes.

        `margin` is where the potential begins, `room` what spheres have been grown by.
        """
        solid = 1.0 if self.solid_outside else 0.0
        head = [*self.origin, self.spacing, solid, float(len(planes)), margin, room]
        return np.array([*head, *np.asarray(planes, dtype=np.float64).reshape(-1)])

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_tensors": {}}


def block_least(
    values: Float32[np.ndarray, "g nx ny nz"],
) -> Float32[np.ndarray, "g bx by bz"]:
    """Return the least node that a spline in each block of 4 x 4 x 4 cells reads."""
    for axis, n in enumerate(values.shape[1:], start=1):
        starts = 4 * np.arange((n - 1) // 4 + 1)[:, None]
        # A point between nodes i and i + 1 hears of i - 1 to i + 2.
        rows = np.clip(starts + np.arange(-1, 6), 0, n - 1)
        values = np.take(values, rows, axis=axis).min(axis=axis + 1)
    return np.ascontiguousarray(values)


def spline_weights(
    inside: Float[Tensor, "*shape 3"], sizes: tuple[int, ...]
) -> tuple[Int[Tensor, "*shape 3 3"], Float[Tensor, "*shape 3 3"]]:
    """Indices of the three nodes per axis around points of a grid, and their weights."""
    size = torch.tensor(sizes, device=inside.device)
    node = torch.minimum((inside.detach() + 0.5).floor().long(), size - 1)
    t = inside - node
    weights = torch.stack(
        [0.5 * (0.5 - t).square(), 0.75 - t.square(), 0.5 * (0.5 + t).square()], dim=-1
    )
    around = (node[..., None] + torch.arange(-1, 2, device=inside.device)).clamp(min=0)
    return torch.minimum(around, size[:, None] - 1), weights


def grown(radii: Float[np.ndarray, " s"], spacing: float) -> Float[np.ndarray, " s"]:
    """Return what a spline of distances must exceed for a ball to be clear, metres.

    With D^2 <= d^2 + 3 h^2 / 4, D > sqrt(r^2 + 3 h^2 / 4) proves d > r.
    """
    return np.sqrt(radii**2 + SPREAD * spacing**2)


def union_field(fields: Sequence[Any], planes: Float[np.ndarray, "p 4"]) -> SplineField:
    """Signed distance to fields' obstacles and half-spaces together, one per contact rule.

    Depth is the distance to what is outside of both: where an object stands on a table, the
    pull of its underside and the push of the table would cancel.
    """
    made = _unions.setdefault(fields[0], {})
    key = np.asarray(planes, dtype=np.float64).tobytes(), *fields[1:]
    if key not in made:
        made[key] = _union_field(fields, planes)
    return made[key]


def _union_field(fields: Sequence[Any], planes: Float[np.ndarray, "p 4"]) -> SplineField:
    field = fields[0]
    spacing = float(field.spacing)
    first = np.rint(np.asarray(field.origin) / spacing).astype(np.int64) - 1
    x, y, z = (n + 2 for n in field.distance.shape)
    # One more node all around: space outside the grid is a way out of what touches its faces.
    grid = Grid(spacing, first, (x, y, z))
    ends = [np.float32(spacing**2) * np.isin(np.arange(n), [0, n - 1]) for n in grid.shape]
    rim = ends[0][:, None, None] + ends[1][:, None] + ends[2]
    floor = np.full(grid.shape, np.inf, dtype=np.float32)
    for start in range(0, x, 16):
        part = floor[start : start + 16]
        nodes = grid.slab(start, start + len(part))
        for row in planes:
            away = (nodes @ row[:3] - row[3]).reshape(part.shape)
            np.minimum(part, away, out=part, casting="same_kind")
    solid = bool(getattr(field, "solid_outside", False))
    merged = []
    for own in fields:
        nodes = np.maximum(np.pad(own.distance, 1, mode="edge"), 0.0)
        nodes = np.where(rim > 0.0, 0.0 if solid else np.sqrt(nodes**2 + rim), nodes)
        nodes = np.maximum(np.minimum(nodes, floor), 0.0).astype(np.float32)
        source = np.zeros(grid.shape, dtype=np.int16)
        merged.append(finish(NodeDistances(nodes, source), grid, (), solid).distance)
    return SplineField(np.stack(merged), grid.origin, spacing, solid)
