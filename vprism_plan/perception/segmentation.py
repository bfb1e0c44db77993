# SPDX-License-Identifier: BSD-3-Clause
"""Object labels from geometry alone, where the user has no segmentation model.

Euclidean clusters of the pixels above a plane, on the image's own neighbourhood graph. Objects
that touch are hills with valleys between them.
"""

import logging
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError, cKDTree

from vprism_plan._arguments import number, whole
from vprism_plan._shapes import Indices, Pixels, PointImage, Points, Values
from vprism_plan.errors import ConfigError, PlaneNotFoundError
from vprism_plan.perception.camera import inlier_band, stereo_noise
from vprism_plan.perception.image_graph import (
    SurfaceImage,
    components,
    flying_pixels,
    graph_edges,
    jump_pixels,
    specks,
    surface_image,
)
from vprism_plan.perception.observation import Observation
from vprism_plan.perception.plane import Plane, TableRegion, table_region
from vprism_plan.perception.plane_fitting import fit_plane

logger = logging.getLogger(__name__)

Clusters = Int[np.ndarray, "_ _"]

_SPECK_PIXELS, _SPECK_AREA = 12, 1e-4
# Metres around and above the table within which sensor noise is removed.
_WORKSPACE_MARGIN, _WORKSPACE_HEIGHT = 0.1, 1.0
_MIN_ON_TABLE = 0.6  # share of a cluster that stands over the table top
_REACH = 0.015  # from pixels cut off at a depth edge to their cluster
# A fragment: at most this share of what it is joined to, this share of it near, this large.
_FRAGMENT, _CONTACT, _MIN_FRAGMENT = 0.25, 0.1, 1e-4
_INSIDE = 0.7  # share of a cluster's footprint in another's hull that makes it a part of that

_STEP = 0.005  # metres by which the water rises
# A summit must rise this much over the pass to its neighbour, in metres and as a share of its
# height above the table. Rims, knobs and handles do not.
_PROMINENCE, _RELATIVE_PROMINENCE = 0.022, 0.25


def segment_tabletop(
    obs: Observation,
    *,
    plane: Plane | None = None,
    seed: int = 0,
    min_height: float = 0.012,
    max_height: float = 0.5,
    max_size: float = 0.6,
    min_area: float = 1e-3,
    min_points: int = 50,
    remove_flying: bool = True,
) -> Observation:
    """Label what stands on the support plane, one id per Euclidean cluster.

    Pixels higher than `min_height` (or 3 standard deviations of stereo noise) over the
    plane are linked to their image neighbours unless depth jumps between them; connected
    pieces are clusters. Clusters that touch are told apart where a valley in height runs
    between them; stacked objects stay one. Fragments of one object (a handle, the far
    wall of a cup) are joined to it. Labels run from 1, by falling visible area.

    Pixels that see the robot (`ignore_robot`) are left out. What is *not* labelled stays
    background, and so remains an obstacle: clutter too small, too large (`max_size`,
    `max_height`: walls, people) or not over the table top.

    Args:
        obs: observation; existing labels are replaced.
        plane: support plane in the world frame; default: `obs.plane`, else `fit_plane`.
        seed: seed of the plane fit.
        min_height, max_height: of an object over the plane, metres.
        max_size: largest horizontal size of an object, metres.
        min_area: least visible area of an object, square metres, measured facing the camera.
        min_points: least number of pixels of an object.
        remove_flying: set depth to 0, "no return", where stereo sensors invent it between the
            two sides of a depth edge, and at specks of at most 12 pixels and 1 cm^2: they would
            be obstacles in mid-air. Only over the table top (10 cm around it, up to 1 m above),
            and not in ramps of more than three pixels, which may be the side of a box.

    Returns:
        The observation with `labels` and `plane` set. If nothing stands on the plane all
        labels are 0; `require_objects` then says so.

    Raises:
        PlaneNotFoundError: no support plane in view (see `fit_plane`).
        ConfigError: a limit that is not positive, or contradicts another.
    """
    limits = {"max_height": max_height, "max_size": max_size, "min_area": min_area}
    for name, value in {"min_height": min_height, **limits}.items():
        number(name, value, 0.0, above=True)
    whole("min_points", min_points, 1)
    if min_height >= max_height:
        raise ConfigError(f"min_height {min_height} must be less than max_height {max_height}")
    unlabelled = replace(obs, labels=None)
    plane = plane or obs.plane or fit_plane(unlabelled, seed=seed)
    points, depth = unlabelled.point_image(), obs.depth.copy()
    height = np.nan_to_num(plane.signed_distance(points), nan=-np.inf)
    height[obs.sees_robot] = -np.inf  # neither a surface nor something that stands on it
    on_plane = (depth > 0) & (np.abs(height) < inlier_band(depth, 0.01))
    if on_plane.sum() < 3:
        found = f"{int(on_plane.sum())} observed points lie on the given plane"
        raise PlaneNotFoundError(f"{found}; check its frame and units, or let it be fitted")
    region = table_region(plane, points[on_plane])
    if remove_flying:
        image = surface_image(depth, obs.intrinsics, np.where(np.isfinite(height), height, 0.0))
        over_table = (height > min_height) & (height < _WORKSPACE_HEIGHT)
        over_table[over_table] = region.contains(points[over_table], _WORKSPACE_MARGIN)
        noise = flying_pixels(image) & over_table
        noise |= specks(image, (depth > 0) & ~noise, _SPECK_PIXELS, _SPECK_AREA) & over_table
        depth[noise] = 0.0
        height[noise] = -np.inf
        logger.info("%d flying pixels and specks set to 'no return'", int(noise.sum()))
    image = surface_image(depth, obs.intrinsics, np.where(np.isfinite(height), height, 0.0))
    raised = (depth > 0) & (height > np.maximum(min_height, 3.0 * stereo_noise(depth)))
    clusters = _cluster_pixels(image, points, plane, raised, min_area)
    labels = _accept(clusters, image, points, region, min_points, **limits)
    logger.info("%d objects on the support plane", int(labels.max()))
    return replace(obs, depth=depth, labels=labels, plane=plane)


