# SPDX-License-Identifier: BSD-3-Clause
"""What a map is learned from: object-centric negative samples (section V of the paper), where
nothing is; subsampling; and flying pixels, points between a depth edge and what lies behind it.

All functions take points in the world frame, metres, and draw from the generator they are given.
"""

from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Int

from vprism_plan._kernels import mapping as kernels
from vprism_plan._shapes import Chosen, Indices, Points, Vector
from vprism_plan.errors import MapError
from vprism_plan.mapping.config import RaySampling


def box_centers(
    points: Points, labels: Indices, object_ids: tuple[int, ...], trim: float = 0.0
) -> tuple[Points, Points]:
    """Return the lower and upper corners (m) of each object's axis-aligned box.

    Rows follow `object_ids`; the centres o_k of the paper are the means of the two.
    Every id must own at least one point. A share `trim` of an object's points may stick
    out at each end of each axis.
    """
    corners = [np.quantile(points[labels == k], [trim, 1.0 - trim], axis=0) for k in object_ids]
    return np.stack([c[0] for c in corners]), np.stack([c[1] for c in corners])


def sample_rays(
    points: Float[np.ndarray, "n 3"],
    origin: Float[np.ndarray, " 3"],
    centers: Float[np.ndarray, "c 3"],
    radius: float,
    step: float,
    rng: np.random.Generator,
    sampling: RaySampling = "stratified",
) -> Float[np.ndarray, "m 3"]:
    """Samples on the rays from `origin` to every point, by default stratified uniform ones.

    Each ray is cut into strata of length `step` (m) from the camera on, the last one
    ending at the surface; every stratum gives one uniform sample, kept if it is within
    `radius` (m) of a centre. Background rays pass objects too, and count.

    `sampling` "steps" takes each stratum's near end instead; "whole" one uniform sample
    of every whole ray, wherever the objects are.
    """
    if len(points) == 0 or len(centers) == 0:
        return np.zeros((0, 3))
    if sampling == "whole":
        return np.asarray(origin + rng.random((len(points), 1)) * (points - origin))
    first, count = kernels.ray_strata(points, origin, centers, radius, step)
    most = int(count.max(initial=0))
    if most == 0:
        return np.zeros((0, 3))
    uniform = np.zeros((len(points), most))
    if sampling == "stratified":
        uniform = rng.random((len(points), most))
    samples, keep = kernels.ray_samples(
        points, origin, centers, radius, step, first, count, uniform
    )
    return samples[keep]


