# SPDX-License-Identifier: BSD-3-Clause
"""A robot as a tree of links and joints."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from vprism_plan.robots._geometry import PrimitiveGeometry
from vprism_plan.robots._mesh_files import MeshFile

MOVING_TYPES = ("revolute", "continuous", "prismatic")


@dataclass(frozen=True)
class Joint:
    """A joint of the tree; ``lower``/``upper`` are -pi/pi for continuous joints.

    Of a joint that others mimic, they are narrowed so that these stay in their own limits.
    """

    name: str
    kind: str
    parent: str
    child: str
    T_origin: np.ndarray
    axis: np.ndarray
    lower: float
    upper: float
    velocity: float
    mimic: tuple[str, float, float] | None = None

    @property
    def moves(self) -> bool:
        """Whether the joint has a degree of freedom (its own or a mimicked one)."""
        return self.kind in MOVING_TYPES


@dataclass(frozen=True)
class Link:
    """A link with its collision geometry: primitives, and meshes that are not read yet."""

    name: str
    primitives: tuple[PrimitiveGeometry, ...] = ()
    meshes: tuple[MeshFile, ...] = ()


@dataclass(frozen=True)
class RobotModel:
    """A tree of links: ``joints`` are ordered so that parents come first."""

    name: str
    root: str
    links: dict[str, Link]
    joints: tuple[Joint, ...]
    joint_map: dict[str, Joint] = field(repr=False)

    @property
    def actuated(self) -> tuple[str, ...]:
        """Names of the joints that move and do not mimic another."""
        return tuple(j.name for j in self.joints if j.moves and j.mimic is None)

    def resolve_mimic(self, name: str) -> tuple[str, float, float]:
        """Follow a chain of mimic joints to its driver.

        Returns:
            (driver, multiplier, offset): value = multiplier * driver + offset.
        """
        multiplier, offset = 1.0, 0.0
        mimic = self.joint_map[name].mimic
        while mimic is not None:
            name, factor, shift = mimic
            offset += multiplier * shift
            multiplier *= factor
            mimic = self.joint_map[name].mimic
        return name, multiplier, offset
