# SPDX-License-Identifier: BSD-3-Clause
"""Distance to a triangle mesh and inside or outside of it, fast and for any mesh (libigl)."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from vprism_plan.errors import MissingDependencyError

_INSIDE = 0.5  # winding number from which a point is inside
_CHUNK = 1 << 18  # points per call, which bounds the memory


class MeshTruth:
    """One closed surface, or something near to one, with its search trees.

    The distance is exact. The sign comes from the winding number, which is 1 inside and
    0 outside of a closed mesh, counts overlapping pieces as one body, and falls from 1
    to 0 across a hole: a mesh with holes has an inside where most of its surface says so.
    """

    def __init__(self, vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> None:
        try:
            import igl
        except ImportError as error:
            raise MissingDependencyError(
                "distances to true meshes need libigl: pip install 'vprism_plan[experiments]'"
            ) from error
        self._vertices = np.ascontiguousarray(vertices, dtype=np.float64)
        self._faces = np.ascontiguousarray(faces, dtype=np.int64)
        self._tree: Any = igl.AABB()
        self._tree.init(self._vertices, self._faces)
        self._winding: Any = igl.FastWindingNumberBVH()
        self._winding.init(self._vertices, self._faces)
        self.low, self.high = self._vertices.min(axis=0), self._vertices.max(axis=0)

    def contains(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Return which points lie inside."""
        inside = np.zeros(len(points), dtype=bool)
        near = np.flatnonzero(((points >= self.low) & (points <= self.high)).all(axis=1))
        for start in range(0, len(near), _CHUNK):
            part = near[start : start + _CHUNK]
            number = self._winding.winding_number(np.ascontiguousarray(points[part]))
            inside[part] = number > _INSIDE
        return inside

    def signed_distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Return the distance to the nearest triangle, metres, negative inside."""
        distance = np.empty(len(points))
        for start in range(0, len(points), _CHUNK):
            part = slice(start, start + _CHUNK)
            square, _, _ = self._tree.squared_distance(
                self._vertices, self._faces, np.ascontiguousarray(points[part])
            )
            distance[part] = np.sqrt(square)
        distance[self.contains(points)] *= -1.0
        return distance

    def box_distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Return the distance to the box around it, 0 inside: no surface is nearer."""
        outside = np.maximum(np.maximum(self.low - points, points - self.high), 0.0)
        return np.asarray(np.linalg.norm(outside, axis=1))
