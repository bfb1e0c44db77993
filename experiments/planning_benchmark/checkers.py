# SPDX-License-Identifier: BSD-3-Clause
"""The worlds and checkers of all contenders in one scene.

All but the mesh checker are worlds of the same `CollisionChecker`, so only the map and what
it says of unseen space differ. All see the same observation.
"""

import time
from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from experiments.baselines import method
from experiments.planning_benchmark.contenders import LONE, STRAYS, Contender
from experiments.planning_benchmark.grid_world import (
    GridWorld,
    benchmark_bounds,
    benchmark_grid,
    empty_lattice,
    support_plane,
    world_of_lattice,
)
from experiments.protocols import TrueScene
from vprism_plan._kernels import world as kernels
from vprism_plan.collision import CheckerConfig, CollisionChecker
from vprism_plan.errors import ConfigError
from vprism_plan.mapping.training_data import stray_points
from vprism_plan.perception.camera import depth_sigma
from vprism_plan.robots import Robot
from vprism_plan.world import World, WorldConfig
from vprism_plan.world.config import OccludedPolicy
from vprism_plan.world.distance import Lattice
from vprism_plan.world.grid import Grid
from vprism_plan.world.visibility import background_points

_OFF_TABLE = 0.015  # metres over the support from which unlabelled points are things
_CELLS = 2  # cells per grid step that observed points mark
_HIDDEN = 0.15  # metres around what was seen of the objects in which networks are asked
OCTOMAP_OCCUPIED = 1


