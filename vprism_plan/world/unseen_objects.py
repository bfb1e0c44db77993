# SPDX-License-Identifier: BSD-3-Clause
"""Objects that nobody saw, in hidden space of which no map says anything: a Boolean model."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Int8, UInt8
from scipy.ndimage import maximum_filter

from vprism_plan._kernels import risk as kernels
from vprism_plan._threads import run_chunked
from vprism_plan.mapping.prior import FADE
from vprism_plan.perception import Plane
from vprism_plan.world import visibility
from vprism_plan.world.config import WorldConfig
from vprism_plan.world.grid import Chosen, Grid, Index, Points

RADII = 0.02, 0.06  # metres, the least and the greatest
HEIGHTS = 0.03, 0.25  # metres over the support surface
_MOST = 1000.0  # of them per square metre: with more there is no room left
_GOES_ON = 0.1  # P(occupied) from which a guess counts as cut off by the side of its grid
_STREAM = 0x0B1EC75  # other random numbers than the weights'


class OpenSides:
    """Where the guess of a map's prior goes on at the sides of what it looked at, and is hidden: a
    long object seen end-on reaches farther than the grid around it.

    Args:
        map_: a map with a prior of the package's own.
        views: of the map, ready to be asked.
    """

    def __init__(self, map_: Any, views: Sequence[visibility.View]) -> None:
        self._prior = map_.prior
        n = self._prior.log_odds.shape[1]
        nodes = np.moveaxis(np.indices((n, n, n)), 0, -1).reshape(-1, 3)
        nodes = nodes[np.minimum(nodes, n - 1 - nodes).min(axis=1) == FADE]
        self._open = np.zeros(self._prior.log_odds.shape, dtype=bool)
        for own, pose in zip(self._open, self._prior.T_voxel_world, strict=True):
            points = np.linalg.solve(pose[:, :3], (nodes - pose[:, 3]).T).T
            hidden = visibility.classify_points(views, points) != visibility.SEEN
            held = np.asarray(map_.occupancy(points[hidden])) >= _GOES_ON
            own[tuple(nodes[hidden][held].T)] = True
            own[:] = maximum_filter(own, 3)  # points between nodes are asked about

    def reach(self, points: Points) -> Chosen:
        """Return which points (m) outside the grids the guess may reach: the side of the nearest
        grid is open where it is nearest to them."""
        grid, at = self._prior.nearest(points)
        return np.asarray(self._open[(grid, *np.rint(at).astype(np.int64).T)])


def open_sides(
    map_: Any, config: WorldConfig, views: Sequence[visibility.View]
) -> OpenSides | None:
    """Return what says where hidden space is no business of unseen objects; None if it never is:
    they stand on a support surface that goes on, not too many of them, in space that a prior of
    the package's own would have known of if it were an object's."""
    prior = getattr(map_, "prior", None)
    if config.occluded != "posterior" or config.hidden_objects > _MOST:
        return None
    if prior is None or prior.own or map_.plane is None or config.support == "seen":
        return None
    return OpenSides(map_, views)


@dataclass(frozen=True, eq=False)
class UnseenObjects:
    """Upright cylinders whose centres are a Poisson process on the hidden support surface.

    Radii are uniform in `RADII`, heights in `HEIGHTS`. What of them is not hidden does not exist.

    Attributes:
        density: objects per square metre of hidden support surface.
        plane: the support surface.
        resolution: edge of a voxel, metres; centres are whole multiples of it.
        first: index of the first voxel of the mask.
        mask: (x, y, z) the voxels any part of which may be theirs.
        floor: (m, 2) centres of squares as wide as a voxel that the hidden surface consists of,
            metres along the plane's axes.
    """

    density: float
    plane: Plane
    resolution: float
    first: Index
    mask: Bool[np.ndarray, "x y z"]
    floor: Float[np.ndarray, "m 2"]

    @classmethod
    def among(
        cls, cells: Bool[np.ndarray, "a b c"], grid: Grid, plane: Plane, density: float
    ) -> "UnseenObjects | None":
        """Return those in marked cells, two per grid step; None if there are none."""
        if density <= 0.0 or not cells.any():
            return None
        # Voxel k reaches half a step either way of node k: over the cells 2 k - 1 and 2 k.
        mask = np.pad(cells, 1)
        mask = mask[0::2] | mask[1::2]
        mask = mask[:, 0::2] | mask[:, 1::2]
        mask = mask[:, :, 0::2] | mask[:, :, 1::2]
        index = np.argwhere(mask) + grid.first
        index = index[plane.signed_distance(grid.spacing * index) <= HEIGHTS[1]]
        if len(index) == 0:
            return None
        first = index.min(axis=0)
        low, high = first - grid.first, index.max(axis=0) + 1 - grid.first
        local, mask = index - first, np.zeros(tuple(high - low), dtype=bool)
        mask[tuple(local.T)] = True
        flat = grid.spacing * index @ plane.axes().T
        edges = flat.min(axis=0) - grid.spacing, flat.max(axis=0) + 2.0 * grid.spacing
        sides = [np.arange(a, b, grid.spacing) for a, b in zip(*edges, strict=True)]
        floor = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 2)
        # Where space is hidden high enough for the lowest; the priors' grids leave out the surface.
        for height in (0.25 * grid.spacing, 0.5 * HEIGHTS[0]):
            places = floor @ plane.axes() + (plane.offset + height) * plane.normal
            floor = floor[_marked(mask, np.rint(places / grid.spacing).astype(np.int64) - first)]
        return cls(density, plane, grid.spacing, first, mask, floor)

    def coarser(self, factor: int) -> "UnseenObjects":
        """Return the same on voxels whose edge is a multiple of these, wherever one of these is."""
        if factor == 1:
            return self
        index = np.floor((np.argwhere(self.mask) + self.first) / factor + 0.5).astype(np.int64)
        first = index.min(axis=0)
        mask = np.zeros(tuple(index.max(axis=0) - first + 1), dtype=bool)
        mask[tuple((index - first).T)] = True
        return replace(
            self, density=self.density / factor**2, resolution=self.resolution * factor,
            first=first, mask=mask,
        )  # fmt: skip

    def draw(self, n_worlds: int, seed: int) -> Float[np.ndarray, "n 5"]:
        """Return the cylinders of some worlds: world, centre (two coordinates, metres along the
        plane's axes), radius and height (metres), one row each."""
        rng = np.random.default_rng((seed, _STREAM))
        counts = rng.poisson(self.density * len(self.floor) * self.resolution**2, n_worlds)
        n = int(counts.sum())
        middle = self.floor[rng.integers(max(len(self.floor), 1), size=n)]
        middle = middle + self.resolution * rng.uniform(-0.5, 0.5, (n, 2))
        sizes = [rng.uniform(*ends, n) for ends in (RADII, HEIGHTS)]
        return np.column_stack([np.repeat(np.arange(n_worlds), counts), middle, *sizes])

    def stand(
        self, index: Int[np.ndarray, "n 3"], cylinders: Float[np.ndarray, "m 5"], owner: int,
        owners: UInt8[np.ndarray, "n s"], odds: Int8[np.ndarray, "n s"],
    ) -> None:  # fmt: skip
        """Give voxels that are free in a world to its cylinders, if their centres are in them and
        the voxels in the mask."""
        rows = np.flatnonzero(_marked(self.mask, index - self.first))
        points = self.resolution * index[rows]
        places = np.column_stack([points @ self.plane.axes().T, self.plane.signed_distance(points)])
        own, their_odds = owners[rows], odds[rows]
        run_chunked(
            lambda s: kernels.stand(places, cylinders, owner, own, their_odds, s.start, s.stop),
            len(rows), 1024,
        )  # fmt: skip
        owners[rows], odds[rows] = own, their_odds


def _marked(mask: Bool[np.ndarray, "x y z"], local: Int[np.ndarray, "n 3"]) -> Chosen:
    """Which voxels a mask holds, whatever lies outside of it."""
    rows = np.flatnonzero(((local >= 0) & (local < mask.shape)).all(axis=1))
    found = np.zeros(len(local), dtype=bool)
    found[rows] = mask[tuple(local[rows].T)]
    return found
