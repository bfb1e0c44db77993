# SPDX-License-Identifier: BSD-3-Clause
"""A small depth-buffered renderer for spheres and triangles, in numpy.

matplotlib's 3-D axes sort whole collections, so robots appear in front of what they
stand behind. Here every pixel asks which surface is nearest. Layers can be laid over
each other clear: a robot's pose in between is one silhouette, not a heap of discs.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

_LIGHT = np.array([0.30, -0.35, 0.89]) / np.linalg.norm([0.30, -0.35, 0.89])
_NOTHING = np.float32(np.inf)
_SHARP = 0.8  # cosine above which neighbouring faces share a normal


@dataclass(frozen=True, eq=False)
class View:
    """A perspective view from `eye` to `target` (world, z up, metres)."""

    eye: np.ndarray
    target: np.ndarray

    @property
    def axes(self) -> np.ndarray:
        """Columns right, up, forward (3, 3)."""
        forward = self.target - self.eye
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right = right / np.linalg.norm(right)
        return np.stack([right, np.cross(right, forward), forward], axis=1)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return image-plane coordinates (..., 2), right and up, of points in front."""
        local = (points - self.eye) @ self.axes
        return np.asarray(local[..., :2] / np.maximum(local[..., 2:], 1e-3))


@dataclass(eq=False)
class Film:
    """Pixels and their rays: a view, image-plane bounds, and how many pixels per unit."""

    view: View
    low: np.ndarray
    high: np.ndarray
    scale: float

    def __post_init__(self) -> None:
        self.width, self.height = (int(n) for n in np.ceil((self.high - self.low) * self.scale))
        x = self.low[0] + (np.arange(self.width) + 0.5) / self.scale
        y = self.high[1] - (np.arange(self.height) + 0.5) / self.scale
        grid = np.stack([*np.meshgrid(x, y), np.ones((self.height, self.width))], axis=-1)
        rays = grid @ self.view.axes.T
        self.rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)

    @classmethod
    def around(cls, view: View, points: np.ndarray, pixels: int) -> "Film":
        """Return one that shows all points (n, 3), with so many pixels along its longer side."""
        flat = view.project(points)
        low, high = flat.min(axis=0), flat.max(axis=0)
        pad = 0.03 * float((high - low).max())
        low, high = low - pad, high + pad
        return cls(view, low, high, pixels / float((high - low).max()))

    def boxes(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the first and last column and row (..., 2) in rectangles of the image plane."""
        first = np.stack([low[..., 0] - self.low[0], self.high[1] - high[..., 1]], axis=-1)
        last = np.stack([high[..., 0] - self.low[0], self.high[1] - low[..., 1]], axis=-1)
        first, last = (np.floor(v * self.scale).astype(np.int64) for v in (first, last))
        return np.maximum(first, 0), np.minimum(last, np.array([self.width, self.height]) - 1)


class Layer:
    """What is nearest in every pixel of a film: distance, outward normal, colour."""

    def __init__(self, film: Film) -> None:
        self.film, shape = film, (film.height, film.width)
        self.depth = np.full(shape, _NOTHING, dtype=np.float32)
        self.normal = np.zeros((*shape, 3), dtype=np.float32)
        self.color = np.ones((*shape, 3), dtype=np.float32)

    def add_spheres(self, centers: np.ndarray, radii: np.ndarray, color: Any) -> None:
        """Add spheres (n, 3), radii (n,), metres, in one RGB colour."""
        view = self.film.view
        owner = np.full(self.depth.shape, -1, dtype=np.int32)
        for index, (center, radius) in enumerate(zip(centers, radii, strict=True)):
            offset = center - view.eye
            ahead = float(offset @ view.axes[:, 2])
            if ahead <= 2 * radius:
                continue
            # A ball's outline in perspective is at most this far from its middle's image.
            pad = 1.3 * radius / (ahead - radius)
            middle = view.project(center)
            (left, top), (right, bottom) = self.film.boxes(middle - pad, middle + pad)
            if left > right or top > bottom:
                continue
            window = slice(top, bottom + 1), slice(left, right + 1)
            rays = self.film.rays[window]
            along = rays @ offset.astype(np.float32)
            inside = along**2 - np.float32(offset @ offset - radius**2)
            t = along - np.sqrt(np.maximum(inside, 0.0))
            closer = (inside > 0) & (t < self.depth[window])
            self.depth[window][closer] = t[closer]
            owner[window][closer] = index
        hit = owner >= 0
        who = owner[hit]
        points = view.eye + self.depth[hit][:, None] * self.film.rays[hit]
        self.normal[hit] = (points - centers[who]) / radii[who][:, None]
        self.color[hit] = color

    def add_mesh(self, triangles: np.ndarray, normals: np.ndarray, color: Any) -> None:
        """Add triangles (n, 3, 3) with normals (n, 3, 3) at their corners, in one colour."""
        eye = self.film.view.eye
        face = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        facing = np.einsum("ij,ij->i", face, eye - triangles[:, 0]) > 1e-15
        triangles, normals = triangles[facing], normals[facing]
        # A ray r meets the plane of corners c at sum(w) = 1 with r t = C w: w / t = C^-1 r.
        inverse = np.linalg.inv(np.swapaxes(triangles - eye, 1, 2))
        # Every pixel in the box of each triangle.
        flat = self.film.view.project(triangles)
        low, high = self.film.boxes(flat.min(axis=1), flat.max(axis=1))
        size = np.maximum(high - low + 1, 0)
        count = size[:, 0] * size[:, 1]
        which = np.repeat(np.arange(len(flat)), count)
        number = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
        rows, columns = np.divmod(number, size[which, 0])
        pixel = (low[which, 1] + rows) * self.film.width + low[which, 0] + columns
        rays = self.film.rays.reshape(-1, 3)[pixel].astype(np.float64)
        weights = np.einsum("ijk,ik->ij", inverse[which], rays)
        inside = weights.min(axis=1) >= -1e-7
        pixel, which, weights = pixel[inside], which[inside], weights[inside]
        t = 1.0 / weights.sum(axis=1)
        order = np.lexsort((t, pixel))
        _, first = np.unique(pixel[order], return_index=True)
        nearest = order[first]
        nearest = nearest[t[nearest] < self.depth.reshape(-1)[pixel[nearest]]]
        pixel, which = pixel[nearest], which[nearest]
        normal = np.einsum("ij,ijk->ik", weights[nearest] * t[nearest, None], normals[which])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        self.depth.reshape(-1)[pixel] = t[nearest]
        self.normal.reshape(-1, 3)[pixel] = normal
        self.color.reshape(-1, 3)[pixel] = color

    def shaded(self) -> np.ndarray:
        """Return the lit colours (h, w, 3) with dark lines where the depth jumps."""
        light = 0.42 + 0.58 * np.clip(0.45 + 0.55 * (self.normal @ _LIGHT.astype(np.float32)), 0, 1)
        picture = self.color * light[..., None]
        return np.asarray(np.where(self.edges()[..., None], 0.55 * picture, picture))

    def edges(self) -> np.ndarray:
        """Return where the depth jumps to a farther neighbour by more than 2 cm."""
        depth = np.where(np.isfinite(self.depth), self.depth, np.float32(1e3))
        jump = np.zeros(depth.shape, dtype=bool)
        jump[1:] |= depth[:-1] - depth[1:] > 0.02
        jump[:-1] |= depth[1:] - depth[:-1] > 0.02
        jump[:, 1:] |= depth[:, :-1] - depth[:, 1:] > 0.02
        jump[:, :-1] |= depth[:, 1:] - depth[:, :-1] > 0.02
        return jump & np.isfinite(self.depth)

    def lay_over(self, picture: np.ndarray, share: np.ndarray, where: Any = True) -> None:
        """Mix this into a picture (h, w, 3), by a share (h, w) at the pixels it covers."""
        there = np.isfinite(self.depth) & where
        weight = share[there][:, None]
        picture[there] = (1.0 - weight) * picture[there] + weight * self.shaded()[there]


def corners(mesh: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return a mesh's triangles and the normals at their corners; sharp edges stay sharp."""
    own = np.repeat(np.asarray(mesh.face_normals)[:, None], 3, axis=1)
    smooth = np.asarray(mesh.vertex_normals)[np.asarray(mesh.faces)]
    alike = np.einsum("ijk,ijk->ij", own, smooth) > _SHARP
    normals = np.where(alike[..., None], smooth, own)
    return np.asarray(mesh.triangles, dtype=np.float64), normals


def sphere_ends(centers: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Return the points (n, 3) of spheres (..., s, 3) farthest along the axes."""
    ends = radii[:, None, None] * np.concatenate([np.eye(3), -np.eye(3)])
    return np.asarray((centers[..., None, :] + ends).reshape(-1, 3))


def ground(
    film: Film, height: float, low: np.ndarray, high: np.ndarray, shade: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the picture (h, w, 3) and distance of a table top, white elsewhere.

    shade: (nx, ny) brightness over the rectangle low..high (world xy, metres).
    """
    rays, eye = film.rays, film.view.eye.astype(np.float32)
    slope = np.where(np.abs(rays[..., 2]) < 1e-9, np.float32(-1e-9), rays[..., 2])
    t = (np.float32(height) - eye[2]) / slope
    x, y = (eye[k] + t * rays[..., k] for k in range(2))
    on = (t > 0) & (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])
    xy = np.stack([x[on], y[on]], axis=1)
    last = np.array(shade.shape) - 1
    cell = np.round((xy - low) / (high - low) * last).astype(np.int64).clip(0, last)
    # Lines every 10 cm give the eye a measure of length.
    grid = (np.abs((xy + 0.05) % 0.1 - 0.05) < 0.0012).any(axis=1)
    brightness = shade[cell[:, 0], cell[:, 1]] * np.where(grid, 0.92, 1.0)
    picture = np.ones((*on.shape, 3), dtype=np.float32)
    picture[on] = np.array([0.90, 0.89, 0.87]) * brightness[:, None]
    return picture, np.where(on, t, _NOTHING)


def halved(picture: np.ndarray) -> np.ndarray:
    """Average blocks of 2 x 2 pixels, in 0..1."""
    h, w = picture.shape[0] // 2 * 2, picture.shape[1] // 2 * 2
    p = picture[:h, :w]
    mean = 0.25 * (p[::2, ::2] + p[1::2, ::2] + p[::2, 1::2] + p[1::2, 1::2])
    return np.asarray(np.clip(mean, 0.0, 1.0))
