# SPDX-License-Identifier: BSD-3-Clause
"""What a world is made of, and what counts as an obstacle in it."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float

from vprism_plan._arguments import choice, number, rigid_pose
from vprism_plan.errors import ConfigError

OccludedPolicy = Literal["occupied", "posterior", "free"]
UnobservedPolicy = Literal["free", "occupied"]
SupportExtent = Literal["auto", "seen", "unbounded"]


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
        owner = _owner(self)
        object.__setattr__(self, "size", _vector(owner, "size", self.size, positive=True))
        object.__setattr__(self, "T_world", _pose(owner, self.T_world))

    def signed_distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """See `Primitive`."""
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
        owner = _owner(self)
        object.__setattr__(self, "radius", _length(owner, "radius", self.radius))
        object.__setattr__(self, "center", _vector(owner, "center", self.center))

    def signed_distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """See `Primitive`."""
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
        owner = _owner(self)
        object.__setattr__(self, "radius", _length(owner, "radius", self.radius))
        object.__setattr__(self, "length", _length(owner, "length", self.length))
        object.__setattr__(self, "T_world", _pose(owner, self.T_world))

    def signed_distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """See `Primitive`."""
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

    `normal` (3,) points to the free side and is scaled to unit length with its `offset` (metres).
    Half-spaces are checked exactly and cost no grid: use them for walls.
    """

    name: str
    normal: Any
    offset: float

    def __post_init__(self) -> None:
        owner = _owner(self)
        normal = _vector(owner, "normal", self.normal)
        length, offset = float(np.linalg.norm(normal)), number(f"{owner}: offset", self.offset)
        if length < 1e-9:
            raise ConfigError(f"{owner}: normal {self.normal!r} must not be zero")
        object.__setattr__(self, "normal", normal / length)
        object.__setattr__(self, "offset", offset / length)


@dataclass(frozen=True, eq=False)
class KnownMesh:
    """A `trimesh.Trimesh` in world coordinates (metres), filled if it is watertight."""

    name: str
    mesh: Any

    def __post_init__(self) -> None:
        owner = _owner(self)
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


def _owner(item: Any) -> str:
    if not isinstance(item.name, str) or not item.name:
        raise ConfigError(f"known geometry needs a name (a non-empty string), got {item.name!r}")
    return f"{type(item).__name__} {item.name!r}"


def _vector(owner: str, what: str, value: Any, positive: bool = False) -> np.ndarray:
    array = np.array(value, dtype=np.float64)
    if array.shape != (3,) or not np.isfinite(array).all() or (positive and (array <= 0).any()):
        kind = "positive finite" if positive else "finite"
        raise ConfigError(f"{owner}: {what} is {value!r}; it must be three {kind} numbers (metres)")
    return array


def _length(owner: str, what: str, value: Any) -> float:
    return number(f"{owner}: {what}", value, 0.0, unit="metres", above=True)


def _pose(owner: str, value: Any) -> np.ndarray:
    return rigid_pose(f"{owner}: T_world", value)


def _from_slabs(excess: np.ndarray) -> np.ndarray:
    """Signed distance to a product of slabs, from the signed distance to each, (n, k)."""
    # Column by column: numpy's reductions along a short axis take four times as long.
    squares, deepest = np.zeros(len(excess)), np.full(len(excess), -np.inf)
    for column in excess.T:
        squares += np.maximum(column, 0.0) ** 2
        np.maximum(deepest, column, out=deepest)
    return np.sqrt(squares) + np.minimum(deepest, 0.0)


