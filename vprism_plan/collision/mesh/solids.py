# SPDX-License-Identifier: BSD-3-Clause
"""FCL shapes of a robot (primitives, meshes, or spheres where a link has neither) and of a world
(extracted objects and known geometry)."""

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float, Int

from vprism_plan._arguments import choice
from vprism_plan.collision.mesh.fcl import Shape, point_distance, point_within
from vprism_plan.collision.packing import Configuration, reach_table
from vprism_plan.errors import ConfigError, RobotError
from vprism_plan.robots import Robot
from vprism_plan.robots.geometry import PrimitiveGeometry
from vprism_plan.robots.kinematics import KIND_REVOLUTE
from vprism_plan.world.config import Box, Cylinder, KnownMesh, Sphere
from vprism_plan.world.grid import Points, Values, Vector
from vprism_plan.world.levelset import lattice_refinement
from vprism_plan.world.marks import winding_number
from vprism_plan.world.meshes import extract_refined_meshes
from vprism_plan.world.seen import RIM, SeenSupport, seen_support
from vprism_plan.world.sources import SUPPORT

LinkShapes = Literal["geometry", "spheres"]
_MOST_PIECES = 20


@dataclass(frozen=True, eq=False)
class Solid:
    """One shape of a link, as large as the URDF has it."""

    link: int  # index into `robot.link_names`
    sphere: int  # index of the collision sphere it is, or -1
    shape: Shape  # what FCL is asked about
    T_link: Float[np.ndarray, "4 4"]  # pose in the link's frame
    center: Vector  # centre of a ball that holds it, link frame, metres
    radius: float  # of that ball, metres
    # a point of the shape, link frame: the shape is connected, so where no surface cuts it this
    # point tells which side all of it is on
    witness: Vector
    triangles: Float[np.ndarray, "f 3 3"]  # of its surface, link frame
    primitive: PrimitiveGeometry | None = None  # the shape as a formula; None for meshes
    vertices: np.ndarray | None = None  # of a mesh, link frame; None for primitives
    closed: bool = False  # whether it is a closed mesh, whose inside counts
    hull: np.ndarray | None = None  # half-spaces n . x + d <= 0 around a mesh, link frame

    def holds(self, point: Vector) -> bool:
        """Whether a point (link frame) is inside a closed mesh."""
        return self.closed and abs(winding_number(point, self.triangles)) > 0.5

    def bound(self, points: Points) -> Values:
        """Lower bound of the signed distance of points (link frame), metres; exact for
        primitives."""
        if self.primitive is not None:
            return self.primitive.signed_distance(points)
        assert self.hull is not None
        return np.asarray((points @ self.hull[:, :3].T + self.hull[:, 3]).max(axis=1))


def robot_solids(
    robot: Robot, links: LinkShapes, link_meshes: Mapping[str, Any] | None
) -> list[Solid]:
    """Return the shapes of every link that carries collision spheres; see `MeshChecker`.

    Raises:
        ConfigError: `links` is neither.
        RobotError: a mesh is for an unknown link, or cannot be used.
    """
    choice("links", links, get_args(LinkShapes))
    meshes = dict(link_meshes or {})
    unknown = sorted(set(meshes) - set(robot.link_names))
    if unknown:
        raise RobotError(
            f"link_meshes names {unknown}, which carry no collision spheres; "
            f"links: {list(robot.link_names)}"
        )
    if meshes and links == "spheres":
        raise ConfigError("link_meshes are given but links is 'spheres'; use links='geometry'")
    in_link = _spheres_in_links(robot)
    unread = set(robot.meshes_as_read)
    solids: list[Solid] = []
    for index, name in enumerate(robot.link_names):
        if links == "geometry" and name in meshes:
            solids += _mesh_solids(index, name, meshes[name])
        elif links == "geometry" and (pieces := _own_meshes(robot, name)) is not None:
            solids += [solid for mesh in pieces for solid in _mesh_solids(index, name, mesh)]
            solids += _primitives(robot, index)
        elif links == "geometry" and name in robot.geometry and name not in unread:
            solids += _primitives(robot, index)
        else:
            padding = float(robot.arrays.link_padding[index])
            for sphere in np.flatnonzero(robot.sphere_links == index):
                pose = np.eye(4)
                pose[:3, 3] = in_link[sphere]
                radius = (float(robot.sphere_radii[sphere]) - padding,)
                ball = PrimitiveGeometry("sphere", radius, pose)
                solids.append(_primitive(index, ball, int(sphere)))
    return solids