class Bench:
    """One scene's worlds and checkers; what contenders share is built once.

    Args:
        scene: what the camera saw is all that checkers get of it.
        robot: who moves.
        seed: of the maps.
        truth: the true world, for the contender "truth".

    Attributes:
        seconds: processor time that each part took.
    """

    def __init__(
        self, scene: TrueScene, robot: Robot, seed: int, truth: GridWorld | None = None
    ) -> None:
        self.scene = scene
        self.observation = scene.observation
        self.robot = robot
        self.seed = seed
        self.truth = truth
        self.seconds: dict[str, float] = {}
        self._worlds: dict[str, Any] = {}

    def checkers(self, contender: Contender) -> tuple[list[Any], float]:
        """Return a contender's checkers, one per bound, and the processor seconds they took
        from the observation on, what others made before included."""
        name = f"world {contender.map} {contender.occluded} {contender.resolution:g}"
        name += " by default" if contender.defaults else ""
        world = self._world(contender, name)
        began = time.process_time()
        made = [self._make(contender, world, *bound) for bound in contender.bounds]
        spent = time.process_time() - began
        parts = (f"map {contender.map}", name)
        return made, spent + sum(self.seconds.get(part, 0.0) for part in parts)

    def _make(self, contender: Contender, world: Any, margin: float, risk: float | None) -> Any:
        if contender.meshes:
            from experiments.planning_benchmark.fcl_checker import FclChecker

            return FclChecker(world, self.robot, contender.step, margin)
        if contender.defaults:
            return CollisionChecker(world, self.robot)
        # 256 worlds without a collision cannot show a risk below 0.0148.
        draws = 512 if risk is not None and risk < 0.015 else 256
        config = CheckerConfig(margin=margin, max_risk=risk, n_worlds=draws)
        return CollisionChecker(world, self.robot, config)

    def _world(self, contender: Contender, name: str) -> Any:
        if name not in self._worlds:
            if contender.defaults:
                map_ = self.vprism
                make: Callable[[], Any] = lambda: World(map_)  # noqa: E731
            elif contender.map in ("vprism", "sgd"):
                map_ = self.vprism if contender.map == "vprism" else self.sgd
                config = WorldConfig(
                    resolution=contender.resolution,
                    occluded=contender.occluded,
                    bounds=benchmark_bounds(self.observation),
                    lone_share=LONE,
                )
                make = lambda: World(map_, config)  # noqa: E731
            elif contender.map == "points":
                make = self.point_world
            elif contender.map == "octomap":
                tree = self.octomap
                make = lambda: self.octomap_world(tree, contender.occluded)  # noqa: E731
            elif contender.map in ("pointsdf", "network"):
                make = lambda: self.completed_world(contender.map)  # noqa: E731
            elif contender.map == "truth" and self.truth is not None:
                return self.truth
            else:
                raise ConfigError(f"contender {contender.key!r} has no world here")
            self._worlds[name] = self._timed(name, make)
        return self._worlds[name]

    def _timed(self, name: str, make: Callable[[], Any]) -> Any:
        began = time.process_time()
        made = make()
        self.seconds[name] = time.process_time() - began
        return made

    @cached_property
    def vprism(self) -> Any:
        """The map of the default preset."""
        return self._timed("map vprism", lambda: method("vprism").fit(self.observation, self.seed))

    @cached_property
    def sgd(self) -> Any:
        """The point estimate: a map whose posterior has no width."""
        return self._timed("map sgd", lambda: method("sgd").fit(self.observation, self.seed))

    @cached_property
    def octomap(self) -> Any:
        """The octree."""
        fit = method("octomap").fit
        return self._timed("map octomap", lambda: fit(self.observation, self.seed))

    def completed_world(self, key: str) -> GridWorld:
        """Return the observed points, and the solids that a network makes of each object.

        A 5 mm cell is inside where the method's occupancy at its corner reaches its level.
        """
        chosen, grid = method(key), benchmark_grid(self.observation)
        found = chosen.fit(self.observation, self.seed)
        points, labels = self.observation.points()
        seen, step = points[labels > 0], grid.spacing / _CELLS
        low, high = (
            np.clip(np.round((corner - grid.origin) / step), 0, _CELLS * (np.array(grid.shape) - 1))
            for corner in (seen.min(axis=0) - _HIDDEN, seen.max(axis=0) + _HIDDEN)
        )
        axes = [np.arange(a, b + 1, dtype=np.int64) for a, b in zip(low, high, strict=True)]
        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        nodes = nodes[
            support_plane(self.observation).signed_distance(grid.origin + step * nodes) > 0
        ]
        occupied = 1.0 - found.predict_proba(grid.origin + step * nodes)[:, 0]
        return self.point_world(nodes[occupied >= chosen.level])

    def point_world(self, solid: Int[np.ndarray, "n 3"] | None = None) -> GridWorld:
        """Return the observed points off the table, each as large as the sensor is uncertain.

        A point marks the 5 mm cells within three standard deviations of the depth noise
        at its range, and at least half its pixel's width. Flying pixels are left out as
        our map leaves them out. All else is free, but the cells around `solid` nodes.
        """
        grid = benchmark_grid(self.observation)
        lattice = empty_lattice(grid, _CELLS)
        if solid is not None:
            lattice.labels[tuple(solid.T)] = 1
        points, labels, depth = self._things()
        focal = min(self.observation.intrinsics[0, 0], self.observation.intrinsics[1, 1])
        half = np.maximum(3.0 * depth_sigma(depth), 0.5 * depth / focal)
        ids = [int(i) for i in np.unique(labels)]
        names = [f"object:{i}" if i > 0 else "background" for i in ids]
        for number, own in enumerate(ids, start=1):
            chosen = labels == own
            kernels.mark_boxes(
                np.ascontiguousarray(points[chosen]), half[chosen], grid.origin,
                grid.spacing / _CELLS, np.uint8(number), lattice.labels,
            )  # fmt: skip
        return world_of_lattice(lattice, grid, names, self.observation)

    def _things(self) -> tuple[Float[np.ndarray, "n 3"], np.ndarray, Float[np.ndarray, " n"]]:
        """Points (m) off the table, their labels and depths (m); flying pixels left out."""
        view = self.observation
        points, labels = view.points()
        keep = labels > 0
        for own in np.unique(labels[keep]):
            rows = np.flatnonzero(labels == own)
            keep[rows] = ~stray_points(points[rows], STRAYS)
        others, _ = background_points([view], support_plane(view), _OFF_TABLE, LONE)
        points = np.concatenate([points[keep], others])
        labels = np.concatenate([labels[keep], np.zeros(len(others), dtype=labels.dtype)])
        return points, labels, (points - view.camera_center) @ view.pose[:3, 2]

    def octomap_world(self, tree: Any, occluded: OccludedPolicy) -> GridWorld:
        """Return an octree's occupied cells and, if asked, its unknown ones in the image.

        Its cells are centred on the nodes of the grid. Occupied ones count that hold a point
        off the support which is no flying pixel, as for the point cloud; unknown ones outside
        the image are free, as they are for us.
        """
        grid = benchmark_grid(self.observation)
        plane = support_plane(self.observation)
        lattice = empty_lattice(grid, _CELLS)
        points = self._things()[0]
        cells = np.unique(np.round(points / tree.cell).astype(np.int64), axis=0)
        inside = ((cells >= grid.first) & (cells < grid.first + grid.shape)).all(axis=1)
        cells = cells[inside]
        cells = cells[tree.state(cells * tree.cell) == OCTOMAP_OCCUPIED]
        if occluded == "occupied":
            nodes = np.argwhere(~known_nodes(tree, grid))
            centers = grid.spacing * (nodes + grid.first)
            nodes = nodes[plane.signed_distance(centers) > 0.5 * tree.cell]
            nodes = nodes[self._in_image(grid.spacing * (nodes + grid.first))]
            mark_cells(lattice, nodes, 1)
        mark_cells(lattice, cells - grid.first, 2)
        return world_of_lattice(lattice, grid, ("occluded", "background"), self.observation)

    def _in_image(self, points: Float[np.ndarray, "n 3"]) -> np.ndarray:
        """Whether world points (m) project into the image."""
        view = self.observation
        local = (points - view.camera_center) @ view.pose[:3, :3]
        front = local[:, 2] > 0.0
        scale = np.where(front, local[:, 2], 1.0)
        K = view.intrinsics
        u = K[0, 0] * local[:, 0] / scale + K[0, 2]
        v = K[1, 1] * local[:, 1] / scale + K[1, 2]
        height, width = view.depth.shape
        return front & (u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5)