def sample_below_plane(
    normal: Float[np.ndarray, " 3"],
    offset: float,
    centers: Float[np.ndarray, "c 3"],
    radius: float,
    count: int,
    rng: np.random.Generator,
    margin: float = 0.0,
) -> Float[np.ndarray, "m 3"]:
    """Uniform samples in the ball of `radius` (m) around each centre, under the plane.

    `count` are drawn per centre; those with normal . x < offset - margin are kept, since
    what rests on the plane {normal . x = offset} cannot reach below it.
    """
    directions = rng.normal(size=(len(centers), count, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    distances = radius * rng.random((len(centers), count, 1)) ** (1.0 / 3.0)
    samples = (centers[:, None, :] + distances * directions).reshape(-1, 3)
    return samples[samples @ normal < offset - margin]


def sunk_objects(
    points: Points, labels: Indices, object_ids: tuple[int, ...], normal: Vector, offset: float
) -> Chosen:
    """Which objects lie lower than the plane: on a bench beside the table, in a bin.

    A fifth of what was seen of them is more than 2 cm (noise at table range) below it.
    """
    heights = [points[labels == k] @ normal - offset for k in object_ids]
    return np.array([np.quantile(height, 0.2) < -0.02 for height in heights], dtype=bool)


def outside_boxes(points: Points, lower: Points, upper: Points, room: float) -> Chosen:
    """Which points (m) keep `room` (m) along an axis from every box."""
    outside = np.ones(len(points), dtype=bool)
    for low, high in zip(lower - room, upper + room, strict=True):
        outside &= ((points < low) | (points > high)).any(axis=1)
    return outside


def sample_in_front(points: Points, origin: Vector, distance: float) -> Points:
    """Points `distance` (m) before each point on its ray; nearer ones to the camera give none."""
    rays = points - origin
    length = np.linalg.norm(rays, axis=1)
    far = length > distance
    return points[far] - rays[far] * (distance / length[far])[:, None]


def grid_subsample(points: Points, resolution: float | None) -> Points:
    """Return the barycentre of the points in each occupied cell of `resolution` (m).

    Cells sit at world multiples of the resolution; the result is ordered by cell, so
    it does not depend on the order of the points but for rounding in the sums. A
    resolution of None keeps every point.
    """
    if len(points) == 0 or resolution is None:
        return points.copy()
    cells = np.floor(points / resolution)
    lower = cells.min(axis=0)
    extent = cells.max(axis=0) - lower + 1.0
    if extent.prod() >= 2.0**62:
        raise MapError(
            f"the points span {extent[0]:.3g} x {extent[1]:.3g} x {extent[2]:.3g} cells of "
            f"{resolution} m; check the depth unit (metres)"
        )
    index = (cells - lower).astype(np.int64)
    shape = extent.astype(np.int64)
    key = (index[:, 0] * shape[1] + index[:, 1]) * shape[2] + index[:, 2]
    order, start = _grouped(key)
    count = np.diff(np.append(start, len(points)))
    return np.add.reduceat(points[order], start, axis=0) / count[:, None]


def _grouped(keys: Indices) -> tuple[Indices, Indices]:
    """Order whole numbers from 0, equal ones as they come; return also where each new one starts.

    Sorting values that hold their own place is many times faster than numpy's stable argsort.
    """
    bits = len(keys).bit_length()
    if int(keys.max(initial=0)).bit_length() + bits < 63:
        both = keys << bits | np.arange(len(keys))
        both.sort()
        order, ordered = both & (1 << bits) - 1, both >> bits
    else:
        order = np.argsort(keys, kind="stable")
        ordered = keys[order]
    return order, np.flatnonzero(np.diff(ordered, prepend=-1))


_CELL = 0.01  # metres; a point's surroundings are its cell and the 26 around it
BLOCK = 3.0 * _CELL


def stray_points(points: Float[np.ndarray, "n 3"], share: float) -> Bool[np.ndarray, " n"]:
    """Return which points of one object stand almost alone.

    A depth camera reports points in the air behind an object's outline. They are few
    and spread along the rays, so the 3 cm block around one holds far fewer points than
    around a point of a surface: less than `share` of the object's median.

    Args:
        points: one object's observed points, m, at the image's resolution.
        share: of the median; 0 calls nothing stray.
    """
    if share <= 0.0 or len(points) == 0:
        return np.zeros(len(points), dtype=bool)
    density = points_around(points)
    return density < share * np.median(density)


def points_around(points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """Return how many of the points (m) lie in the `BLOCK` wide block around each."""
    if len(points) == 0:
        return np.zeros(0, dtype=np.int64)
    cells = np.floor(points / _CELL).astype(np.int64)
    cells -= cells.min(axis=0) - 1  # the neighbours of all have keys, in order
    shape = cells.max(axis=0) + 2
    every = np.ravel_multi_index(tuple(cells.T), tuple(shape))
    order, start = _grouped(every)
    keys, totals = every[order[start]], np.append(start, len(points))
    around = np.zeros(len(keys), dtype=np.int64)
    for x, y in product((-1, 0, 1), repeat=2):  # three in a row follow one another
        low = keys + (x * shape[1] + y) * shape[2] - 1
        ends = [np.searchsorted(keys, key) for key in (low, low + 3)]
        around += totals[ends[1]] - totals[ends[0]]
    found = np.empty(len(points), dtype=np.int64)
    found[order] = np.repeat(around, np.diff(totals))
    return found
