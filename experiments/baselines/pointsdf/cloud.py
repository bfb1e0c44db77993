# SPDX-License-Identifier: BSD-3-Clause
"""From what a camera saw of one object to what the network is given, and back.

The network never sees metres. A partial cloud is turned so that z points away from the
table and x from the camera to the object (level), moved so that its bounding box is centred
and scaled so that its farthest point has length 1. The scale in metres, the height above the
table and the camera's elevation are given beside it.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from vprism_plan.errors import ObservationError
from vprism_plan.mapping.training_data import grid_subsample
from vprism_plan.perception.plane import Plane

CONTEXT = 3  # numbers beside the cloud: log scale, height of the centre, elevation
_RESOLUTION = 0.003  # metres: cells that the pixels are averaged in, against their noise
_NEIGHBOUR_RADIUS, _NEIGHBOURS = 0.01, 5  # fewer points than this within 1 cm are stray
_MIN_SCALE = 0.015  # metres
_TYPICAL_SCALE = 0.08  # metres; its logarithm is the zero of the context
_MARGIN = (0.05, 0.12)  # metres around the cloud's box, by its scale
_UNDER_TABLE = 0.02  # metres that the box reaches below the support plane


@dataclass(frozen=True, eq=False)
class ObjectFrame:
    """Where the network's coordinates of one object lie in the world.

    Attributes:
        rotation: (3, 3) rows are the axes in the world: away from the camera (level), to the
            left, up from the table.
        center: (3,) middle of the cloud's bounding box along those axes, world, metres.
        scale: metres to the cloud's farthest point from `center`.
        height: of `center` above the support plane, metres.
        elevation: sine of the angle at which the camera looks down on `center`.
        lower, upper: (3,) corners of the box that the network answers in, its coordinates.
    """

    rotation: Float[np.ndarray, "3 3"]
    center: Float[np.ndarray, "3"]
    scale: float
    height: float
    elevation: float
    lower: Float[np.ndarray, "3"]
    upper: Float[np.ndarray, "3"]

    def to_object(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """World points (m) in the network's coordinates."""
        return (np.asarray(points, dtype=np.float64) - self.center) @ self.rotation.T / self.scale

    def to_world(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Points in the network's coordinates in the world, metres."""
        return np.asarray(points, dtype=np.float64) * self.scale @ self.rotation + self.center

    def covers(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
        """Whether points in the network's coordinates lie in the box it was trained in."""
        return np.asarray(((points >= self.lower) & (points <= self.upper)).all(axis=1))

    @property
    def context(self) -> Float32[np.ndarray, "3"]:
        """What the network is told beside the cloud: log scale, height, elevation."""
        return np.array(
            [np.log(self.scale / _TYPICAL_SCALE), self.height / self.scale, self.elevation],
            dtype=np.float32,
        )


def prepare_cloud(
    points: Float[np.ndarray, "n 3"], plane: Plane, camera_center: Float[np.ndarray, "3"], size: int
) -> tuple[Float32[np.ndarray, "m 3"], ObjectFrame]:
    """Normalise the world points (m) seen of one object.

    Stray points are left out, pixels averaged in cells of 3 mm, and `size` of the rest chosen
    farthest first; a cloud of fewer is repeated. The order of the points does not matter.

    Args:
        points: (n, 3) at least one.
        plane: support plane, world.
        camera_center: (3,) world, metres.
        size: points of the result.

    Returns:
        The cloud (size, 3) in the network's coordinates, farthest first, and its frame.

    Raises:
        ObservationError: there is no point.
    """
    points = np.asarray(points, dtype=np.float64)
    if len(points) == 0:
        raise ObservationError("an object without a single point cannot be reconstructed")
    points = points[np.lexsort(points.T)]
    rotation = _view_axes(points.mean(axis=0), plane, camera_center)
    local = without_strays(points) @ rotation.T
    local = grid_subsample(local - local.min(axis=0), _RESOLUTION) + local.min(axis=0)
    low, high = local.min(axis=0), local.max(axis=0)
    middle = (low + high) / 2.0
    local -= middle
    scale = max(float(np.linalg.norm(local, axis=1).max()), _MIN_SCALE)
    center = middle @ rotation
    height = float(plane.signed_distance(center))
    margin = float(np.clip(scale, *_MARGIN))
    lower, upper = low - middle - margin, high - middle + margin
    lower[2] = min(-_UNDER_TABLE - height, lower[2] + margin)
    sight = center - camera_center
    frame = ObjectFrame(
        rotation, center, scale, height,
        float(-(sight @ plane.normal) / max(float(np.linalg.norm(sight)), 1e-9)),
        lower / scale, upper / scale,
    )  # fmt: skip
    cloud = local / scale
    return cloud[farthest_first(cloud, size)].astype(np.float32), frame


def without_strays(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """Leave out points with fewer than five neighbours within 1 cm, unless nothing remains.

    A depth camera reports points between an object and what lies behind its edge; they would
    be the first that farthest point sampling chooses.
    """
    from scipy.spatial import cKDTree

    # The nearest is the point itself; those beyond the radius are infinitely far.
    tree = cKDTree(points)
    distance = np.asarray(
        tree.query(points, k=[_NEIGHBOURS + 1], distance_upper_bound=_NEIGHBOUR_RADIUS)[0]
    )
    kept = points[np.isfinite(distance[:, 0])]
    return kept if len(kept) else points


def farthest_first(points: Float[np.ndarray, "n 3"], size: int) -> Int[np.ndarray, "m"]:
    """Return `size` indices, each the point farthest from those before it.

    The first is the one farthest from the mean; ties go to the lowest index. The first m are
    thus a sample of m, for every m. When every point has been taken the same again.
    """
    n = len(points)
    order = np.empty(min(size, n), dtype=np.int64)
    x, y, z = (np.ascontiguousarray(points[:, axis]) for axis in range(3))
    mean = points.mean(axis=0)
    order[0] = np.argmax(((points - mean) ** 2).sum(axis=1))
    gap = np.full(n, np.inf)
    for i in range(1, len(order)):
        last = order[i - 1]
        np.minimum(gap, (x - x[last]) ** 2 + (y - y[last]) ** 2 + (z - z[last]) ** 2, out=gap)
        gap[last] = -1.0  # taken, so that duplicates of it are still to be had
        order[i] = np.argmax(gap)
    return np.resize(order, size)


def _view_axes(
    center: Float[np.ndarray, "3"], plane: Plane, camera_center: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3 3"]:
    """Rows: level away from the camera, left of it, up; any level axes from straight above."""
    level = center - camera_center
    level = level - (level @ plane.normal) * plane.normal
    length = float(np.linalg.norm(level))
    ahead = level / length if length > 1e-6 else np.asarray(plane.axes()[0])
    return np.stack([ahead, np.cross(plane.normal, ahead), plane.normal])
