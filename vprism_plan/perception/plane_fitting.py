# SPDX-License-Identifier: BSD-3-Clause
"""Find the surface that the objects stand on, and put the world frame on it.

RANSAC for planes (Fischler and Bolles, 1981) with least-squares refinement, in the camera
frame; each point has its own inlier band, since noise grows with depth.
"""

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator
from scipy.spatial import cKDTree

from vprism_plan._arguments import number
from vprism_plan._shapes import Chosen, Indices, Points, Values, Vector
from vprism_plan.errors import ObservationError, PlaneNotFoundError
from vprism_plan.perception.camera import backproject, inlier_band, invert_transform
from vprism_plan.perception.observation import Observation
from vprism_plan.perception.plane import Plane, facing, over_extent, refine

logger = logging.getLogger(__name__)

_MAX_POINTS, _MAX_PLANES = 20_000, 6
_MAX_BELOW = 0.3  # share of inliers just below a surface: seen past its edge, not through it
_OBJECT_HEIGHT = 0.4  # metres; what stands higher on a table does not vote for it
_OBJECT_SIZE = 0.6  # metres; a larger flat patch is furniture or a wall, not the side of an object
# Cosine of a surface that things stand on with a pose's z; how many more points a wall needs.
_LEVEL, _LEVEL_BONUS = float(np.cos(np.radians(15.0))), 20.0
_NARROW = 0.4  # of the band, where the whole band mixes a surface with another
_CLEAR = 0.8  # concentration from which on a plane is a surface, see `_concentration`
_LEVEL_SHARE = 0.2  # of the share that others need, for a level surface: a board before a wall
# Triples of points that are tried, points that score them, the best of them that are refined.
_HYPOTHESES, _SCORING_POINTS, _NEIGHBOURS, _REFINED = 768, 2000, 100, 8


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A plane of the camera frame, and those of the points it was fitted to that support it."""

    plane: Plane
    inliers: Chosen  # the points in their band around the plane


def fit_plane(
    obs: Observation, *, seed: int = 0, threshold: float = 0.01, min_share: float = 0.05
) -> Plane:
    """Fit the support plane of the objects, in the world frame, normal towards the camera.

    Seeded RANSAC on up to 20,000 points finds the large planes one after the other. Of these
    the support plane is the one that most points belong to *and stand on*: an empty floor
    behind the table or a wall has no objects within 0.4 m above its visible extent (other
    large planes do not count as objects). Points labelled as objects do not vote for a plane;
    each object stands on the one that its lowest points touch, which the walls of a bin and
    the back of a shelf are not. Points of the robot (`ignore_robot`) do not vote. Where the
    observation is posed, a surface within 15 degrees of level is preferred to walls, and may
    hold a fifth of `min_share`.

    Args:
        obs: the observation; labels are used where they exist.
        seed: seed of the random triples; same seed, same plane.
        threshold: half-width of the inlier band in metres up to 1 m of depth; it grows
            with depth squared up to 2 m.
        min_share: smallest share of the pixels with a return that a plane must hold.

    Raises:
        PlaneNotFoundError: no plane is large enough, or a surface with empty space beneath it.
        ConfigError: `threshold` (0 to 0.2 m) or `min_share` (0 to 1) out of range.
    """
    number("threshold", threshold, 0.0, 0.2, "metres", above=True)
    number("min_share", min_share, 0.0, 1.0, above=True)
    valid = (obs.depth > 0) & ~obs.sees_robot
    points = backproject(obs.depth, obs.intrinsics)[valid]
    labels = np.zeros(len(points), dtype=np.int32) if obs.labels is None else obs.labels[valid]
    background, standing, ids = points[labels <= 0], points[labels > 0], labels[labels > 0]
    if len(background) < 3:
        raise PlaneNotFoundError(
            f"{len(background)} background pixels have a depth return; at least 3 are "
            "needed to fit the support plane: is every pixel labelled as an object?"
        )
    rng = np.random.default_rng(seed)
    sample = background[_choose(len(background), rng)]
    chosen = _choose(len(standing), rng)
    band = inlier_band(sample[:, 2], threshold)
    everywhere = np.ones(len(sample), dtype=bool)
    candidates, rejected = _peel(sample, band, everywhere, min_share, rng, None)
    candidates += _overlooked(candidates, sample, band, min_share, rng, obs)
    if not candidates:
        raise PlaneNotFoundError(_why_not(rejected, min_share))
    if len(ids):
        least = 0.02
        carried = _touched(candidates, sample, standing[chosen], ids[chosen], threshold)
    else:
        least, carried = 0.1, _furnished(candidates, sample, threshold)
    # Points on the plane, times how much stands on it, times its orientation. Without a pose
    # 'up' is only a hint, since a camera may be mounted upside down.
    scores = []
    for candidate, share in zip(candidates, carried, strict=True):
        upright = 1.0 + 0.5 * float(np.clip(candidate.plane.normal @ _up(obs), -1.0, 1.0))
        if obs.posed and _is_level(candidate.plane, obs):
            upright *= _LEVEL_BONUS
        scores.append(float(candidate.inliers.sum()) * (least + min(1.0, float(share))) * upright)
    best = candidates[int(np.argmax(scores))]
    logger.debug("scores %s of %s", np.round(scores), [c.plane for c in candidates])
    band = inlier_band(background[:, 2], threshold)
    plane = refine(best.plane, background, band)
    if _concentration(plane, background, band) < _CLEAR:
        plane = refine(best.plane, background, _NARROW * band)
    share, distance = 100 * best.inliers.mean(), best.plane.signed_distance(sample[best.inliers])
    rms = float(np.sqrt(np.mean(distance**2)))
    logger.info("support plane holds %.0f %% of the background, rms %.4f m", share, rms)
    return plane.transformed(obs.pose)


def _choose(count: int, rng: Generator) -> Indices:
    if count <= _MAX_POINTS:
        return np.arange(count)
    return np.sort(rng.choice(count, size=_MAX_POINTS, replace=False))


def _up(obs: Observation) -> Vector:
    """Return a guess of 'up' in the camera frame: world z if posed, else the image's up."""
    return obs.pose[2, :3] if obs.posed else np.array([0.0, -1.0, 0.0])


