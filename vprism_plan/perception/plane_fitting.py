# SPDX-License-Identifier: BSD-3-Clause
"""Find the surface that the objects stand on."""

import logging
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from vprism_plan.errors import ConfigError, PlaneNotFoundError
from vprism_plan.perception._ransac import (
    PlaneCandidate,
    concentration,
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
# A surface that things stand on is level within this many degrees of a pose's z.
LEVEL = 15.0
# How many more points a wall needs to be taken for the support of a scene with a pose.
_LEVEL_BONUS = 20.0
# Part of the band in which a surface is looked for that the whole band mixes with another.
_NARROW = 0.4
# Concentration from which on a plane is a surface, see `concentration`.
_CLEAR = 0.8
# A level surface may hold this part of the share that others need: a board before a wall.
_LEVEL_SHARE = 0.2


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
    Points labelled as objects do not vote for a plane; each object stands on the one that its
    lowest points touch, which the walls of a bin and the back of a shelf are not. Points of
    the robot (`ignore_robot`) do not vote. Where the observation is posed, a surface within
    15 degrees of level is preferred to walls, and may hold a fifth of `min_share`.

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
    chosen = _choose(len(standing), _MAX_POINTS, rng)
    standing = standing[chosen]
    ids = None if obs.labels is None else obs.labels[valid][is_object][chosen]
    band = inlier_band(sample[:, 2], threshold)
    everywhere = np.ones(len(sample), dtype=bool)
    candidates, rejected = _peel(sample, band, everywhere, min_share, rng)
    candidates += _overlooked(candidates, sample, band, min_share, rng, obs)
    if not candidates:
        raise PlaneNotFoundError(_why_not(rejected, min_share))
    best = _choose_support(candidates, sample, standing, ids, obs, threshold)
    band = inlier_band(background[:, 2], threshold)
    plane = refine(best.plane, background, band)
    if concentration(plane, background, band) < _CLEAR:
        plane = refine(best.plane, background, _NARROW * band)
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


def _is_level(plane: Plane, obs: Observation) -> bool:
    """Whether a plane in the camera frame is level, seen from above, by the pose."""
    return bool(plane.normal @ _up(obs) > np.cos(np.radians(LEVEL)))


@dataclass(frozen=True, eq=False)
class _Rejection:
    share: float
    below: float


def _peel(
    points: Float[np.ndarray, "n 3"],
    band: Float[np.ndarray, " n"],
    among: Bool[np.ndarray, " n"],
    min_share: float,
    rng: np.random.Generator,
    up: Float[np.ndarray, " 3"] | None = None,
) -> tuple[list[PlaneCandidate], list[_Rejection]]:
    """Peel the largest planes off some of the points, one by one; with `up`, level ones only.

    Returns planes, whose `inliers` index into `points`, and what was none.
    """
    remaining = np.flatnonzero(among)
    found: list[PlaneCandidate] = []
    rejected: list[_Rejection] = []
    for _ in range(_MAX_PLANES):
        if len(remaining) < max(3, min_share * len(points)):
            break
        candidate = find_plane(points[remaining], band[remaining], rng, up, LEVEL)
        if candidate is None:
            break
        share = float(candidate.inliers.sum()) / len(points)
        inliers = np.zeros(len(points), dtype=bool)
        inliers[remaining[candidate.inliers]] = True
        below = max(candidate.below, _seen_through(candidate.plane, points, band, inliers))
        if share >= min_share and below <= _MAX_BELOW:
            found.append(PlaneCandidate(candidate.plane, inliers, below, candidate.rms))
        else:
            rejected.append(_Rejection(share, below))
        if share < min_share:
            break
        # Twice the band: the fringe of a warped surface is not a plane of its own.
        distance = np.abs(candidate.plane.signed_distance(points[remaining]))
        remaining = remaining[distance > 2.0 * band[remaining]]
    return found, rejected


def _overlooked(
    candidates: list[PlaneCandidate],
    points: Float[np.ndarray, "n 3"],
    band: Float[np.ndarray, " n"],
    min_share: float,
    rng: np.random.Generator,
    obs: Observation,
) -> list[PlaneCandidate]:
    """Surfaces that the band mixed with others and, with a pose, small level ones.

    A narrow band tells the floor of a bin from the foot of its walls.
    """
    clear = [concentration(c.plane, points, band) >= _CLEAR for c in candidates]
    if all(clear) and not obs.posed:
        return []
    narrow, rest = _NARROW * band, np.ones(len(points), dtype=bool)
    for candidate, is_clear in zip(candidates, clear, strict=True):
        if is_clear:
            level = obs.posed and _is_level(candidate.plane, obs)
            rest &= np.abs(candidate.plane.signed_distance(points)) > 2.0 * (
                band if level else narrow
            )
    up, share = None, min_share
    if obs.posed:
        up, share = _up(obs), _LEVEL_SHARE * min_share
    found = []
    for other in _peel(points, narrow, rest, share, rng, up)[0]:
        if concentration(other.plane, points[rest], narrow[rest]) >= _CLEAR:
            whole = np.abs(other.plane.signed_distance(points)) < band
            found.append(PlaneCandidate(other.plane, whole, other.below, other.rms))
    return found


def _seen_through(
    plane: Plane,
    points: Float[np.ndarray, "n 3"],
    band: Float[np.ndarray, " n"],
    inliers: Bool[np.ndarray, " n"],
) -> float:
    """Share of points just under the inliers' own 4 cm cells, those of other planes included.

    A ring around the walls of a bin, above the floor that was peeled off, is no surface.
    """
    height = plane.signed_distance(points) / band
    under = points[(height <= -1.0) & (height > -3.0)]
    seen = over_extent(plane, points[inliers], under, grown=False)
    return float(seen.sum()) / max(1, int(inliers.sum()))


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
    ids: Int[np.ndarray, " m"] | None,
    obs: Observation,
    threshold: float,
) -> PlaneCandidate:
    """Return the candidate that carries most: see `fit_plane`.

    The score is the number of points on the plane, times how much stands on it, times its
    orientation. Without a pose 'up' is only a hint, since a camera may be mounted upside
    down; with one, a level surface is preferred to any wall that carries as much.
    """
    if ids is not None and len(ids):
        least, carried = 0.02, _touched(candidates, sample, standing, ids, threshold)
    else:
        least, carried = 0.1, _furnished(candidates, sample, threshold)
    up = _up(obs)
    scores = []
    for candidate, share in zip(candidates, carried, strict=True):
        cosine = float(np.clip(candidate.plane.normal @ up, -1.0, 1.0))
        upright = 1.0 + 0.5 * cosine
        if obs.posed and _is_level(candidate.plane, obs):
            upright *= _LEVEL_BONUS
        scores.append(float(candidate.inliers.sum()) * (least + min(1.0, float(share))) * upright)
        logger.debug(
            "plane %s: %d inliers, carries %.3f, score %.0f",
            np.round(candidate.plane.normal, 2),
            candidate.inliers.sum(),
            share,
            scores[-1],
        )
    return candidates[int(np.argmax(scores))]


