# SPDX-License-Identifier: BSD-3-Clause
"""The few calls of FCL that can be trusted, each with what it can and cannot say.

Meshes are hollow to FCL; primitives are solid. What is left out on purpose: its continuous
collision check (crashes or misses with meshes), its managers (a moved object that is not reported
to them is looked for where it was, and exceptions in callbacks are swallowed), and its figures for
a sphere that overlaps a mesh (depth and distance are garbage there; the distance from the sphere's
centre is exact instead), and its signed distance.
"""

from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Float

from vprism_plan._shapes import Vector
from vprism_plan.errors import MissingDependencyError

# A point to FCL, which has none: a ball too small to matter, metres.
_POINT_RADIUS = 1e-9
_MAX_CONTACTS = 256


@cache
def fcl() -> Any:
    """Return the module python-fcl, imported on first use; MissingDependencyError without it."""
    try:
        import fcl as module
    except ImportError as error:
        raise MissingDependencyError(
            "checking against meshes needs FCL; install it with: pip install python-fcl"
        ) from error
    return module


class Shape:
    """A shape FCL can be asked about, at a pose that can be changed: a "sphere", "box" or
    "cylinder" with sizes as for `PrimitiveGeometry`, or a "mesh" (`trimesh.Trimesh`)."""

    def __init__(self, kind: str, size: tuple[float, ...] = (), mesh: Any = None) -> None:
        self.kind = kind
        self.size = size
        self.normals: np.ndarray | None = None
        self.body = fcl().CollisionObject(self._geometry(mesh))
        self._rotation = np.eye(3)
        self.center = np.zeros(3)  # where its own origin is, world frame

    def _geometry(self, mesh: Any) -> Any:
        if self.kind != "mesh":
            return getattr(fcl(), self.kind.capitalize())(*map(float, self.size))
        from trimesh.collision import mesh_to_BVH

        self.normals = np.asarray(mesh.face_normals)
        return mesh_to_BVH(mesh)

    @property
    def hollow(self) -> bool:
        """Whether FCL sees only the surface."""
        return self.kind == "mesh"

    def place(self, R: Float[np.ndarray, "3 3"], t: Float[np.ndarray, "3"]) -> None:
        """Move the shape to a pose in the world."""
        self._rotation, self.center = R, t
        self.body.setTransform(fcl().Transform(R, t))

    def to_world(self, point: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """Move a point of the shape's own frame along with it."""
        return self._rotation @ point + self.center

    def normal_of(self, face: int) -> Float[np.ndarray, "3"]:
        """Outward normal of a triangle, world frame."""
        if self.normals is None:
            raise ValueError(f"a {self.kind} has no triangles")
        return self._rotation @ self.normals[face]


def touches(a: Shape, b: Shape) -> bool:
    """Whether two shapes intersect; of a mesh, only its surface counts."""
    return _collide(a.body, b.body) is not None


def _collide(a: Any, b: Any, **wanted: Any) -> Any:
    """FCL's result for two of its objects that touch, else None."""
    result = fcl().CollisionResult()
    return result if fcl().collide(a, b, fcl().CollisionRequest(**wanted), result) else None


def _ball(point: Float[np.ndarray, "3"], radius: float) -> Any:
    return fcl().CollisionObject(fcl().Sphere(radius), fcl().Transform(point))


def gap(a: Shape, b: Shape) -> float:
    """Distance between two shapes, metres; 0.0 where they touch."""
    if touches(a, b):  # FCL's distance is anything between -1 and garbage then
        return 0.0
    module = fcl()
    request, result = module.DistanceRequest(), module.DistanceResult()
    return max(0.0, float(module.distance(a.body, b.body, request, result)))


def signed_gap(a: Shape, b: Shape) -> float:
    """Distance between two shapes, metres; where they touch, minus the way out of solids, 0 of
    meshes. FCL's own signed distance errs by up to 0.2 mm; its distance and its depth do not."""
    touch = None if a.hollow or b.hollow else deepest_touch(a, b)
    return gap(a, b) if touch is None else touch[0]


def point_distance(shape: Shape, point: Vector) -> tuple[float, Vector]:
    """Distance from a point to a mesh's surface, metres, and the nearest point on it (world)."""
    module, ball = fcl(), _ball(point, _POINT_RADIUS)
    # The mesh goes first: FCL swaps the two otherwise, and the points with them.
    if _collide(shape.body, ball) is not None:
        return 0.0, np.array(point)
    result = module.DistanceResult()
    request = module.DistanceRequest(enable_nearest_points=True)
    distance = module.distance(shape.body, ball, request, result)
    # For a sphere FCL gives the mesh's point in the mesh's own frame.
    return float(distance) + _POINT_RADIUS, shape.to_world(np.array(result.nearest_points[0]))


def point_within(shape: Shape, point: Float[np.ndarray, "3"], reach: float) -> bool:
    """Whether a point is within `reach` (metres) of a mesh's surface."""
    return _collide(shape.body, _ball(point, max(reach, _POINT_RADIUS))) is not None


def nearest_points(a: Shape, b: Shape) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """The points (world) at which two shapes that do not touch are nearest to each other."""
    if b.hollow and not a.hollow:
        on_b, on_a = nearest_points(b, a)
        return on_a, on_b
    if a.hollow and b.kind == "sphere":
        way, on_a = point_distance(a, b.center)
        return on_a, b.center + (b.size[0] / max(way, _POINT_RADIUS)) * (on_a - b.center)
    module, result = fcl(), fcl().DistanceResult()
    module.distance(a.body, b.body, module.DistanceRequest(enable_nearest_points=True), result)
    first, second = (np.array(point, dtype=np.float64) for point in result.nearest_points)
    return first, second


def deepest_touch(a: Shape, b: Shape) -> tuple[float, Vector, Vector] | None:
    """Return where two shapes intersect most, or None: minus the depth (metres), where, and the
    unit vector that leads from the first to the second, world.

    Between solids the depth is the way out; for a sphere and a mesh, how far the surface reaches
    into the sphere. For other shapes and a mesh it is FCL's figure for the deepest triangle, which
    is local: it says how far the solid reaches through one triangle, not how far it has to move. A
    mesh's normal is the triangle's own.
    """
    result = _collide(a.body, b.body, num_max_contacts=_MAX_CONTACTS, enable_contact=True)
    if result is None:
        return None
    found = max(result.contacts, key=lambda contact: float(contact.penetration_depth))
    depth = max(0.0, float(found.penetration_depth))
    normal = np.array(found.normal, dtype=np.float64)
    # FCL puts a mesh first, whatever the order of the call.
    if a.hollow:
        normal = a.normal_of(int(found.b1))
    elif b.hollow:
        normal = -b.normal_of(int(found.b1))
    ball = next((shape for shape in (a, b) if shape.kind == "sphere"), None)
    mesh = next((shape for shape in (a, b) if shape.hollow), None)
    if ball is not None and mesh is not None:
        depth = max(0.0, ball.size[0] - point_distance(mesh, ball.center)[0])
    return -depth, np.array(found.pos, dtype=np.float64), normal