def _own_meshes(robot: Robot, name: str) -> list[Any] | None:
    """The URDF's meshes of a link; None if it has none that can stand for it. Files that are
    missing, and meshes in so many pieces that each triangle would be a solid of its own, are left
    to the spheres."""
    files = robot.meshes.get(name, ())
    if not files or any(file.path is None for file in files):
        return None
    meshes = [file.mesh() for file in files]
    return meshes if sum(mesh.body_count for mesh in meshes) <= _MOST_PIECES else None


def _primitives(robot: Robot, link: int) -> list[Solid]:
    solids = robot.geometry.get(robot.link_names[link], ())
    return [_primitive(link, replace(solid, padding=0.0)) for solid in solids]


def _spheres_in_links(robot: Robot) -> Float[np.ndarray, "s 3"]:
    """Sphere centres in their links' frames: they do not depend on the configuration."""
    world, poses = robot.sphere_centers(robot.neutral), robot.link_poses(robot.neutral)
    of_link = [poses[robot.link_names[int(link)]] for link in robot.sphere_links]
    return np.array(
        [T[:3, :3].T @ (x - T[:3, 3]) for T, x in zip(of_link, world, strict=True)]
    ).reshape(-1, 3)


def _primitive(link: int, solid: PrimitiveGeometry, sphere: int = -1) -> Solid:
    shape = Shape(solid.kind, tuple(float(v) for v in solid.size))
    T, radius = np.array(solid.T_link), solid.bounding_radius()
    return Solid(link, sphere, shape, T, T[:3, 3], radius, T[:3, 3], solid.triangles(), solid)


def _mesh_solids(link: int, name: str, mesh: Any) -> list[Solid]:
    """One solid per connected piece, so that a single point tells where a piece is."""
    vertices = np.asarray(getattr(mesh, "vertices", np.empty((0, 3))), dtype=np.float64)
    faces = np.asarray(getattr(mesh, "faces", np.empty((0, 3))))
    if len(vertices) == 0 or len(faces) == 0 or not np.isfinite(vertices).all():
        raise RobotError(
            f"the mesh of link '{name}' is a {type(mesh).__name__} with {len(faces)} triangles; "
            "it must be a trimesh.Trimesh with finite vertices and at least one triangle"
        )
    return [_piece(link, piece) for piece in mesh.split(only_watertight=False)]


def _piece(link: int, piece: Any) -> Solid:
    points = np.asarray(piece.vertices, dtype=np.float64)
    center = 0.5 * (points.min(axis=0) + points.max(axis=0))
    radius = float(np.linalg.norm(points - center, axis=1).max())
    shape, triangles = Shape("mesh", mesh=piece), points[np.asarray(piece.faces)]
    own = {"vertices": points, "closed": piece.is_watertight, "hull": _hull(points)}
    return Solid(link, -1, shape, np.eye(4), center, radius, points[0], triangles, **own)