def _furnished(
    candidates: list[PlaneCandidate], sample: Float[np.ndarray, "n 3"], threshold: float
) -> list[float]:
    """How full each plane is with unlabelled things; 1 is a set table."""
    # A floor does not stand on the wall it meets, nor a table top on the floor.
    furniture = np.zeros(len(sample), dtype=bool)
    for candidate in candidates:
        if _extent(sample[candidate.inliers], candidate.plane) > _OBJECT_SIZE:
            furniture |= candidate.inliers
    result = []
    for candidate in candidates:
        on_plane = sample[candidate.inliers]
        others = sample[~candidate.inliers & ~furniture]
        standing = standing_on(candidate.plane, on_plane, others, threshold)
        # A tenth as many points standing on it as lying on it is a set table.
        result.append(float(standing.sum()) / max(1, len(on_plane)) / 0.1)
    return result


def _touched(
    candidates: list[PlaneCandidate],
    sample: Float[np.ndarray, "n 3"],
    standing: Float[np.ndarray, "m 3"],
    ids: Int[np.ndarray, " m"],
    threshold: float,
) -> list[float]:
    """How many of the objects each plane carries; 1 is half of them.

    An object is carried by the plane that its lowest points come nearest to, of those over
    whose visible extent it lies and that it does not reach through. All things in a bin
    lie over its walls as well, but few touch them.
    """
    numbers = np.unique(ids)
    gaps = np.full((len(candidates), len(numbers)), np.inf)
    for gap, candidate in zip(gaps, candidates, strict=True):
        height = candidate.plane.signed_distance(standing)
        over = over_extent(candidate.plane, sample[candidate.inliers], standing)
        for index, number in enumerate(numbers):
            own = ids == number
            # Not the very lowest: masks and edges bleed.
            low = float(np.percentile(height[own], 5.0))
            sunk = low < -2.0 * threshold
            if not sunk and low < _OBJECT_HEIGHT and over[own].mean() > 0.5:
                gap[index] = max(low, 0.0)
    gaps = gaps[:, np.isfinite(gaps).any(axis=0)]
    if gaps.size == 0:
        return [0.0] * len(candidates)
    nearest = gaps <= gaps.min(axis=0) + threshold
    share = (nearest / nearest.sum(axis=0)).sum(axis=1) / len(numbers)
    return (share / 0.5).tolist()


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
    """Which of `others` stand over the plane's visible extent, within 0.4 m of it."""
    height = plane.signed_distance(others)
    high_enough = height > 2.0 * inlier_band(others[:, 2], threshold)
    result = high_enough & (height < _OBJECT_HEIGHT)
    result[result] = over_extent(plane, on_plane, others[result])
    return result


def over_extent(
    plane: Plane,
    on_plane: Float[np.ndarray, "n 3"],
    others: Float[np.ndarray, "m 3"],
    grown: bool = True,
) -> Bool[np.ndarray, " m"]:
    """Which of `others` have their foot on the plane's visible extent.

    The extent is a grid of 4 cm cells that hold a point of the plane. `grown`, it is closed
    over gaps of 12 cm and one cell wider: the foot and the shadow of an object are not visible.
    """
    from scipy import ndimage

    if not len(on_plane):
        return np.zeros(len(others), dtype=bool)
    axes = plane.axes()
    cells = np.floor(on_plane @ axes.T / _CELL).astype(np.int64)
    lower = cells.min(axis=0) - 4
    # Far strays of a distant floor could span a huge grid: cells are kept within 10 m.
    upper = np.minimum(cells.max(axis=0) + 5, lower + int(10.0 / _CELL))
    grid = np.zeros(upper - lower, dtype=bool)
    inside = ((cells >= lower) & (cells < upper)).all(axis=1)
    grid[tuple((cells[inside] - lower).T)] = True
    if grown:
        grid = ndimage.binary_closing(grid, iterations=3)
        grid = ndimage.binary_dilation(grid)
    feet = np.floor(others @ axes.T / _CELL).astype(np.int64) - lower
    inside = ((feet >= 0) & (feet < grid.shape)).all(axis=1)
    inside[inside] = grid[tuple(feet[inside].T)]
    return inside
