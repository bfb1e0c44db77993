# SPDX-License-Identifier: BSD-3-Clause
"""Geometry the user knows and adds to a world: primitives, half-spaces, meshes."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from vprism_plan.errors import ConfigError


def _named(name: Any) -> str:
    if not isinstance(name, str) or not name:
        raise ConfigError(f"known geometry needs a name (a non-empty string), got {name!r}")
    return name


def _vector(owner: str, what: str, value: Any, positive: bool = False) -> np.ndarray:
    array = np.array(value, dtype=np.float64)
    if array.shape != (3,) or not np.isfinite(array).all() or (positive and (array <= 0).any()):
        kind = "positive finite" if positive else "finite"
        raise ConfigError(f"{owner}: {what} is {value!r}; it must be three {kind} numbers (metres)")
    return array


def _length(owner: str, what: str, value: Any) -> float:
    if not (np.isfinite(value) and value > 0):
        raise ConfigError(f"{owner}: {what} is {value!r}; it must be positive and finite (metres)")
    return float(value)


def _pose(owner: str, value: Any) -> np.ndarray:
    pose = np.array(value, dtype=np.float64)
    rigid = (
        pose.shape == (4, 4)
        and np.isfinite(pose).all()
        and np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6)
        and np.linalg.det(pose[:3, :3]) > 0
        and np.allclose(pose[3], (0, 0, 0, 1))
    )
    if not rigid:
        raise ConfigError(f"{owner}: T_world must be a rigid (4, 4) transform, got {value!r}")
    return pose


class Primitive(ABC):
    """A solid with an exact signed distance."""

    name: str

    @abstractmethod
    def signed_distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Exact distance from world points to the solid, metres, negative inside."""

    @abstractmethod
    def box(self) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
        """Lower and upper corner of a box (world axes) that contains the solid."""


@dataclass(frozen=True, eq=False)
class Box(Primitive):
    """A box with edge lengths `size` (3,), metres, centred in the frame `T_world` (4, 4)."""

    name: str
    size: Any
    T_world: Any = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        owner = f"Box {_named(self.name)!r}"
        object.__setattr__(self, "size", _vector(owner, "size", self.size, positive=True))
        object.__setattr__(self, "T_world", _pose(owner, self.T_world))

    def signed_distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Exact distance from world points to the box, metres, negative inside."""
        local = (points - self.T_world[:3, 3]) @ self.T_world[:3, :3]
        return _from_slabs(np.abs(local) - 0.5 * self.size)

    def box(self) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
        """Lower and upper corner of the box around it, world axes."""
        reach = np.abs(self.T_world[:3, :3]) @ (0.5 * self.size)
        return self.T_world[:3, 3] - reach, self.T_world[:3, 3] + reach


@dataclass(frozen=True, eq=False)
class Sphere(Primitive):
    """A ball of `radius` metres round `center` (3,), world frame."""

    name: str
    radius: float
    center: Any

    def __post_init__(self) -> None:
        owner = f"Sphere {_named(self.name)!r}"
        object.__setattr__(self, "radius", _length(owner, "radius", self.radius))
        object.__setattr__(self, "center", _vector(owner, "center", self.center))

    def signed_distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Exact distance from world points to the ball, metres, negative inside."""
        return np.linalg.norm(points - self.center, axis=1) - self.radius

    def box(self) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
        """Lower and upper corner of the box around it."""
        return self.center - self.radius, self.center + self.radius


@dataclass(frozen=True, eq=False)
class Cylinder(Primitive):
    """A cylinder along z of the frame `T_world` (4, 4), centred in it; metres."""

    name: str
    radius: float
    length: float
    T_world: Any = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        owner = f"Cylinder {_named(self.name)!r}"
        object.__setattr__(self, "radius", _length(owner, "radius", self.radius))
        object.__setattr__(self, "length", _length(owner, "length", self.length))
        object.__setattr__(self, "T_world", _pose(owner, self.T_world))

    def signed_distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Exact distance from world points to the cylinder, metres, negative inside."""
        local = (points - self.T_world[:3, 3]) @ self.T_world[:3, :3]
        radial = np.hypot(local[:, 0], local[:, 1]) - self.radius
        return _from_slabs(np.stack([radial, np.abs(local[:, 2]) - 0.5 * self.length], axis=1))

    def box(self) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
        """Lower and upper corner of the box around it, world axes."""
        axis = self.T_world[:3, 2]
        reach = 0.5 * self.length * np.abs(axis)
        reach += self.radius * np.sqrt(np.maximum(0.0, 1.0 - axis**2))
        return self.T_world[:3, 3] - reach, self.T_world[:3, 3] + reach


@dataclass(frozen=True, eq=False)
class HalfSpace:
    """Everything below a plane, {x : normal . x < offset}: a wall, a floor, a ceiling.

    `normal` (3,) points to the free side and is scaled to unit length with its `offset`
    (metres). Half-spaces are checked exactly and cost no grid: use them for walls.
    """

    name: str
    normal: Any
    offset: float

    def __post_init__(self) -> None:
        owner = f"HalfSpace {_named(self.name)!r}"
        normal = _vector(owner, "normal", self.normal)
        length = float(np.linalg.norm(normal))
        if length < 1e-9 or not np.isfinite(self.offset):
            raise ConfigError(
                f"{owner}: normal {self.normal!r} must not be zero and offset {self.offset!r} "
                "must be finite"
            )
        object.__setattr__(self, "normal", normal / length)
        object.__setattr__(self, "offset", float(self.offset) / length)


@dataclass(frozen=True, eq=False)
class KnownMesh:
    """A `trimesh.Trimesh` in world coordinates (metres), filled if it is watertight."""

    name: str
    mesh: Any

    def __post_init__(self) -> None:
        owner = f"KnownMesh {_named(self.name)!r}"
        vertices = np.asarray(getattr(self.mesh, "vertices", np.empty((0, 3))))
        faces = np.asarray(getattr(self.mesh, "faces", np.empty((0, 3))))
        if len(vertices) == 0 or len(faces) == 0:
            raise ConfigError(
                f"{owner}: a {type(self.mesh).__name__} without triangles; it must be a "
                "trimesh.Trimesh with at least one face (for a scene: scene.to_mesh())"
            )
        if not np.isfinite(vertices).all():
            raise ConfigError(f"{owner}: the mesh has vertices that are not finite")

    def box(self) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
        """Lower and upper corner of the box around it."""
        used = np.asarray(self.mesh.vertices, dtype=np.float64)[np.unique(self.mesh.faces)]
        return used.min(axis=0), used.max(axis=0)


Known = Box | Sphere | Cylinder | HalfSpace | KnownMesh


def _from_slabs(excess: np.ndarray) -> np.ndarray:
    """Signed distance to a product of slabs, from the signed distance to each, (n, k)."""
    outside = np.linalg.norm(np.maximum(excess, 0.0), axis=1)
    return outside + np.minimum(excess.max(axis=1), 0.0)
