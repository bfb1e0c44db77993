# SPDX-License-Identifier: BSD-3-Clause
"""Collision meshes of a URDF: where their files are, and their triangles in metres."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from vprism_plan._files import reading
from vprism_plan.errors import RobotError
from vprism_plan.robots._mesh_spheres import MOST_BYTES, read_scene, read_triangles

# No link is longer, metres: such a mesh is in millimetres.
_MAX_EXTENT = 20.0
# What rounding makes of triangles without any, as a share of the extent squared.
_NO_AREA = 1e-12
_logger = logging.getLogger(__name__)

PackageDirs = str | Path | Sequence[str | Path] | Mapping[str, str | Path] | None
"""Where packages are: folders that hold them (or are them), or package -> its folder."""


@dataclass(frozen=True, eq=False)
class MeshFile:
    """A mesh that a URDF names as collision geometry; read when it is needed.

    Attributes:
        link: Whose geometry it is.
        filename: As the URDF writes it.
        scale: (3,) factors along the mesh's own axes.
        T_link: (4, 4) pose in the link's frame.
        path: The file, or None if there is none.
        searched: Where it was looked for.
    """

    link: str
    filename: str
    scale: Float[np.ndarray, "3"]
    T_link: Float[np.ndarray, "4 4"]
    path: Path | None
    searched: tuple[str, ...] = ()

    def require(self) -> Path:
        """Return the file.

        Raises:
            RobotError: There is none; the message says where it was looked for.
        """
        if self.path is None:
            raise RobotError(
                f"link '{self.link}' has the mesh '{self.filename}' as collision geometry, and "
                f"there is no such file; looked for {list(self.searched)}. Pass package_dirs= "
                "(folders that hold the packages), or spheres= to do without the mesh"
            )
        return self.path

    def scaled(self, about: Float[np.ndarray, "3"], factor: float) -> MeshFile:
        """The same mesh larger or smaller by a factor, about a point of the link's frame."""
        T = self.T_link.copy()
        T[:3, 3] = about + factor * (T[:3, 3] - about)
        return replace(self, scale=factor * self.scale, T_link=T)

    def mesh(self) -> Any:
        """The mesh as a ``trimesh.Trimesh`` in the link's frame, metres, vertices merged.

        Raises:
            RobotError: See :meth:`require`; or the file cannot be read, holds no triangle
                with an area, or is too large to be in metres.
        """
        path = self.require()
        with reading(path, f"a usable mesh of link '{self.link}'", RobotError, MOST_BYTES):
            return self._local(path)

    def _local(self, path: Path) -> Any:
        import trimesh

        what = f"link '{self.link}'"
        loaded = _loaded(path, what)
        what = f"{what}, '{path}'"
        read_triangles(loaded, what, math.inf)  # before merging, which is for finite vertices
        # Readers keep vertices apart that differ in texture or normal: one point to us.
        local = trimesh.Trimesh(
            np.asarray(loaded.vertices, dtype=np.float64) * self.scale, loaded.faces, process=False
        )
        local.merge_vertices(merge_tex=True, merge_norm=True)
        local.apply_transform(self.T_link)
        if self.scale.prod() < 0.0:
            local.invert()
        extent = float(np.ptp(read_triangles(local, what, _MAX_EXTENT), axis=(0, 1)).max())
        if not local.area > _NO_AREA * extent**2:
            raise RobotError(
                f"{what}: the mesh has no area, its triangles are lines or points; give a mesh "
                "file with a surface, or spheres= for the link"
            )
        return local

    def triangles(self) -> Float[np.ndarray, "f 3 3"]:
        """Triangles in the link's frame, metres; errors as of :meth:`mesh`."""
        return np.asarray(self.mesh().triangles, dtype=np.float64)


def _loaded(path: Path, what: str) -> Any:
    """A file as one mesh, in metres where the file states its unit (COLLADA)."""
    scene = read_scene(path)
    units = scene.units if path.suffix.lower() == ".dae" else None
    mesh = scene.to_mesh()
    if len(mesh.faces) == 0:
        raise RobotError(
            f"{what}: '{path}' holds no triangles; give a mesh file with a surface, or spheres= "
            "for the link"
        )
    if units not in (None, "meters"):
        import trimesh

        mesh.apply_scale(trimesh.units.unit_conversion(units, "meters"))
    return mesh


def find_mesh(
    filename: str, urdf: Path, package_dirs: PackageDirs
) -> tuple[Path | None, list[str]]:
    """Find the file that a URDF's mesh element names.

    ``package://NAME/REST`` is looked for as ``package_dirs`` says, in ROS_PACKAGE_PATH and in
    AMENT_PREFIX_PATH (``share/NAME``), beside each folder above the URDF, and last as
    ``REST`` below each of these folders (a checkout need not have the package's name): that
    may be another package's file, so it is logged, and not done for a package that
    ``package_dirs`` has. Other names are relative to the URDF's folder.

    Args:
        filename: The element's attribute.
        urdf: The URDF file.
        package_dirs: See :data:`PackageDirs`.

    Returns:
        The file or None, and the places where it was looked for.
    """
    scheme, _, rest = filename.rpartition("://")
    folder = urdf.absolute().parent
    guesses: list[Path] = []
    if scheme in ("package", "model"):
        places = _in_packages(rest, folder, package_dirs)
        guesses = [] if _names(package_dirs, rest) else _nameless(rest, folder)
    elif scheme in ("", "file"):
        places = [folder / rest]  # an absolute path replaces the folder
    else:
        places = []
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        found = next((place for place in guesses if place.is_file()), None)
        places = places + guesses
        if found is not None:
            _logger.warning(
                "no package of the name was found for '%s'; '%s' is taken, whose folder is called "
                "otherwise: if that is another package's file, pass package_dirs=",
                *(filename, found),
            )
    return found, [str(place) for place in places] or [filename]


def _in_packages(reference: str, folder: Path, package_dirs: PackageDirs) -> list[Path]:
    package, _, rest = reference.partition("/")
    places: list[Path] = []
    given: Sequence[str | Path]
    if isinstance(package_dirs, Mapping):
        given = []
        if package in package_dirs:
            places.append(Path(package_dirs[package]) / rest)
    elif package_dirs is None:
        given = []
    else:
        given = [package_dirs] if isinstance(package_dirs, str | Path) else package_dirs
    roots = [Path(root) for root in given]
    roots += [Path(p) for p in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if p]
    for root in roots:
        places.append(root / package / rest)
        if root.absolute().name == package:
            places.append(root / rest)
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    places += [Path(prefix) / "share" / package / rest for prefix in prefixes if prefix]
    return places + [parent / package / rest for parent in [folder, *folder.parents]]


def _nameless(reference: str, folder: Path) -> list[Path]:
    rest = reference.partition("/")[2]
    return [parent / rest for parent in [folder, *folder.parents]]


def _names(package_dirs: PackageDirs, reference: str) -> bool:
    """Whether the caller says where the package is."""
    package = reference.partition("/")[0]
    if package_dirs is None or isinstance(package_dirs, Mapping):
        return package in (package_dirs or {})
    given = [package_dirs] if isinstance(package_dirs, str | Path) else package_dirs
    return any(
        Path(root).absolute().name == package or (Path(root) / package).is_dir() for root in given
    )
