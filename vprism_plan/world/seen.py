# SPDX-License-Identifier: BSD-3-Clause
"""What labelled pixels say is there, whatever the map makes of them.

With a return: a point of the object's surface. A thin part can stay below the level set: the
kernels of the map are centimetres long, and the free space on both sides outweighs it.

Without a return (glass, black, shiny things): somewhere along the ray the object's surface is, no
nearer than its neighbours and its foot on the support surface allow, and no farther than that
surface.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage

from vprism_plan.mapping.training_data import stray_points
from vprism_plan.perception import Observation, Plane
from vprism_plan.perception.camera import height_sigma, inlier_band, pixel_rays
from vprism_plan.perception.plane import TableRegion, table_region
from vprism_plan.world.distance import bounding, lower_bounds
from vprism_plan.world.grid import Chosen, Grid, Image, Mask, Nodes, Points, Values, Vector
from vprism_plan.world.visibility import THIN, beside, without_fringe

_STRAY_SHARE = 0.03  # as in the default map: fewer neighbours than this is a flying pixel
_OFF = 0.004  # metres off the level set: no ball of 5 mm around a seen point may be free


Surface = tuple[int, Points, Values]


def surface_points(map_: Any, bounded: bool = False) -> list[Surface]:
    """Return class, observed points of its surface (world, metres) and half the width of their
    pixels, per object and view of a map.

    Points less than 3 mm (or three standard deviations of the noise) above the support surface are
    its own, and points that stand alone are flying pixels, unless they are beside others. What is
    lower counts as well if the support surface is `bounded`.
    """
    found = []
    plane = map_.plane
    for view in map_.views:
        points, labels = view.points()
        depth = np.asarray(view.depth, dtype=np.float64)[view.depth > 0]
        focal = min(float(view.intrinsics[0, 0]), float(view.intrinsics[1, 1]))
        for k, object_id in enumerate(map_.object_ids, start=1):
            own = np.flatnonzero(labels == object_id)
            own = own[_of_surfaces(points[own])]
            if plane is not None:
                sigma = height_sigma(points[own] - view.camera_center, depth[own], plane.normal)
                height = plane.signed_distance(points[own])
                height = np.abs(height) if bounded else height
                own = own[height > np.maximum(THIN, 3.0 * sigma)]
            found.append((k, points[own], 0.5 * depth[own] / focal))
    return found


def _of_surfaces(points: Points) -> Chosen:
    """Which points of one object are no flying pixels."""
    return beside(points, ~stray_points(points, _STRAY_SHARE))


def off_level_set(points: Points, distance: Nodes, grid: Grid) -> Chosen:
    """Which points lie more than 4 mm off the level set, by the distance of every grid node to
    it (metres). Nearer ones are its own business: marking them would only thicken it."""
    return lower_bounds(points, grid, distance) > _OFF


_TALLEST = 0.4  # metres above the support surface; what stands on a table is rarely taller
_OVERHANG = (0.03, 0.15)  # metres by which a thing may lean out over its foot, least and most
_SLOPE = 2.0  # metres nearer per metre to the side: how steeply a seen surface may go on
_NEAR = 0.002  # metres a surface may bulge beside what was seen of it
_BESIDE = 3  # pixels around a mask that count as beside it
_PIECE = 200_000  # points at a time


def lost_objects(view: Observation) -> tuple[int, ...]:
    """Ids that label at least one pixel without a return, sorted."""
    if view.labels is None:
        return ()
    ids = np.unique(view.labels[(view.labels > 0) & (view.depth == 0)])
    return tuple(int(i) for i in ids)


@dataclass(frozen=True)
class Cone:
    """Where an object may be, along the rays of pixels that carry its label and no depth.

    Attributes:
        start, end: (n,) depths, metres.
    """

    object_id: int  # the label
    pixels: Int[np.ndarray, "n 2"]  # row and column
    rays: Points  # world directions at depth 1
    start: Values
    end: Values


def lost_cones(view: Observation, plane: Plane | None) -> list[Cone]:
    """Return where the `lost_objects` may be, an entry for each that has more than small holes.

    The cone of a pixel without a return runs from the nearest depth at which the object's surface
    is plausible to the farthest, or to the support surface. Nearest is the farthest of: the upright
    plane through the front of its foot, of its other points and of what is seen beside its mask,
    moved towards the camera by half its width; the height of 40 cm; and its own nearest seen
    surface, continued towards the camera at two metres per metre. Farthest is that surface
    continued away from the camera; flying pixels are no surface. Holes of up to four pixels, and
    outlines frayed by two, have no cone: every depth camera has them all around. Specks of returns
    do not make a hole of glass.
    """
    found: list[Cone] = []
    for object_id in lost_objects(view):
        whole = view.labels == object_id
        window = bounding(whole, _BESIDE)
        mask, depth = whole[window], view.depth[window].astype(np.float64)
        lost = mask & (depth == 0)
        lost = without_fringe(lost, mask & ~lost)
        if not lost.any():
            continue
        rays = pixel_rays(view.shape, view.intrinsics)[window] @ view.pose[:3, :3].T
        points = view.point_image()[window]
        own = mask & (depth > 0)
        own[own] = _of_surfaces(points[own])
        start, end = _beside_own_surface(view, depth, own)
        if plane is not None:
            sinking = -(rays @ plane.normal)
            at_plane = np.full(mask.shape, np.inf)
            height = float(plane.signed_distance(view.camera_center))
            at_plane[sinking > 0.0] = height / sinking[sinking > 0.0]
            foot = _before_foot(view, plane, mask, lost, rays, points, at_plane)
            start, end = np.maximum(start, foot), np.minimum(end, at_plane)
        lost &= start < end
        pixels = np.argwhere(lost) + np.array([w.start for w in window])
        found.append(Cone(object_id, pixels, rays[lost], start[lost], end[lost]))
    return found


def lost_points(
    view: Observation, cones: Sequence[Cone], lower: Vector, upper: Vector, step: float
) -> Iterator[tuple[int, Points, Values]]:
    """Yield points `step` apart along a view's `lost_cones` in a box, with the half edge of
    cubes around them that hold the cones; piece by piece, with the object's id, world, metres."""
    eye = view.camera_center
    focal = min(float(view.intrinsics[0, 0]), float(view.intrinsics[1, 1]))
    for cone in cones:
        rays, length = cone.rays, np.linalg.norm(cone.rays, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            ways = np.stack([(lower - step - eye) / rays, (upper + step - eye) / rays])
        first = np.fmax(cone.start, np.nanmax(ways.min(axis=0), axis=1))
        last = np.fmin(cone.end, np.nanmin(ways.max(axis=0), axis=1))
        counts = np.ceil(np.maximum(last - first, 0.0) * length / step).astype(np.int64) + 1
        counts[last < first] = 0
        for piece in np.array_split(np.arange(len(rays)), counts.sum() // _PIECE + 1):
            count = counts[piece]
            owner = np.repeat(piece, count)
            index = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
            share = index / np.maximum(np.repeat(count, count) - 1, 1)
            depth = first[owner] + share * (last - first)[owner]
            points = eye + depth[:, None] * rays[owner]
            # A pixel's corner is 0.71 of its width off its middle.
            yield cone.object_id, points, 0.71 * depth / focal + 0.5 * step


def _beside_own_surface(view: Observation, depth: Image, own: Mask) -> tuple[Image, Image]:
    """Nearest and farthest depth that the object's own seen pixels allow; 0, inf without any."""
    if not own.any():
        return np.zeros(own.shape), np.full(own.shape, np.inf)
    # Of several surfaces nearby each may be the one that goes on.
    size = 2 * _BESIDE + 1
    low = ndimage.minimum_filter(np.where(own, depth, np.inf), size, mode="nearest")
    high = ndimage.maximum_filter(np.where(own, depth, 0.0), size, mode="nearest")
    away, index = ndimage.distance_transform_edt(~own, return_indices=True)
    focal = min(float(view.intrinsics[0, 0]), float(view.intrinsics[1, 1]))
    # The way to the side is measured at the depth sought.
    steep = _SLOPE * away / focal
    start = np.maximum(low[tuple(index)] - _NEAR, 0.0) / (1.0 + steep)
    end = np.full(own.shape, np.inf)
    near = steep < 1.0
    end[near] = (high[tuple(index)] + _NEAR)[near] / (1.0 - steep[near])
    return start, end


def _before_foot(
    view: Observation,
    plane: Plane,
    mask: Mask,
    lost: Mask,
    rays: Float[np.ndarray, "h w 3"],
    points: Float[np.ndarray, "h w 3"],
    at_plane: Image,
) -> Image:
    """Nearest depth (m) by where the object can stand and how tall it can be."""
    eye = view.camera_center
    height = float(plane.signed_distance(eye))
    sinking = -(rays @ plane.normal)
    with np.errstate(divide="ignore"):
        below_top = np.where(sinking > 0.0, np.maximum(height - _TALLEST, 0.0) / sinking, 0.0)
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


RIM = 0.05  # metres around the seen part of the support surface that count as part of it
_BAND = 0.01  # metres at a depth of 1 m within which a point is of the surface


@dataclass(frozen=True, eq=False)
class SeenSupport:
    """Everything under the convex hull (`region`), grown by `RIM`, of what was seen of a plane."""

    plane: Plane
    region: TableRegion

    def signed_distance(self, points: Points) -> Values:
        """Lower bound of the distance from world points, metres, negative inside. Exact but for
        points beyond a corner of the hull."""
        flat = points @ self.region.axes.T
        beside = np.full(len(points), -np.inf)
        for a, b, c in self.region.halfplanes:
            np.maximum(beside, flat @ np.array([a, b]) + c - RIM, out=beside)
        above = self.plane.signed_distance(points)
        outside = np.hypot(np.maximum(beside, 0.0), np.maximum(above, 0.0))
        return np.asarray(outside + np.minimum(np.maximum(beside, above), 0.0))


def seen_support(views: Sequence[Observation], plane: Plane) -> SeenSupport:
    """Bound a support plane to what the views saw of it.

    Raises:
        PlaneNotFoundError: they saw no patch of 6 cm x 6 cm of it.
    """
    kept = [np.empty((0, 3))]
    for view in views:
        points, labels = view.points()
        band = inlier_band(view.depth[view.depth > 0], _BAND)
        kept.append(points[(np.abs(plane.signed_distance(points)) < band) & (labels == 0)])
    return SeenSupport(plane, table_region(plane, np.concatenate(kept)))
