"""Slow twins of a path's risk: the same draws, asked voxel by voxel at every sample."""

from itertools import pairwise

import numpy as np
from scipy.special import logsumexp

from oracles.checker_oracle import sphere_positions
from oracles.worlds_oracle import draw_logits, owners_of

ODDS, MOST = 12.0, 127.0  # log-odds are kept in steps of 1 / ODDS, at most MOST of them
DEPTHS = 16.0  # steps of a depth in a voxel, rounded up


class DrawnVoxels:
    """What each draw says of each voxel of a small map, straight from the definition."""

    def __init__(self, map_, n_worlds, seed, resolution):
        self.n_worlds = n_worlds
        self.lower, self.upper = map_.support_bounds()
        self.first = np.floor(self.lower / resolution).astype(int)
        shape = np.ceil(self.upper / resolution).astype(int) - self.first + 1
        self.values = np.zeros((*shape, n_worlds), np.uint8)
        self.odds = np.zeros((*shape, n_worlds))
        index = np.indices(shape).reshape(3, -1).T
        for part in np.array_split(index, len(index) // 20_000 + 1):
            logits = draw_logits(map_, resolution * (part + self.first), n_worlds, seed)
            self.values[tuple(part.T)] = owners_of(logits)
            odds = ODDS * (logsumexp(logits[:, :, 1:], axis=2) - logits[:, :, 0])
            steps = np.clip(np.rint(np.abs(odds)), 1.0, MOST)
            self.odds[tuple(part.T)] = np.where(odds > 0.0, steps, -steps)
        self.possible = self.values.any(axis=3)

    def __call__(self, index):
        """(n, 3) voxel indices -> (n, S) classes; nothing is outside the map's support."""
        return self._read(self.values, index, 0)

    def _read(self, table, index, outside):
        local = np.asarray(index) - self.first
        inside = ((local >= 0) & (local < self.possible.shape)).all(axis=1)
        out = np.full((len(local), self.n_worlds), outside, table.dtype)
        out[inside] = table[tuple(local[inside].T)]
        return out

    def depths(self, index, allowed=()):
        """(n, S) voxels between the centres of voxels and the surface of what may not be touched;
        -inf in draws that do not occupy them.

        Towards a free neighbour the surface is where the log-odds, linear between the centres,
        are 0, towards one that may be touched half way; the depth is that of the plane through
        the nearer crossing on each axis.
        """
        mine = np.maximum(self._read(self.odds, index, -MOST), 1.0)
        squares = np.zeros(mine.shape)
        for axis in np.eye(3, dtype=int):
            ways = np.full(mine.shape, np.inf)
            for beside in (index - axis, index + axis):
                owners, theirs = self(beside), self._read(self.odds, beside, -MOST)
                crossing = np.where(owners == 0, mine / (mine - np.minimum(theirs, 0.0)), np.inf)
                crossing[(owners > 0) & np.isin(owners, list(allowed))] = 0.5
                ways = np.minimum(ways, crossing)
            squares += 1.0 / ways**2
        depth = 1.0 / np.sqrt(np.maximum(squares, 1.0))
        depth = np.ceil(DEPTHS * depth - 1e-3) / DEPTHS
        return np.where(np.isin(self(index), [0, *allowed]), -np.inf, depth)

    def occupiable(self, index):
        """Those of the voxels (n, 3) that any draw occupies."""
        local = np.asarray(index) - self.first
        index = index[((local >= 0) & (local < self.possible.shape)).all(axis=1)]
        return index[self.possible[tuple((index - self.first).T)]]

    def beyond(self, center, radius):
        """Whether a ball lies outside the box of the map's support."""
        return bool(((center + radius < self.lower) | (center - radius > self.upper)).any())


def ball_touches(owners_at, center, radius, resolution, allowed=(), inscribed=False):
    """Draws (S,) with a voxel whose ball, which reaches to the surface, meets another; or, if that
    is asked, the ball inscribed in it."""
    widest = radius + (1.0 + 1e-9) * resolution
    if owners_at.beyond(center, widest):
        return np.zeros(owners_at.n_worlds, bool)
    index = owners_at.occupiable(inside_ball(center, widest, resolution))
    depths = owners_at.depths(index, allowed)
    if inscribed:
        depths = np.where(np.isfinite(depths), 0.5, -np.inf)
    away = np.linalg.norm(resolution * index - center, axis=1)[:, None]
    return (away <= radius + (depths + 1e-9) * resolution).any(axis=0)


def inside_ball(center, radius, resolution):
    """Indices of the voxels whose centres lie in a closed ball."""
    low = np.ceil((center - radius) / resolution).astype(int)
    high = np.floor((center + radius) / resolution).astype(int)
    axes = [np.arange(a, b + 1) for a, b in zip(low, high, strict=True)]
    index = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return index[((resolution * index - center) ** 2).sum(axis=1) <= radius**2]


def dense_touches(owners_at, arrays, path, resolution, step=0.0005):
    """Draws (S,) with a voxel whose ball meets a sphere anywhere on the path.

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
                hit |= ball_touches(owners_at, centers[s], arrays.sphere_radius[s], resolution)
    return hit