def _accept(
    clusters: Clusters,
    image: SurfaceImage,
    points: PointImage,
    region: TableRegion,
    min_points: int,
    max_height: float,
    max_size: float,
    min_area: float,
) -> Clusters:
    """Keep the clusters that can be objects on the table; number them by visible area."""
    pixels, areas = np.bincount(clusters.ravel()), _areas(clusters, image)
    large = (pixels >= min_points) & (areas >= min_area)
    large[0] = False
    number, order = np.zeros(len(pixels), dtype=np.int32), np.argsort(-areas, kind="stable")
    for cluster in order[large[order]].tolist():
        member = clusters == cluster
        if np.percentile(image.height[member], 99.0) > max_height:
            continue
        flat = points[member] @ region.axes.T
        size = np.percentile(flat, 99.0, axis=0) - np.percentile(flat, 1.0, axis=0)
        if size.max() > max_size:
            continue
        if region.contains(points[member], 0.02).mean() >= _MIN_ON_TABLE:
            number[cluster] = number.max() + 1
    return number[clusters]


# ----------------------------------------------------------------------------------- clusters
def _cluster_pixels(
    image: SurfaceImage, points: PointImage, plane: Plane, raised: Pixels, min_area: float
) -> Clusters:
    """Number the clusters of the raised pixels from 1, 0 = none; see `segment_tabletop`."""
    clusters = np.zeros(raised.shape, dtype=np.int64)
    if not raised.any():
        return clusters
    core = raised & ~jump_pixels(image)
    if not core.any():
        core = raised
    start, end = graph_edges(image, core)
    height = np.asarray(ndimage.median_filter(image.height, size=3))
    clusters[core] = _split_at_valleys(height[core], image.pitch[core] ** 2, start, end, min_area)
    keep = _areas(clusters, image) >= 0.25 * min_area
    keep[0] = False
    clusters = np.where(keep, np.cumsum(keep), 0)[clusters]
    _attach(clusters, raised, points)
    # What is left is so thin that every pixel of it is at an edge.
    loose = raised & (clusters == 0)
    thin = components(int(loose.sum()), *graph_edges(image, loose))
    clusters[loose] = thin + 1 + clusters.max()
    clusters = _join_fragments(clusters, image, points, plane)
    _fill_holes(clusters, image)
    return clusters


def _areas(clusters: Clusters, image: SurfaceImage) -> Float[np.ndarray, " c"]:
    return np.bincount(clusters.ravel(), weights=(image.pitch**2).ravel())


def _attach(clusters: Clusters, raised: Pixels, points: PointImage) -> None:
    """Give raised pixels without a cluster to the nearest one in space, if it is near."""
    owned = clusters > 0
    loose = raised & ~owned
    if owned.any() and loose.any():
        tree = cKDTree(points[owned])
        _, nearest = tree.query(points[loose], distance_upper_bound=_REACH)
        clusters[loose] = np.append(clusters[owned], 0)[nearest]  # the last: none is near


