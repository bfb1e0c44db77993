# SPDX-License-Identifier: BSD-3-Clause
"""Meshes as the generator uses them: read once, cleaned, then scaled per scene."""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from vprism_plan.errors import ConfigError, MissingDependencyError

if TYPE_CHECKING:
    import trimesh

MESH_SUFFIXES = (".obj", ".ply", ".stl", ".off", ".glb", ".gltf", ".dae")
_MILLIMETRE = 0.001
_SEAM = 1.0005  # pieces of one object grow by this, so that faces they share overlap


@dataclass(frozen=True, eq=False)
class Shape:
    """A triangle mesh in its own frame, the middle of its box at the origin, metres.

    Attributes:
        name: where it comes from.
        vertices: corners; each is a whole float32 number of millimetres, which is what
            a BOP model file holds, so that saving loses nothing.
        faces: corners of each triangle, counter-clockwise from outside.
        hull: indices of the vertices of the convex hull.
    """

    name: str
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    hull: Int[np.ndarray, " h"]

    @property
    def extents(self) -> Float[np.ndarray, "3"]:
        """Edge lengths of the box around it, metres."""
        return np.asarray(np.ptp(self.vertices, axis=0))

    @cached_property
    def fill(self) -> float:
        """Volume as a share of the convex hull's; small for thin shells and lattices."""
        from scipy.spatial import ConvexHull

        volume = _volume(self.vertices, self.faces)
        return volume / float(ConvexHull(self.vertices[self.hull]).volume)

    def scaled(self, factor: float) -> "Shape":
        """Return it `factor` times as large, the middle of its box at the origin."""
        corners = self.vertices * factor
        middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
        return Shape(self.name, file_precision(corners - middle), self.faces, self.hull)


def file_precision(vertices: np.ndarray) -> np.ndarray:
    """Round metres to what float32 millimetres hold; the result rounds to itself."""
    return from_millimetres(to_millimetres(vertices))


def to_millimetres(vertices: np.ndarray) -> np.ndarray:
    """Return float32 millimetres of metres."""
    return (vertices / _MILLIMETRE).astype(np.float32)


def from_millimetres(vertices: np.ndarray) -> np.ndarray:
    """Return metres of float32 millimetres."""
    return vertices.astype(np.float64) * _MILLIMETRE


def _volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Return the enclosed volume, negative inside out (trimesh's divides by it, and warns)."""
    a, b, c = (vertices - vertices.mean(axis=0))[faces].transpose(1, 0, 2)
    return float((a * np.cross(b, c)).sum()) / 6.0


@lru_cache(maxsize=2048)
def read_shape(path: Path) -> Shape:
    """Read a mesh file; one process reads each file once.

    Raises:
        ConfigError: the file is no mesh, is empty, has corners that are not numbers, or
            is flat.
    """
    import trimesh

    try:
        mesh = trimesh.load_mesh(path, process=False)
    # Every format's reader of trimesh fails in its own way on a damaged file.
    except Exception as error:
        raise ConfigError(f"{path} is not a readable mesh: {error}; remove or mend it") from error
    return shape_of(mesh, str(path))


def shape_of(mesh: "trimesh.Trimesh", name: str) -> Shape:
    """Return the outer surface of a mesh as a shape; raises ConfigError if it has no volume.

    A mesh of several closed pieces (a convex decomposition, say) is replaced by the
    surface of their union: the faces between the pieces are no surface of the object.
    Any other mesh keeps its triangles, holes included. Inside-out meshes are turned.
    """
    from scipy.spatial import ConvexHull, QhullError

    if len(getattr(mesh, "faces", ())) == 0:
        raise ConfigError(f"{name} has no triangles; remove it from the folder")
    if not np.isfinite(mesh.vertices).all():
        raise ConfigError(f"{name} has corners that are not finite numbers; remove or mend it")
    mesh = _outer_surface(mesh)
    largest = float(np.ptp(mesh.vertices, axis=0).max())
    if largest <= 0.0:
        raise ConfigError(f"{name} is a single point; remove it from the folder")
    vertices = np.ascontiguousarray(mesh.vertices, dtype=np.float64)
    try:
        # Qhull's tolerances are absolute: a mesh in kilometres is as good as one in metres.
        hull = np.sort(ConvexHull(vertices / largest).vertices)
    except QhullError as error:
        raise ConfigError(f"{name} is flat: no volume to rest on; remove it") from error
    faces = np.ascontiguousarray(mesh.faces, dtype=np.int64)
    return Shape(name, vertices, faces, hull.astype(np.int64))


def _outer_surface(mesh: "trimesh.Trimesh") -> "trimesh.Trimesh":
    """Unite closed pieces, or merge corners; turn an inside-out mesh."""
    import trimesh

    mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    # Corners that two pieces have in common must stay two, or the pieces hang together.
    pieces = _closed_pieces(mesh)
    if not pieces:
        mesh.merge_vertices()
        mesh.update_faces(mesh.nondegenerate_faces())
        mesh.remove_unreferenced_vertices()
        pieces = _closed_pieces(mesh)
    if len(pieces) > 1:
        if find_spec("manifold3d") is None:
            raise MissingDependencyError(
                "meshes of several pieces are united with manifold3d: pip install manifold3d"
            )
        for piece in pieces:
            middle = piece.bounds.mean(axis=0)
            piece.vertices = (piece.vertices - middle) * _SEAM + middle
        mesh = trimesh.boolean.union(pieces, check_volume=False)
    if _volume(mesh.vertices, mesh.faces) < 0:
        mesh.invert()
    return mesh


def _closed_pieces(mesh: "trimesh.Trimesh") -> "list[trimesh.Trimesh]":
    """Return the connected pieces if all of them are closed and right side out, else none."""
    pieces = list(mesh.split(only_watertight=False))
    closed = all(p.is_watertight and _volume(p.vertices, p.faces) > 0 for p in pieces)
    return pieces if closed else []
