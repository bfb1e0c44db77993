# SPDX-License-Identifier: BSD-3-Clause
"""The plan as a picture: objects, the robot from start to goal, the path of the hand."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from vprism_plan.viz._figures import legend, line, new_figure, object_color, show_picture
from vprism_plan.viz._raster import Film, Layer, View, corners, ground, halved, sphere_ends

if TYPE_CHECKING:
    import trimesh

    from vprism_plan.robots import Robot

START_COLOR = (0.16, 0.44, 0.70)
GOAL_COLOR = (0.85, 0.45, 0.13)
HAND_COLOR = (0.72, 0.05, 0.35)
_BASE_COLOR = (0.66, 0.66, 0.68)
_PIXELS = 1120  # along the longer side of a view, before averaging
_CLEAR = 0.16  # how much of a pose in between is seen


@dataclass(frozen=True, eq=False)
class _Stage:
    """Everything that is drawn, in world coordinates."""

    meshes: "Mapping[int, trimesh.Trimesh]"
    centers: np.ndarray  # (t, s, 3) spheres along the path
    radii: np.ndarray
    fixed: np.ndarray  # (s,) spheres that no joint moves
    hand: np.ndarray  # (t, 3)
    table: float
    ghosts: np.ndarray  # rows of `centers` drawn clear

    def points(self) -> np.ndarray:
        """Return points that must be in the picture, and their shadows on the table."""
        shown = sphere_ends(self.centers[[0, *self.ghosts, -1]], self.radii)
        points = np.concatenate([shown, *(np.asarray(m.vertices) for m in self.meshes.values())])
        shadow = points.copy()
        shadow[:, 2] = self.table
        return np.concatenate([points, shadow])


def plan_figure(
    meshes: "Mapping[int, trimesh.Trimesh]",
    robot: "Robot",
    path: Float[np.ndarray, "t dof"],
    *,
    table_height: float = 0.0,
    ghosts: int = 3,
    title: str | None = None,
) -> Figure:
    """Draw the map's objects and the robot's collision spheres along a path, from two views.

    Args:
        meshes: object id to surface, world frame, metres.
        robot: supplies the spheres; its base must stand where it was planned.
        path: waypoints in joint space; drawn at equal joint-space arc length.
        table_height: z of the table top, metres.
        ghosts: how many poses between start and goal are drawn, clear.
        title: above both views.
    """
    dense = resample(path, 120)
    stage = _Stage(
        meshes,
        robot.sphere_centers(dense),
        np.asarray(robot.sphere_radii),
        np.asarray(robot.fixed_links)[np.asarray(robot.sphere_links)],
        hand_path(robot, dense),
        table_height,
        np.linspace(0, len(dense) - 1, ghosts + 2).astype(int)[1:-1],
    )
    points = stage.points()
    low, high = points.min(axis=0), points.max(axis=0)
    middle = 0.5 * (low + high)
    middle[2] = table_height + 0.45 * (high[2] - table_height)
    distance = 2.2 * float(np.linalg.norm(high - low)) / 2
    ahead = middle[:2] - robot.base_pose[:2, 3]
    heading = float(np.arctan2(ahead[1], ahead[0]))
    pictures = {}
    for name, turn, rise in (("facing the robot", 0.30, 0.42), ("from above", 0.0, 1.15)):
        angle = heading + turn
        offset = [np.cos(angle) * np.cos(rise), np.sin(angle) * np.cos(rise), np.sin(rise)]
        view = View(middle + distance * np.array(offset), middle)
        pictures[name] = _render(stage, points, view)
    shapes = [picture.shape[1] / picture.shape[0] for picture in pictures.values()]
    figure = new_figure(max(5.6 * sum(shapes) + 0.4, 8.0), 6.6, title)
    axes = figure.subplots(1, 2, gridspec_kw={"width_ratios": shapes})
    for axis, (name, picture) in zip(axes, pictures.items(), strict=True):
        show_picture(axis, picture, name)
    entries = [
        Patch(color=START_COLOR, label="start"),
        Patch(color=GOAL_COLOR, label="goal"),
        line("path of the hand", color=HAND_COLOR, linewidth=3),
        *(Patch(color=tuple(object_color(k)), label=f"object {k}") for k in sorted(meshes)),
    ]
    legend(figure, entries, max(1, int(figure.get_figwidth() / 1.7)))
    return figure


def _render(stage: _Stage, points: np.ndarray, view: View) -> np.ndarray:
    """Return one view as an image (h, w, 3) in 0..1."""
    film = Film.around(view, points, _PIXELS)
    solid = Layer(film)
    for object_id, mesh in stage.meshes.items():
        solid.add_mesh(*corners(mesh), object_color(object_id))
    start, goal, fixed, moving = stage.centers[0], stage.centers[-1], stage.fixed, ~stage.fixed
    solid.add_spheres(start[fixed], stage.radii[fixed], _BASE_COLOR)
    solid.add_spheres(start[moving], stage.radii[moving], START_COLOR)
    solid.add_spheres(goal[moving], stage.radii[moving], GOAL_COLOR)
    picture, table = ground(film, stage.table, *_shade(stage, points[:, :2]))
    seen = solid.depth < table
    picture[seen] = solid.shaded()[seen]
    behind = np.minimum(table, solid.depth)
    for row in stage.ghosts:
        share = row / (len(stage.centers) - 1)
        color = (1 - share) * np.array(START_COLOR) + share * np.array(GOAL_COLOR)
        ghost = Layer(film)
        ghost.add_spheres(stage.centers[row][moving], stage.radii[moving], color)
        clear = np.where(ghost.edges(), 2.5 * _CLEAR, _CLEAR)
        ghost.lay_over(picture, clear, ghost.depth < behind)
    length = float(np.linalg.norm(np.diff(stage.hand, axis=0), axis=1).sum())
    # So close together that beads look like a tube.
    beads = resample(stage.hand, max(2, int(length / 0.004)))
    hand = Layer(film)
    hand.add_spheres(beads, np.full(len(beads), 0.008), HAND_COLOR)
    hand.lay_over(picture, np.where(hand.depth < behind, 1.0, 0.35))
    return halved(picture)


def _shade(stage: _Stage, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the table's rectangle and its brightness under what stands over it."""
    from scipy.ndimage import gaussian_filter

    low, high = points.min(axis=0) - 0.12, points.max(axis=0) + 0.12
    cell = 0.006
    shape = tuple(int(n) for n in np.ceil((high - low) / cell) + 1)
    covered = np.zeros(shape)
    x, y = (low[k] + cell * np.arange(shape[k]) for k in range(2))
    for centers in (stage.centers[0], stage.centers[-1]):
        for center, radius in zip(centers, stage.radii, strict=True):
            near = (x[:, None] - center[0]) ** 2 + (y[None] - center[1]) ** 2 < radius**2
            covered[near] = np.maximum(covered[near], 0.16)
    for mesh in stage.meshes.values():
        spots = np.round((np.asarray(mesh.triangles_center)[:, :2] - low) / cell).astype(int)
        covered[spots[:, 0], spots[:, 1]] = 0.4
    return low, high, 1.0 - gaussian_filter(covered, 0.014 / cell)


def resample(path: Float[np.ndarray, "t dof"], count: int) -> Float[np.ndarray, "count dof"]:
    """Return `count` configurations at equal joint-space arc length along a path."""
    path = np.asarray(path, dtype=np.float64)
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    at = np.linspace(0.0, along[-1], count)
    return np.stack([np.interp(at, along, column) for column in path.T], axis=1)


def hand_path(robot: "Robot", path: Float[np.ndarray, "t dof"]) -> Float[np.ndarray, "t 3"]:
    """Return the middle of the last link's spheres along a path, world frame, metres."""
    last = int(np.max(robot.sphere_links))
    return robot.sphere_centers(path)[:, np.asarray(robot.sphere_links) == last].mean(axis=1)
