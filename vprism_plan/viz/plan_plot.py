# SPDX-License-Identifier: BSD-3-Clause
"""The plan as a picture: objects, the robot from start to goal, the path of the hand."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from vprism_plan.viz._figures import new_figure, object_color
from vprism_plan.viz._painter import Painter, View, sheet, unit_sphere

if TYPE_CHECKING:
    import trimesh

    from vprism_plan.robots import Robot

START_COLOR = (0.16, 0.44, 0.70)
GOAL_COLOR = (0.85, 0.45, 0.13)
_HAND_COLOR = (0.72, 0.05, 0.35)
_TABLE_COLOR = (0.86, 0.85, 0.82)


def plan_figure(
    meshes: "Mapping[int, trimesh.Trimesh]",
    robot: "Robot",
    path: Float[np.ndarray, "t dof"],
    *,
    table_height: float = 0.0,
    camera_center: Float[np.ndarray, "3"] | None = None,
    ghosts: int = 4,
    title: str | None = None,
) -> Figure:
    """Draw the map's objects and the robot's collision spheres along a path, from two views.

    Args:
        meshes: object id to surface, world frame, metres.
        robot: supplies the spheres; its base must stand where it was planned.
        path: waypoints in joint space; drawn at equal joint-space arc length.
        table_height: z of the table top, metres.
        camera_center: the camera that saw the scene, drawn as a marker if given.
        ghosts: how many poses between start and goal are drawn, clear.
        title: above both views.
    """
    dense = resample(path, 60)
    centers = sphere_centers(robot, dense)
    middle, size = _extent(meshes, centers)
    painter = _compose(meshes, robot, centers, dense, ghosts)
    table = _table(middle, size, table_height)
    figure = new_figure(13.2, 6.4)
    axes = figure.subplots(1, 2)
    if title:
        figure.suptitle(title)
    base = robot.base_pose[:3, 3]
    sideways = middle[:2] - base[:2]
    sideways /= max(float(np.linalg.norm(sideways)), 1e-9)
    heading = float(np.arctan2(sideways[1], sideways[0]))
    for axis, (name, turn, height) in zip(
        axes,
        (("facing the robot", 0.45, 0.45), ("from above, behind the robot", 2.75, 0.85)),
        strict=True,
    ):
        angle = heading + turn
        offset = np.array(
            [np.cos(angle) * np.cos(height), np.sin(angle) * np.cos(height), np.sin(height)]
        )
        view = View(middle + 2.6 * size * offset, middle)
        table.paint(axis, view)
        painter.paint(axis, view)
        _fit(axis, view, meshes, centers, table_height)
        _mark(axis, view, camera_center)
        axis.set_title(name, fontsize=11)
    _legend(figure, meshes)
    return figure


def resample(path: Float[np.ndarray, "t dof"], count: int) -> Float[np.ndarray, "count dof"]:
    """Return `count` configurations at equal joint-space arc length along a path."""
    path = np.asarray(path, dtype=np.float64)
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    if along[-1] == 0.0:
        return np.repeat(path[:1], count, axis=0)
    at = np.linspace(0.0, along[-1], count)
    return np.stack([np.interp(at, along, column) for column in path.T], axis=1)


def sphere_centers(robot: "Robot", path: Float[np.ndarray, "t dof"]) -> Float[np.ndarray, "t s 3"]:
    """Return the world centres (metres) of all collision spheres along a path."""
    import torch

    with torch.no_grad():
        return robot.sphere_centers(torch.as_tensor(path, dtype=torch.float64)).numpy()


def hand_path(robot: "Robot", path: Float[np.ndarray, "t dof"]) -> Float[np.ndarray, "t 3"]:
    """Return the middle of the last link's spheres along a path, world frame, metres."""
    last = int(np.max(robot.sphere_links))
    return sphere_centers(robot, path)[:, np.asarray(robot.sphere_links) == last].mean(axis=1)


def _extent(
    meshes: "Mapping[int, trimesh.Trimesh]", centers: np.ndarray
) -> tuple[np.ndarray, float]:
    points = [centers.reshape(-1, 3), *(np.asarray(mesh.vertices) for mesh in meshes.values())]
    everything = np.concatenate(points)
    low, high = everything.min(axis=0), everything.max(axis=0)
    return 0.5 * (low + high), float(np.linalg.norm(high - low)) / 2


