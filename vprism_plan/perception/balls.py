# SPDX-License-Identifier: BSD-3-Clause
"""Which of many points lie in one of many balls."""

import numpy as np
from jaxtyping import Bool, Float


def within_balls(
    points: Float[np.ndarray, "n 3"], balls: Float[np.ndarray, "s 4"]
) -> Bool[np.ndarray, " n"]:
    """Whether each point lies in a ball, its surface included.

    A point is in a ball of radius r about c if |x - c|^2 + (R^2 - r^2) <= R^2: a nearest
    neighbour search in four dimensions, with the root of R^2 - r^2 as the fourth, answers that
    for all balls with radii up to R at once. Balls are taken by size, down to half of R
    together, so that the fourth coordinate does not outweigh the others.

    Args:
        points: metres; what is not finite is in no ball.
        balls: rows (x, y, z, radius), metres; a radius below 0 holds nothing.
    """
    from scipy.spatial import cKDTree

    inside = np.zeros(len(points), dtype=bool)
    left = np.flatnonzero(np.isfinite(points).all(axis=1))
    balls = balls[balls[:, 3] >= 0.0]
    balls = balls[np.argsort(-balls[:, 3], kind="stable")]
    while len(balls) and len(left):
        radius = float(balls[0, 3])
        count = int((balls[:, 3] >= 0.5 * radius).sum())
        group, balls = balls[:count], balls[count:]
        low = (group[:, :3] - group[:, 3:]).min(axis=0)
        high = (group[:, :3] + group[:, 3:]).max(axis=0)
        near = left[((points[left] >= low) & (points[left] <= high)).all(axis=1)]
        lifted = np.column_stack([group[:, :3], np.sqrt(radius**2 - group[:, 3] ** 2)])
        asked = np.column_stack([points[near], np.zeros(len(near))])
        # The bound of the search is exclusive, and roots round.
        away, _ = cKDTree(lifted).query(asked, distance_upper_bound=radius * (1.0 + 1e-9) + 1e-12)
        inside[near[np.isfinite(away)]] = True
        left = left[~inside[left]]
    return inside
