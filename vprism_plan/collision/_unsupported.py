# SPDX-License-Identifier: BSD-3-Clause
"""How much of what a robot sweeps lies in space that the map cannot judge."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from vprism_plan._kernels import risk as kernels

_ONE = np.zeros(1, np.int64)
_MAX_SAMPLES = 64
_SLAB = 8  # planes of nodes classified at once


class SpaceCodes:
    """What is known of the space around each node of a world's grid.

    0: seen, or hidden where the map has support. 1: hidden without support. 2: never
    observed. 3 (not stored): outside the grid. Baked once, O(nodes), one byte per node.

    Args:
        world: a `vprism_plan.world.World`.
    """

    def __init__(self, world: Any) -> None:
        field = world.field
        self._origin = np.asarray(field.origin, dtype=np.float64)
        self._spacing = float(field.spacing)
        shape = field.distance.shape
        self._codes = np.empty(shape, np.uint8)
        for start in range(0, shape[0], _SLAB):
            stop = min(start + _SLAB, shape[0])
            index = np.moveaxis(np.indices((stop - start, *shape[1:])), 0, -1).reshape(-1, 3)
            corner = self._origin + self._spacing * np.array([start, 0, 0])
            points = corner + self._spacing * index
            codes = np.asarray(world.status(points)).astype(np.uint8)
            codes[codes == 3] = 0  # rounding at the faces
            hidden = np.flatnonzero(codes == 1)
            judged = np.asarray(world.map.support(points[hidden])) >= world.config.min_support
            codes[hidden[judged]] = 0
            self._codes[start:stop] = codes.reshape(stop - start, *shape[1:])

    def shares(
        self,
        centers: Float[np.ndarray, "n 3 s"],
        radii: Float[np.ndarray, " s"],
        rules: Int[np.ndarray, " s"],
    ) -> dict[str, float]:
        """Return the share of the swept volume that lies in each kind of space not judged.

        Seven points per ball (its centre and six at three fifths of the radius), balls
        weighted by volume, averaged over at most 64 samples spread along the path.
        Balls with rule -1 (not checked) do not count.
        """
        n = len(centers)
        chosen = _ONE if n == 1 else np.arange(m := min(n, _MAX_SAMPLES)) * (n - 1) // (m - 1)
        totals = np.zeros(4)
        kernels.volume_codes(
            centers, chosen, radii, rules, self._codes, self._origin, self._spacing, totals
        )
        seen, occluded, unobserved, outside = totals.tolist()
        whole = max(seen + occluded + unobserved + outside, 1e-300)
        return {
            "occluded": occluded / whole,
            "unobserved": unobserved / whole,
            "outside": outside / whole,
        }
