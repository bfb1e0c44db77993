# SPDX-License-Identifier: BSD-3-Clause
"""Which part of a plane is the table top that is in view."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from vprism_plan.errors import PlaneNotFoundError
from vprism_plan.perception.plane import Plane

_CELL = 0.02
# Gaps up to 10 cm in the visible table (objects and their shadows) do not split it.
_BRIDGE = 5
_MAX_CELLS = 1000
_MIN_PATCH = 0.2


@dataclass(frozen=True, eq=False)
class TableRegion:
    """The convex hull of the visible table top, in the plane's own axes.

    Attributes:
        axes: (2, 3) directions in the plane.
        halfplanes: (F, 3) rows (a, b, c): a x + b y + c <= 0 inside, (a, b) of unit length.
    """

    axes: Float[np.ndarray, "2 3"]
    halfplanes: Float[np.ndarray, "f 3"]

    def contains(
        self, points: Float[np.ndarray, "n 3"], margin: float = 0.0
    ) -> Bool[np.ndarray, " n"]:
        """Whether the foot of a point lies on the table top, or within `margin` metres of it."""
        flat = points @ self.axes.T
        inside = np.ones(len(flat), dtype=bool)
        for a, b, c in self.halfplanes:
            inside &= flat @ np.array([a, b]) + c <= margin
        return inside


def table_region(plane: Plane, on_plane: Float[np.ndarray, "n 3"]) -> TableRegion:
    """Return the region covered by points on the plane, strays of other surfaces left out.

    A chair seat or a second desk may happen to lie in the same plane: of the patches more
    than 10 cm apart, those with less than a fifth of the largest one's points are left out.
    So are strips thinner than 6 cm, where a chair's back beside the table passes through
    the plane.

    Raises:
        PlaneNotFoundError: the points cover no patch of 6 cm x 6 cm.
    """
    from scipy import ndimage
    from scipy.spatial import ConvexHull

    axes = plane.axes()
    flat = on_plane @ axes.T
    centre = np.median(flat, axis=0)
    cells = np.floor((flat - centre) / _CELL).astype(np.int64) + _MAX_CELLS // 2
    cells = cells[((cells >= 0) & (cells < _MAX_CELLS)).all(axis=1)]
    lower = cells.min(axis=0) - _BRIDGE
    grid = np.zeros(cells.max(axis=0) - lower + _BRIDGE + 1, dtype=bool)
    grid[tuple((cells - lower).T)] = True
    grid &= ndimage.binary_opening(ndimage.binary_closing(grid), np.ones((3, 3), dtype=bool))
    if not grid.any():
        raise PlaneNotFoundError(
            "the points on the support plane cover no patch of 6 cm x 6 cm; is it the right plane?"
        )
    patches, count = ndimage.label(ndimage.binary_closing(grid, iterations=_BRIDGE))
    patches[~grid] = 0
    pixels = np.bincount(patches[tuple((cells - lower).T)], minlength=count + 1)
    kept = grid & (pixels >= _MIN_PATCH * pixels.max())[patches]
    corners = (np.argwhere(kept) + lower - _MAX_CELLS // 2)[:, None, :] + np.array(
        [[0, 0], [0, 1], [1, 0], [1, 1]]
    )
    hull = ConvexHull(corners.reshape(-1, 2) * _CELL + centre)
    return TableRegion(axes, np.asarray(hull.equations))
