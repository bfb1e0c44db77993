# SPDX-License-Identifier: BSD-3-Clause
"""Worlds for the collision checker made of nothing but marked cells, or of known distances.

A `CollisionChecker` asks its world for distances at nodes, half-spaces and names. So any map
that can say which cells are occupied can be checked by the same code as a V-PRISM map, and
only the map differs.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from vprism_plan.collision import CheckerConfig, CollisionChecker
from vprism_plan.perception import Observation, Plane
from vprism_plan.robots import Robot
from vprism_plan.world import WorldConfig
from vprism_plan.world.distance import (
    DistanceField,
    Lattice,
    NodeDistances,
    distance_to_lattice,
    finish,
)
from vprism_plan.world.grid import Grid, choose_grid
from vprism_plan.world.visibility import OUTSIDE, View, classify_points, make_view

_AROUND = 0.6  # metres around the seen objects, as a `World` chooses
_UNDER, _ABOVE = 0.02, 1.0  # metres below and above the support


@dataclass(frozen=True)
class _Inside:
    """Stands in for a map where reasons are given: 1 inside obstacles, 0 elsewhere."""

    field: DistanceField

    def occupancy(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Return 1 where a world point (m) may be inside an obstacle, else 0."""
        return (self.field.lower_bound(points) <= 0.0).astype(np.float64)


@dataclass(frozen=True, eq=False)
class GridWorld:
    """A distance field and half-spaces: what `CollisionChecker` asks of a world.

    Attributes:
        field: distance to the obstacles.
        planes: (P, 4) half-spaces {x : n . x < offset}, the support surface first, metres.
        plane_names: their names.
        views: what the camera saw, for `status` only.
        config: unobserved space is free.
    """

    field: DistanceField
    planes: Float[np.ndarray, "p 4"]
    plane_names: tuple[str, ...]
    views: tuple[View, ...]
    config: WorldConfig

    @property
    def sources(self) -> tuple[str, ...]:
        """Names that `field.source` indexes."""
        return self.field.sources

    @property
    def map(self) -> Any:
        """What answers `occupancy`: whether a point is inside an obstacle."""
        return _Inside(self.field)

    def status(self, points: Float[np.ndarray, "n 3"]) -> UInt8[np.ndarray, " n"]:
        """What the camera knows of world points (m); see `World.status`."""
        status = classify_points(self.views, points)
        outside = ((points < self.field.origin) | (points > self.field.upper)).any(axis=1)
        status[outside] = OUTSIDE
        return status


def support_plane(observation: Observation) -> Plane:
    """Return the observation's support plane; fitted as `fit_map` does where none is given."""
    if observation.plane is not None:
        return observation.plane
    from vprism_plan.perception.plane_fitting import fit_plane

    return fit_plane(observation, seed=0)


def views_of(observation: Observation, tolerance: float = 0.01) -> tuple[View, ...]:
    """Return the observation as a `World` looks at it."""
    return (make_view(observation, tolerance, support_plane(observation)),)


def benchmark_bounds(observation: Observation) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the box (m) that the grids of all worlds of one scene cover."""
    points, labels = observation.points()
    seen = points[labels > 0]
    lower, upper = seen.min(axis=0) - _AROUND, seen.max(axis=0) + _AROUND
    lower[2], upper[2] = -_UNDER, max(_ABOVE, float(upper[2]))
    return tuple(lower.tolist()), tuple(upper.tolist())


def benchmark_grid(observation: Observation, resolution: float = 0.01) -> Grid:
    """Return the nodes that every world of one scene is baked on."""
    config = WorldConfig(resolution=resolution, bounds=benchmark_bounds(observation))
    return choose_grid(None, config, None)


def world_of_distances(
    field: DistanceField, observation: Observation, plane: Plane | None = None
) -> GridWorld:
    """Put a world together from a field and the support plane (the observation's if None)."""
    plane = support_plane(observation) if plane is None else plane
    rows = np.array([[*plane.normal, plane.offset]], dtype=np.float64)
    config = WorldConfig(resolution=field.spacing, occluded="free")
    return GridWorld(field, rows, ("support surface",), views_of(observation), config)


def world_of_lattice(
    lattice: Lattice, grid: Grid, names: Sequence[str], observation: Observation
) -> GridWorld:
    """Make a world of marked cells.

    Args:
        lattice: marks; label k is an obstacle called `names[k - 1]`.
        grid: nodes of the field.
        names: for reasons; "object:3", "background" and "occluded" are understood.
        observation: brings the support plane and the view.
    """
    distance, label = distance_to_lattice(lattice, grid)
    nodes = NodeDistances(distance, label.astype(np.int16) - np.int16(1))
    return world_of_distances(finish(nodes, grid, tuple(names), False), observation)


def checker_of(world: GridWorld, robot: Robot, margin: float = 0.0) -> CollisionChecker:
    """Return the checker that keeps `margin` (m) from a world."""
    return CollisionChecker(world, robot, CheckerConfig(margin=margin, max_risk=None))


def empty_lattice(grid: Grid, factor: int) -> Lattice:
    """Return a lattice without marks, `factor` times finer than the grid, that covers it."""
    shape = tuple(factor * (n - 1) + 1 for n in grid.shape)
    return Lattice(np.zeros(shape, np.uint8), grid.first * factor, factor)


def benchmark_robot() -> Robot:
    """Return the Panda beside the table: base at (0.05, -0.6, 0) m, facing +y."""
    from vprism_plan._resources import urdf_path

    base = np.eye(4)
    base[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    base[:3, 3] = (0.05, -0.6, 0.0)
    return Robot.from_urdf(urdf_path("panda"), base_pose=base)
