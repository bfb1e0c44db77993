# SPDX-License-Identifier: BSD-3-Clause
"""A robot as its URDF draws it, and the spheres it is checked with laid over that."""

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from vprism_plan.errors import RobotError
from vprism_plan.viz._figures import PALETTE, new_figure
from vprism_plan.viz._raster import Film, Layer, View, halved

if TYPE_CHECKING:
    from vprism_plan.robots import Robot

_PIXELS = 1100  # along the longer side of a view, before averaging
_GREY = np.array([0.72, 0.72, 0.74])
_CLEAR, _OUTLINE = 0.42, 0.85  # how much of a sphere and of its outline is seen
_SHARP = 0.8  # cosine above which neighbouring faces share a normal


def robot_figure(robot: "Robot", q: Any = None, *, title: str | None = None) -> Figure:
    """Draw a robot's collision geometry, and its spheres over it, link by link.

    Args:
        robot: Attached objects are drawn, padding and scale are not: both are as they were
            read. Links whose mesh files are missing are drawn by their spheres only.
        q: (dof,) configuration; None is `robot.neutral`.
        title: Above both views; None: the robot's name and how many spheres it has.

    Raises:
        RobotError: q does not fit, or a mesh cannot be read.
    """
    q = robot.neutral if q is None else robot.check_configuration(q)
    parts = _geometry(robot, q)
    centers, radii, owners = _spheres(robot, q)
    film = _film(robot, parts, centers, radii)
    bare, over = np.ones((film.height, film.width, 3)), Layer(film)
    solid = Layer(film)
    for triangles, normals in parts:
        solid.add_mesh(triangles, normals, _GREY)
    there = np.isfinite(solid.depth)
    bare[there] = solid.shaded()[there]
    for link in range(len(robot.link_names)):
        mine = owners == link
        over.add_spheres(centers[mine], radii[mine], PALETTE[link % len(PALETTE)])
    covered = bare.copy()
    seen = np.isfinite(over.depth)
    weight = np.where(over.edges(), _OUTLINE, _CLEAR)[seen][:, None]
    covered[seen] = (1.0 - weight) * covered[seen] + weight * over.shaded()[seen]
    wide = film.width / film.height
    figure = new_figure(max(2 * 5.4 * wide, 6.0), 6.0)
    figure.suptitle(title or f"{robot.name}: {len(robot.sphere_radii)} spheres")
    axes = figure.subplots(1, 2)
    names = ("collision geometry", "spheres, a colour for each link")
    for axis, name, picture in zip(axes, names, (bare, covered), strict=True):
        axis.imshow(np.clip(halved(picture), 0.0, 1.0), interpolation="antialiased")
        axis.set_title(name, fontsize=11)
        axis.set_axis_off()
    return figure


def _spheres(robot: "Robot", q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """World centres, radii and links' indices, without padding and scale."""
    checked = robot.sphere_centers(q)
    poses = robot.link_poses(q)
    parts = []
    for index, link in enumerate(robot.link_names):
        mine = np.asarray(robot.sphere_links) == index
        centers, radii = checked[mine], robot.sphere_radii[mine]
        if link in robot.link_spheres:  # all but attached objects
            T, rows = poses[link], robot.link_spheres[link]
            centers, radii = rows[:, :3] @ T[:3, :3].T + T[:3, 3], rows[:, 3]
        parts.append((centers, radii, np.full(len(radii), index)))
    return tuple(np.concatenate(column) for column in zip(*parts, strict=True))  # type: ignore[return-value]


def _geometry(robot: "Robot", q: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Triangles and normals at their corners (n, 3, 3), world, of all links."""
    import trimesh

    poses = robot.link_poses(q)
    parts = []
    for link, T in poses.items():
        meshes = [
            mesh.mesh() for mesh in robot.meshes_as_read.get(link, ()) if mesh.path is not None
        ]
        for solid in robot.geometry_as_read.get(link, ()):
            triangles = solid.triangles()
            meshes.append(trimesh.Trimesh(**trimesh.triangles.to_kwargs(triangles), process=True))
        for mesh in meshes:
            if not np.isfinite(mesh.vertices).all():
                raise RobotError(f"link '{link}' has geometry that is not finite")
            triangles, normals = _corners(mesh)
            parts.append((triangles @ T[:3, :3].T + T[:3, 3], normals @ T[:3, :3].T))
    return parts


def _corners(mesh: Any) -> tuple[np.ndarray, np.ndarray]:
    triangles = np.asarray(mesh.triangles, dtype=np.float64)
    own = np.repeat(np.asarray(mesh.face_normals)[:, None], 3, axis=1)
    smooth = np.asarray(mesh.vertex_normals)[np.asarray(mesh.faces)]
    alike = np.einsum("ijk,ijk->ij", own, smooth) > _SHARP
    normals = np.where(alike[..., None], smooth, own)
    if mesh.is_watertight:
        return triangles, normals
    # Nothing tells the outside of an open surface: it is drawn from both sides.
    return (
        np.concatenate([triangles, triangles[:, ::-1]]),
        np.concatenate([normals, -normals[:, ::-1]]),
    )


def _film(
    robot: "Robot",
    parts: list[tuple[np.ndarray, np.ndarray]],
    centers: np.ndarray,
    radii: np.ndarray,
) -> Film:
    around = np.concatenate([np.eye(3), -np.eye(3)])
    ends = centers[:, None] + radii[:, None, None] * around
    points = np.concatenate([ends.reshape(-1, 3), *(part.reshape(-1, 3) for part, _ in parts)])
    low, high = points.min(axis=0), points.max(axis=0)
    middle = 0.5 * (low + high)
    forward = robot.base_pose[:3, 0]
    heading = float(np.arctan2(forward[1], forward[0])) - 0.9
    offset = np.array([np.cos(heading), np.sin(heading), 0.35])
    view = View(middle + 1.8 * float(np.linalg.norm(high - low)) * offset, middle)
    flat = view.project(points)
    pad = 0.03 * float((flat.max(axis=0) - flat.min(axis=0)).max())
    lower, upper = flat.min(axis=0) - pad, flat.max(axis=0) + pad
    return Film(view, lower, upper, _PIXELS / float((upper - lower).max()))
