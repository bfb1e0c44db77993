# SPDX-License-Identifier: BSD-3-Clause
"""Collision shapes of links: boxes, cylinders, spheres, and meshes of files."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from vprism_plan._files import reading
from vprism_plan._shapes import Points, Pose, Triangles, Values, Vector
from vprism_plan.errors import RobotError
from vprism_plan.robots.plain_xml import refuse_growing_scene

# No link is longer, metres, and nothing that an arm carries: such a mesh is in millimetres.
_LONGEST_LINK, _LONGEST_OBJECT = 20.0, 5.0
_MOST_BYTES = 2**26  # of a mesh file: 64 MiB, or 1.3 million triangles as STL
_MOST_TRIANGLES = 10_000_000
# trimesh also reads archives and formats of its own, which stand for more than they hold.
_FORMATS = (".stl", ".obj", ".dae", ".ply", ".off", ".glb", ".gltf")
# What rounding makes of triangles without any, as a share of the extent squared.
_NO_AREA = 1e-12
_REMEDY = "give a mesh file with a surface, or spheres= for the link"
_logger = logging.getLogger(__name__)

PackageDirs = str | Path | Sequence[str | Path] | Mapping[str, str | Path] | None
"""Where packages are: folders that hold them (or are them), or package -> its folder."""


@dataclass(frozen=True, eq=False)
class MeshFile:
    """A mesh that a URDF names as collision geometry; read when it is needed."""

    link: str  # whose geometry it is
    filename: str  # as the URDF writes it
    scale: Vector  # factors along the mesh's own axes
    T_link: Pose  # in the link's frame
    path: Path | None  # the file, or None if there is none
    searched: tuple[str, ...] = ()  # where it was looked for

    def scaled(self, about: Vector, factor: float) -> MeshFile:
        """The same mesh larger or smaller by a factor, about a point of the link's frame."""
        T = _moved(self.T_link, about, factor)
        return replace(self, scale=factor * self.scale, T_link=T)

    def mesh(self) -> Any:
        """The mesh as a ``trimesh.Trimesh`` in the link's frame, metres, vertices merged.

        Raises:
            RobotError: The file is missing, unreadable, without area, or too large for metres.
        """
        import trimesh

        path, what = self.path, f"link '{self.link}'"
        if path is None:
            raise RobotError(
                f"{what} has the mesh '{self.filename}' as collision geometry, and there is no "
                f"such file; looked for {list(self.searched)}. Pass package_dirs= (folders that "
                "hold the packages), or spheres= to do without the mesh"
            )
        with reading(path, f"a usable mesh of {what}", RobotError, _MOST_BYTES):
            scene = read_scene(path)
            loaded = scene.to_mesh()
            if len(loaded.faces) == 0:
                raise RobotError(f"{what}: '{path}' holds no triangles; {_REMEDY}")
            # COLLADA states its unit.
            if path.suffix.lower() == ".dae" and scene.units not in (None, "meters"):
                loaded.apply_scale(trimesh.units.unit_conversion(scene.units, "meters"))
            what = f"{what}, '{path}'"
            read_triangles(loaded, what, math.inf)  # before merging, which is for finite vertices
            vertices = np.asarray(loaded.vertices, dtype=np.float64) * self.scale
            # Readers keep vertices apart that differ in texture or normal: one point to us.
            local = trimesh.Trimesh(vertices, loaded.faces, process=False)
            local.merge_vertices(merge_tex=True, merge_norm=True)
            local.apply_transform(self.T_link)
            if self.scale.prod() < 0.0:
                local.invert()
            extent = float(np.ptp(read_triangles(local, what, _LONGEST_LINK), axis=(0, 1)).max())
            if not local.area > _NO_AREA * extent**2:
                found = "the mesh has no area, its triangles are lines or points"
                raise RobotError(f"{what}: {found}; {_REMEDY}")
            return local

    def triangles(self) -> Triangles:
        """Triangles in the link's frame, metres; errors as of :meth:`mesh`."""
        return np.asarray(self.mesh().triangles, dtype=np.float64)


def _moved(T_link: Pose, about: Vector, factor: float) -> Pose:
    T = T_link.copy()
    T[:3, 3] = about + factor * (T[:3, 3] - about)
    return T


