# SPDX-License-Identifier: BSD-3-Clause
"""A support surface that ends where it was seen to end."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from vprism_plan.perception import Observation, Plane
from vprism_plan.perception.camera import inlier_band
from vprism_plan.perception.plane import TableRegion, table_region

RIM = 0.05  # metres around the seen part of the surface that count as part of it
_BAND = 0.01  # metres at a depth of 1 m within which a point is of the surface


@dataclass(frozen=True, eq=False)
class SeenSupport:
    """Everything under the convex hull, grown by `RIM`, of what was seen of a plane.

    Attributes:
        plane: the surface, world frame.
        region: the hull.
    """

    plane: Plane
    region: TableRegion

    def signed_distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Lower bound of the distance from world points, metres, negative inside.

        Exact but for points beyond a corner of the hull.
        """
        flat = points @ self.region.axes.T
        beside = np.full(len(points), -np.inf)
        for a, b, c in self.region.halfplanes:
            np.maximum(beside, flat @ np.array([a, b]) + c - RIM, out=beside)
        above = self.plane.signed_distance(points)
        outside = np.hypot(np.maximum(beside, 0.0), np.maximum(above, 0.0))
        return np.asarray(outside + np.minimum(np.maximum(beside, above), 0.0))


def seen_support(views: Sequence[Observation], plane: Plane) -> SeenSupport:
    """Bound a support plane to what the views saw of it.

    Raises:
        PlaneNotFoundError: they saw no patch of 6 cm x 6 cm of it.
    """
    kept = [np.empty((0, 3))]
    for view in views:
        points, labels = view.points()
        band = inlier_band(view.depth[view.depth > 0], _BAND)
        kept.append(points[(np.abs(plane.signed_distance(points)) < band) & (labels == 0)])
    return SeenSupport(plane, table_region(plane, np.concatenate(kept)))