def _hull(points: Points) -> Float[np.ndarray, "f 4"]:
    """Half-spaces around points: of their convex hull, or of their box if they are flat."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return np.asarray(ConvexHull(points).equations)
    except QhullError:
        sides = np.concatenate([np.eye(3), -np.eye(3)])
        return np.column_stack([sides, -(points @ sides.T).max(axis=0)])


class PlacedSolids:
    """All solids of a robot, and where a configuration puts them."""

    def __init__(self, robot: Robot, solids: list[Solid]) -> None:
        self.robot = robot
        self.solids = solids
        self.links = np.array([solid.link for solid in solids], dtype=np.int64)
        self.radii = np.array([solid.radius for solid in solids])
        self.moving = ~np.asarray(robot.fixed_links)[self.links]
        self._names = [robot.link_names[i] for i in np.unique(self.links)]
        self._row = np.searchsorted(np.unique(self.links), self.links)
        self._local = np.array([solid.T_link for solid in solids]).reshape(-1, 4, 4)
        self._centers = np.array([solid.center for solid in solids]).reshape(-1, 3)
        self._witness = np.array([solid.witness for solid in solids]).reshape(-1, 3)
        self._levers = self._lever_table()
        # Half edges of boxes, half lengths and radii of cylinders, radii of spheres: a
        # primitive reaches as far in a direction as these say together.
        self._halves = np.zeros((len(solids), 3))
        self._rims, self._balls = np.zeros(len(solids)), np.zeros(len(solids))
        self._meshes = np.flatnonzero([solid.vertices is not None for solid in solids])
        for i, solid in enumerate(solids):
            size = solid.shape.size
            if solid.shape.kind == "box":
                self._halves[i] = 0.5 * np.array(size)
            elif solid.shape.kind == "cylinder":
                self._rims[i], self._halves[i, 2] = size[0], 0.5 * size[1]
            elif solid.shape.kind == "sphere":
                self._balls[i] = size[0]
        # Where the last call of `place` put everything.
        self.R = self.t = self.centers = self.witnesses = np.empty(0)
        self._link_poses = np.empty(0)

    def place(self, q: Configuration) -> None:
        """Compute all poses; shapes are moved one by one, when they are asked about."""
        poses = self.robot.link_poses(q)
        self._link_poses = np.array([poses[name] for name in self._names])
        T = self._link_poses[self._row]
        world = T @ self._local
        self.R, self.t = world[:, :3, :3], world[:, :3, 3]
        self.centers = np.einsum("nij,nj->ni", T[:, :3, :3], self._centers) + T[:, :3, 3]
        self.witnesses = np.einsum("nij,nj->ni", T[:, :3, :3], self._witness) + T[:, :3, 3]

    def shape(self, i: int) -> Shape:
        """Return a solid's shape, moved to where `place` put it."""
        shape = self.solids[i].shape
        shape.place(self.R[i], self.t[i])
        return shape

    def to_link(self, i: int, points: Points) -> Points:
        """Express world points in the frame of a solid's link."""
        T = self._link_poses[self._row[i]]
        return (points - T[:3, 3]) @ T[:3, :3]

    def from_links(self, solids: Int[np.ndarray, "n"], points: Points) -> Points:
        """World positions of points in the frames of the links of some solids."""
        T = self._link_poses[self._row[solids]]
        return np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]

    def points_within(self, i: int, points: Points, reach: Values) -> Iterator[int]:
        """Rows of points (world) that lie in a solid, or within `reach` (metres) of it; those
        that seem deepest first."""
        solid, local = self.solids[i], self.to_link(i, points)
        bound = solid.bound(local) - reach
        rows = np.argsort(bound, kind="stable")
        rows = rows[bound[rows] <= 0.0]
        if solid.primitive is not None:
            yield from rows.tolist()
            return
        shape = self.shape(i)
        for row in rows.tolist():
            if point_within(shape, points[row], float(reach[row])) or solid.holds(local[row]):
                yield row

    def point_gap(self, i: int, point: Vector) -> float:
        """Signed distance from a solid to a point (world), metres; exact."""
        solid, local = self.solids[i], self.to_link(i, point[None])[0]
        if solid.primitive is not None:
            return float(solid.bound(local[None])[0])
        way, _ = point_distance(self.shape(i), point)
        return -way if solid.holds(local) else way

    def plane_gaps(self, plane: Float[np.ndarray, "4"]) -> Values:
        """Signed distance from each solid to the half-space {x : n . x < offset}, exact, metres."""
        return self.lowest_points(plane[:3]) @ plane[:3] - plane[3]

    def lowest_points(self, normal: Vector) -> Float[np.ndarray, "n 3"]:
        """World point of each solid that lies farthest against a direction."""
        local = np.einsum("nij,i->nj", self.R, normal)  # in each solid's frame
        points = -self._balls[:, None] * local - np.sign(local) * self._halves
        across = np.maximum(np.hypot(local[:, 0], local[:, 1]), 1e-300)
        points[:, :2] -= (self._rims / across)[:, None] * local[:, :2]
        lowest = np.einsum("nij,nj->ni", self.R, points) + self.t
        for i in self._meshes:
            T, vertices = self._link_poses[self._row[i]], np.asarray(self.solids[i].vertices)
            farthest = vertices[np.argmin(vertices @ (T[:3, :3].T @ normal))]
            lowest[i] = T[:3, :3] @ farthest + T[:3, 3]
        return lowest

    def pairs(self) -> Int[np.ndarray, "p 2"]:
        """Pairs of solids of the link pairs that the robot tests against each other."""
        of_link = [np.flatnonzero(self.links == k) for k in range(len(self.robot.link_names))]
        pairs = (itertools.product(of_link[a], of_link[b]) for a, b in self.robot.collision_pairs)
        rows = list(itertools.chain.from_iterable(pairs))
        return np.array(rows, dtype=np.int64).reshape(-1, 2)

    def motion_bound(self, delta: Configuration) -> float:
        """Bound the way of any point of any solid while the joints change by `delta`, metres."""
        return float(np.max(np.abs(delta) @ self._levers, initial=0.0))

    def _lever_table(self) -> Float[np.ndarray, "dof links"]:
        """Metres that any point of a link can move per unit of each joint. The table of the checker
        bounds the sphere centres; a solid's farthest point is at most the way to the nearest sphere
        centre and the solid's ball beyond that."""
        arrays = self.robot.arrays
        in_link = _spheres_in_links(self.robot)
        beyond = np.zeros(len(self.robot.link_names))
        for solid in self.solids:
            own = in_link[self.robot.sphere_links == solid.link]
            way = float(np.min(np.linalg.norm(own - solid.center, axis=1)))
            beyond[solid.link] = max(beyond[solid.link], way + solid.radius)
        table = reach_table(arrays)
        turning = (arrays.kind == KIND_REVOLUTE)[:, None]
        levers = np.where(table >= 0.0, table + np.where(turning, beyond, 0.0), 0.0)
        out = np.zeros((self.robot.dof, levers.shape[1]))
        for frame in range(1, len(arrays.parent)):
            out[arrays.q_index[frame]] += abs(arrays.q_mult[frame]) * levers[frame]
        return out


