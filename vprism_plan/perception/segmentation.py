# SPDX-License-Identifier: BSD-3-Clause
"""Object labels from geometry alone, where the user has no segmentation model."""

import logging
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from vprism_plan.errors import ConfigError, PlaneNotFoundError
from vprism_plan.perception._clusters import cluster_pixels
from vprism_plan.perception._image_graph import (
    SurfaceImage,
    depth_noise,
    flying_pixels,
    specks,
    surface_image,
)
from vprism_plan.perception._table_region import TableRegion, table_region
from vprism_plan.perception.observation import Observation
from vprism_plan.perception.plane import Plane
from vprism_plan.perception.plane_fitting import fit_plane, inlier_band

logger = logging.getLogger(__name__)

_SPECK_PIXELS = 12
_SPECK_AREA = 1e-4
# Sensor noise is removed this far around the table; what is farther away stays as it is.
_WORKSPACE_MARGIN = 0.1
_WORKSPACE_HEIGHT = 1.0
# A cluster belongs to the table if this share of it stands over the table top.
_MIN_ON_TABLE = 0.6


@dataclass(frozen=True)
class _Limits:
    min_height: float
    max_height: float
    max_size: float
    min_area: float
    min_points: int

    def __post_init__(self) -> None:
        for name in ("min_height", "max_height", "max_size", "min_area"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ConfigError(f"{name} is {value}; it must be positive (metres)")
        if self.min_height >= self.max_height:
            raise ConfigError(
                f"min_height {self.min_height} must be less than max_height {self.max_height}"
            )
        if self.min_points < 1:
            raise ConfigError(f"min_points is {self.min_points}; it must be at least 1")


def segment_tabletop(
    obs: Observation,
    *,
    plane: Plane | None = None,
    seed: int = 0,
    min_height: float = 0.012,
    max_height: float = 0.5,
    max_size: float = 0.6,
    min_area: float = 1e-3,
    min_points: int = 50,
    remove_flying: bool = True,
) -> Observation:
    """Label what stands on the support plane, one id per Euclidean cluster.

    Pixels higher than `min_height` (or 3 standard deviations of stereo noise) over the
    plane are linked to their image neighbours unless depth jumps between them; connected
    pieces are clusters. Clusters that touch are told apart where a valley in height runs
    between them; stacked objects stay one. Fragments of one object (a handle, the far
    wall of a cup) are joined to it. Labels run from 1, by falling visible area.

    Pixels that see the robot (`ignore_robot`) are left out of all this.

    What is *not* labelled stays background, and so remains an obstacle: clutter too small,
    too large (`max_size`, `max_height`: walls, people) or not over the table top.

    Flying pixels (`remove_flying`), which stereo sensors invent between the two sides of a
    depth edge, and specks of at most 12 pixels and 1 cm^2 that no surface continues are set
    to depth 0, "no return": they would be obstacles in mid-air and cast shadows. This is
    done only over the table top (10 cm around it, up to 1 m above it); elsewhere no pixel
    is ever dropped. Ramps of more than three pixels stay, as obstacles: they may be the
    side of a box seen at a glancing angle.

    Args:
        obs: observation; existing labels are replaced.
        plane: support plane in the world frame; default: `obs.plane`, else `fit_plane`.
        seed: seed of the plane fit.
        min_height: least height over the plane, metres.
        max_height: largest height of an object, metres.
        max_size: largest horizontal size of an object, metres.
        min_area: least visible area of an object, square metres, measured facing the camera.
        min_points: least number of pixels of an object.
        remove_flying: set flying pixels and specks to "no return".

    Returns:
        The observation with `labels` and `plane` set. If nothing stands on the plane all
        labels are 0; `require_objects` then says so.

    Raises:
        PlaneNotFoundError: no support plane in view (see `fit_plane`).
        ConfigError: a limit that is not positive, or contradicts another.
    """
    limits = _Limits(min_height, max_height, max_size, min_area, min_points)
    unlabelled = replace(obs, labels=None)
    plane = plane or obs.plane or fit_plane(unlabelled, seed=seed)
    points = unlabelled.point_image()
    height = np.nan_to_num(plane.signed_distance(points), nan=-np.inf)
    height[obs.sees_robot] = -np.inf  # neither a surface nor something that stands on it
    region = _visible_table(plane, points, obs.depth, height)
    depth = obs.depth.copy()
    if remove_flying:
        noise = _noise_pixels(obs, plane, points, height, region, min_height)
        depth[noise] = 0.0
        height[noise] = -np.inf
        logger.info("%d flying pixels and specks set to 'no return'", int(noise.sum()))
    image = surface_image(depth, obs.intrinsics, np.where(np.isfinite(height), height, 0.0))
    raised = (depth > 0) & (height > np.maximum(min_height, 3.0 * depth_noise(depth)))
    clusters = cluster_pixels(image, points, plane, raised, min_area)
    labels = _accept(clusters, image, points, region, limits)
    logger.info("%d objects on the support plane", int(labels.max()))
    return replace(obs, depth=depth, labels=labels, plane=plane)


def _visible_table(
    plane: Plane,
    points: Float[np.ndarray, "h w 3"],
    depth: Float[np.ndarray, "h w"],
    height: Float[np.ndarray, "h w"],
) -> TableRegion:
    on_plane = (depth > 0) & (np.abs(height) < inlier_band(depth, 0.01))
    if on_plane.sum() < 3:
        raise PlaneNotFoundError(
            f"{int(on_plane.sum())} observed points lie on the given plane; check its frame and "
            "units, or let it be fitted"
        )
    return table_region(plane, points[on_plane])


def _noise_pixels(
    obs: Observation,
    plane: Plane,
    points: Float[np.ndarray, "h w 3"],
    height: Float[np.ndarray, "h w"],
    region: TableRegion,
    min_height: float,
) -> Bool[np.ndarray, "h w"]:
    """Flying pixels and specks over the table."""
    image = surface_image(obs.depth, obs.intrinsics, np.where(np.isfinite(height), height, 0.0))
    over_table = (height > min_height) & (height < _WORKSPACE_HEIGHT)
    over_table[over_table] = region.contains(points[over_table], _WORKSPACE_MARGIN)
    flying = flying_pixels(image) & over_table
    small = specks(image, (obs.depth > 0) & ~flying, _SPECK_PIXELS, _SPECK_AREA)
    return np.asarray(flying | (small & over_table))


def _accept(
    clusters: Int[np.ndarray, "h w"],
    image: SurfaceImage,
    points: Float[np.ndarray, "h w 3"],
    region: TableRegion,
    limits: _Limits,
) -> Int[np.ndarray, "h w"]:
    """Keep the clusters that can be objects on the table; number them by visible area."""
    accepted: list[tuple[float, int]] = []
    pixels = np.bincount(clusters.ravel())
    areas = np.bincount(clusters.ravel(), weights=(image.pitch**2).ravel())
    large = (pixels >= limits.min_points) & (areas >= limits.min_area)
    large[0] = False
    for cluster in np.flatnonzero(large).tolist():
        member = clusters == cluster
        if np.percentile(image.height[member], 99.0) > limits.max_height:
            continue
        flat = points[member] @ region.axes.T
        size = np.percentile(flat, 99.0, axis=0) - np.percentile(flat, 1.0, axis=0)
        if size.max() > limits.max_size:
            continue
        if region.contains(points[member], 0.02).mean() < _MIN_ON_TABLE:
            continue
        accepted.append((-float(areas[cluster]), cluster))
    number = np.zeros(int(clusters.max()) + 1, dtype=np.int32)
    for label, (_, cluster) in enumerate(sorted(accepted), start=1):
        number[cluster] = label
    return number[clusters]
