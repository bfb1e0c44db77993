# SPDX-License-Identifier: BSD-3-Clause
"""Euclidean clusters of the pixels above a plane, on the image's own neighbourhood graph."""

import numpy as np
from jaxtyping import Bool, Float, Int

from vprism_plan.perception._image_graph import (
    SurfaceImage,
    components,
    depth_noise,
    graph_edges,
    jump_pixels,
)
from vprism_plan.perception._valleys import split_at_valleys
from vprism_plan.perception.plane import Plane

# Pixels cut off at a depth edge go back to the cluster they are this close to.
_REACH = 0.015
# A fragment is at most this share of what it is joined to.
_FRAGMENT = 0.25
_CONTACT = 0.1
_MIN_FRAGMENT = 1e-4
# Share of a cluster's footprint inside another's hull that makes it a part of the other.
_INSIDE = 0.7


def cluster_pixels(
    image: SurfaceImage,
    points: Float[np.ndarray, "h w 3"],
    plane: Plane,
    raised: Bool[np.ndarray, "h w"],
    min_area: float,
) -> Int[np.ndarray, "h w"]:
    """Number the clusters of the raised pixels from 1, 0 = none; see `segment_tabletop`."""
    core = raised & ~jump_pixels(image)
    clusters = np.zeros(raised.shape, dtype=np.int64)
    if not core.any():
        core = raised
    if not core.any():
        return clusters
    start, end = graph_edges(image, core)
    height = _smooth(image)
    clusters[core] = split_at_valleys(height[core], image.pitch[core] ** 2, start, end, min_area)
    clusters = _drop_small(clusters, image, min_area)
    _attach(clusters, raised, points)
    _add_thin(clusters, raised, image)
    clusters = _join_fragments(clusters, image, points, plane)
    _fill_holes(clusters, image)
    return clusters


def _smooth(image: SurfaceImage) -> Float[np.ndarray, "h w"]:
    from scipy import ndimage

    return np.asarray(ndimage.median_filter(image.height, size=3))


def _areas(clusters: Int[np.ndarray, "h w"], image: SurfaceImage) -> Float[np.ndarray, " c"]:
    return np.bincount(clusters.ravel(), weights=(image.pitch**2).ravel())


def _drop_small(
    clusters: Int[np.ndarray, "h w"], image: SurfaceImage, min_area: float
) -> Int[np.ndarray, "h w"]:
    """Forget clusters below a quarter of `min_area`; renumber the rest from 1."""
    keep = _areas(clusters, image) >= 0.25 * min_area
    keep[0] = False
    number = np.where(keep, np.cumsum(keep), 0)
    return number[clusters]


def _attach(
    clusters: Int[np.ndarray, "h w"],
    raised: Bool[np.ndarray, "h w"],
    points: Float[np.ndarray, "h w 3"],
) -> None:
    """Give raised pixels without a cluster to the nearest one in space, if it is near."""
    from scipy.spatial import cKDTree

    owned = clusters > 0
    loose = raised & ~owned
    if not owned.any() or not loose.any():
        return
    tree = cKDTree(points[owned])
    distance, nearest = tree.query(points[loose], distance_upper_bound=_REACH)
    found = np.isfinite(distance)
    clusters_of = np.append(clusters[owned], 0)
    clusters[loose] = np.where(found, clusters_of[nearest], 0)


def _add_thin(
    clusters: Int[np.ndarray, "h w"], raised: Bool[np.ndarray, "h w"], image: SurfaceImage
) -> None:
    """Number what is left: things so thin that every pixel of theirs is at an edge."""
    loose = raised & (clusters == 0)
    start, end = graph_edges(image, loose)
    clusters[loose] = components(int(loose.sum()), start, end) + 1 + clusters.max()


def _join_fragments(
    clusters: Int[np.ndarray, "h w"],
    image: SurfaceImage,
    points: Float[np.ndarray, "h w 3"],
    plane: Plane,
) -> Int[np.ndarray, "h w"]:
    """Join a small cluster to a larger one that it touches or in whose footprint it stands."""
    area = _areas(clusters, image)
    area[0] = 0.0
    candidates = np.flatnonzero(area > _MIN_FRAGMENT)
    order = candidates[np.argsort(-area[candidates], kind="stable")]
    members = {c: points[clusters == c] for c in order.tolist()}
    noise = {c: float(np.median(depth_noise(image.depth[clusters == c]))) for c in members}
    axes = plane.axes()
    owner = np.arange(len(area))
    for position, big in enumerate(order.tolist()):
        if owner[big] != big:
            continue
        outline = _footprint(members[big] @ axes.T)
        for small in order[position + 1 :].tolist():
            if owner[small] != small:
                continue
            joined = (
                outline is not None and _share_inside(members[small] @ axes.T, outline) >= _INSIDE
            )
            if not joined and area[small] <= _FRAGMENT * area[big]:
                joined = _touch(members[big], members[small], _REACH + 3.0 * noise[small])
            if joined:
                owner[small] = big
    return np.asarray(np.unique(owner[clusters], return_inverse=True)[1]).reshape(clusters.shape)


def _touch(big: Float[np.ndarray, "n 3"], small: Float[np.ndarray, "m 3"], reach: float) -> bool:
    """Whether a tenth of the small cluster lies within reach of the big one."""
    from scipy.spatial import cKDTree

    lower, upper = small.min(axis=0) - reach, small.max(axis=0) + reach
    near = big[((big >= lower) & (big <= upper)).all(axis=1)]
    if not len(near):
        return False
    gap, _ = cKDTree(near).query(small, distance_upper_bound=reach)
    return bool(np.isfinite(gap).mean() >= _CONTACT)


def _footprint(flat: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "f 3"] | None:
    """Half-planes of the convex hull of a footprint, or None if it has no area."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return np.asarray(ConvexHull(flat).equations)
    except (QhullError, ValueError):
        return None


def _share_inside(flat: Float[np.ndarray, "n 2"], outline: Float[np.ndarray, "f 3"]) -> float:
    inside = (flat @ outline[:, :2].T + outline[:, 2] <= 0.0).all(axis=1)
    return float(inside.mean())


def _fill_holes(clusters: Int[np.ndarray, "h w"], image: SurfaceImage) -> None:
    """Add the low pixels that a cluster encloses on its own surface: the bottom of a bowl.

    The table seen through the handle of a cup is enclosed too, but depth jumps there.
    """
    from scipy import ndimage

    low = (image.depth > 0) & (clusters == 0) & (image.height > 1.5 * depth_noise(image.depth))
    low &= ~jump_pixels(image, reach=1)
    for cluster, box in enumerate(ndimage.find_objects(clusters), start=1):
        if box is None:
            continue
        enclosed = ndimage.binary_fill_holes(clusters[box] == cluster) & low[box]
        clusters[box][enclosed] = cluster