def _is_level(plane: Plane, obs: Observation) -> bool:
    """Whether a plane in the camera frame is level, seen from above, by the pose."""
    return bool(plane.normal @ _up(obs) > _LEVEL)


# ------------------------------------------------------------------------- planes among points
def _peel(
    points: Points, band: Values, among: Chosen, min_share: float, rng: Generator, up: Vector | None
) -> tuple[list[_Candidate], list[tuple[float, float]]]:
    """Peel the largest (level) planes off some of the points; return share, `below` of others."""
    remaining = among.copy()
    found: list[_Candidate] = []
    rejected: list[tuple[float, float]] = []
    for _ in range(_MAX_PLANES):
        if remaining.sum() < max(3, min_share * len(points)):
            break
        plane = _find_plane(points[remaining], band[remaining], rng, up)
        if plane is None:
            break
        height = plane.signed_distance(points) / band
        inliers = remaining & (np.abs(height) < 1.0)
        count = int(inliers.sum())
        share = count / len(points)
        # Points in the two bands just under the plane, per inlier. Nothing is seen through a
        # surface: near 0 for a real one, about 1 for a slice through something curved or noisy.
        # A ring around the walls of a bin, above the floor that was peeled off, is no surface:
        # other planes' points under its own cells count as well.
        under = (height <= -1.0) & (height > -3.0)
        through = over_extent(plane, points[inliers], points[under], grown=False)
        below = float(max((under & remaining).sum(), through.sum())) / max(1, count)
        if share >= min_share and below <= _MAX_BELOW:
            found.append(_Candidate(plane, inliers))
        else:
            rejected.append((share, below))
        if share < min_share:
            break
        # Twice the band: the fringe of a warped surface is not a plane of its own.
        remaining &= np.abs(height) > 2.0
    return found, rejected


