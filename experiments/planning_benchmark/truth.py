# SPDX-License-Identifier: BSD-3-Clause
"""Does a path really collide? The robot's spheres against the true scene.

A grid of true distances bounds the distance of every sphere at every sample of a path from
below; the exact distance is asked for only where that bound cannot settle which sphere comes
nearest. Between two samples no point of the robot moves more than 2 mm, so what a judgement
says of the depth is at most 1 mm short.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from experiments.planning_benchmark.grid_world import benchmark_grid, checker_of, world_of_distances
from experiments.protocols import TrueScene
from experiments.stored import Stored
from vprism_plan.collision import CollisionChecker
from vprism_plan.collision.motion import Edges, edges_of, place_points
from vprism_plan.perception import Plane
from vprism_plan.robots import Robot
from vprism_plan.robots.kinematics import frame_poses
from vprism_plan.world.distance import DistanceField, round_down
from vprism_plan.world.grid import Grid

TOLERANCE = 0.001  # metres of motion between a point of a path and the nearest sample
_COARSE = 4  # nodes of the fine grid per node of the coarse one
_BAND = 0.03  # metres around the objects in which the fine nodes are exact
_CHUNK = 512  # samples placed at once
_ASKED = 256  # points whose exact distance is asked for at once
_DEPTHS = (0.0005, 0.001, 0.002, 0.004, 0.008)  # metres under a surface, to name its object


@dataclass(frozen=True)
class PathTruth(Stored):
    """What the true scene says of a path.

    Attributes:
        clearance: smallest signed distance between the robot's moving spheres and anything,
            metres; below 0 it collides. At most 1 mm above the true minimum.
        body: what is nearest there: "object:3", "clutter" or "table".
        link: the link that is.
        sphere: its sphere.
        place: where on the path: the edge's number plus the fraction of it.
        point: (3,) the point of the surface nearest to that sphere's centre, world, metres.
        samples: configurations looked at.
    """

    clearance: float
    body: str
    link: str
    sphere: int
    place: float
    point: tuple[float, float, float]
    samples: int

    @property
    def collides(self) -> bool:
        """Whether the path really collides."""
        return self.clearance < 0.0

    @property
    def depth(self) -> float:
        """Depth of the worst penetration, metres; 0 without."""
        return max(0.0, -self.clearance)


def true_field(scene: TrueScene, grid: Grid) -> DistanceField:
    """Return lower bounds of the distance to a scene's objects at the nodes of a grid.

    Exact (rounded down) at nodes within 3 cm of an object; farther away they follow from
    exact distances four nodes apart.
    """
    spacing = _COARSE * grid.spacing
    first = np.floor(grid.first / _COARSE).astype(np.int64)
    last = np.ceil((grid.first + np.array(grid.shape) - 1) / _COARSE).astype(np.int64)
    nx, ny, nz = (int(n) for n in last - first + 1)
    rough = Grid(spacing, first, (nx, ny, nz))
    exact = _exact(scene, rough.slab(0, nx))
    coarse = _as_field(rough, exact)
    out = np.empty(grid.shape, dtype=np.float32)
    for start in range(0, grid.shape[0], 16):
        stop = min(start + 16, grid.shape[0])
        nodes = grid.slab(start, stop)
        values = coarse.lower_bound(nodes)
        near = np.flatnonzero(values < _BAND)
        if len(near):
            values[near] = _exact(scene, nodes[near])
        out[start:stop] = round_down(values).reshape(stop - start, *grid.shape[1:])
    return _as_field(grid, out.astype(np.float64).reshape(-1))


def _exact(scene: TrueScene, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    return np.asarray(scene.signed_distance(np.ascontiguousarray(points)), dtype=np.float64)


def _as_field(grid: Grid, values: Float[np.ndarray, " n"]) -> DistanceField:
    source = np.zeros(grid.shape, dtype=np.int16)
    # A scene without objects: any finite number is a bound, and arithmetic stays finite.
    reach = float(np.linalg.norm(grid.upper - grid.origin)) + grid.spacing
    distance = round_down(np.minimum(values, reach)).reshape(grid.shape)
    return DistanceField(grid.origin, grid.spacing, distance, source, ("object",))


class Truth:
    """A true scene, asked about the motions of one robot.

    Args:
        scene: the truth; its support is z = 0.
        robot: whose moving spheres are checked. Links that no joint moves stand on the table.

    Attributes:
        field: lower bounds of the distance to the objects, 1 cm apart.
    """

    def __init__(self, scene: TrueScene, robot: Robot) -> None:
        self.scene = scene
        self.robot = robot
        self.grid = benchmark_grid(scene.observation)
        self.field = true_field(scene, self.grid)
        floor = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
        self.world = world_of_distances(self.field, scene.observation, floor)
        self._spheres = np.flatnonzero(~np.asarray(robot.fixed_links)[robot.sphere_links])

    def checker(self, margin: float = 0.0) -> CollisionChecker:
        """Return a checker whose world is the true one: what it accepts is really free."""
        return checker_of(self.world, self.robot, margin)

    @cached_property
    def exact(self) -> CollisionChecker:
        """The checker of the true world without a margin."""
        return self.checker()

    def edges(self, path: Float[np.ndarray, "t dof"]) -> Edges:
        """Return the edges of a path (T, dof), and how far they can move anything."""
        return edges_of(self.exact, path)

    def judge(self, path: Float[np.ndarray, "t dof"]) -> PathTruth:
        """Return how near a path (T, dof) comes to the true objects and the table.

        Raises:
            RobotError: the path has a wrong shape or values that are not finite.
        """
        edges = self.edges(path)
        Q, places = edges.samples(TOLERANCE)
        radii = np.asarray(self.robot.sphere_radii)[self._spheres]
        best = _Nearest()
        for start in range(0, len(Q), _CHUNK):
            centers = self.sphere_centers(Q[start : start + _CHUNK], self._spheres)
            self._against_table(centers, radii, start, best)
            self._against_objects(centers, radii, start, best)
        return self._described(best, Q, places)

    def sphere_centers(
        self, Q: Float[np.ndarray, "n dof"], spheres: Int[np.ndarray, " s"]
    ) -> Float[np.ndarray, "n s 3"]:
        """Return the world centres (m) of some of the robot's spheres."""
        arrays = self.robot.arrays
        R, t = frame_poses(arrays, Q)
        return place_points(R, t, arrays.sphere_frame[spheres], arrays.sphere_center[spheres])

    def _against_table(
        self, centers: np.ndarray, radii: np.ndarray, start: int, best: "_Nearest"
    ) -> None:
        gaps = centers[..., 2] - radii
        flat = int(np.argmin(gaps))
        row, column = divmod(flat, len(radii))
        best.offer(float(gaps[row, column]), start + row, column, "table", centers[row, column])

    def _against_objects(
        self, centers: np.ndarray, radii: np.ndarray, start: int, best: "_Nearest"
    ) -> None:
        """Ask for exact distances, most promising first, until no bound is below the best."""
        points = centers.reshape(-1, 3)
        size = np.tile(radii, len(centers))
        bound = self.field.lower_bound(points) - size
        order = np.flatnonzero(bound < best.gap)
        order = order[np.argsort(bound[order], kind="stable")]
        for piece in range(0, len(order), _ASKED):
            chosen = order[piece : piece + _ASKED]
            if bound[chosen[0]] >= best.gap:
                break
            gaps = _exact(self.scene, points[chosen]) - size[chosen]
            nearest = int(np.argmin(gaps))
            row, column = divmod(int(chosen[nearest]), len(radii))
            best.offer(float(gaps[nearest]), start + row, column, "object", centers[row, column])

    def _described(
        self, best: "_Nearest", Q: Float[np.ndarray, "n dof"], places: Float[np.ndarray, " n"]
    ) -> PathTruth:
        sphere = int(self._spheres[best.sphere])
        body, point = best.body, best.center * [1.0, 1.0, 0.0]
        if body == "object":
            body, point = nearest_surface(self.scene, best.center)
        x, y, z = (float(v) for v in point)
        link = self.robot.link_names[int(self.robot.sphere_links[sphere])]
        place = float(places[best.row])
        return PathTruth(best.gap, body, link, sphere, place, (x, y, z), len(Q))


