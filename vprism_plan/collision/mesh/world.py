# SPDX-License-Identifier: BSD-3-Clause
"""The surfaces of a world as FCL shapes: extracted objects and known geometry."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from vprism_plan.collision.mesh.fcl import Shape
from vprism_plan.world.config import Box, Cylinder, KnownMesh, Sphere
from vprism_plan.world.levelset import lattice_refinement
from vprism_plan.world.marks import winding_number
from vprism_plan.world.meshes import extract_refined_meshes
from vprism_plan.world.seen import RIM, SeenSupport, seen_support
from vprism_plan.world.sources import SUPPORT

_DEEP = 5.0  # metres: what is under a surface that ends reaches down farther than any robot


@dataclass(frozen=True, eq=False)
class Body:
    """One obstacle with a surface.

    Attributes:
        name: "object:3" or "known:NAME".
        class_index: class of the map (1..C), 0 for known geometry.
        shape: what FCL is asked about, at its place in the world.
        lower: lower corner of its box, world axes, metres.
        upper: upper corner.
        witnesses: (w, 3) one point of each connected piece of the surface, world.
        closed: (f, 3, 3) triangles of a closed mesh whose inside counts; None for objects
            (their inside is the map's to say), primitives (solid to FCL) and open meshes.
    """

    name: str
    class_index: int
    shape: Shape
    lower: Float[np.ndarray, "3"]
    upper: Float[np.ndarray, "3"]
    witnesses: Float[np.ndarray, "w 3"]
    closed: np.ndarray | None = None

    def contains(self, point: Float[np.ndarray, "3"]) -> bool:
        """Whether a point is inside a closed known mesh."""
        if self.closed is None or ((point < self.lower) | (point > self.upper)).any():
            return False
        return abs(winding_number(point, self.closed)) > 0.5


class MeshWorld:
    """Bodies of a world, and where its objects are.

    Attributes:
        bodies: objects in the map's order, then known geometry, then a support surface that
            ends somewhere.
        resolution: edge of the marching cubes, metres.
        meshes: object id -> `trimesh.Trimesh`, world frame.
    """

    def __init__(self, world: Any, resolution: float | None = None) -> None:
        config = world.config
        if resolution is None:
            refinement = lattice_refinement(config.resolution, world.map.kernel_length)
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

    def box_distances(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n b"]:
        """Distance from points to the boxes of the bodies, metres: never above that to them."""
        below = self.lower - points[:, None]
        above = points[:, None] - self.upper
        out = np.maximum(np.maximum(below, above), 0.0)
        return np.sqrt(np.einsum("nbi,nbi->nb", out, out))

    def object_at(self, points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n"]:
        """Class (1..C) of the object that holds each point, 0 if none does.

        The level set decides, not the mesh: a closed surface says nothing to FCL about
        its inside.
        """
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
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    faces = np.asarray(mesh.faces)
    used = vertices[np.unique(faces)]
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    joined = coo_array((np.ones(len(edges)), tuple(edges.T)), shape=(len(vertices),) * 2)
    _, piece = connected_components(joined, directed=False)
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
