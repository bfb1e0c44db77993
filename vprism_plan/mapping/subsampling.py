# SPDX-License-Identifier: BSD-3-Clause
"""Grid subsampling: one point per occupied cell, the barycentre (Thomas et al. 2019)."""

import numpy as np
from jaxtyping import Float

from vprism_plan.errors import MapError


def grid_subsample(
    points: Float[np.ndarray, "n 3"], resolution: float | None
) -> Float[np.ndarray, "m 3"]:
    """Return the barycentre of the points in each occupied cell of `resolution` (m).

    Cells sit at world multiples of the resolution; the result is ordered by cell, so
    it does not depend on the order of the points but for rounding in the sums. A
    resolution of None keeps every point.
    """
    if len(points) == 0 or resolution is None:
        return points.copy()
    cells = np.floor(points / resolution)
    lower = cells.min(axis=0)
    extent = cells.max(axis=0) - lower + 1.0
    if extent.prod() >= 2.0**62:
        raise MapError(
            f"the points span {extent[0]:.3g} x {extent[1]:.3g} x {extent[2]:.3g} cells of "
            f"{resolution} m; check the depth unit (metres)"
        )
    index = (cells - lower).astype(np.int64)
    shape = extent.astype(np.int64)
    key = (index[:, 0] * shape[1] + index[:, 1]) * shape[2] + index[:, 2]
    order = np.argsort(key, kind="stable")
    sorted_key = key[order]
    start = np.flatnonzero(np.concatenate(([True], sorted_key[1:] != sorted_key[:-1])))
    count = np.diff(np.append(start, len(points)))
    return np.add.reduceat(points[order], start, axis=0) / count[:, None]
