# SPDX-License-Identifier: BSD-3-Clause
"""Collision shapes of links: boxes, cylinders and spheres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, eq=False)
class PrimitiveGeometry:
    """One solid of a link.

    Attributes:
        kind: ``"box"``, ``"cylinder"`` (axis z, centred) or ``"sphere"``.
        size: Metres. Box: the three edge lengths; cylinder: radius and length;
            sphere: radius.
        T_link: Pose of the solid in its link's frame, (4, 4).
        padding: Metres by which the solid is grown all around: it is every point at most so
            far from the shape of ``size``, so its edges are round.
    """

    kind: Literal["box", "cylinder", "sphere"]
    size: tuple[float, ...]
    T_link: Float[np.ndarray, "4 4"]
    padding: float = 0.0

    def signed_distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Exact signed distance of points to the solid.

        Args:
            points: (n, 3) positions in the link's frame, metres.

        Returns:
            (n,) metres, negative inside.
        """
        local = (points - self.T_link[:3, 3]) @ self.T_link[:3, :3]
        if self.kind == "sphere":
            return np.linalg.norm(local, axis=1) - self.size[0] - self.padding
        if self.kind == "box":
            excess = np.abs(local) - 0.5 * np.asarray(self.size)
        else:
            radius, length = self.size
            radial = np.linalg.norm(local[:, :2], axis=1) - radius
            excess = np.stack([radial, np.abs(local[:, 2]) - 0.5 * length], axis=1)
        outside = np.linalg.norm(np.maximum(excess, 0.0), axis=1)
        return outside + np.minimum(excess.max(axis=1), 0.0) - self.padding

    def triangles(self, sides: int = 32) -> Float[np.ndarray, "f 3 3"]:
        """A closed surface around the solid without its padding, link frame, metres.

        Exact for a box. A cylinder becomes a prism around it, a sphere a polyhedron around
        it (of 1280 faces, half a percent larger), so what holds them holds the solid.

        Args:
            sides: Of the prism; its edges stand out by (pi / sides)^2 / 2 of the radius.
        """
        import trimesh

        if self.kind == "box":
            mesh = trimesh.creation.box(self.size)
        elif self.kind == "cylinder":
            radius, length = self.size
            wide = radius / np.cos(np.pi / sides) * (1.0 + 1e-9)
            mesh = trimesh.creation.cylinder(wide, length, sections=sides)
        else:
            mesh = trimesh.creation.icosphere(subdivisions=3)
            nearest = np.einsum("ij,ij->i", mesh.face_normals, mesh.triangles[:, 0]).min()
            mesh.apply_scale(self.size[0] / nearest * (1.0 + 1e-9))
        local = np.asarray(mesh.triangles, dtype=np.float64)
        return local @ self.T_link[:3, :3].T + self.T_link[:3, 3]

    def bounding_radius(self) -> float:
        """Radius in metres of the ball around the solid's centre that holds it."""
        if self.kind == "sphere":
            return self.size[0] + self.padding
        if self.kind == "box":
            return float(0.5 * np.linalg.norm(self.size)) + self.padding
        return float(np.hypot(self.size[0], 0.5 * self.size[1])) + self.padding
