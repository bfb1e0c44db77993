"""Slow twins of `PosteriorWorlds`: every draw evaluated at every voxel asked about."""

import numpy as np


def draw_logits(map_, points, n_worlds, seed):
    """Logits (n, S, K) of each draw at points (n, 3), straight from the definition."""
    weights = map_.sample_weights(n_worlds, seed)
    hinges = np.asarray(map_.space.hinges)
    away = ((points[:, None] - hinges) ** 2).sum(axis=2)
    phi = np.exp(-map_.config.gamma * away)
    phi[away > map_.space.radius**2] = 0.0
    features = np.column_stack([phi, np.ones(len(points))])
    return np.tensordot(features, weights, axes=(1, 1))


def owners_of(logits):
    """Logits (n, S, K) -> (n, S): 0 where softmax(z)_0 >= 1/2, else the likeliest object class."""
    p = np.exp(logits - logits.max(axis=2, keepdims=True))
    p /= p.sum(axis=2, keepdims=True)
    return np.where(1.0 - p[:, :, 0] > 0.5, 1 + logits[:, :, 1:].argmax(axis=2), 0)


def draw_owners(map_, points, n_worlds, seed):
    """(n, S): what each draw says of each point."""
    return owners_of(draw_logits(map_, points, n_worlds, seed))


def voxels_near(center, radius, resolution):
    """Integer indices of all voxels whose centres are within `radius` of a point."""
    low = np.floor((center - radius) / resolution).astype(int)
    high = np.ceil((center + radius) / resolution).astype(int)
    axes = [np.arange(a, b + 1) for a, b in zip(low, high, strict=True)]
    index = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return index[np.linalg.norm(resolution * index - center, axis=1) <= radius]


def touched(owners_at, center, radius, resolution, n_worlds, allowed=()):
    """The definition of a touch: draws that occupy a voxel x with |v - x| <= r + |c - v|.

    v is the voxel nearest to the centre c; owners_at(index) -> (n, S).
    """
    v = np.floor(center / resolution + 0.5).astype(int)
    reach = radius + np.linalg.norm(center - resolution * v)
    index = voxels_near(resolution * v, reach + 2 * resolution, resolution)
    apart = np.linalg.norm(resolution * (index - v), axis=1)
    # The table rounds down to 1 / 16 of a voxel (1 / 8 for a long reach).
    surely = owners_at(index[apart <= reach])
    maybe = owners_at(index[apart <= reach + resolution / 8 + 1e-9])
    counts = [np.isin(o, [0, *allowed], invert=True).any(axis=0) for o in (surely, maybe)]
    return counts[0], counts[1]
