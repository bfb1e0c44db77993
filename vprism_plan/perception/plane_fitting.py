# SPDX-License-Identifier: BSD-3-Clause
"""Find the surface that the objects stand on."""

import logging
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from vprism_plan.errors import ConfigError, PlaneNotFoundError
from vprism_plan.perception._ransac import (
    PlaneCandidate,
    find_plane,
    refine,
)
from vprism_plan.perception.camera import backproject
from vprism_plan.perception.observation import Observation
from vprism_plan.perception.plane import Plane

logger = logging.getLogger(__name__)

_MAX_POINTS = 20_000
_MAX_PLANES = 6
# Share of the inliers that may lie just below a surface: seen past its edge, not through it.
_MAX_BELOW = 0.3
# Objects on a table are rarely taller; what stands higher does not vote for a plane.
_OBJECT_HEIGHT = 0.4
# A flat patch larger than this is furniture or a wall, not the side of an object.
_OBJECT_SIZE = 0.6
_CELL = 0.04


def inlier_band(depth: np.ndarray, threshold: float) -> np.ndarray:
    """Half-width (metres) of the band in which a point at this depth counts as on the plane.

    Stereo noise grows with the square of depth: `threshold` up to 1 m, beyond it
    `threshold * depth^2`, and from 2 m on `4 * threshold`, or else a band at 5 m would
    take in the table and the floor under it.
    """
    return np.asarray(threshold * np.clip(np.asarray(depth, dtype=np.float64), 1.0, 2.0) ** 2)


def fit_plane(
    obs: Observation, *, seed: int = 0, threshold: float = 0.01, min_share: float = 0.05
) -> Plane:
    """Fit the support plane of the objects, in the world frame, normal towards the camera.

    Seeded RANSAC on up to 20,000 points finds the large planes one after the other, each
    refined by least squares. Of these the support plane is the one that most points
    belong to *and stand on*: an empty floor behind the table or a wall has no objects
    within 0.4 m above its visible extent (other large planes do not count as objects).
    Points labelled as objects only vote as things that stand on a plane; points of the
    robot (`ignore_robot`) do not vote.

    Args:
        obs: the observation; labels are used where they exist.
        seed: seed of the random triples; same seed, same plane.
        threshold: half-width of the inlier band in metres up to 1 m of depth; it grows
            with depth squared up to 2 m.
        min_share: smallest share of the pixels with a return that a plane must hold.

    Raises:
        PlaneNotFoundError: no plane is large enough, or none is a surface with empty space
            beneath it.
        ConfigError: `threshold` or `min_share` out of range.
    """
    _check_arguments(threshold, min_share)
    valid = (obs.depth > 0) & ~obs.sees_robot
    points = backproject(obs.depth, obs.intrinsics)[valid]
    is_object = np.zeros(len(points), dtype=bool)
    if obs.labels is not None:
        is_object = obs.labels[valid] > 0
    if (~is_object).sum() < 3:
        raise PlaneNotFoundError(
            f"{int((~is_object).sum())} background pixels have a depth return; at least 3 are "
            "needed to fit the support plane: is every pixel labelled as an object?"
        )
    rng = np.random.default_rng(seed)
    background, standing = points[~is_object], points[is_object]
    sample = background[_choose(len(background), _MAX_POINTS, rng)]
    standing = standing[_choose(len(standing), _MAX_POINTS, rng)]
    candidates = _large_planes(sample, threshold, min_share, rng)
    best = _choose_support(candidates, sample, standing, _up(obs), threshold)
    plane = refine(best.plane, background, inlier_band(background[:, 2], threshold))
    share = float(best.inliers.mean())
    logger.info("support plane holds %.0f %% of the background, rms %.4f m", 100 * share, best.rms)
    return plane.transformed(obs.pose)


def _check_arguments(threshold: float, min_share: float) -> None:
    if not 0.0 < threshold <= 0.2:
        raise ConfigError(f"threshold is {threshold}; it must lie in (0, 0.2] metres")
    if not 0.0 < min_share <= 1.0:
        raise ConfigError(f"min_share is {min_share}; it must lie in (0, 1]")


def _choose(count: int, at_most: int, rng: np.random.Generator) -> np.ndarray:
    if count <= at_most:
        return np.arange(count)
    return np.sort(rng.choice(count, size=at_most, replace=False))


def _up(obs: Observation) -> Float[np.ndarray, " 3"]:
    """Return a guess of 'up' in the camera frame: world z if posed, else the image's up."""
    return obs.pose[2, :3] if obs.posed else np.array([0.0, -1.0, 0.0])


@dataclass(frozen=True, eq=False)
class _Rejection:
    share: float
    below: float


