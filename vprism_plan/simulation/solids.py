# SPDX-License-Identifier: BSD-3-Clause
"""Analytic solids: exact signed distance, exact ray intersection, a mesh.

Every solid is convex and stands in its own frame, placed by `pose` (a 4x4 rigid
transform to the world, metres). Distances are negative inside.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, fields
from itertools import pairwise
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from jaxtyping import Float

from vprism_plan._arguments import choice

if TYPE_CHECKING:
    import trimesh

_SEGMENTS = 64  # of a revolved mesh; the chord error is 0.12 percent of the radius


@dataclass(frozen=True, eq=False)
class Solid(ABC):
    """A convex body placed in the world by `pose` (4, 4)."""

    pose: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4), kw_only=True)
    kind: ClassVar[str] = ""

    @abstractmethod
    def _distance(self, p: np.ndarray) -> np.ndarray:
        """Signed distance of local points (n, 3)."""

    @abstractmethod
    def _hit(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        """Smallest positive ray parameter in the local frame, inf for a miss."""

    def _profile(self) -> np.ndarray:
        """Outline (m, 2) of (radius, z), bottom to top; other bodies bring points and a mesh."""
        raise NotImplementedError

    @property
    @abstractmethod
    def bounding_radius(self) -> float:
        """Radius of the ball around the solid's origin that encloses it, metres."""

    @property
    def center(self) -> Float[np.ndarray, "3"]:
        """Return the origin of the solid in the world, metres."""
        return self.pose[:3, 3]

    def signed_distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Return the exact signed distance of world points, metres, negative inside."""
        local = (np.asarray(points, dtype=np.float64) - self.center) @ self.pose[:3, :3]
        return self._distance(local)

    def intersect(
        self, origin: Float[np.ndarray, "3"], directions: Float[np.ndarray, "n 3"]
    ) -> Float[np.ndarray, "n"]:
        """Return t of the first hit of each ray origin + t * direction; inf where it misses.

        Directions need not be unit vectors; with the optical z of each equal to 1,
        t is the depth that a camera measures. The origin must lie outside the solid.
        """
        o = (np.asarray(origin, dtype=np.float64) - self.center) @ self.pose[:3, :3]
        return self._hit(o, directions @ self.pose[:3, :3])

    def normals(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the unit gradient of the signed distance at world points, by differences."""
        h = 1e-6
        gradient = np.empty_like(points)
        for axis in range(3):
            step = np.zeros(3)
            step[axis] = h
            ahead, behind = self.signed_distance(points + step), self.signed_distance(points - step)
            gradient[:, axis] = ahead - behind
        length = np.linalg.norm(gradient, axis=1, keepdims=True)
        return gradient / np.maximum(length, 1e-300)

    def surface_points(self, spacing: float) -> Float[np.ndarray, "m 3"]:
        """Return world points on the surface, neighbours at most about `spacing` metres apart."""
        ring = []
        for (r0, z0), (r1, z1) in pairwise(self._profile()):
            n = max(1, int(np.ceil(np.hypot(r1 - r0, z1 - z0) / spacing)))
            for s in np.linspace(0.0, 1.0, n + 1):
                r, z = r0 + s * (r1 - r0), z0 + s * (z1 - z0)
                angles = 2 * np.pi * np.arange(max(1, int(np.ceil(2 * np.pi * r / spacing))))
                angles = angles / len(angles)
                ring.append(
                    np.stack([r * np.cos(angles), r * np.sin(angles), np.full_like(angles, z)], 1)
                )
        return self._to_world(np.concatenate(ring))

    def mesh(self) -> "trimesh.Trimesh":
        """Return a watertight triangle mesh in the world frame, curved faces in 64 segments."""
        import trimesh

        return trimesh.creation.revolve(self._profile(), sections=_SEGMENTS, transform=self.pose)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready description that `solid_from_dict` reads back exactly."""
        sizes = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "pose"}
        return {"kind": self.kind, **sizes, "pose": self.pose.tolist()}

    def _to_world(self, p: np.ndarray) -> np.ndarray:
        return p @ self.pose[:3, :3].T + self.center


@dataclass(frozen=True, eq=False)
class Box(Solid):
    """A box of the given half edge lengths, metres."""

    half_extents: tuple[float, float, float]
    kind: ClassVar[str] = "box"

    @property
    def bounding_radius(self) -> float:
        """Half the space diagonal, metres."""
        return float(np.linalg.norm(self.half_extents))

    def _distance(self, p: np.ndarray) -> np.ndarray:
        q = np.abs(p) - np.asarray(self.half_extents)
        outside = np.linalg.norm(np.maximum(q, 0.0), axis=1)
        return outside + np.minimum(q.max(axis=1), 0.0)

    def _hit(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        h = np.asarray(self.half_extents)
        # A zero component is replaced by a tiny one: the slab then answers +-huge, as it should.
        inverse = 1.0 / np.where(np.abs(d) < 1e-300, 1e-300, d)
        a, b = (-h - o) * inverse, (h - o) * inverse
        near = np.minimum(a, b).max(axis=1)
        far = np.maximum(a, b).min(axis=1)
        return np.where((near <= far) & (near > 0), near, np.inf)

    def surface_points(self, spacing: float) -> Float[np.ndarray, "m 3"]:
        """Return world points on the six faces, at most `spacing` metres apart."""
        axes = [
            np.linspace(-h, h, max(2, int(np.ceil(2 * h / spacing)) + 1)) for h in self.half_extents
        ]
        faces = []
        for axis in range(3):
            u, v = (k for k in range(3) if k != axis)
            grid = np.stack(np.meshgrid(axes[u], axes[v], indexing="ij"), -1).reshape(-1, 2)
            for sign in (-1.0, 1.0):
                face = np.empty((len(grid), 3))
                face[:, [u, v]] = grid
                face[:, axis] = sign * self.half_extents[axis]
                faces.append(face)
        return self._to_world(np.concatenate(faces))

    def mesh(self) -> "trimesh.Trimesh":
        """Return the box as twelve triangles in the world frame."""
        import trimesh

        extents = 2 * np.asarray(self.half_extents)
        return trimesh.creation.box(extents=extents, transform=self.pose)


@dataclass(frozen=True, eq=False)
class Frustum(Solid):
    """A cone frustum about local z; equal radii make it a cylinder, metres."""

    bottom_radius: float
    top_radius: float
    half_height: float
    kind: ClassVar[str] = "frustum"

    @property
    def bounding_radius(self) -> float:
        """Distance from the middle of the axis to the farther rim, metres."""
        return float(np.hypot(max(self.bottom_radius, self.top_radius), self.half_height))

    def _profile(self) -> np.ndarray:
        h = self.half_height
        outline = [[0.0, -h], [self.bottom_radius, -h], [self.top_radius, h], [0.0, h]]
        # A cone's tip, or its flipped bottom, would otherwise occur twice.
        return np.array([q for k, q in enumerate(outline) if k == 0 or q != outline[k - 1]])

    def _distance(self, p: np.ndarray) -> np.ndarray:
        # In the half plane (radius, z): distance to the nearer cap, and to the slanted side.
        r1, r2, h = self.bottom_radius, self.top_radius, self.half_height
        r, z = np.hypot(p[:, 0], p[:, 1]), p[:, 2]
        cap = np.stack([r - np.minimum(r, np.where(z < 0, r1, r2)), np.abs(z) - h], 1)
        side = np.array([r2 - r1, 2 * h])
        along = ((r - r1) * side[0] + (z + h) * side[1]) / (side @ side)
        along = np.clip(along, 0.0, 1.0)
        slant = np.stack([r - r1 - along * side[0], z + h - along * side[1]], 1)
        inside = (slant[:, 0] < 0) & (cap[:, 1] < 0)
        square = np.minimum((cap**2).sum(1), (slant**2).sum(1))
        return np.where(inside, -1.0, 1.0) * np.sqrt(square)

    def _hit(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        h = self.half_height
        slope = (self.top_radius - self.bottom_radius) / (2 * h)
        middle = 0.5 * (self.top_radius + self.bottom_radius)
        # |o_xy + t d_xy|^2 = (middle + slope (o_z + t d_z))^2
        ro, rd = middle + slope * o[2], slope * d[:, 2]
        a = d[:, 0] ** 2 + d[:, 1] ** 2 - rd**2
        b = o[0] * d[:, 0] + o[1] * d[:, 1] - ro * rd
        c = o[0] ** 2 + o[1] ** 2 - ro**2
        best = np.full(len(d), np.inf)
        root = np.sqrt(np.maximum(b * b - a * c, 0.0))
        safe = np.where(np.abs(a) < 1e-300, 1e-300, a)
        for t in ((-b - root) / safe, (-b + root) / safe):
            z = o[2] + t * d[:, 2]
            good = (b * b - a * c >= 0) & (t > 0) & (np.abs(z) <= h)
            best = np.where(good, np.minimum(best, t), best)
        dz = np.where(np.abs(d[:, 2]) < 1e-300, 1e-300, d[:, 2])
        for cap, radius in ((-h, self.bottom_radius), (h, self.top_radius)):
            t = (cap - o[2]) / dz
            with np.errstate(over="ignore", invalid="ignore"):
                square = (o[0] + t * d[:, 0]) ** 2 + (o[1] + t * d[:, 1]) ** 2
            good = (t > 0) & (square <= radius**2)
            best = np.where(good, np.minimum(best, t), best)
        return best


@dataclass(frozen=True, eq=False)
class Capsule(Solid):
    """All points within `radius` of a segment on local z; zero length makes it a sphere."""

    radius: float
    half_length: float = 0.0
    kind: ClassVar[str] = "capsule"

    @property
    def bounding_radius(self) -> float:
        """Half length of the segment plus the radius, metres."""
        return self.radius + self.half_length

    def _profile(self) -> np.ndarray:
        quarter = np.linspace(-np.pi / 2, 0.0, _SEGMENTS // 4 + 1)
        lower = self.radius * np.stack([np.cos(quarter), np.sin(quarter)], 1)
        lower[0, 0] = 0.0
        upper = lower[::-1] * [1.0, -1.0]
        lower[:, 1] -= self.half_length
        upper[:, 1] += self.half_length
        return np.concatenate([lower, upper if self.half_length > 0 else upper[1:]])

    def surface_points(self, spacing: float) -> Float[np.ndarray, "m 3"]:
        """Return world points exactly on the surface, about `spacing` metres apart."""
        chord = (super().surface_points(spacing) - self.center) @ self.pose[:3, :3]
        axis = np.zeros_like(chord)
        axis[:, 2] = np.clip(chord[:, 2], -self.half_length, self.half_length)
        offset = chord - axis
        offset *= self.radius / np.linalg.norm(offset, axis=1, keepdims=True)
        return self._to_world(axis + offset)

    def _distance(self, p: np.ndarray) -> np.ndarray:
        q = p.copy()
        q[:, 2] -= np.clip(q[:, 2], -self.half_length, self.half_length)
        return np.linalg.norm(q, axis=1) - self.radius

    def _hit(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        best = np.full(len(d), np.inf)
        if self.half_length > 0:
            a = np.maximum(d[:, 0] ** 2 + d[:, 1] ** 2, 1e-300)
            b = o[0] * d[:, 0] + o[1] * d[:, 1]
            disc = b * b - a * (o[0] ** 2 + o[1] ** 2 - self.radius**2)
            t = (-b - np.sqrt(np.maximum(disc, 0.0))) / a
            good = (disc >= 0) & (t > 0) & (np.abs(o[2] + t * d[:, 2]) <= self.half_length)
            best = np.where(good, t, best)
        a = (d**2).sum(1)
        for z in {-self.half_length, self.half_length}:
            q = o - np.array([0.0, 0.0, z])
            b = d @ q
            disc = b * b - a * (q @ q - self.radius**2)
            t = (-b - np.sqrt(np.maximum(disc, 0.0))) / a
            best = np.where((disc >= 0) & (t > 0), np.minimum(best, t), best)
        return best


def cylinder(radius: float, half_height: float, pose: np.ndarray | None = None) -> Frustum:
    """Return a cylinder about local z, metres."""
    return Frustum(radius, radius, half_height, pose=np.eye(4) if pose is None else pose)


def sphere(radius: float, pose: np.ndarray | None = None) -> Capsule:
    """Return a sphere, metres."""
    return Capsule(radius, 0.0, pose=np.eye(4) if pose is None else pose)


def solid_from_dict(data: dict[str, Any]) -> Solid:
    """Rebuild a solid from `Solid.to_dict`; raises ConfigError for an unknown kind."""
    kinds = {solid.kind: solid for solid in (Box, Frustum, Capsule)}
    kind = kinds[choice("kind of solid", data["kind"], kinds)]
    sizes = {f.name: data[f.name] for f in fields(kind) if f.name != "pose"}
    sizes = {k: tuple(v) if isinstance(v, list) else v for k, v in sizes.items()}
    return kind(**sizes, pose=np.asarray(data["pose"], dtype=np.float64))