def find_mesh(
    filename: str, urdf: Path, package_dirs: PackageDirs
) -> tuple[Path | None, list[str]]:
    """Find the file that a URDF's mesh element names.

    ``package://NAME/REST`` is looked for as ``package_dirs`` says, in ROS_PACKAGE_PATH and in
    AMENT_PREFIX_PATH (``share/NAME``), beside each folder above the URDF, and last as
    ``REST`` below each of these folders (a checkout need not have the package's name), which
    is logged, and not done for a package that ``package_dirs`` has. Other names are relative
    to the URDF's folder.

    Returns:
        The file or None, and the places where it was looked for.
    """
    scheme, _, rest = filename.rpartition("://")
    folder = urdf.absolute().parent
    places: list[Path] = []
    guesses: list[Path] = []
    if scheme in ("package", "model"):
        places, guesses = _in_packages(rest, folder, package_dirs)
    elif scheme in ("", "file"):
        places = [folder / rest]  # an absolute path replaces the folder
    every = [*places, *guesses]
    found = next((place for place in every if place.is_file()), None)
    if found is not None and found not in places:
        _logger.warning(
            "no package of the name was found for '%s'; '%s' is taken, whose folder is called "
            "otherwise: if that is another package's file, pass package_dirs=",
            *(filename, found),
        )
    return found, [str(place) for place in every] or [filename]


def _in_packages(
    reference: str, folder: Path, package_dirs: PackageDirs
) -> tuple[list[Path], list[Path]]:
    """Where a package's file may be, and where it may be if no folder has the package's name."""
    package, _, rest = reference.partition("/")
    folders: list[Path] = []
    given: list[Path] = []
    if isinstance(package_dirs, Mapping):
        folders = [Path(package_dirs[package])] if package in package_dirs else []
    elif package_dirs is not None:
        several = [package_dirs] if isinstance(package_dirs, str | Path) else package_dirs
        given = [Path(root) for root in several]
    known = bool(folders) or any(
        root.absolute().name == package or (root / package).is_dir() for root in given
    )
    for root in [*given, *_paths("ROS_PACKAGE_PATH")]:
        folders += [root / package, *([root] if root.absolute().name == package else [])]
    folders += [prefix / "share" / package for prefix in _paths("AMENT_PREFIX_PATH")]
    above = [folder, *folder.parents]
    folders += [parent / package for parent in above]
    return [found / rest for found in folders], [] if known else [up / rest for up in above]


def _paths(variable: str) -> list[Path]:
    return [Path(part) for part in os.environ.get(variable, "").split(os.pathsep) if part]


@dataclass(frozen=True, eq=False)
class PrimitiveGeometry:
    """One solid of a link.

    Attributes:
        kind: ``"box"``, ``"cylinder"`` (axis z, centred) or ``"sphere"``.
        size: Metres. Box: the three edge lengths; cylinder: radius and length;
            sphere: radius.
        T_link: Pose of the solid in its link's frame, (4, 4).
        padding: Metres by which the solid is grown all around: it is every point at most so
            far from the shape of ``size``, so its edges are round.
    """

    kind: Literal["box", "cylinder", "sphere"]
    size: tuple[float, ...]
    T_link: Pose
    padding: float = 0.0

    def signed_distance(self, points: Points) -> Values:
        """Exact signed distance (metres, negative inside) of points in the link's frame."""
        local = (points - self.T_link[:3, 3]) @ self.T_link[:3, :3]
        if self.kind == "sphere":
            return np.linalg.norm(local, axis=1) - self.size[0] - self.padding
        if self.kind == "box":
            excess = np.abs(local) - 0.5 * np.asarray(self.size)
        else:
            radius, length = self.size
            radial = np.linalg.norm(local[:, :2], axis=1) - radius
            excess = np.stack([radial, np.abs(local[:, 2]) - 0.5 * length], axis=1)
        outside = np.linalg.norm(np.maximum(excess, 0.0), axis=1)
        return outside + np.minimum(excess.max(axis=1), 0.0) - self.padding

    def triangles(self, sides: int = 32) -> Triangles:
        """A closed surface around the solid without its padding, link frame, metres.

        Exact for a box. A cylinder becomes a prism around it, a sphere a polyhedron around
        it (of 1280 faces, half a percent larger), so what holds them holds the solid.

        Args:
            sides: Of the prism; its edges stand out by (pi / sides)^2 / 2 of the radius.
        """
        import trimesh

        if self.kind == "box":
            mesh = trimesh.creation.box(self.size)
        elif self.kind == "cylinder":
            radius, length = self.size
            wide = radius / np.cos(np.pi / sides) * (1.0 + 1e-9)
            mesh = trimesh.creation.cylinder(wide, length, sections=sides)
        else:
            mesh = trimesh.creation.icosphere(subdivisions=3)
            nearest = np.einsum("ij,ij->i", mesh.face_normals, mesh.triangles[:, 0]).min()
            mesh.apply_scale(self.size[0] / nearest * (1.0 + 1e-9))
        local = np.asarray(mesh.triangles, dtype=np.float64)
        return local @ self.T_link[:3, :3].T + self.T_link[:3, 3]

    def grown(self, about: Vector, factor: float, padding: float) -> PrimitiveGeometry:
        """The solid scaled about a point of the link's frame, then padded."""
        T, size = _moved(self.T_link, about, factor), tuple(factor * edge for edge in self.size)
        return PrimitiveGeometry(self.kind, size, T, factor * self.padding + padding)

    def bounding_radius(self) -> float:
        """Radius in metres of the ball around the solid's centre that holds it."""
        if self.kind == "sphere":
            return self.size[0] + self.padding
        if self.kind == "box":
            return float(0.5 * np.linalg.norm(self.size)) + self.padding
        return float(np.hypot(self.size[0], 0.5 * self.size[1])) + self.padding


