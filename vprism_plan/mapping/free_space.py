# SPDX-License-Identifier: BSD-3-Clause
"""Which lattice nodes the cameras made superfluous: far inside space they saw to be empty."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import minimum_filter
from scipy.spatial import cKDTree

from vprism_plan.perception.camera import invert_transform, project, transform_points
from vprism_plan.perception.observation import Observation
from vprism_plan.perception.plane import Plane

# Metres above the support surface up to which an unlabelled point may be of it: noise at table
# range. What is lower than that casts no shadow that a lattice of centimetres could show.
_ON_PLANE = 0.01


def needed_nodes(
    nodes: Float[np.ndarray, "n 3"],
    views: Sequence[Observation],
    plane: Plane,
    surface: Float[np.ndarray, "s 3"],
    spacing: float,
    margin: float,
) -> Bool[np.ndarray, " n"]:
    """Return which lattice nodes (m, world) have more to tell than "empty, as seen".

    Needed is a node within `margin` (m) of an object's observed surface, a node whose
    cell no view saw through, and a node beside such a cell: what bounds a shadow is
    learned from both of its sides. Cells under the support plane count as seen.

    Args:
        nodes: of a cubic lattice.
        views: posed observations.
        plane: support surface, world frame.
        surface: observed points of the objects (m, world).
        spacing: edge of the lattice's cell, m.
        margin: m.
    """
    empty = plane.signed_distance(nodes) < 0.0
    for view in views:
        empty |= _seen_through(nodes, view, plane, 0.5 * spacing)
    near, _ = cKDTree(surface).query(nodes, distance_upper_bound=margin)
    needed = np.isfinite(near)
    if not empty.all():
        # 1.8 spacings take in the 26 neighbours, the farthest at sqrt(3).
        beside, _ = cKDTree(nodes[~empty]).query(nodes, distance_upper_bound=1.05 * spacing)
        needed |= np.isfinite(beside)
    return needed


def _seen_through(
    nodes: Float[np.ndarray, "n 3"], view: Observation, plane: Plane, radius: float
) -> Bool[np.ndarray, " n"]:
    """Whether every pixel around a node's image shows something behind the node's cell.

    The support surface counts as behind all that stands on it. A pixel without a return
    shows nothing, and outside the image nothing was seen.
    """
    local = transform_points(invert_transform(view.pose), nodes)
    pixels, z = project(local, view.intrinsics)
    height, width = view.depth.shape
    with np.errstate(invalid="ignore"):
        column, row = np.rint(pixels).T
        inside = (z > 2.0 * radius) & (column >= 0) & (column < width)
        inside &= (row >= 0) & (row < height)
    seen = np.zeros(len(nodes), dtype=bool)
    if not inside.any():
        return seen
    focal = max(float(view.intrinsics[0, 0]), float(view.intrinsics[1, 1]))
    window = 2 * int(np.ceil(focal * radius / z[inside].min())) + 1
    nearest = minimum_filter(_depth_behind(view, plane), window, mode="nearest")
    at = nearest[row[inside].astype(np.int64), column[inside].astype(np.int64)]
    seen[inside] = at > z[inside] + radius
    return seen


def _depth_behind(view: Observation, plane: Plane) -> Float[np.ndarray, "h w"]:
    """Depth of what each pixel shows, m; inf where that is the support surface."""
    depth = np.array(view.depth, dtype=np.float64)
    points, labels = view.points()
    valid = depth > 0.0
    bare = (labels == 0) & ~view.sees_robot[valid] & (plane.signed_distance(points) < _ON_PLANE)
    depth[valid] = np.where(bare, np.inf, depth[valid])
    return depth
