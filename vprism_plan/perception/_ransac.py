# SPDX-License-Identifier: BSD-3-Clause
"""RANSAC for planes (Fischler and Bolles, 1981) with least-squares refinement.

Works in the camera frame on arrays of points, each with its own inlier band, since
stereo depth noise grows with the square of depth.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from vprism_plan.perception.plane import Plane

_SCORING_POINTS = 2000
_NEIGHBOURS = 100
_REFINED = 8


@dataclass(frozen=True, eq=False)
class PlaneCandidate:
    """A plane with what speaks for it among the points it was fitted to.

    Attributes:
        plane: camera frame, normal towards the camera.
        inliers: (N,) which points lie in their band around the plane.
        below: share of points in the two bands just under the plane, relative to the
            inliers. Nothing is seen through a surface, so it is near 0 for a real plane
            and about 1 for a slice through a curved surface or through noise.
        rms: root mean square distance of the inliers, metres.
    """

    plane: Plane
    inliers: Bool[np.ndarray, " n"]
    below: float
    rms: float


def facing(normal: Float[np.ndarray, " 3"], offset: float) -> Plane:
    """Return the plane with its normal on the side of the origin (the camera)."""
    return Plane(normal, offset) if offset <= 0 else Plane(-normal, -offset)


def least_squares_plane(
    points: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, " n"]
) -> Plane:
    """Plane of least weighted squared distance; normal towards the origin."""
    total = weights.sum()
    mean = weights @ points / total
    centred = points - mean
    covariance = (centred * weights[:, None]).T @ centred / total
    normal = np.linalg.eigh(covariance)[1][:, 0]
    return facing(normal, float(normal @ mean))


def refine(
    plane: Plane,
    points: Float[np.ndarray, "n 3"],
    band: Float[np.ndarray, " n"],
    iterations: int = 20,
) -> Plane:
    """Refit to the points in the band until the set no longer changes.

    Points are weighted by 1 / band^2, so that near, precise ones decide.
    """
    inliers = np.abs(plane.signed_distance(points)) < band
    for _ in range(iterations):
        if inliers.sum() < 3:
            return plane
        plane = least_squares_plane(points[inliers], 1.0 / band[inliers] ** 2)
        updated = np.abs(plane.signed_distance(points)) < band
        if np.array_equal(updated, inliers):
            break
        inliers = updated
    return plane


def describe(
    plane: Plane, points: Float[np.ndarray, "n 3"], band: Float[np.ndarray, " n"]
) -> PlaneCandidate:
    """Collect the evidence for a plane."""
    height = plane.signed_distance(points) / band
    inliers = np.abs(height) < 1.0
    below = (height <= -1.0) & (height > -3.0)
    count = max(int(inliers.sum()), 1)
    residual = plane.signed_distance(points)[inliers]
    rms = float(np.sqrt(np.mean(residual**2))) if residual.size else 0.0
    return PlaneCandidate(plane, inliers, float(below.sum()) / count, rms)


def concentration(
    plane: Plane, points: Float[np.ndarray, "n 3"], band: Float[np.ndarray, " n"]
) -> float:
    """Share of the points in the band that lie in its middle half.

    0.8 to 1 for the surface of a real table, a half where a plane cuts through others: the
    floor of a bin and the foot of its wall together, in a band wider than the noise.
    """
    height = np.abs(plane.signed_distance(points)) / band
    return float((height < 0.5).sum()) / max(1, int((height < 1.0).sum()))


def find_plane(
    points: Float[np.ndarray, "n 3"],
    band: Float[np.ndarray, " n"],
    rng: np.random.Generator,
    up: Float[np.ndarray, " 3"] | None = None,
    max_tilt: float = 180.0,
    hypotheses: int = 768,
) -> PlaneCandidate | None:
    """Return the plane with most points in its band, or None if no triple spans one.

    Two thirds of the hypotheses take their three points from one neighbourhood: on a
    cluttered scene three random points rarely share a surface, three neighbours mostly
    do. The best few are refined on all points before the best is chosen. With `up`, only
    planes count whose normal is within `max_tilt` degrees of it.
    """
    least = -2.0 if up is None else float(np.cos(np.radians(max_tilt)))
    up = np.zeros(3) if up is None else up
    subset = rng.choice(len(points), size=min(len(points), _SCORING_POINTS), replace=False)
    scored, scored_band = points[subset], band[subset]
    normals, offsets = _hypotheses(scored, rng, hypotheses)
    towards_camera = np.where(offsets > 0, -1.0, 1.0)
    level = towards_camera * (normals @ up) >= least
    normals, offsets = normals[level], offsets[level]
    if len(normals) == 0:
        return None
    counts = np.empty(len(normals), dtype=np.int64)
    for start in range(0, len(normals), 128):
        part = slice(start, start + 128)
        distance = np.abs(scored @ normals[part].T - offsets[part])
        counts[part] = (distance < scored_band[:, None]).sum(axis=0)
    best: PlaneCandidate | None = None
    for index in np.argsort(-counts, kind="stable")[:_REFINED]:
        plane = refine(facing(normals[index], float(offsets[index])), points, band)
        if plane.normal @ up < least:
            continue
        candidate = describe(plane, points, band)
        if best is None or candidate.inliers.sum() > best.inliers.sum():
            best = candidate
    return best


def _hypotheses(
    points: Float[np.ndarray, "n 3"], rng: np.random.Generator, count: int
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, " m"]]:
    """Normals and offsets of planes through triples of points, degenerate triples dropped."""
    from scipy.spatial import cKDTree

    n_local = 2 * count // 3
    neighbours = min(_NEIGHBOURS, len(points))
    anchors = rng.integers(len(points), size=n_local)
    near = np.asarray(cKDTree(points).query(points[anchors], k=neighbours)[1])
    pick = rng.integers(neighbours, size=(n_local, 2))
    local = np.stack(
        [anchors, near[np.arange(n_local), pick[:, 0]], near[np.arange(n_local), pick[:, 1]]], 1
    )
    triples = np.concatenate([local, rng.integers(len(points), size=(count - n_local, 3))])
    a, b, c = points[triples[:, 0]], points[triples[:, 1]], points[triples[:, 2]]
    normals = np.cross(b - a, c - a)
    area = np.linalg.norm(normals, axis=1)
    longest = np.maximum(np.linalg.norm(b - a, axis=1), np.linalg.norm(c - a, axis=1))
    usable = area > 1e-3 * longest**2
    usable &= area > 0
    normals = normals[usable] / area[usable, None]
    return normals, np.einsum("ij,ij->i", normals, a[usable])