def read_scene(path: Path) -> Any:
    """What a mesh file holds, as a ``trimesh.Scene``; call it inside of `reading`."""
    import trimesh

    format = path.suffix.lower()
    if format not in _FORMATS:
        valid = f"formats that are read: {', '.join(_FORMATS)}"
        raise RobotError(f"'{path}' is a mesh of format {format!r}; {valid}")
    if format == ".dae":
        refuse_growing_scene(path)
    # Processing would cut out vertices that are not finite, and their faces, in silence.
    scene = trimesh.load_scene(path, process=False)
    sizes = {name: len(getattr(part, "faces", ())) for name, part in scene.geometry.items()}
    count = sum(sizes[scene.graph[node][1]] for node in scene.graph.nodes_geometry)
    if count > _MOST_TRIANGLES:
        raise RobotError(f"'{path}' has {count:,} triangles; at most {_MOST_TRIANGLES:,} are read")
    return scene


def read_triangles(mesh: Any, what: str, max_extent: float = _LONGEST_OBJECT) -> Triangles:
    """Triangles of a mesh or of a mesh file, metres.

    Raises:
        RobotError: There is no such file, it holds no triangles, a vertex is not finite,
            or it is larger than `max_extent`.
    """
    if isinstance(mesh, str | Path):
        path = Path(mesh)
        if not path.is_file():
            raise RobotError(f"{what}: no mesh file at '{path}'; give an existing file")
        with reading(path, f"a usable mesh of {what}", RobotError, _MOST_BYTES):
            return read_triangles(read_scene(path).to_mesh(), f"{what}, '{path}'", max_extent)
    vertices = np.asarray(getattr(mesh, "vertices", ()), dtype=np.float64)
    faces = np.asarray(getattr(mesh, "faces", ()))
    if len(vertices) == 0 or len(faces) == 0:
        raise RobotError(
            f"{what}: a {type(mesh).__name__} without triangles; give a trimesh.Trimesh or the "
            "path of a mesh file (for a scene: scene.to_mesh())"
        )
    triangles = vertices[faces]
    if not np.isfinite(triangles).all():
        raise RobotError(f"{what}: the mesh has vertices that are not finite")
    extent = float(np.ptp(triangles.reshape(-1, 3), axis=0).max())
    if not 0.0 < extent <= max_extent:
        raise RobotError(
            f"{what}: the mesh is {extent:.6g} m long; it must be more than 0 and at most "
            f'{max_extent:g} m (a mesh in millimetres: mesh.apply_scale(0.001), or scale="0.001 '
            '0.001 0.001" in a URDF)'
        )
    return np.asarray(triangles, dtype=np.float64)