@dataclass(frozen=True)
class WorldConfig:
    """How a map becomes obstacles. Lengths in metres.

    Attributes:
        resolution: distance between the nodes of the distance field.
        level: the objects are {x : P(occupied)(x) >= level}.
        occluded: what to do with space that a camera's ray would reach only through something it
            saw. "posterior" (default): where the map has support (kernel mass >= `min_support`), or
            its prior has looked, the posterior decides; what lies farther from every object is
            judged by `hidden_objects`. "occupied": it is an obstacle, also where the map's kernels
            reach: nothing that hides can be touched, whatever its probability. "free": only the
            posterior decides.
        hidden_objects: how many objects that nobody saw stand on a square metre of hidden support
            surface (policy "posterior"). Where the map has nothing to say, draws of the posterior
            hold so many of them, as cylinders 4 to 12 cm wide and 3 to 25 cm high, so bounds on
            risk count them; the field, and verdicts without such a bound, take that space for
            free: any one place is nearly always. It stays an obstacle behind unlabelled clutter,
            where the prior's guess is cut off by the end of what it looked at, outside the grid,
            for maps without a prior or with one of your own, without a plane and with
            `support="seen"`. 0: that space is free; above 1000, or infinite: it is an obstacle.
        unobserved: the same for space outside every image or behind pixels without a depth return:
            "free" (default) or "occupied". Space outside the grid counts as unobserved.
        support: how far the support surface goes on. "unbounded": everything below its plane is an
            obstacle. "seen": only below the convex hull of what was seen of it and 5 cm around;
            what else lies lower is judged like all other space. "auto" (default): "seen" for a
            robot whose base stands more than 5 cm below the plane, which its checker then says,
            else "unbounded".
        bounds: (lower, upper) corners of the box that the grid must cover at least; None chooses
            the observed objects' box and room around it. The grid always covers the whole level set
            and all known geometry.
        known: obstacles the user adds: `Box`, `Sphere`, `Cylinder`, `HalfSpace`, `KnownMesh`.
        min_support: kernel mass from which the posterior counts (policy "posterior").
        occlusion_tolerance: how far behind the measured depth shadow begins; at least three
            standard deviations of a depth camera's noise at that range.
        background_height: unlabelled points at least this far above the support plane (or three
            standard deviations, if that is more) are obstacles ...
        lone_share: ... unless they are flying pixels: alone, with points around them that fill less
            than this share of what a surface facing the camera would show in the 3 cm around. None
            (default): 0.03, only of points at an outline, between a nearer and a farther return. 0
            keeps every point. 0.03 drops all that a noisy camera strews, and nothing as thick as
            a 1 mm rod.

    Raises:
        ConfigError: a value outside its range.
    """

    resolution: float = 0.01
    level: float = 0.5
    occluded: OccludedPolicy = "posterior"
    unobserved: UnobservedPolicy = "free"
    support: SupportExtent = "auto"
    bounds: Any = None
    known: tuple[Known, ...] = ()
    min_support: float = 0.5
    occlusion_tolerance: float = 0.01
    background_height: float = 0.015
    lone_share: float | None = None
    hidden_objects: float = 2.0

    def __post_init__(self) -> None:
        number("resolution", self.resolution, 1e-4, 1.0, "metres")
        check_level(self.level)
        number("min_support", self.min_support, 0.0, unit="kernel mass")
        number("occlusion_tolerance", self.occlusion_tolerance, 0.0, 1.0, "metres")
        number("background_height", self.background_height, 0.0, 1.0, "metres")
        if self.lone_share is not None:
            number("lone_share", self.lone_share, 0.0, 0.25, "(a share)")
        number("hidden_objects", self.hidden_objects, 0.0, unit="per square metre", finite=False)
        choice("occluded", self.occluded, get_args(OccludedPolicy))
        choice("unobserved", self.unobserved, get_args(UnobservedPolicy))
        choice("support", self.support, get_args(SupportExtent))
        object.__setattr__(self, "bounds", _checked_bounds(self.bounds))
        object.__setattr__(self, "known", _checked_known(self.known))


def check_level(level: float) -> None:
    """Raise ConfigError unless `level` is a probability strictly between 0 and 1."""
    number("level", level, 0.0, 1.0, "(a probability)", above=True, below=True)


def _checked_bounds(bounds: Any) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
    if bounds is None:
        return None
    box = np.asarray(bounds, dtype=np.float64)
    if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[0] < box[1]).all():
        raise ConfigError(
            f"bounds is {bounds!r}; it must be ((x, y, z), (x, y, z)) in metres, finite, "
            "with every lower coordinate below the upper one"
        )
    lower, upper = box.tolist()
    return tuple(lower), tuple(upper)


def _checked_known(known: Any) -> tuple[Known, ...]:
    known = tuple(known)
    for item in known:
        if not isinstance(item, (HalfSpace, KnownMesh, Primitive)):
            raise ConfigError(
                f"known holds a {type(item).__name__}; it must hold Box, Sphere, Cylinder, "
                "HalfSpace or KnownMesh"
            )
    names = [item.name for item in known]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ConfigError(f"known geometry names must differ; used twice: {', '.join(twice)}")
    return known