def _join_fragments(
    clusters: Clusters, image: SurfaceImage, points: PointImage, plane: Plane
) -> Clusters:
    """Join a small cluster to a larger one that it touches or in whose footprint it stands."""
    area = _areas(clusters, image)
    area[0] = 0.0
    candidates = np.flatnonzero(area > _MIN_FRAGMENT)
    order = candidates[np.argsort(-area[candidates], kind="stable")].tolist()
    members = {c: points[clusters == c] for c in order}
    noise = {c: float(np.median(stereo_noise(image.depth[clusters == c]))) for c in order}
    axes = plane.axes()
    owner = np.arange(len(area))
    for position, big in enumerate(order):
        if owner[big] != big:
            continue
        outline = _footprint(members[big] @ axes.T)
        for small in order[position + 1 :]:
            if owner[small] != small:
                continue
            flat, joined = members[small] @ axes.T, False
            if outline is not None:
                inside = (flat @ outline[:, :2].T + outline[:, 2] <= 0.0).all(axis=1)
                joined = bool(inside.mean() >= _INSIDE)
            if not joined and area[small] <= _FRAGMENT * area[big]:
                joined = _touch(members[big], members[small], _REACH + 3.0 * noise[small])
            if joined:
                owner[small] = big
    return np.asarray(np.unique(owner[clusters], return_inverse=True)[1]).reshape(clusters.shape)


def _touch(big: Points, small: Float[np.ndarray, "m 3"], reach: float) -> bool:
    """Whether a tenth of the small cluster lies within reach of the big one."""
    lower, upper = small.min(axis=0) - reach, small.max(axis=0) + reach
    near = big[((big >= lower) & (big <= upper)).all(axis=1)]
    if not len(near):
        return False
    gap, _ = cKDTree(near).query(small, distance_upper_bound=reach)
    return bool(np.isfinite(gap).mean() >= _CONTACT)


def _footprint(flat: np.ndarray) -> np.ndarray | None:
    """Half-planes of the convex hull of a footprint, or None if it has no area."""
    try:
        return np.asarray(ConvexHull(flat).equations)
    except (QhullError, ValueError):
        return None


def _fill_holes(clusters: Clusters, image: SurfaceImage) -> None:
    """Add the low pixels that a cluster encloses on its own surface: the bottom of a bowl."""
    # The table seen through the handle of a cup is enclosed too, but depth jumps there.
    low = (image.depth > 0) & (clusters == 0) & (image.height > 1.5 * stereo_noise(image.depth))
    low &= ~jump_pixels(image, reach=1)
    for cluster, box in enumerate(ndimage.find_objects(clusters), start=1):
        if box is not None:
            enclosed = ndimage.binary_fill_holes(clusters[box] == cluster) & low[box]
            clusters[box][enclosed] = cluster


# ------------------------------------------------------------------------------------ valleys
def _split_at_valleys(
    height: Values, area: Values, start: Indices, end: Indices, min_area: float
) -> Indices:
    """Number the hills of a graph of pixels, 0 = in a valley (belongs to the nearest hill).

    The graph is flooded from below in steps of 5 mm. Where what is still above water
    falls apart into two pieces or more, each prominent and of at least `min_area`, they are
    different objects; a piece that is neither is part of the same hill.
    """
    hills = np.zeros(len(height), dtype=np.int64)
    piece = components(len(height), start, end)
    divisible = np.bincount(piece, weights=area) >= 2.0 * min_area
    order = np.argsort(piece, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(piece[order])) + 1)
    found = 0
    stack = [(nodes, start, end) for nodes in groups]
    while stack:
        members, first, second = stack.pop()
        parts: list[np.ndarray] = []
        if divisible[piece[members[0]]]:
            inside = np.zeros(len(height), dtype=bool)
            inside[members] = True
            within = inside[first] & inside[second]
            first, second = first[within], second[within]
            parts = _fall_apart(members, height, area, first, second, min_area)
        if parts:
            stack += [(part, first, second) for part in parts]
        else:
            found += 1
            hills[members] = found
    return hills


def _fall_apart(
    members: Indices, height: Values, area: Values, start: Indices, end: Indices, min_area: float
) -> list[np.ndarray]:
    """Raise the water until two or more prominent pieces are left; [] if that never happens."""
    heights = height[members]
    number = np.empty(len(height), dtype=np.int64)
    for level in np.arange(heights.min() + _STEP, heights.max() - _PROMINENCE, _STEP):
        dry = members[heights >= level]
        number[dry] = np.arange(len(dry))
        above = (height[start] >= level) & (height[end] >= level)
        start, end = start[above], end[above]
        piece = components(len(dry), number[start], number[end])
        size = np.bincount(piece, weights=area[dry])
        if (size >= min_area).sum() < 2:
            continue
        prominent = []
        for part in np.flatnonzero(size >= min_area):
            nodes = dry[piece == part]
            summit = float(np.percentile(height[nodes], 95.0))
            if summit - level >= max(_PROMINENCE, _RELATIVE_PROMINENCE * summit):
                prominent.append(nodes)
        if len(prominent) > 1:
            return prominent
    return []
