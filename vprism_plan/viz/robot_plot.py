# SPDX-License-Identifier: BSD-3-Clause
"""A robot as its URDF draws it, and the spheres it is checked with laid over that."""

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from vprism_plan.errors import RobotError
from vprism_plan.viz._figures import PALETTE, new_figure, show_picture
from vprism_plan.viz._raster import Film, Layer, View, corners, halved, sphere_ends

if TYPE_CHECKING:
    from vprism_plan.robots import Robot
    from vprism_plan.robots.geometry import MeshFile, PrimitiveGeometry

_PIXELS = 1100  # along the longer side of a view, before averaging
_GREY = np.array([0.72, 0.72, 0.74])
_CLEAR, _OUTLINE = 0.42, 0.85  # how much of a sphere and of its outline is seen


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
    poses = robot.link_poses(q)
    parts = _geometry(robot, poses)
    spheres = _spheres(robot, q, poses)
    ends = [sphere_ends(centers, radii) for centers, radii in spheres]
    points = np.concatenate([*ends, *(triangles.reshape(-1, 3) for triangles, _ in parts)])
    film = Film.around(_view(robot, points), points, _PIXELS)
    solid, over = Layer(film), Layer(film)
    for triangles, normals in parts:
        solid.add_mesh(triangles, normals, _GREY)
    for link, (centers, radii) in enumerate(spheres):
        over.add_spheres(centers, radii, PALETTE[link % len(PALETTE)])
    bare = np.ones((film.height, film.width, 3))
    solid.lay_over(bare, np.ones(solid.depth.shape))
    covered = bare.copy()
    over.lay_over(covered, np.where(over.edges(), _OUTLINE, _CLEAR))
    title = title or f"{robot.name}: {len(robot.sphere_radii)} spheres"
    figure = new_figure(max(2 * 5.4 * film.width / film.height, 6.0), 6.0, title)
    left, right = figure.subplots(1, 2)
    show_picture(left, halved(bare), "collision geometry")
    show_picture(right, halved(covered), "spheres, a colour for each link")
    return figure


def link_meshes(
    meshes: "Mapping[str, Sequence[MeshFile]]",
    geometry: "Mapping[str, Sequence[PrimitiveGeometry]]",
) -> Iterator[tuple[str, str, Any]]:
    """Yield link, name ("mesh0" or "0") and surface, in the link's frame, of all geometry.

    Mesh files that are missing are left out: the robot was given spheres in their place.

    Raises:
        RobotError: a mesh file cannot be read.
    """
    import trimesh

    for link, files in meshes.items():
        for number, file in enumerate(files):
            if file.path is not None:
                yield link, f"mesh{number}", file.mesh()
    for link, solids in geometry.items():
        for number, solid in enumerate(solids):
            corner_lists = trimesh.triangles.to_kwargs(solid.triangles())
            yield link, f"{number}", trimesh.Trimesh(**corner_lists, process=True)


def _spheres(
    robot: "Robot", q: np.ndarray, poses: dict[str, np.ndarray]
) -> list[tuple[np.ndarray, np.ndarray]]:
    """World centres and radii of each link's spheres, without padding and scale."""
    checked = robot.sphere_centers(q)
    spheres = []
    for index, link in enumerate(robot.link_names):
        mine = np.asarray(robot.sphere_links) == index
        centers, radii = checked[mine], robot.sphere_radii[mine]
        if link in robot.link_spheres:  # all but attached objects
            T, rows = poses[link], robot.link_spheres[link]
            centers, radii = rows[:, :3] @ T[:3, :3].T + T[:3, 3], rows[:, 3]
        spheres.append((centers, radii))
    return spheres


def _geometry(robot: "Robot", poses: dict[str, np.ndarray]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Triangles and normals at their corners (n, 3, 3), world, of all links."""
    parts = []
    for link, _, mesh in link_meshes(robot.meshes_as_read, robot.geometry_as_read):
        if not np.isfinite(mesh.vertices).all():
            raise RobotError(f"link '{link}' has geometry that is not finite")
        triangles, normals = corners(mesh)
        if not mesh.is_watertight:
            # Nothing tells the outside of an open surface: it is drawn from both sides.
            triangles = np.concatenate([triangles, triangles[:, ::-1]])
            normals = np.concatenate([normals, -normals[:, ::-1]])
        T = poses[link]
        parts.append((triangles @ T[:3, :3].T + T[:3, 3], normals @ T[:3, :3].T))
    return parts


def _view(robot: "Robot", points: np.ndarray) -> View:
    """A view of all points, from the robot's front right."""
    low, high = points.min(axis=0), points.max(axis=0)
    middle = 0.5 * (low + high)
    forward = robot.base_pose[:3, 0]
    heading = float(np.arctan2(forward[1], forward[0])) - 0.9
    offset = np.array([np.cos(heading), np.sin(heading), 0.35])
    return View(middle + 1.8 * float(np.linalg.norm(high - low)) * offset, middle)