def _overlooked(
    candidates: list[_Candidate],
    points: Points,
    band: Values,
    min_share: float,
    rng: Generator,
    obs: Observation,
) -> list[_Candidate]:
    """Surfaces that the band mixed, as a bin's floor and walls, and small level ones if posed."""
    clear = [_concentration(c.plane, points, band) >= _CLEAR for c in candidates]
    if all(clear) and not obs.posed:
        return []
    narrow, rest = _NARROW * band, np.ones(len(points), dtype=bool)
    for candidate, is_clear in zip(candidates, clear, strict=True):
        if is_clear:
            width = band if obs.posed and _is_level(candidate.plane, obs) else narrow
            rest &= np.abs(candidate.plane.signed_distance(points)) > 2.0 * width
    up, share = (_up(obs), _LEVEL_SHARE * min_share) if obs.posed else (None, min_share)
    return [
        replace(other, inliers=np.abs(other.plane.signed_distance(points)) < band)
        for other in _peel(points, narrow, rest, share, rng, up)[0]
        if _concentration(other.plane, points[rest], narrow[rest]) >= _CLEAR
    ]


def _concentration(plane: Plane, points: Points, band: Values) -> float:
    """Share of the points in the band in its middle half: 0.8 to 1 for a table, 0.5 for a mix."""
    height = np.abs(plane.signed_distance(points)) / band
    return float((height < 0.5).sum()) / max(1, int((height < 1.0).sum()))


def _find_plane(points: Points, band: Values, rng: Generator, up: Vector | None) -> Plane | None:
    """Return the plane with most points in its band, or None if no triple spans one.

    Two thirds of the hypotheses take their three points from one neighbourhood: on a
    cluttered scene three random points rarely share a surface, three neighbours mostly
    do. The best few are refined on all points. With `up`, only level planes count.
    """
    least = -2.0 if up is None else _LEVEL
    up = np.zeros(3) if up is None else up
    subset = rng.choice(len(points), size=min(len(points), _SCORING_POINTS), replace=False)
    scored, scored_band = points[subset], band[subset]
    normals, offsets = _hypotheses(scored, rng)
    towards_camera = np.where(offsets > 0, -1.0, 1.0)
    level = towards_camera * (normals @ up) >= least
    normals, offsets = normals[level], offsets[level]
    counts = np.empty(len(normals), dtype=np.int64)
    for start in range(0, len(normals), 128):
        part = slice(start, start + 128)
        distance = np.abs(scored @ normals[part].T - offsets[part])
        counts[part] = (distance < scored_band[:, None]).sum(axis=0)
    best, most = None, -1
    for index in np.argsort(-counts, kind="stable")[:_REFINED]:
        plane = refine(facing(normals[index], float(offsets[index])), points, band)
        if plane.normal @ up < least:
            continue
        count = int((np.abs(plane.signed_distance(points)) < band).sum())
        if count > most:
            best, most = plane, count
    return best


def _hypotheses(points: Points, rng: Generator) -> tuple[Points, Values]:
    """Normals and offsets of planes through triples of points, degenerate triples dropped."""
    n_local = 2 * _HYPOTHESES // 3
    neighbours = min(_NEIGHBOURS, len(points))
    anchors = rng.integers(len(points), size=n_local)
    near = np.asarray(cKDTree(points).query(points[anchors], k=neighbours)[1])
    pick = rng.integers(neighbours, size=(n_local, 2))
    local = np.column_stack([anchors, np.take_along_axis(near, pick, axis=1)])
    triples = np.concatenate([local, rng.integers(len(points), size=(_HYPOTHESES - n_local, 3))])
    a, b, c = points[triples.T]
    normals = np.cross(b - a, c - a)
    area = np.linalg.norm(normals, axis=1)
    longest = np.maximum(np.linalg.norm(b - a, axis=1), np.linalg.norm(c - a, axis=1))
    usable = (area > 1e-3 * longest**2) & (area > 0)
    normals = normals[usable] / area[usable, None]
    return normals, np.einsum("ij,ij->i", normals, a[usable])


def _why_not(rejected: list[tuple[float, float]], min_share: float) -> str:
    largest = 100 * max((share for share, _ in rejected), default=0.0)
    if not rejected:
        found = "no three background points span a plane"
    elif largest < 100 * min_share:
        needed = f"at least {100 * min_share:g} % is needed (min_share)"
        found = f"the largest plane holds {largest:.1f} % of the background, {needed}"
    else:
        region = f"the largest flat region ({largest:.0f} % of the background)"
        found = f"{region} is a slice through something curved or noisy, not a surface"
    return f"{found}; is the table in view, and is depth in metres?"


