# SPDX-License-Identifier: BSD-3-Clause
"""What several baselines share."""

import numpy as np
from jaxtyping import Float, Int


def one_hot(classes: Int[np.ndarray, " n"], count: int) -> Float[np.ndarray, "n k"]:
    """Return probability 1 for each point's class, (n, count)."""
    rows = np.zeros((len(classes), count))
    rows[np.arange(len(classes)), classes] = 1.0
    return rows


def counts_per_voxel(
    points: Float[np.ndarray, "n 3"],
    first: Int[np.ndarray, " 3"],
    edge: float,
    shape: tuple[int, ...],
) -> Int[np.ndarray, "nx ny nz"]:
    """Count points in voxels centred on edge * (first + (i, j, k)); others are left out."""
    index = np.round(points / edge).astype(np.int64) - first
    inside = ((index >= 0) & (index < shape)).all(axis=1)
    flat = np.ravel_multi_index(tuple(index[inside].T), shape)
    return np.bincount(flat, minlength=int(np.prod(shape))).reshape(shape)
