# SPDX-License-Identifier: BSD-3-Clause
"""Observed surfaces of objects that the map's level set does not hold.

A thin part can stay below the level set: the kernels of the map are centimetres long, and
the free space on both sides outweighs it. What was seen is there, so the world keeps those
points as obstacles.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Float32

from vprism_plan._kernels import world as kernels
from vprism_plan._threads import run_chunked
from vprism_plan.mapping.training_data import stray_points
from vprism_plan.perception import Observation, Plane
from vprism_plan.perception.camera import height_sigma
from vprism_plan.world.grid import Grid
from vprism_plan.world.visibility import THIN, beside

_STRAY_SHARE = 0.03  # as in the default map: fewer neighbours than this is a flying pixel
_OFF = 0.004  # metres off the level set: no ball of 5 mm around a seen point may be free


Surface = tuple[int, Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]


def surface_points(
    views: Sequence[Observation],
    object_ids: Sequence[int],
    plane: Plane | None,
    bounded: bool = False,
) -> list[Surface]:
    """Return, per object and view, the observed points of its surface.

    Points less than 3 mm (or three standard deviations of the noise) above the support surface
    are its own, and points that stand alone are flying pixels, unless they are beside others.

    Args:
        views: what was fitted.
        object_ids: labels of the map's classes 1, 2, ...
        plane: support surface.
        bounded: whether the support surface ends, so that what is lower counts as well.

    Returns:
        Class, points (world, metres) and half the width of their pixels.
    """
    found = []
    for view in views:
        points, labels = view.points()
        depth = np.asarray(view.depth, dtype=np.float64)[view.depth > 0]
        focal = min(float(view.intrinsics[0, 0]), float(view.intrinsics[1, 1]))
        for k, object_id in enumerate(object_ids, start=1):
            own = np.flatnonzero(labels == object_id)
            own = own[beside(points[own], ~stray_points(points[own], _STRAY_SHARE))]
            if plane is not None:
                sigma = height_sigma(points[own] - view.camera_center, depth[own], plane.normal)
                height = plane.signed_distance(points[own])
                height = np.abs(height) if bounded else height
                own = own[height > np.maximum(THIN, 3.0 * sigma)]
            found.append((k, points[own], 0.5 * depth[own] / focal))
    return found


def off_level_set(
    points: Float[np.ndarray, "n 3"], distance: Float32[np.ndarray, "nx ny nz"], grid: Grid
) -> Bool[np.ndarray, " n"]:
    """Which points lie more than 4 mm off the level set, by the distance of every grid node to
    it (metres). Nearer ones are its own business: marking them would only thicken it."""
    return _bound(points, distance, grid) > _OFF


def _bound(
    points: Float[np.ndarray, "n 3"], distance: Float32[np.ndarray, "nx ny nz"], grid: Grid
) -> Float[np.ndarray, " n"]:
    """Lower bound of each point's distance to the level set, metres."""
    out = np.empty(len(points))

    def look(piece: slice) -> None:
        kernels.lower_bounds(
            points, grid.origin, grid.spacing, distance, False, out, piece.start, piece.stop
        )

    run_chunked(look, len(points), 1 << 14)
    return out
