"""Slow twins of a path's risk: the same draws, asked voxel by voxel at every sample."""

from itertools import pairwise

import numpy as np

from oracles.checker_oracle import sphere_positions
from oracles.worlds_oracle import draw_owners


class DrawnVoxels:
    """What each draw says of each voxel of a small map, straight from the definition."""

    def __init__(self, map_, n_worlds, seed, resolution):
        self.n_worlds = n_worlds
        self.lower, self.upper = map_.support_bounds()
        self.first = np.floor(self.lower / resolution).astype(int)
        shape = np.ceil(self.upper / resolution).astype(int) - self.first + 1
        self.values = np.zeros((*shape, n_worlds), np.uint8)
        index = np.indices(shape).reshape(3, -1).T
        for part in np.array_split(index, len(index) // 20_000 + 1):
            points = resolution * (part + self.first)
            self.values[tuple(part.T)] = draw_owners(map_, points, n_worlds, seed)
        self.possible = self.values.any(axis=3)

    def __call__(self, index):
        """(n, 3) voxel indices -> (n, S) classes; nothing is outside the map's support."""
        local = np.asarray(index) - self.first
        inside = ((local >= 0) & (local < self.possible.shape)).all(axis=1)
        out = np.zeros((len(local), self.n_worlds), np.uint8)
        out[inside] = self.values[tuple(local[inside].T)]
        return out

    def occupiable(self, index):
        """Those of the voxels (n, 3) that any draw occupies."""
        local = np.asarray(index) - self.first
        index = index[((local >= 0) & (local < self.possible.shape)).all(axis=1)]
        return index[self.possible[tuple((index - self.first).T)]]

    def beyond(self, center, radius):
        """Whether a ball lies outside the box of the map's support."""
        return bool(((center + radius < self.lower) | (center - radius > self.upper)).any())


def ball_touches(owners_at, center, radius, resolution, allowed=()):
    """Draws (S,) that occupy a voxel whose centre is within radius + half a voxel of `center`."""
    reach = radius + (0.5 + 1e-9) * resolution
    if owners_at.beyond(center, reach):
        return np.zeros(owners_at.n_worlds, bool)
    index = inside_ball(center, reach, resolution)
    return ~np.isin(owners_at(index), [0, *allowed]).all(axis=0)


def inside_ball(center, radius, resolution):
    """Indices of the voxels whose centres lie in a closed ball."""
    low = np.ceil((center - radius) / resolution).astype(int)
    high = np.floor((center + radius) / resolution).astype(int)
    axes = [np.arange(a, b + 1) for a, b in zip(low, high, strict=True)]
    index = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return index[((resolution * index - center) ** 2).sum(axis=1) <= radius**2]


def dense_touches(owners_at, arrays, path, resolution, step=0.0005):
    """Draws (S,) with a voxel whose inscribed ball meets a sphere anywhere on the path.

    Edges are sampled so that sphere centres move about `step` metres at a time.
    """
    moving = np.flatnonzero(~np.asarray(arrays.link_fixed)[arrays.sphere_link])
    hit = np.zeros(owners_at.n_worlds, bool)
    for qa, qb in pairwise(path):
        coarse = [sphere_positions(arrays, qa + t * (qb - qa)) for t in np.linspace(0, 1, 17)]
        longest = np.linalg.norm(np.diff(coarse, axis=0), axis=2).sum(axis=0).max()
        for t in np.linspace(0.0, 1.0, max(2, int(1.2 * longest / step))):
            centers = sphere_positions(arrays, qa + t * (qb - qa))
            for s in moving:
                if owners_at.beyond(centers[s], arrays.sphere_radius[s] + 0.5 * resolution):
                    continue
                index = inside_ball(
                    centers[s], arrays.sphere_radius[s] + 0.5 * resolution, resolution
                )
                hit |= (owners_at(owners_at.occupiable(index)) > 0).any(axis=0)
    return hit