def _large_planes(
    points: Float[np.ndarray, "n 3"],
    threshold: float,
    min_share: float,
    rng: np.random.Generator,
) -> list[PlaneCandidate]:
    """Peel off the largest planes, one by one; `inliers` index into `points`."""
    band = inlier_band(points[:, 2], threshold)
    remaining = np.arange(len(points))
    found: list[PlaneCandidate] = []
    rejected: list[_Rejection] = []
    for _ in range(_MAX_PLANES):
        if len(remaining) < max(3, min_share * len(points)):
            break
        candidate = find_plane(points[remaining], band[remaining], rng)
        if candidate is None:
            break
        share = float(candidate.inliers.sum()) / len(points)
        if share >= min_share and candidate.below <= _MAX_BELOW:
            inliers = np.zeros(len(points), dtype=bool)
            inliers[remaining[candidate.inliers]] = True
            found.append(PlaneCandidate(candidate.plane, inliers, candidate.below, candidate.rms))
        else:
            rejected.append(_Rejection(share, candidate.below))
        if share < min_share:
            break
        # Twice the band: the fringe of a warped surface is not a plane of its own.
        distance = np.abs(candidate.plane.signed_distance(points[remaining]))
        remaining = remaining[distance > 2.0 * band[remaining]]
    if not found:
        raise PlaneNotFoundError(_why_not(rejected, min_share))
    return found


def _why_not(rejected: list[_Rejection], min_share: float) -> str:
    remedy = "is the table in view, and is depth in metres?"
    if not rejected:
        return f"no three background points span a plane; {remedy}"
    largest = max(rejected, key=lambda r: r.share)
    if largest.share < min_share:
        return (
            f"the largest plane holds {100 * largest.share:.1f} % of the background, at least "
            f"{100 * min_share:g} % is needed (min_share); {remedy}"
        )
    return (
        f"the largest flat region ({100 * largest.share:.0f} % of the background) is a slice "
        f"through something curved or noisy, not a surface; {remedy}"
    )


def _choose_support(
    candidates: list[PlaneCandidate],
    sample: Float[np.ndarray, "n 3"],
    standing: Float[np.ndarray, "m 3"],
    up: Float[np.ndarray, " 3"],
    threshold: float,
) -> PlaneCandidate:
    """Return the candidate that carries most: see `fit_plane`.

    The score is the number of points on the plane and standing on it, doubled by
    orientation at most: 'up' is only a hint, since a camera may be mounted upside down.
    """
    # A floor does not stand on the wall it meets, nor a table top on the floor.
    furniture = np.zeros(len(sample), dtype=bool)
    for candidate in candidates:
        if _extent(sample[candidate.inliers], candidate.plane) > _OBJECT_SIZE:
            furniture |= candidate.inliers
    scores = []
    for candidate in candidates:
        on_plane = sample[candidate.inliers]
        others = standing if len(standing) else sample[~candidate.inliers & ~furniture]
        carried = standing_on(candidate.plane, on_plane, others, threshold)
        share = carried.sum() / max(1, len(standing) if len(standing) else len(on_plane))
        # A tenth as many points standing on it as lying on it is a set table.
        full = 0.5 if len(standing) else 0.1
        furnished = 0.1 + min(1.0, float(share) / full)
        tilt = 1.0 + 0.5 * float(np.clip(candidate.plane.normal @ up, -1.0, 1.0))
        scores.append(float(candidate.inliers.sum()) * furnished * tilt)
        logger.debug(
            "plane %s: %d inliers, carries %.3f, score %.0f",
            np.round(candidate.plane.normal, 2),
            candidate.inliers.sum(),
            share,
            scores[-1],
        )
    return candidates[int(np.argmax(scores))]


def _extent(points: Float[np.ndarray, "n 3"], plane: Plane) -> float:
    """Diagonal of the middle 90 % of points on a plane, metres."""
    low, high = np.percentile(points @ plane.axes().T, [5.0, 95.0], axis=0)
    return float(np.linalg.norm(high - low))


def standing_on(
    plane: Plane,
    on_plane: Float[np.ndarray, "n 3"],
    others: Float[np.ndarray, "m 3"],
    threshold: float,
) -> Bool[np.ndarray, " m"]:
    """Which of `others` stand over the plane's visible extent, within 0.4 m of it.

    The extent is a grid of 4 cm cells that hold a point of the plane, grown by one cell
    and closed over gaps of 12 cm: the foot and the shadow of an object are not visible.
    """
    from scipy import ndimage

    height = plane.signed_distance(others)
    high_enough = height > 2.0 * inlier_band(others[:, 2], threshold)
    result = high_enough & (height < _OBJECT_HEIGHT)
    if not result.any() or not len(on_plane):
        return np.zeros(len(others), dtype=bool)
    axes = plane.axes()
    cells = np.floor(on_plane @ axes.T / _CELL).astype(np.int64)
    lower = cells.min(axis=0) - 4
    # Far strays of a distant floor could span a huge grid: cells are kept within 10 m.
    upper = np.minimum(cells.max(axis=0) + 5, lower + int(10.0 / _CELL))
    grid = np.zeros(upper - lower, dtype=bool)
    inside = ((cells >= lower) & (cells < upper)).all(axis=1)
    grid[tuple((cells[inside] - lower).T)] = True
    grid = ndimage.binary_closing(grid, iterations=3)
    grid = ndimage.binary_dilation(grid)
    feet = np.floor(others @ axes.T / _CELL).astype(np.int64) - lower
    inside = ((feet >= 0) & (feet < grid.shape)).all(axis=1)
    result &= inside
    result[result] = grid[tuple(feet[result].T)]
    return result
