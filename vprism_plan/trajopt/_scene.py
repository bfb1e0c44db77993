# SPDX-License-Identifier: BSD-3-Clause
"""Which obstacles count for which sphere of a robot."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from vprism_plan.collision import CollisionChecker
from vprism_plan.errors import ConfigError


@dataclass(frozen=True, eq=False)
class Scene:
    """A robot among obstacles, as one checker (or a checker without settings) sees them.

    Attributes:
        world: the world; None where there is only a map.
        robot: the robot.
        rules: sets of objects that may be touched, one per contact rule.
        link_rules: (L,) the rule of each link; -1 where no joint moves it: such links are not
            checked against the world.
        margin: metres that the checker wants spheres to keep.
        checker: the checker, if there is one.
    """

    world: Any
    robot: Any
    rules: tuple[frozenset[int], ...]
    link_rules: Int[np.ndarray, " l"]
    margin: float
    checker: CollisionChecker | None

    @property
    def sphere_rules(self) -> Int[np.ndarray, " s"]:
        """(S,) the rule of each sphere; -1 is not checked."""
        return self.link_rules[self.robot.arrays.sphere_link]

    @property
    def radii(self) -> Float[np.ndarray, " s"]:
        """(S,) radii of the spheres with the checker's margin, metres."""
        return self.robot.arrays.sphere_radius + self.margin

    def fields(self) -> list[Any]:
        """Return the distance field of each rule: the one verdicts are given by."""
        if self.checker is None:
            return [self.world.field]
        arrays = self.robot.arrays
        found: list[Any] = [None] * len(self.rules)
        for link in range(len(arrays.link_frame)):
            found[self.rules.index(self.checker.allowed_objects(link))] = (
                self.checker.verdict_field(link)
            )
        return found


def scene_of(world: Any, robot: Any) -> Scene:
    """Put a scene together from a checker, or from a world (or None) and a robot.

    Raises:
        ConfigError: a robot is missing, or another one than the checker's is given.
    """
    if isinstance(world, CollisionChecker):
        if robot is not None and robot is not world.robot:
            raise ConfigError(
                "a checker brings its own robot; leave `robot` out, or build a checker for this one"
            )
        robot = world.robot
        per_link = [world.allowed_objects(k) for k in range(len(robot.arrays.link_frame))]
        rules = tuple(dict.fromkeys(per_link))
        index = np.array([rules.index(own) for own in per_link], dtype=np.int64)
        margin, checker, world = float(world.config.margin), world, world.world
    else:
        if robot is None:
            raise ConfigError("a world alone has no robot; pass one, or pass a CollisionChecker")
        rules, margin, checker = (frozenset[int](),), 0.0, None
        index = np.zeros(len(robot.arrays.link_frame), dtype=np.int64)
    index = np.where(robot.arrays.link_fixed, -1, index)
    return Scene(world, robot, rules, index, margin, checker)


def map_and_scene(world: Any, robot: Any) -> tuple[Any, Scene]:
    """Return the map of a checker, a world, or itself, and the scene: without a world for a map.

    Raises:
        ConfigError: it is none of them, or see `scene_of`.
    """
    if isinstance(world, CollisionChecker) or hasattr(world, "certain_field"):
        scene = scene_of(world, robot)
        return scene.world.map, scene
    if not hasattr(world, "log_proba_and_support"):
        raise ConfigError(
            f"got a {type(world).__name__}; pass a VPrismMap, a World or a CollisionChecker"
        )
    return world, scene_of(None, robot)