_DEEP = 5.0  # metres: what is under a surface that ends reaches down farther than any robot


@dataclass(frozen=True, eq=False)
class Body:
    """One obstacle with a surface."""

    name: str  # "object:3" or "known:NAME"
    class_index: int  # class of the map (1..C), 0 for known geometry
    shape: Shape  # what FCL is asked about, at its place in the world
    lower: Vector  # lower corner of its box, world axes, metres
    upper: Vector  # upper corner
    witnesses: Float[np.ndarray, "w 3"]  # one point of each connected piece of the surface, world
    # triangles of a closed mesh whose inside counts; None for objects (their inside is the map's
    # to say), primitives (solid to FCL) and open meshes
    closed: np.ndarray | None = None

    def contains(self, point: Vector) -> bool:
        """Whether a point is inside a closed known mesh."""
        if self.closed is None or ((point < self.lower) | (point > self.upper)).any():
            return False
        return abs(winding_number(point, self.closed)) > 0.5


class MeshWorld:
    """Bodies of a world, and where its objects are.

    Attributes:
        bodies: objects in the map's order, then known geometry, then a support surface that ends
            somewhere.
        resolution: edge of the marching cubes, metres.
        meshes: object id -> `trimesh.Trimesh`, world frame.
    """

    def __init__(self, world: Any, resolution: float | None = None) -> None:
        config = world.config
        if resolution is None:
            refinement = lattice_refinement(config.resolution, world.map)
            resolution = config.resolution / refinement
        self.map = world.map
        self.level = float(config.level)
        self.resolution = float(resolution)
        self.meshes = extract_refined_meshes(self.map, self.level, self.resolution)
        self.bodies = [
            mesh_body(f"object:{i}", mesh, class_index=self.map.object_ids.index(i) + 1)
            for i, mesh in self.meshes.items()
        ]
        known = (known_body(item) for item in config.known)
        self.bodies += [body for body in known if body is not None]
        if config.support == "seen" and self.map.plane is not None:
            support = seen_support(self.map.views, self.map.plane)
            self.bodies.append(mesh_body(SUPPORT, _prism(support)))
        self.classes = np.array([body.class_index for body in self.bodies], dtype=np.int64)
        self.lower = np.array([body.lower for body in self.bodies]).reshape(-1, 3)
        self.upper = np.array([body.upper for body in self.bodies]).reshape(-1, 3)

    def box_distances(self, points: Points) -> Float[np.ndarray, "n b"]:
        """Distance from points to the boxes of the bodies, metres: never above that to them."""
        below = self.lower - points[:, None]
        above = points[:, None] - self.upper
        out = np.maximum(np.maximum(below, above), 0.0)
        return np.sqrt(np.einsum("nbi,nbi->nb", out, out))

    def object_at(self, points: Points) -> Int[np.ndarray, "n"]:
        """Class (1..C) of the object that holds each point, 0 if none does. The level set decides,
        not the mesh: a closed surface says nothing to FCL about its inside."""
        owner = np.zeros(len(points), dtype=np.int64)
        to_boxes = self.box_distances(points)[:, self.classes > 0]
        near = np.flatnonzero((to_boxes <= 0.0).any(axis=1))
        if len(near):
            probabilities = np.asarray(self.map.predict_proba(points[near]))
            occupied = probabilities[:, 1:].sum(axis=1) >= self.level
            owner[near] = np.where(occupied, 1 + np.argmax(probabilities[:, 1:], axis=1), 0)
        return owner


