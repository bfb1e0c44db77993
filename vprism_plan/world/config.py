# SPDX-License-Identifier: BSD-3-Clause
"""What a world is made of, and what counts as an obstacle in it."""

from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from vprism_plan.errors import ConfigError
from vprism_plan.world.known import HalfSpace, Known, KnownMesh, Primitive

OccludedPolicy = Literal["occupied", "posterior", "free"]
UnobservedPolicy = Literal["free", "occupied"]
SupportExtent = Literal["auto", "seen", "unbounded"]


@dataclass(frozen=True)
class WorldConfig:
    """How a map becomes obstacles. Lengths in metres.

    Attributes:
        resolution: distance between the nodes of the distance field.
        level: the objects are {x : P(occupied)(x) >= level}.
        occluded: what to do with space that a camera's ray would reach only through
            something it saw.
            "occupied" (default): it is an obstacle, also where the map's kernels reach.
            A posterior that extrapolates "empty" a centimetre into a shadow can never
            make a hidden object touchable.
            "posterior": where the map has support (kernel mass >= `min_support`) the
            posterior decides; elsewhere it is an obstacle.
            "free": only the posterior decides.
        unobserved: the same for space outside every image or behind pixels without a
            depth return: "free" (default) or "occupied". Space outside the grid counts
            as unobserved.
        support: how far the support surface goes on.
            "unbounded": everything below its plane is an obstacle.
            "seen": only below the convex hull of what was seen of it and 5 cm around; what
            else lies lower is judged like all other space.
            "auto" (default): "seen" for a robot whose base stands more than 5 cm below the
            plane, which its `CollisionChecker` then says, else "unbounded".
        bounds: (lower, upper) corners of the box that the grid must cover at least; None
            chooses the observed objects' box and room around it. The grid always
            covers the whole level set and all known geometry.
        known: obstacles the user adds: `Box`, `Sphere`, `Cylinder`, `HalfSpace`, `KnownMesh`.
        min_support: kernel mass from which the posterior counts (policy "posterior").
        occlusion_tolerance: how far behind the measured depth shadow begins; at least
            three standard deviations of a depth camera's noise at that range.
        background_height: unlabelled points at least this far above the support plane
            (or three standard deviations, if that is more) are obstacles ...
        lone_share: ... unless they are flying pixels: alone, with points around them that
            fill less than this share of what a surface facing the camera would show in
            the 3 cm around. 0 (default) keeps every point. 0.03 drops what a noisy camera
            strews behind outlines, and nothing as thick as a 1 mm rod.

    Raises:
        ConfigError: a value outside its range; the message names it and the range.
    """

    resolution: float = 0.01
    level: float = 0.5
    occluded: OccludedPolicy = "occupied"
    unobserved: UnobservedPolicy = "free"
    support: SupportExtent = "auto"
    bounds: Any = None
    known: tuple[Known, ...] = ()
    min_support: float = 0.5
    occlusion_tolerance: float = 0.01
    background_height: float = 0.015
    lone_share: float = 0.0

    def __post_init__(self) -> None:
        _require_in("resolution", self.resolution, 1e-4, 1.0, "metres")
        check_level(self.level)
        _require_in("min_support", self.min_support, 0.0, np.inf, "kernel mass")
        _require_in("occlusion_tolerance", self.occlusion_tolerance, 0.0, 1.0, "metres")
        _require_in("background_height", self.background_height, 0.0, 1.0, "metres")
        _require_in("lone_share", self.lone_share, 0.0, 0.25, "(a share)")
        _require_choice("occluded", self.occluded, get_args(OccludedPolicy))
        _require_choice("unobserved", self.unobserved, get_args(UnobservedPolicy))
        _require_choice("support", self.support, get_args(SupportExtent))
        object.__setattr__(self, "bounds", _checked_bounds(self.bounds))
        object.__setattr__(self, "known", _checked_known(self.known))


def check_level(level: float) -> None:
    """Raise ConfigError unless `level` is a probability strictly between 0 and 1."""
    if not 0.0 < float(level) < 1.0:
        raise ConfigError(
            f"level is {level}; it must be a probability strictly between 0 and 1 (default 0.5)"
        )


def _require_in(name: str, value: float, low: float, high: float, unit: str) -> None:
    if not low <= float(value) <= high:
        raise ConfigError(f"{name} is {value}; it must be between {low:g} and {high:g} {unit}")


def _require_choice(name: str, value: str, valid: tuple[str, ...]) -> None:
    if value not in valid:
        raise ConfigError(f"{name} is {value!r}; it must be one of {', '.join(map(repr, valid))}")


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