def mark_cells(lattice: Lattice, nodes: Int[np.ndarray, "n 3"], label: int) -> None:
    """Mark cells as wide as the grid's step, centred on its nodes."""
    for shift in np.ndindex(3, 3, 3):
        at = _CELLS * nodes + np.array(shift) - 1
        at = np.clip(at, 0, np.array(lattice.labels.shape) - 1)
        lattice.labels[tuple(at.T)] = label


def known_nodes(tree: Any, grid: Grid) -> Bool[np.ndarray, "nx ny nz"]:
    """Return which nodes lie in a leaf of an octree (cells centred on nodes), free or not."""
    if not np.isclose(tree.cell, grid.spacing):
        raise ConfigError(f"the octree has cells of {tree.cell} m, the grid of {grid.spacing} m")
    rows = [(*leaf.getCoordinate(), leaf.getSize()) for leaf in tree.tree.begin_leafs()]
    leaves = np.array(rows, dtype=np.float64).reshape(-1, 4)
    width = np.round(leaves[:, 3] / tree.cell).astype(np.int64)
    # The tree's own frame is shifted by half a cell: its corners are whole cells there.
    corner = np.round((leaves[:, :3] - 0.5 * leaves[:, 3:]) / tree.cell).astype(np.int64)
    first = corner - grid.first
    known = np.zeros(grid.shape, dtype=np.bool_)
    low = np.clip(first, 0, grid.shape)
    high = np.clip(first + width[:, None], 0, grid.shape)
    single = (width == 1) & (high > low).all(axis=1)
    known[tuple(low[single].T)] = True
    for a, b in zip(low[width > 1].tolist(), high[width > 1].tolist(), strict=True):
        known[a[0] : b[0], a[1] : b[1], a[2] : b[2]] = True
    return known