def mesh_body(name: str, mesh: Any, class_index: int = 0) -> Body:
    """Wrap a `trimesh.Trimesh` in world coordinates."""
    from trimesh.graph import connected_component_labels

    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    faces = np.asarray(mesh.faces)
    used = vertices[np.unique(faces)]
    piece = connected_component_labels(mesh.edges, node_count=len(vertices))
    _, first = np.unique(piece[faces[:, 0]], return_index=True)
    shape, box = Shape("mesh", mesh=mesh), (used.min(axis=0), used.max(axis=0))
    closed = vertices[faces] if class_index == 0 and mesh.is_watertight else None
    return Body(name, class_index, shape, *box, vertices[faces[first, 0]], closed)


def _prism(support: SeenSupport) -> Any:
    """The space under a support surface that ends, as a closed mesh."""
    import trimesh

    region, normal = support.region, support.plane.normal
    edges = region.halfplanes - np.array([0.0, 0.0, RIM])
    edges = edges[np.argsort(np.arctan2(edges[:, 1], edges[:, 0]))]
    pairs = np.stack([edges, np.roll(edges, -1, axis=0)], axis=1)
    corners = np.linalg.solve(pairs[:, :, :2], -pairs[:, :, 2:])[:, :, 0]
    rim = corners @ region.axes + support.plane.offset * normal
    return trimesh.convex.convex_hull(np.concatenate([rim, rim - _DEEP * normal]))


def known_body(item: Any) -> Body | None:
    """Wrap known geometry; None for half-spaces, which are checked by a formula."""
    name = f"known:{item.name}"
    if isinstance(item, KnownMesh):
        return mesh_body(name, item.mesh)
    pose = np.eye(4)
    if isinstance(item, Sphere):
        shape = Shape("sphere", (item.radius,))
        pose[:3, 3] = item.center
    elif isinstance(item, Box):
        shape = Shape("box", tuple(item.size))
        pose = item.T_world
    elif isinstance(item, Cylinder):
        shape = Shape("cylinder", (item.radius, item.length))
        pose = item.T_world
    else:
        return None
    shape.place(np.array(pose[:3, :3]), np.array(pose[:3, 3]))
    lower, upper = item.box()
    return Body(name, 0, shape, lower, upper, np.array(pose[:3, 3])[None])