def _table(middle: np.ndarray, size: float, height: float) -> Painter:
    table = Painter()
    reach = 0.95 * size
    table.add(sheet(middle[:2] - reach, middle[:2] + reach, height, 14), _TABLE_COLOR, ambient=1.0)
    return table


def _compose(
    meshes: "Mapping[int, trimesh.Trimesh]",
    robot: "Robot",
    centers: np.ndarray,
    dense: np.ndarray,
    ghosts: int,
) -> Painter:
    painter = Painter()
    for object_id, mesh in meshes.items():
        triangles = np.asarray(mesh.triangles, dtype=np.float64)
        normals = np.asarray(mesh.vertex_normals)[np.asarray(mesh.faces)].mean(axis=1)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        painter.add(triangles, tuple(object_color(object_id)), normals=normals)
    radii = np.asarray(robot.sphere_radii)
    fine, coarse = unit_sphere(2), unit_sphere(1)
    for index in np.linspace(0, len(dense) - 1, ghosts + 2).astype(int)[1:-1]:
        share = index / (len(dense) - 1)
        color = tuple((1 - share) * np.array(START_COLOR) + share * np.array(GOAL_COLOR))
        _add_spheres(painter, coarse, centers[index], radii, (*color, 0.13))
    fixed = np.linalg.norm(centers[0] - centers[-1], axis=1) < 1e-6
    _add_spheres(painter, fine, centers[0][fixed], radii[fixed], (0.62, 0.62, 0.64))
    _add_spheres(painter, fine, centers[0][~fixed], radii[~fixed], START_COLOR)
    _add_spheres(painter, fine, centers[-1][~fixed], radii[~fixed], GOAL_COLOR)
    painter.add_tube(hand_path(robot, dense), 0.006, _HAND_COLOR)
    return painter


def _add_spheres(
    painter: Painter,
    ball: np.ndarray,
    centers: np.ndarray,
    radii: np.ndarray,
    color: Sequence[float],
) -> None:
    for center, radius in zip(centers, radii, strict=True):
        normals = ball.mean(axis=1)
        normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        painter.add(center + radius * ball, tuple(color), normals=normals)


def _fit(
    axis: Axes,
    view: View,
    meshes: "Mapping[int, trimesh.Trimesh]",
    centers: np.ndarray,
    table_height: float,
) -> None:
    points = np.concatenate(
        [centers.reshape(-1, 3), *(np.asarray(mesh.vertices) for mesh in meshes.values())]
    )
    shadow = points.copy()
    shadow[:, 2] = table_height
    flat, _ = view.project(np.concatenate([points, shadow]))
    low, high = flat.min(axis=0), flat.max(axis=0)
    pad = 0.06 * float((high - low).max())
    axis.set_xlim(low[0] - pad, high[0] + pad)
    axis.set_ylim(low[1] - pad, high[1] + pad)


def _mark(axis: Axes, view: View, camera_center: np.ndarray | None) -> None:
    if camera_center is None:
        return
    flat, _ = view.project(np.asarray(camera_center, dtype=np.float64)[None])
    (x0, x1), (y0, y1) = axis.get_xlim(), axis.get_ylim()
    if x0 < flat[0, 0] < x1 and y0 < flat[0, 1] < y1:
        axis.plot(*flat[0], marker="^", color="black", markersize=8)
        axis.annotate("camera", flat[0], xytext=(6, 4), textcoords="offset points", fontsize=9)


def _legend(figure: Figure, meshes: "Mapping[int, trimesh.Trimesh]") -> None:
    entries: list[Patch | Line2D] = [
        Patch(color=START_COLOR, label="start"),
        Patch(color=GOAL_COLOR, label="goal"),
        Line2D([], [], color=_HAND_COLOR, linewidth=3, label="path of the hand"),
    ]
    entries += [Patch(color=tuple(object_color(k)), label=f"object {k}") for k in sorted(meshes)]
    figure.legend(handles=entries, loc="outside lower center", ncols=min(len(entries), 10))
