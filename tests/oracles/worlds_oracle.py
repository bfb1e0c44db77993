"""Slow twins of `PosteriorWorlds`: every draw evaluated at every voxel asked about."""

import numpy as np
from scipy.stats import norm


def draw_logits(map_, points, n_worlds, seed, thresholds=True):
    """Logits (n, S, K) of each draw at points (n, 3), straight from the definition; without
    thresholds, those of the drawn weights."""
    weights = map_.sample_weights(n_worlds, seed)
    hinges = np.asarray(map_.space.hinges)
    away = ((points[:, None] - hinges) ** 2).sum(axis=2)
    phi = np.exp(-map_.config.gamma * away)
    phi[away > map_.space.radius**2] = 0.0
    features = np.column_stack([phi, np.ones(len(points))])
    logits = np.tensordot(features, weights, axes=(1, 1))
    if map_.prior is not None:
        logits += map_.prior.at(points)[:, None]
    if not thresholds:
        return logits
    if map_.prior is None:
        return logits
    guess = map_.prior.at(points)[:, 1:].max(axis=1)  # -7 at the least: seen to be empty
    for row in np.flatnonzero(np.asarray(map_.informed(points)) & (guess > -6.99)):
        logits[row, :, 1:] += threshold(points[row], n_worlds, seed)[:, None]
    return logits


def threshold(point, n_worlds, seed):
    """(S,): logistic, from normal numbers at the corners of the cell of 5 cm around a point."""
    low = np.floor(point / 0.05).astype(int)
    share = point / 0.05 - low
    total, square = np.zeros(n_worlds), 0.0
    for corner in np.ndindex(2, 2, 2):
        rng = np.random.default_rng([seed, 0x10617, *(low + corner + 2**31).tolist()])
        u = (rng.permutation(n_worlds) + 0.5) / n_worlds
        weight = np.prod(np.where(corner, share, 1.0 - share))
        total += weight * norm.ppf(u)
        square += weight**2
    g = total / np.sqrt(square)
    found = 1.5976 * g + 0.07057 * g**3
    assert np.abs(1.0 / (1.0 + np.exp(-found)) - norm.cdf(g)).max() < 2e-4  # logistic, nearly
    return found.clip(-np.log(511.0), np.log(511.0))


def owners_of(logits):
    """Logits (n, S, K) -> (n, S): 0 where softmax(z)_0 >= 1/2, else the likeliest object class."""
    p = np.exp(logits - logits.max(axis=2, keepdims=True))
    p /= p.sum(axis=2, keepdims=True)
    return np.where(1.0 - p[:, :, 0] > 0.5, 1 + logits[:, :, 1:].argmax(axis=2), 0)


def draw_owners(map_, points, n_worlds, seed):
    """(n, S): what each draw says of each point."""
    return owners_of(draw_logits(map_, points, n_worlds, seed))


def in_cylinders(unseen, cylinders, index, n_worlds):
    """(n, S): which voxels of the mask have their centres in a cylinder of each world."""
    out = np.zeros((len(index), n_worlds), bool)
    u, v = unseen.plane.axes()
    for row, voxel in enumerate(np.asarray(index)):
        local = voxel - unseen.first
        if (local < 0).any() or (local >= unseen.mask.shape).any() or not unseen.mask[tuple(local)]:
            continue
        x = unseen.resolution * voxel
        height = x @ unseen.plane.normal - unseen.plane.offset
        for world, a, b, radius, top in cylinders:
            near = np.hypot(x @ u - a, x @ v - b) <= radius
            out[row, int(world)] |= near and height <= top
    return out
