# SPDX-License-Identifier: BSD-3-Clause
"""Flying pixels: points between a depth edge and what lies behind it, where nothing is."""

from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Int

_CELL = 0.01  # metres; a point's surroundings are its cell and the 26 around it
BLOCK = 3.0 * _CELL


def stray_points(points: Float[np.ndarray, "n 3"], share: float) -> Bool[np.ndarray, " n"]:
    """Return which points of one object stand almost alone.

    A depth camera reports points in the air behind an object's outline. They are few
    and spread along the rays, so the 3 cm block around one holds far fewer points than
    around a point of a surface: less than `share` of the object's median.

    Args:
        points: one object's observed points, m, at the image's resolution.
        share: of the median; 0 calls nothing stray.
    """
    if share <= 0.0 or len(points) == 0:
        return np.zeros(len(points), dtype=bool)
    density = points_around(points)
    return density < share * np.median(density)


def points_around(points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """Return how many of the points (m) lie in the `BLOCK` wide block around each."""
    cells, inverse, counts = np.unique(
        np.floor(points / _CELL).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    index = {
        tuple(cell): count for cell, count in zip(cells.tolist(), counts.tolist(), strict=True)
    }
    around = np.zeros(len(cells), dtype=np.int64)
    for shift in product((-1, 0, 1), repeat=3):
        near = (cells + np.array(shift)).tolist()
        around += np.array([index.get(tuple(cell), 0) for cell in near], dtype=np.int64)
    return around[inverse.reshape(-1)]
