# SPDX-License-Identifier: BSD-3-Clause
"""Pixels that carry an object's label and no depth: glass, black, shiny things.

Somewhere along such a ray the object stands. Where, is bounded by what is around it: no
nearer than its neighbours and its foot on the support surface allow, and no farther than
that surface.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from vprism_plan.perception import Observation, Plane
from vprism_plan.perception.camera import pixel_rays

_TALLEST = 0.4  # metres above the support surface; what stands on a table is rarely taller
_OVERHANG = (0.03, 0.15)  # metres by which a thing may lean out over its foot, least and most
_SLOPE = 2.0  # metres nearer per metre to the side: how steeply a seen surface may go on
_NEAR = 0.01  # metres a surface may bulge beside what was seen of it
_BESIDE = 3  # pixels around a mask that count as beside it


def lost_objects(view: Observation) -> tuple[int, ...]:
    """Ids that label at least one pixel without a return, sorted."""
    if view.labels is None:
        return ()
    ids = np.unique(view.labels[(view.labels > 0) & (view.depth == 0)])
    return tuple(int(i) for i in ids)


def lost_cones(
    view: Observation, plane: Plane | None
) -> Iterator[tuple[int, Float[np.ndarray, "h w"]]]:
    """Yield each id of `lost_objects` and the depth (m) where its cone begins, inf elsewhere.

    The cone of a pixel without a return runs from the nearest depth at which the object is
    plausible down to the support surface. Nearest is the farthest of: the upright plane
    through the front of its foot, of its other points and of what is seen beside its mask,
    moved towards the camera by half its width; the height of 40 cm; and its own nearest seen
    surface, continued towards the camera at two metres per metre.
    """
    lost_ids = lost_objects(view)
    if not lost_ids:
        return
    rays = pixel_rays(view.shape, view.intrinsics) @ view.pose[:3, :3].T
    points = view.point_image()
    for object_id in lost_ids:
        mask = view.labels == object_id
        lost = mask & (view.depth == 0)
        start = np.maximum(_beside_own_surface(view, mask), 0.0)
        if plane is not None:
            start = np.maximum(start, _before_foot(view, plane, mask, lost, rays, points))
        yield object_id, np.where(lost, start, np.inf)


def _beside_own_surface(
    view: Observation, mask: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w"]:
    """Nearest depth that the object's own seen pixels allow; 0 where it has none."""
    own = mask & (view.depth > 0)
    if not own.any():
        return np.zeros(view.shape)
    depth = np.where(own, view.depth.astype(np.float64), np.inf)
    # One flying pixel behind the object must not push the cone back.
    depth = ndimage.minimum_filter(depth, 2 * _BESIDE + 1, mode="nearest")
    away, index = ndimage.distance_transform_edt(~own, return_indices=True)
    nearest = depth[tuple(index)]
    focal = min(float(view.intrinsics[0, 0]), float(view.intrinsics[1, 1]))
    # Divided by the steepness, since the way to the side is measured at the depth sought.
    return np.asarray((nearest - _NEAR) / (1.0 + _SLOPE * away / focal))


def _before_foot(
    view: Observation,
    plane: Plane,
    mask: Bool[np.ndarray, "h w"],
    lost: Bool[np.ndarray, "h w"],
    rays: Float[np.ndarray, "h w 3"],
    points: Float[np.ndarray, "h w 3"],
) -> Float[np.ndarray, "h w"]:
    """Nearest depth (m) by where the object can stand and how tall it can be."""
    eye = view.camera_center
    height = float(plane.signed_distance(eye))
    sinking = -(rays @ plane.normal)
    with np.errstate(divide="ignore", invalid="ignore"):
        at_plane = np.where(sinking > 0.0, height / sinking, np.inf)
        below_top = np.where(sinking > 0.0, (height - _TALLEST) / sinking, 0.0)
    ahead = rays[mask].mean(axis=0)
    ahead -= (ahead @ plane.normal) * plane.normal
    length = float(np.linalg.norm(ahead))
    if length < 0.05:  # seen from straight above: it has no front
        return below_top
    ahead /= length
    along = rays @ ahead
    beside = ndimage.binary_dilation(mask, iterations=_BESIDE)
    fronts = [(points[beside] - eye) @ ahead]
    feet = lost & np.isfinite(at_plane)
    fronts.append((at_plane * along)[feet])
    known = np.concatenate(fronts)
    known = known[np.isfinite(known)]
    if len(known) == 0:
        return below_top
    columns = np.flatnonzero(mask.any(axis=0))
    width = (columns[-1] - columns[0] + 1) / float(view.intrinsics[0, 0])
    front = float(known.min())
    front -= float(np.clip(0.5 * width * front / length, *_OVERHANG))
    with np.errstate(divide="ignore", invalid="ignore"):
        at_front = np.where(along > 0.0, front / along, 0.0)
    return np.maximum(np.maximum(below_top, at_front), 0.0)
