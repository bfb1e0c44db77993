# SPDX-License-Identifier: BSD-3-Clause
"""Everything that counting colliding worlds needs, put together once."""

import dataclasses
from collections.abc import Collection, Sequence
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from vprism_plan.collision._packing import pack_robot, pack_world
from vprism_plan.collision.config import CheckerConfig
from vprism_plan.collision.protocols import NodeField, RuledWorld, SphereRobot
from vprism_plan.world import PosteriorWorlds

# Voxels by which spheres may grow when no world may collide any more (`PathRisk.tightened`).
PADDINGS = (0.5, 1.0, 2.0)
# Voxels between a voxel's faces and its corners: a sphere grown by it touches the ball around
# every occupied voxel that it meets, where else it touches the ball inside.
CORNER = 0.5 * 3.0**0.5 - 0.5
# Voxels between a sphere's surface and the farthest voxel it is compared with: the way to
# the far node of its centre's cell, half a diagonal for a voxel's own size, at most five
# eighths for the way between samples, and room to spare.
_ROOM = 3.0 + CORNER


class Certain:
    """What is an obstacle in every world, under each contact rule; baked when it is asked for.

    Baking takes longer than drawing worlds, and who only counts draws never asks.
    """

    def __init__(self, world: RuledWorld, rules: Sequence[Collection[int]]) -> None:
        self._world = world
        self._rules = tuple(rules)

    @cached_property
    def fields(self) -> tuple[NodeField, ...]:
        """Distance to it, one field per contact rule."""
        return tuple(self._world.certain_field(ids) for ids in self._rules)

    @cached_property
    def packed(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The same for the kernels: distances, block bounds, floats."""
        baked = pack_world(self._world, self.fields, 0.0)
        return baked.distance, baked.blocks, baked.floats


@dataclasses.dataclass(frozen=True, eq=False)
class Setting:
    """A robot among the worlds of one map.

    Attributes:
        world: what is an obstacle in every world.
        robot: whose spheres are asked about.
        config: margin, worlds, seed and confidence.
        worlds: the draws.
        radii: (S,) metres.
        tables: (rules,) the table of `worlds` that holds for each contact rule.
        sphere_tables: (S,) the table that holds for each sphere; -1 is not checked.
        certain: what is an obstacle in every world.
        floats, ints: the robot for the kernels, without joint limits and link pairs.
        spacing: no sphere centre moves more than this between two samples, metres.
        margin: metres to keep from what is certain; in `radii` already.
    """

    world: RuledWorld
    robot: SphereRobot
    config: CheckerConfig
    worlds: PosteriorWorlds
    radii: Float[np.ndarray, " s"]
    tables: Int[np.ndarray, " g"]
    sphere_tables: Int[np.ndarray, " s"]
    certain: Certain
    floats: Float[np.ndarray, " f"]
    ints: Int[np.ndarray, " i"]
    spacing: float
    margin: float = 0.0

    @property
    def fields(self) -> tuple[NodeField, ...]:
        """Distance to the certain obstacles, one per contact rule."""
        return self.certain.fields

    @cached_property
    def packed(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The same for the kernels, with the margin: distances, block bounds, floats."""
        distance, blocks, floats = self.certain.packed
        floats = floats.copy()
        floats[6] += self.margin
        return distance, blocks, floats


def grown(setting: Setting, voxels: float) -> Setting:
    """Return the same for spheres larger by some voxels (smaller, if negative) in the draws."""
    radii = setting.radii + voxels * setting.worlds.resolution
    return dataclasses.replace(setting, radii=radii)


def with_margin(setting: Setting, margin: float) -> Setting:
    """Return the same for spheres that must keep `margin` (metres) more than not touching."""
    return dataclasses.replace(
        setting, radii=setting.radii + margin, margin=setting.margin + margin
    )


def make_setting(
    world: RuledWorld,
    robot: SphereRobot,
    config: CheckerConfig,
    rules: Sequence[Collection[int]],
    link_rules: Int[np.ndarray, " l"],
) -> Setting:
    """Put a setting together.

    Args:
        world: a `vprism_plan.world.World`.
        robot: the robot.
        config: the checker's.
        rules: object ids that may be touched, one set per contact rule.
        link_rules: (links,) the rule of each link.
    """
    arrays = robot.arrays
    moving = ~np.asarray(arrays.link_fixed)[arrays.sphere_link]
    radii = arrays.sphere_radius.copy()  # kernels get it
    resolution = float(world.field.spacing)
    room = _ROOM if config.max_risk is None else _ROOM + PADDINGS[-1]
    reach = float(np.max(radii[moving], initial=0.0)) + config.margin + room * resolution
    worlds = world.posterior_worlds(config.n_worlds, config.risk_seed, reach=reach)
    tables = np.array([worlds.rule(ids) for ids in rules], dtype=np.int64)
    per_link = np.where(arrays.link_fixed, -1, tables[link_rules])
    alone = dataclasses.replace(arrays, pairs=np.empty((0, 2), np.int64))
    packed = pack_robot(alone, rules=link_rules)
    _open_limits(packed.floats, packed.ints)
    return Setting(
        world=world,
        robot=robot,
        config=config,
        worlds=worlds,
        radii=radii,
        tables=tables,
        sphere_tables=per_link[arrays.sphere_link].astype(np.int64),
        certain=Certain(world, rules),
        floats=packed.floats,
        ints=packed.ints,
        spacing=min(resolution, 0.5 * float(world.map.kernel_length)),
    )


def _open_limits(rf: Float[np.ndarray, " f"], ri: Int[np.ndarray, " i"]) -> None:
    """Let every joint value pass the limits of a packed robot."""
    start, dof = int(ri[19]), int(ri[4])
    rf[start : start + 2 * dof : 2] = -np.inf
    rf[start + 1 : start + 2 * dof : 2] = np.inf
