# SPDX-License-Identifier: BSD-3-Clause
"""A small depth-sorting painter: shaded triangles in perspective, no 3-D axes.

matplotlib's own 3-D axes sort whole collections, not triangles, so robots appear in
front of what they stand behind. Here all triangles of a picture are sorted together.
"""

from dataclasses import dataclass, field

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection

_LIGHT = np.array([0.35, -0.45, 0.82]) / np.linalg.norm([0.35, -0.45, 0.82])


@dataclass(frozen=True)
class View:
    """A perspective view from `eye` to `target` (world, z up, metres)."""

    eye: np.ndarray
    target: np.ndarray

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return image coordinates (..., 2) and the distance (...) of world points."""
        forward = self.target - self.eye
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right = right / np.linalg.norm(right)
        axes = np.stack([right, np.cross(right, forward), forward], axis=1)
        local = (points - self.eye) @ axes
        depth = np.maximum(local[..., 2], 1e-3)
        return local[..., :2] / depth[..., None], np.linalg.norm(points - self.eye, axis=-1)


@dataclass
class Painter:
    """Collects triangles (world, metres) with colours, then paints them far to near."""

    _triangles: list[np.ndarray] = field(default_factory=list)
    _colors: list[np.ndarray] = field(default_factory=list)
    _normals: list[np.ndarray] = field(default_factory=list)

    def add(
        self,
        triangles: np.ndarray,
        color: np.ndarray | tuple[float, ...],
        *,
        normals: np.ndarray | None = None,
        ambient: float = 0.45,
    ) -> None:
        """Add triangles (n, 3, 3), outward by the right-hand rule, in one RGB(A) colour.

        normals (n, 3) give smooth shading; the triangles' own are used if None.
        """
        if len(triangles) == 0:
            return
        if normals is None:
            a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
            normals = np.cross(b - a, c - a)
            normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-15)
        rgba = np.ones((len(triangles), 4))
        rgba[:, : len(color)] = color
        light = ambient + (1 - ambient) * np.clip(0.5 + 0.5 * (normals @ _LIGHT), 0.0, 1.0) ** 1.3
        rgba[:, :3] *= light[:, None]
        self._triangles.append(triangles)
        self._colors.append(rgba)
        self._normals.append(normals)

    def add_tube(self, points: np.ndarray, radius: float, color: tuple[float, ...]) -> None:
        """Add a thin tube along a polyline (n, 3)."""
        ends = np.stack([points[:-1], points[1:]], axis=1)
        ends = ends[np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > 1e-9]
        angles = np.linspace(0, 2 * np.pi, 7)
        for a, b in ends:
            along = (b - a) / np.linalg.norm(b - a)
            side = np.cross(along, [0.0, 0.0, 1.0] if abs(along[2]) < 0.9 else [1.0, 0.0, 0.0])
            side /= np.linalg.norm(side)
            up = np.cross(along, side)
            ring = radius * (np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * up)
            lower, upper = a + ring, b + ring
            triangles = [
                *([lower[i], lower[i + 1], upper[i]] for i in range(6)),
                *([lower[i + 1], upper[i + 1], upper[i]] for i in range(6)),
            ]
            self.add(np.array(triangles), color, ambient=0.8)

    def paint(self, axis: Axes, view: View) -> None:
        """Paint everything into `axis`, whose limits and aspect are set to fit."""
        triangles = np.concatenate(self._triangles)
        colors = np.concatenate(self._colors)
        normals = np.concatenate(self._normals)
        center = triangles.mean(axis=1)
        # Facing away means hidden for closed bodies; the sheets added here are seen from above.
        facing = np.einsum("ij,ij->i", normals, view.eye - center) > 0
        triangles, colors, center = triangles[facing], colors[facing], center[facing]
        flat, _ = view.project(triangles)
        _, distance = view.project(center)
        order = np.argsort(-distance, kind="stable")
        faces = colors[order]
        edges = faces.copy()
        edges[faces[:, 3] < 1.0, 3] = 0.0  # outlines would double up where faces are clear
        axis.add_collection(
            PolyCollection(list(flat[order]), facecolors=faces, edgecolors=edges, linewidths=0.35)
        )
        axis.set_aspect("equal")
        axis.set_axis_off()


def unit_sphere(subdivisions: int = 2) -> np.ndarray:
    """Return the triangles (n, 3, 3) of a unit icosphere, outward."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    return np.asarray(ball.triangles, dtype=np.float64)


def sheet(low: np.ndarray, high: np.ndarray, z: float, cells: int) -> np.ndarray:
    """Return a horizontal rectangle as triangles (n, 3, 3) facing up."""
    x = np.linspace(low[0], high[0], cells + 1)
    y = np.linspace(low[1], high[1], cells + 1)
    triangles = []
    for i in range(cells):
        for j in range(cells):
            a, b = (x[i], y[j], z), (x[i + 1], y[j], z)
            c, d = (x[i + 1], y[j + 1], z), (x[i], y[j + 1], z)
            triangles += [(a, b, c), (a, c, d)]
    return np.array(triangles)
