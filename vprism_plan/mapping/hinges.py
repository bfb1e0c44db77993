# SPDX-License-Identifier: BSD-3-Clause
"""Hinge points: a lattice around the objects plus random points of their surfaces."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import minimum_filter
from scipy.spatial import cKDTree

from vprism_plan._shapes import Chosen, Points
from vprism_plan.mapping.config import MapConfig
from vprism_plan.perception.camera import invert_transform, project, transform_points
from vprism_plan.perception.observation import Observation
from vprism_plan.perception.plane import Plane


def lattice_hinges(
    lower: Float[np.ndarray, "c 3"],
    upper: Float[np.ndarray, "c 3"],
    normal: Float[np.ndarray, " 3"],
    offset: float,
    config: MapConfig,
    sunk: Bool[np.ndarray, " c"] | None = None,
) -> Float[np.ndarray, "h 3"]:
    """Return the lattice nodes (m, world) around the objects' boxes.

    Nodes are world multiples of `config.hinge_spacing` plus `config.hinge_shift`, so two
    fits of one scene share them. Kept: within `hinge_radius` of a box centre or
    `hinge_margin` of a box, and at most `hinge_depth` under the plane
    {normal . x = offset}, unless the object is `sunk`, lower than that itself.
    """
    sunk = np.zeros(len(lower), dtype=bool) if sunk is None else sunk
    spacing, shift = config.hinge_spacing, np.asarray(config.hinge_shift)
    centers = 0.5 * (lower + upper)
    found: list[np.ndarray] = []
    for low, high, center, lies_lower in zip(lower, upper, centers, sunk, strict=True):
        reach_low = np.minimum(low - config.hinge_margin, center - config.hinge_radius)
        reach_high = np.maximum(high + config.hinge_margin, center + config.hinge_radius)
        first = np.ceil((reach_low - shift) / spacing)
        last = np.floor((reach_high - shift) / spacing)
        axes = [np.arange(a, b + 1.0) for a, b in zip(first, last, strict=True)]
        index = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        nodes = index * spacing + shift
        beyond = np.maximum(np.maximum(low - nodes, nodes - high), 0.0)
        near = np.linalg.norm(nodes - center, axis=1) <= config.hinge_radius
        near |= (config.hinge_margin > 0) & (np.linalg.norm(beyond, axis=1) <= config.hinge_margin)
        if config.hinge_depth is not None and not lies_lower:
            near &= nodes @ normal >= offset - config.hinge_depth
        found.append(index[near])
    index = np.unique(np.concatenate(found), axis=0)
    return index * spacing + shift


def surface_hinges(
    points: Float[np.ndarray, "n 3"],
    labels: Int[np.ndarray, " n"],
    object_ids: tuple[int, ...],
    count: int,
    rng: np.random.Generator,
) -> Float[np.ndarray, "h 3"]:
    """Return up to `count` distinct random points of each object (m, world)."""
    chosen = [np.zeros((0, 3))]
    for object_id in object_ids:
        own = points[labels == object_id]
        chosen.append(own[rng.permutation(len(own))[:count]])
    return np.concatenate(chosen)


def local_features(
    hinges: Points, lower: Points, upper: Points, reach: float | None
) -> Bool[np.ndarray, "k m"]:
    """Return which features each class has: "empty" all, an object those that reach where it is.

    Args:
        hinges: m, world.
        lower, upper: corners of the objects' boxes, m.
        reach: an object has the hinges at most this far from its box, m; None: all.
    """
    members = np.ones((len(lower) + 1, len(hinges) + 1), dtype=bool)
    if reach is not None:
        for own, low, high in zip(members[1:, :-1], lower, upper, strict=True):
            beyond = np.maximum(np.maximum(low - hinges, hinges - high), 0.0)
            own[:] = np.linalg.norm(beyond, axis=1) <= reach
    return members


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


def _seen_through(nodes: Points, view: Observation, plane: Plane, radius: float) -> Chosen:
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
    return depth if view.clear is None else np.where(view.clear == view.depth, depth, view.clear)
