# SPDX-License-Identifier: BSD-3-Clause
"""Object-centric negative samples (section V of the paper): where nothing is.

All functions take points in the world frame, metres, and draw from the generator
they are given.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from vprism_plan._kernels import mapping as kernels
from vprism_plan.mapping.config import RaySampling


def box_centers(
    points: Float[np.ndarray, "n 3"],
    labels: Int[np.ndarray, " n"],
    object_ids: tuple[int, ...],
    trim: float = 0.0,
) -> tuple[Float[np.ndarray, "c 3"], Float[np.ndarray, "c 3"]]:
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
    points: Float[np.ndarray, "n 3"],
    labels: Int[np.ndarray, " n"],
    object_ids: tuple[int, ...],
    normal: Float[np.ndarray, " 3"],
    offset: float,
) -> Bool[np.ndarray, " c"]:
    """Which objects lie lower than the plane: on a bench beside the table, in a bin.

    A fifth of what was seen of them is more than 2 cm (noise at table range) below it.
    """
    heights = [points[labels == k] @ normal - offset for k in object_ids]
    return np.array([np.quantile(height, 0.2) < -0.02 for height in heights], dtype=bool)


def outside_boxes(
    points: Float[np.ndarray, "n 3"],
    lower: Float[np.ndarray, "c 3"],
    upper: Float[np.ndarray, "c 3"],
    room: float,
) -> Bool[np.ndarray, " n"]:
    """Which points (m) keep `room` (m) along an axis from every box."""
    outside = np.ones(len(points), dtype=bool)
    for low, high in zip(lower - room, upper + room, strict=True):
        outside &= ((points < low) | (points > high)).any(axis=1)
    return outside


def sample_in_front(
    points: Float[np.ndarray, "n 3"], origin: Float[np.ndarray, " 3"], distance: float
) -> Float[np.ndarray, "m 3"]:
    """Points `distance` (m) before each point on its ray; nearer ones to the camera give none."""
    rays = points - origin
    length = np.linalg.norm(rays, axis=1)
    far = length > distance
    return points[far] - rays[far] * (distance / length[far])[:, None]
