"""Slow twins of a path's risk: the same draws, asked voxel by voxel at every sample."""

from itertools import pairwise

import numpy as np

from oracles.checker_oracle import sphere_positions
from oracles.worlds_oracle import draw_owners


class DrawnVoxels:
    """What each draw says of each voxel, straight from the definition; remembers answers."""

    def __init__(self, map_, n_worlds, seed, resolution):
        self.map, self.n_worlds, self.seed, self.resolution = map_, n_worlds, seed, resolution
        lower, upper = map_.support_bounds()
        self.first = np.floor(lower / resolution).astype(int)
        shape = np.ceil(upper / resolution).astype(int) - self.first + 1
        self.known = np.zeros(shape, bool)
        self.values = np.zeros((*shape, n_worlds), np.uint8)

    def __call__(self, index):
        """(n, 3) voxel indices -> (n, S) classes; nothing is outside the map's support."""
        local = np.asarray(index) - self.first
        inside = ((local >= 0) & (local < self.known.shape)).all(axis=1)
        new = np.unique(local[inside][~self.known[tuple(local[inside].T)]], axis=0)
        for part in np.array_split(new, len(new) // 5000 + 1):
            points = self.resolution * (part + self.first)
            where = tuple(part.T)
            self.values[where] = draw_owners(self.map, points, self.n_worlds, self.seed)
            self.known[where] = True
        out = np.zeros((len(local), self.n_worlds), np.uint8)
        out[inside] = self.values[tuple(local[inside].T)]
        return out


def ball_touches(owners_at, center, radius, resolution, steps, allowed=()):
    """Draws (S,) in which a ball touches, with the rounding that `PosteriorWorlds` states.

    v is the voxel nearest to the centre c. An occupied voxel x counts if its distance
    |v - x|, rounded down to 1 / `steps` of a voxel, is at most r + |c - v| rounded down.
    """
    grid = center / resolution
    v = np.floor(grid + 0.5).astype(int)
    need = radius / resolution + np.linalg.norm(grid - v)
    wide = int(need) + 2
    offsets = np.indices((2 * wide + 1,) * 3).reshape(3, -1).T - wide
    away = np.linalg.norm(offsets, axis=1)
    index = v + offsets[np.floor(steps * away) <= np.floor(steps * need)]
    return ~np.isin(owners_at(index), [0, *allowed]).all(axis=0)


def inside_ball(center, radius, resolution):
    """Indices of the voxels whose centres lie in a closed ball."""
    low = np.ceil((center - radius) / resolution).astype(int)
    high = np.floor((center + radius) / resolution).astype(int)
    axes = [np.arange(a, b + 1) for a, b in zip(low, high, strict=True)]
    index = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return index[((resolution * index - center) ** 2).sum(axis=1) <= radius**2]


def dense_touches(owners_at, arrays, path, resolution, margin=0.0, step=0.0005, allowed=None):
    """Draws (S,) that occupy a voxel centre inside a sphere anywhere on the path.

    Edges are sampled so that sphere centres move about `step` metres at a time. allowed:
    classes that each sphere may touch; None for none.
    """
    moving = np.flatnonzero(~np.asarray(arrays.link_fixed)[arrays.sphere_link])
    hit = np.zeros(owners_at.n_worlds, bool)
    for qa, qb in pairwise(path):
        coarse = [sphere_positions(arrays, qa + t * (qb - qa)) for t in np.linspace(0, 1, 17)]
        longest = np.linalg.norm(np.diff(coarse, axis=0), axis=2).sum(axis=0).max()
        for t in np.linspace(0.0, 1.0, max(2, int(1.2 * longest / step))):
            centers = sphere_positions(arrays, qa + t * (qb - qa))
            for s in moving:
                index = inside_ball(centers[s], arrays.sphere_radius[s] + margin, resolution)
                classes = [0, *(allowed[s] if allowed is not None else ())]
                hit |= ~np.isin(owners_at(index), classes).all(axis=0)
    return hit