# ----------------------------------------------------------------------- what stands on a plane
def _furnished(candidates: list[_Candidate], sample: Points, threshold: float) -> list[float]:
    """How full each plane is with unlabelled things; 1 is a set table."""
    # A floor does not stand on the wall it meets, nor a table top on the floor.
    furniture = np.zeros(len(sample), dtype=bool)
    for candidate in candidates:
        flat = sample[candidate.inliers] @ candidate.plane.axes().T
        low, high = np.percentile(flat, [5.0, 95.0], axis=0)
        if np.linalg.norm(high - low) > _OBJECT_SIZE:
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
    candidates: list[_Candidate],
    sample: Points,
    standing: Points,
    ids: np.ndarray,
    threshold: float,
) -> list[float]:
    """How many of the objects each plane carries; 1 is half of them.

    An object is carried by the plane that its lowest points come nearest to, of those over
    whose extent it lies and that it does not reach through: few things in a bin touch its walls.
    """
    numbers = np.unique(ids)
    gaps = np.full((len(candidates), len(numbers)), np.inf)
    for gap, candidate in zip(gaps, candidates, strict=True):
        height = candidate.plane.signed_distance(standing)
        over = over_extent(candidate.plane, sample[candidate.inliers], standing)
        for index, one in enumerate(numbers):
            own = ids == one
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


def standing_on(plane: Plane, on_plane: Points, others: Points, threshold: float) -> Chosen:
    """Which of `others` stand over the plane's visible extent, within 0.4 m of it."""
    height = plane.signed_distance(others)
    high_enough = height > 2.0 * inlier_band(others[:, 2], threshold)
    result = high_enough & (height < _OBJECT_HEIGHT)
    result[result] = over_extent(plane, on_plane, others[result])
    return result


# ------------------------------------------------------------------------- the world on a plane
def align_to_table(obs: Observation, *, plane: Plane | None = None, seed: int = 0) -> Observation:
    """Return the observation in a world frame that stands on its support plane.

    World z is the plane's normal and the plane is z = 0. The origin is the foot of the
    objects' mean point (of the plane's own points if the observation is unlabelled). World x is
    the camera's viewing direction laid into the plane; seen from straight above, the image's
    upward direction. y completes the right-handed frame (left of the view).

    Args:
        obs: posed or unposed; an existing pose is replaced.
        plane: support plane in the world frame of `obs`; default: `obs.plane`, else fitted.
        seed: seed of the plane fit.

    Raises:
        PlaneNotFoundError: no support plane (see `fit_plane`).
        ObservationError: the camera lies in the plane or below it.
    """
    plane = plane or obs.plane or fit_plane(obs, seed=seed)
    plane = plane.transformed(invert_transform(obs.pose))
    if plane.offset >= -1e-6:
        raise ObservationError(
            f"the camera is {-plane.offset:.3g} m above the support plane; it must be on "
            "the side that the plane's normal points to: flip the plane's normal"
        )
    z = plane.normal
    x = np.array([0.0, 0.0, 1.0]) - z[2] * z
    if np.linalg.norm(x) < 0.05:
        image_up = np.array([0.0, -1.0, 0.0])
        x = image_up - (image_up @ z) * z
    x = x / np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z])
    pose[:3, 3] = -pose[:3, :3] @ _origin(obs, plane)
    return replace(obs, T_world_camera=pose, plane=Plane(np.array([0.0, 0.0, 1.0]), 0.0))


def _origin(obs: Observation, plane: Plane) -> Vector:
    """Origin of the table frame, camera coordinates."""
    points, labels = replace(obs, T_world_camera=None, plane=None).points()
    chosen = points[labels > 0]
    if not len(chosen):
        points = points[~obs.sees_robot[obs.depth > 0]]
        band = inlier_band(points[:, 2], 0.01)
        chosen = points[np.abs(plane.signed_distance(points)) < band]
    if not len(chosen):
        raise ObservationError(
            "no observed point lies on the given support plane and no object is labelled, so "
            "there is nothing to put the origin under; check the plane's frame and units"
        )
    return plane.project(chosen.mean(axis=0))
