# SPDX-License-Identifier: BSD-3-Clause
"""What a checker needs of a world and of a robot: anything that has it can be checked."""

from collections.abc import Collection, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from vprism_plan.collision.config import CheckerConfig
from vprism_plan.robots import KinematicArrays

# Joint values as people write them: an array, a tensor, a list or a tuple.
Numbers = ArrayLike | Sequence[Any]


@runtime_checkable
class NodeField(Protocol):
    """Distances on a grid of nodes; see `vprism_plan.world.DistanceField`."""

    @property
    def origin(self) -> np.ndarray:
        """World position of node (0, 0, 0), metres."""
        ...

    @property
    def spacing(self) -> float:
        """Distance between nodes, metres."""
        ...

    @property
    def distance(self) -> np.ndarray:
        """Lower bound of the signed distance at every node, metres."""
        ...

    @property
    def source(self) -> np.ndarray:
        """Index of the nearest obstacle's name at every node."""
        ...


@runtime_checkable
class BakedWorld(Protocol):
    """A world that answers distances; see `vprism_plan.world.World`."""

    @property
    def field(self) -> NodeField:
        """Combined field of everything that is not a half-space."""
        ...

    @property
    def planes(self) -> np.ndarray:
        """(P, 4) half-space obstacles {x: n.x < offset}, rows (n, offset), metres."""
        ...

    @property
    def plane_names(self) -> tuple[str, ...]:
        """Name of each half-space; the support surface comes first."""
        ...

    @property
    def sources(self) -> tuple[str, ...]:
        """Names that `field.source` indexes."""
        ...

    @property
    def config(self) -> Any:
        """Policies: `.occluded` and `.unobserved`."""
        ...

    @property
    def map(self) -> Any:
        """The map, for `occupancy(points)`."""
        ...

    def status(self, points: np.ndarray) -> np.ndarray:
        """(N,) codes: 0 seen, 1 occluded, 2 unobserved, 3 outside the grid."""
        ...


@runtime_checkable
class RuledWorld(BakedWorld, Protocol):
    """A baked world that knows its objects apart and its posterior's draws: what contact
    rules and probabilities need; see `vprism_plan.world.World`."""

    def fields_without(self, object_ids: Collection[int]) -> NodeField:
        """Combined field without some objects."""
        ...

    def object_field(self, object_id: int) -> Any:
        """Distance to one object alone."""
        ...

    def certain_field(
        self, without: Collection[int] = (), level_set: bool = False, seen: bool = False
    ) -> NodeField:
        """Distance to what is an obstacle whatever the posterior says, and to the level set, or
        to whatever was seen of the objects."""
        ...

    def posterior_worlds(self, n_worlds: int, seed: int, reach: float) -> Any:
        """Joint draws of the map; see `vprism_plan.world.PosteriorWorlds`."""
        ...


@runtime_checkable
class SphereRobot(Protocol):
    """A robot made of spheres; see `vprism_plan.robots.Robot`."""

    @property
    def name(self) -> str:
        """Name for messages."""
        ...

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints of a configuration, in order."""
        ...

    @property
    def dof(self) -> int:
        """Length of a configuration."""
        ...

    @property
    def arrays(self) -> KinematicArrays:
        """Flat description for the kernels."""
        ...

    @property
    def lower(self) -> np.ndarray:
        """(dof,) lower limits, radians or metres."""
        ...

    @property
    def upper(self) -> np.ndarray:
        """(dof,) upper limits, radians or metres."""
        ...

    @property
    def continuous(self) -> np.ndarray:
        """(dof,) bool: joints that wrap."""
        ...

    @property
    def link_names(self) -> tuple[str, ...]:
        """Links that have spheres."""
        ...

    @property
    def sphere_links(self) -> np.ndarray:
        """(S,) index into `link_names`."""
        ...

    @property
    def sphere_radii(self) -> np.ndarray:
        """(S,) metres."""
        ...

    @property
    def collision_pairs(self) -> np.ndarray:
        """(P, 2) links to be checked against each other."""
        ...


@runtime_checkable
class Answers(Protocol):
    """What explaining a verdict needs of the checker that gave it."""

    world: BakedWorld
    robot: SphereRobot
    config: CheckerConfig

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is odd about the world and the robot."""
        ...

    def is_valid(self, q: Numbers) -> bool:
        """Verdict on a configuration."""
        ...

    def clearance(self, q: Numbers) -> float:
        """Distance to the world, metres."""
        ...

    def self_clearance_batch(self, Q: Numbers) -> np.ndarray:
        """(n,) smallest gaps between links, metres."""
        ...

    def verdict_field(self, link: int) -> NodeField:
        """Field that a link is checked against."""
        ...

    def allowed_objects(self, link: int) -> frozenset[int]:
        """Ids of the objects that a link may touch."""
        ...

    def risk_contacts(self, q: np.ndarray) -> tuple[Any, ...]:
        """What refuses a configuration because its risk is above the bound."""
        ...

    def sphere_clearances(
        self, q: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Centres, plane distances, plane indices and field distances of all spheres."""
        ...

    def pair_gaps(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gap of each link pair, metres, and the two spheres that have it."""
        ...