class _Nearest:
    """The smallest gap found so far."""

    def __init__(self) -> None:
        self.gap, self.row, self.sphere, self.body = np.inf, 0, 0, ""
        self.center = np.zeros(3)

    def offer(self, gap: float, row: int, sphere: int, body: str, center: np.ndarray) -> None:
        if gap < self.gap:
            self.gap, self.row, self.sphere, self.body = gap, row, sphere, body
            self.center = center.copy()


def nearest_surface(
    scene: TrueScene, point: Float[np.ndarray, " 3"]
) -> tuple[str, Float[np.ndarray, " 3"]]:
    """Return the name of the object nearest to a point (m), and its nearest surface point.

    The way there is the gradient of the signed distance, by differences over 0.1 mm.
    """
    h = 1e-4
    around = np.concatenate([point + h * np.eye(3), point - h * np.eye(3), point[None]])
    values = _exact(scene, around)
    slope = (values[:3] - values[3:6]) / (2.0 * h)
    length = float(np.linalg.norm(slope))
    out = slope / length if length > 1e-9 else np.array([0.0, 0.0, 1.0])
    surface = point - values[6] * out
    under = surface - np.array(_DEPTHS)[:, None] * out
    ids: Int[np.ndarray, " n"] = np.asarray(scene.object_of(under))
    found = ids[ids != 0]
    if len(found) == 0:
        return "object", surface
    return ("clutter" if found[0] < 0 else f"object:{int(found[0])}"), surface
