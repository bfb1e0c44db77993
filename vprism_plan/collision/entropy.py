# SPDX-License-Identifier: BSD-3-Clause
"""How unsure the map is of the space that a robot passes through, in nats."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from vprism_plan._arguments import number
from vprism_plan.collision.explain import unit_ball_points
from vprism_plan.collision.motion import edges_of, place_points
from vprism_plan.collision.packing import Numbers, Rows, Waypoints
from vprism_plan.collision.reports import Answer
from vprism_plan.errors import RobotError
from vprism_plan.robots.kinematics import frame_poses
from vprism_plan.world.grid import Chosen, Index, Points

_POINTS = 64  # per sphere and waypoint
_MAX_CELLS = 200_000_000
_CHUNK = 1 << 20  # voxel candidates in memory at once


@dataclass(frozen=True)
class PathEntropy(Answer):
    """Answer of `path_entropy`; nats. Only links that joints move count.

    The map's entropy means something where it has support (kernel mass at least
    `WorldConfig.min_support`); elsewhere it repeats the prior. Means, maxima and totals are over
    supported volume only; the rest is reported as a share.

    Attributes:
        waypoint_mean: (T,) average over the spheres' supported volume; nan where there is none.
        waypoint_max: (T,) largest average of any one sphere; nan likewise.
        waypoint_unsupported: (T,) share of the spheres' volume without support.
        swept_total: integral over the supported part of the volume that the spheres sweep along the
            path, m^3 nats; every voxel counts once.
        swept_mean: its average there; nan if nothing is supported.
        swept_volume: all of the swept volume, m^3.
        unsupported_share: share of the swept volume without support.
        resolution: edge of the voxels, metres. One is swept if its centre is in some sphere at some
            sampled configuration.
        spacing: largest motion between two samples, metres.
        configurations: samples on the path.
        voxels: voxels swept.
        map_points: points at which the map was evaluated: what the answer cost.
    """

    waypoint_mean: tuple[float, ...]
    waypoint_max: tuple[float, ...]
    waypoint_unsupported: tuple[float, ...]
    swept_total: float
    swept_mean: float
    swept_volume: float
    unsupported_share: float
    resolution: float
    spacing: float
    configurations: int
    voxels: int
    map_points: int

    def text(self) -> str:
        """Return the answer in one line."""
        mean = "no support" if np.isnan(self.swept_mean) else f"mean entropy {self.swept_mean:.3f}"
        return (
            f"{mean} nats over the supported {100 * (1 - self.unsupported_share):.0f}% of "
            f"{1000 * self.swept_volume:.1f} l swept (total {1000 * self.swept_total:.3f} l nats, "
            f"voxels of {1000 * self.resolution:g} mm)"
        )


def path_entropy(checker: Any, q_or_path: Numbers, resolution: float = 0.01) -> PathEntropy:
    """Return the map's entropy along a path and over the volume it sweeps.

    Per waypoint 64 points in every sphere are asked; in the swept volume every voxel whose centre
    some sphere covers, once. Nothing moves more than half a voxel between samples: between two
    balls of radius r that leaves out a rim at most resolution^2 / (32 r) deep. O(configurations x
    spheres x voxels per sphere) additions and one evaluation of the map per voxel near its support.

    Args:
        checker: a `CollisionChecker` over a `World`.
        q_or_path: (T, dof) waypoints, or (dof,) one configuration.
        resolution: edge of a voxel, metres.

    Raises:
        RobotError: see `waypoints`; or the resolution is too fine for the path.
    """
    number("resolution", resolution, 0.0, unit="metres", above=True, error=RobotError)
    edges = edges_of(checker, q_or_path, single=True)
    Q, _ = edges.samples(0.25 * resolution)
    mean, most, unsupported, asked = _at_waypoints(checker, edges.path)
    voxels = swept_voxels(checker, Q, resolution)
    entropy, supported, more = _entropy(checker, resolution * voxels)
    cell = resolution**3
    return PathEntropy(
        waypoint_mean=mean,
        waypoint_max=most,
        waypoint_unsupported=unsupported,
        swept_total=cell * float(entropy.sum()),
        swept_mean=float(entropy.mean()) if len(entropy) else np.nan,
        swept_volume=cell * len(voxels),
        unsupported_share=1.0 - float(supported.mean()) if len(voxels) else 0.0,
        resolution=resolution,
        spacing=0.5 * resolution,
        configurations=len(Q),
        voxels=len(voxels),
        map_points=asked + more,
    )


def _moving(checker: Any, Q: Rows) -> tuple[Float[np.ndarray, "n s 3"], Float[np.ndarray, " s"]]:
    """Centres (world) and radii of the spheres of the links that joints move, metres."""
    arrays = checker.robot.arrays
    spheres = np.flatnonzero(~np.asarray(arrays.link_fixed)[arrays.sphere_link])
    R, t = frame_poses(arrays, Q)
    centers = place_points(R, t, arrays.sphere_frame[spheres], arrays.sphere_center[spheres])
    return centers, arrays.sphere_radius[spheres]


def _entropy(checker: Any, points: Points) -> tuple[Float[np.ndarray, " k"], Chosen, int]:
    """Entropy, nats, of the points with support; which those are; how many the map was asked."""
    map_, least = checker.world.map, checker.world.config.min_support
    lower, upper = map_.support_bounds()
    near = ((points > lower) & (points < upper)).all(axis=1)
    supported = near.copy()
    supported[near] = np.asarray(map_.support(points[near])) >= least
    if least <= 0.0:
        supported[:] = True
    entropy = np.asarray(map_.entropy(points[supported]))
    return entropy, supported, int(near.sum() + supported.sum())


def _at_waypoints(
    checker: Any, path: Waypoints
) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...], int]:
    """Mean, largest sphere average and unsupported share per waypoint; points asked."""
    ball = unit_ball_points(_POINTS, surface=False)
    mean, most, unsupported, asked = [], [], [], 0
    for q in path:
        centers, radii = _moving(checker, q[None])
        points = (centers[0][:, None] + radii[:, None, None] * ball).reshape(-1, 3)
        entropy, supported, count = _entropy(checker, points)
        asked += count
        values = np.zeros(len(points))
        values[supported] = entropy
        known = supported.reshape(-1, _POINTS).sum(axis=1)
        sums = values.reshape(-1, _POINTS).sum(axis=1)
        weight = radii**3
        total = float(weight @ known)
        mean.append(float(weight @ sums) / total if total > 0 else np.nan)
        most.append(float((sums[known > 0] / known[known > 0]).max()) if known.any() else np.nan)
        whole = _POINTS * float(weight.sum())
        unsupported.append(1.0 - total / whole if whole > 0 else 0.0)
    return tuple(mean), tuple(most), tuple(unsupported), asked


def swept_voxels(checker: Any, Q: Rows, resolution: float) -> Int[np.ndarray, "v 3"]:
    """Voxels (centres at resolution * (i, j, k), world, metres), each once, whose centre lies in
    a sphere of a moving link at some row of Q; RobotError if they would be too many."""
    centers, radii = _moving(checker, Q)
    ways = [_thinned(way, 0.5 * resolution) for way in np.moveaxis(centers, 1, 0)]
    places = np.concatenate([np.empty((0, 3)), *ways])
    return voxels_in(places, np.repeat(radii, [len(way) for way in ways]), resolution)


def voxels_in(
    centers: Points, radii: Float[np.ndarray, " n"], resolution: float
) -> Int[np.ndarray, "v 3"]:
    """The same for any balls."""
    if len(radii) == 0:
        return np.empty((0, 3), dtype=np.int64)
    grown = radii[:, None] + 2.0 * resolution
    low = np.floor((centers - grown).min(axis=0) / resolution).astype(np.int64)
    high = np.ceil((centers + grown).max(axis=0) / resolution).astype(np.int64)
    shape = tuple(int(n) for n in high - low + 1)
    if float(np.prod(high - low + 1.0)) > _MAX_CELLS:
        raise RobotError(
            f"voxels of {resolution:g} m over what the robot sweeps would be "
            f"{' x '.join(map(str, shape))} (at most {_MAX_CELLS:,}); give a coarser resolution"
        )
    swept = np.zeros(shape, dtype=bool)
    for radius in np.unique(radii).tolist():
        _stamp(swept, low, centers[radii == radius], radius, resolution)
    return np.argwhere(swept) + low


def _thinned(centers: Points, spacing: float) -> Float[np.ndarray, "m 3"]:
    """Leave out centres as long as the way between those kept is at most the spacing."""
    way = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(way)])
    kept = [0]
    while kept[-1] < len(centers) - 1:
        reach = int(np.searchsorted(along, along[kept[-1]] + spacing, side="right")) - 1
        kept.append(max(reach, kept[-1] + 1))
    return centers[kept]


def _stamp(
    swept: Bool[np.ndarray, "x y z"], low: Index, centers: Points, radius: float, resolution: float
) -> None:
    """Mark the voxels whose centres lie in any of some balls of one radius."""
    span = np.arange(2 * (int(radius / resolution) + 1) + 1)
    first = np.ceil((centers - radius) / resolution - 1.0).astype(np.int64)
    step = max(1, _CHUNK // len(span) ** 3)
    for begin in range(0, len(centers), step):
        corner = first[begin : begin + step]
        away = resolution * (corner[:, :, None] + span) - centers[begin : begin + step, :, None]
        x, y, z = np.moveaxis(away**2, 1, 0)
        inside = x[:, :, None, None] + y[:, None, :, None] + z[:, None, None, :] <= radius**2
        for (i, j, k), ball in zip((corner - low).tolist(), inside, strict=True):
            n = len(span)
            swept[i : i + n, j : j + n, k : k + n] |= ball
