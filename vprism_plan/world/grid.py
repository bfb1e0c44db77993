# SPDX-License-Identifier: BSD-3-Clause
"""Where the nodes of a world's distance field lie."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from vprism_plan.errors import WorldError
from vprism_plan.perception import Plane
from vprism_plan.world.config import HalfSpace, WorldConfig

# Arrays by what they hold; metres, world frame.
Vector = Float[np.ndarray, " 3"]
Points = Float[np.ndarray, "_ 3"]
Values = Float[np.ndarray, " _"]
Chosen = Bool[np.ndarray, " _"]
Image = Float[np.ndarray, "_ _"]
Mask = Bool[np.ndarray, "_ _"]
Balls = Float[np.ndarray, "_ 4"]
Nodes = Float32[np.ndarray, "_ _ _"]
Index = Int[np.ndarray, " 3"]
Shape3 = tuple[int, int, int]
Slices = tuple[slice, slice, slice]

_REACH = 0.6  # metres of room around the observed objects
_UNDER = 0.02  # metres below the support plane
_HEIGHT = 1.0  # metres above it, at least
_MAX_NODES = 60_000_000
# Beyond the grid: what the camera saw there, on coarse nodes. Farther from the objects no arm
# that works on them reaches.
_FAR_SPACING = 0.1  # metres
_FAR_REACH = 4.4  # metres beyond the grid
_FAR_BELOW = 0.5  # metres below it: its end must not count where the support surface does


@dataclass(frozen=True, eq=False)
class Grid:
    """Nodes at spacing * (first + (i, j, k)) for 0 <= (i, j, k) < shape.

    The origin is a whole number of steps from the world's origin, so that every finer lattice of
    the world shares its nodes.
    """

    spacing: float
    first: Index
    shape: Shape3

    @property
    def origin(self) -> Vector:
        """World position of node (0, 0, 0), metres."""
        return self.spacing * self.first.astype(np.float64)

    @property
    def upper(self) -> Vector:
        """World position of the last node, metres."""
        return self.spacing * (self.first + np.array(self.shape) - 1).astype(np.float64)

    def slab(self, start: int, stop: int) -> Points:
        """World positions of the nodes with start <= i < stop, in memory order."""
        sizes = (stop - start, *self.shape[1:])
        nodes = np.moveaxis(np.indices(sizes), 0, -1).reshape(-1, 3)
        return self.spacing * (nodes + self.first + np.array([start, 0, 0])).astype(np.float64)


def window(low: np.ndarray, high: np.ndarray) -> Slices:
    """Slices of an array from one corner up to another."""
    x, y, z = (slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
    return x, y, z


def corners(shape: tuple[int, ...]) -> list[tuple[slice, ...]]:
    """Windows of an array of nodes: the eight corners of all its cells."""
    return [
        tuple(slice(bit, n - 1 + bit) for bit, n in zip(bits, shape, strict=True))
        for bits in np.ndindex(2, 2, 2)
    ]


def is_level(plane: Plane | None) -> bool:
    """Whether the support plane is horizontal, that is the world's z axis points up."""
    return plane is not None and float(plane.normal[2]) > 0.99


def _default_box(
    map_: Any, bounded: bool, known: list[tuple[Vector, Vector]]
) -> tuple[np.ndarray, np.ndarray]:
    """Box of the observed objects and robot, grown by the room an arm moves in around them; of
    the middle half of an empty table; of known geometry (its boxes) where nothing was observed."""
    seen = []
    for view in map_.views:
        points, labels = view.points()
        chosen = (labels > 0) | view.sees_robot[view.depth > 0]
        seen.append(points[chosen])
    points = np.concatenate(seen) if seen else np.empty((0, 3))
    if len(points) == 0 and not map_.object_ids:
        points = map_.shown()
    if len(points) == 0:
        boxes = [] if map_.object_ids else known
        points = np.concatenate(boxes or [map_.support_bounds()])
    lower, upper = points.min(axis=0) - _REACH, points.max(axis=0) + _REACH
    if is_level(map_.plane):
        lower[2] = min(lower[2], map_.plane.offset) if bounded else map_.plane.offset - _UNDER
        upper[2] = max(upper[2], map_.plane.offset + _HEIGHT)
    return lower, upper


def grid_beyond(inner: Grid, plane: Plane | None, bounded: bool) -> Grid:
    """Choose coarse nodes around a grid, as far as an arm beside the objects can reach. Under a
    level table the support surface answers, unless it is `bounded`."""
    lower, upper = inner.origin - _FAR_REACH, inner.upper + _FAR_REACH
    if is_level(plane):
        lower[2] = inner.origin[2] - (_FAR_REACH if bounded else _FAR_BELOW)
    spacing = max(_FAR_SPACING, 2.0 * inner.spacing)
    first = np.floor(lower / spacing).astype(np.int64)
    x, y, z = (int(n) for n in np.ceil(upper / spacing).astype(np.int64) - first + 1)
    return Grid(spacing, first, (x, y, z))


def choose_grid(map_: Any, config: WorldConfig, level_box: tuple[Vector, Vector] | None) -> Grid:
    """Choose the nodes: the wanted bounds, the level set and all known geometry.

    Raises:
        WorldError: the grid would have too many nodes to be of use.
    """
    bounded = config.support == "seen"
    known = [item.box() for item in config.known if not isinstance(item, HalfSpace)]
    wanted: Any = config.bounds
    boxes = [_default_box(map_, bounded, known) if wanted is None else np.array(wanted), *known]
    if level_box is not None:
        boxes.append(level_box)
    lower = np.min([box[0] for box in boxes], axis=0)
    upper = np.max([box[1] for box in boxes], axis=0)
    # Marked cells reach up to one step beyond what they cover.
    first = np.floor(lower / config.resolution).astype(np.int64) - 1
    last = np.ceil(upper / config.resolution).astype(np.int64) + 1
    shape = tuple(int(n) for n in last - first + 1)
    if math.prod(shape) > _MAX_NODES:
        size = " x ".join(f"{edge:.2f}" for edge in upper - lower)
        raise WorldError(
            f"a grid of {size} m at {config.resolution} m would have {math.prod(shape):,} nodes "
            f"(at most {_MAX_NODES:,}); use a coarser resolution, smaller bounds, or HalfSpace "
            "for walls and floors"
        )
    return Grid(config.resolution, first, (shape[0], shape[1], shape[2]))
