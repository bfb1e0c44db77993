# SPDX-License-Identifier: BSD-3-Clause
"""Observed surfaces that the map does not hold: thin parts which its kernels smooth away.

A handle or a cable thinner than the kernel can stay below the level set although the
camera saw it. What was seen is there, so the world keeps those points as obstacles.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float, Float32

from vprism_plan.mapping.strays import stray_points
from vprism_plan.perception import Observation, Plane
from vprism_plan.world.grid import Grid

_STRAY_SHARE = 0.03  # as in the default map: fewer neighbours than this is a flying pixel


def forgotten_points(
    views: Sequence[Observation],
    object_ids: Sequence[int],
    plane: Plane | None,
    height: float,
    distance: Float32[np.ndarray, "nx ny nz"],
    grid: Grid,
) -> Iterator[tuple[int, Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]]:
    """Yield, per object and view, observed points more than one voxel off the level set.

    Nearer points are the level set's business: marking them would only thicken it.

    Args:
        views: what was fitted.
        object_ids: labels of the map's classes 1, 2, ...
        plane: support surface; points less than `height` (metres) above it are its own.
        height: see `plane`.
        distance: of every grid node to the level set, metres.
        grid: the nodes.

    Yields:
        Class, points (world, metres) and half the width of their pixels.
    """
    for view in views:
        points, labels = view.points()
        depth = np.asarray(view.depth, dtype=np.float64)[view.depth > 0]
        focal = min(float(view.intrinsics[0, 0]), float(view.intrinsics[1, 1]))
        for k, object_id in enumerate(object_ids, start=1):
            own = np.flatnonzero(labels == object_id)
            own = own[~stray_points(points[own], _STRAY_SHARE)]
            if plane is not None:
                own = own[plane.signed_distance(points[own]) > height]
            far = _bound(points[own], distance, grid) > grid.spacing
            yield k, points[own[far]], 0.5 * depth[own[far]] / focal


def _bound(
    points: Float[np.ndarray, "n 3"], distance: Float32[np.ndarray, "nx ny nz"], grid: Grid
) -> Float[np.ndarray, " n"]:
    """Lower bound of each point's distance to the level set, from its nearest node, metres."""
    steps = np.round((points - grid.origin) / grid.spacing).astype(np.int64)
    steps = np.clip(steps, 0, np.array(grid.shape) - 1)
    way = np.linalg.norm(points - (grid.origin + grid.spacing * steps), axis=1)
    return np.asarray(distance[tuple(steps.T)], dtype=np.float64) - way
