# SPDX-License-Identifier: BSD-3-Clause
"""OctoMap (Hornung et al., Autonomous Robots 2013) through pyoctomap: counted hits and misses.

The library's own ray casting and sensor model. It counts a cell once per cloud, and a
robot's camera sends thirty a second: a single image is handed over in interleaved parts,
so that what it saw many times over is as certain as the sensor model lets it be.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int, Int64, UInt8

from experiments.protocols import checked_points
from vprism_plan.errors import MapError, MissingDependencyError
from vprism_plan.perception.observation import Observation

if TYPE_CHECKING:
    import pyoctomap

CELL = 0.01  # metres
_PARTS = 2  # of the image, along rows and along columns
_UNKNOWN = float(np.nextafter(0.5, 0.0))  # no evidence, which is not the half that counts

FREE, OCCUPIED, UNKNOWN = np.uint8(0), np.uint8(1), np.uint8(2)


@dataclass(frozen=True, eq=False)
class OctoMapReconstruction:
    """An occupancy octree, and which object each occupied cell shows.

    Attributes:
        object_ids: labels of the objects; class k is `object_ids[k - 1]`.
        tree: built in coordinates shifted by half a cell, so that cells are centred on
            whole multiples of `cell` in the world.
        cell: edge of the finest cells, m.
        keys: (c,) cells that hold observed points, one number each, sorted.
        classes: (c,) what most of their points show; 0 is background, such as the table.
    """

    object_ids: tuple[int, ...]
    tree: "pyoctomap.OcTree"
    cell: float
    keys: Int64[np.ndarray, " c"]
    classes: Int64[np.ndarray, " c"]

    def state(self, points: Float[np.ndarray, "n 3"]) -> UInt8[np.ndarray, " n"]:
        """Return FREE (0), OCCUPIED (1) or UNKNOWN (2) at each point (n, 3) m.

        Whatever was seen is occupied, the table as much as the objects.
        """
        occupancy = self.occupancy(points)
        occupied = np.where(occupancy >= 0.5, OCCUPIED, FREE)
        return np.where(np.isnan(occupancy), UNKNOWN, occupied).astype(np.uint8)

    def occupancy(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Return the tree's probability of "occupied" at points (n, 3) m; NaN where unknown."""
        shifted = checked_points(points, MapError) + 0.5 * self.cell
        index, inverse = np.unique(
            np.floor(shifted / self.cell).astype(np.int64), axis=0, return_inverse=True
        )
        found = np.full(len(index), np.nan)
        for row, center in enumerate((index + 0.5) * self.cell):
            node = self.tree.search(center)
            if node is not None:
                found[row] = node.getOccupancy()
        return found[inverse.reshape(-1)]

    def predict_proba(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n k"]:
        """Return P(empty) and P(object) at points (n, 3) m: (n, K), rows sum to 1.

        An occupied cell belongs to the object that most of its points show; one that shows
        the table is certainly no object. Free and unknown cells (0.5, or rather just
        under it) share their probability among all objects.
        """
        points = checked_points(points, MapError)
        occupancy = self.occupancy(points)
        objects = len(self.object_ids)
        occupied = np.where(np.isnan(occupancy), _UNKNOWN, occupancy)
        rows = np.empty((len(points), objects + 1))
        rows[:, 1:] = occupied[:, None] / objects
        hit = np.flatnonzero(occupied >= 0.5)
        shown = self._shown(points[hit])
        rows[hit, 1:] = 0.0
        own = shown > 0
        rows[hit[own], shown[own]] = occupied[hit[own]]
        rows[:, 0] = 1.0 - occupied
        rows[hit[~own], 0] = 1.0
        return rows

    def _shown(self, points: Float[np.ndarray, "n 3"]) -> Int64[np.ndarray, " n"]:
        """Class that most observed points in each point's cell show, 0 without any."""
        key = _keys(points, self.cell)
        at = np.minimum(np.searchsorted(self.keys, key), len(self.keys) - 1)
        return np.where(self.keys[at] == key, self.classes[at], 0)


def fit(observation: Observation, seed: int, cell: float = CELL) -> OctoMapReconstruction:
    """Insert the observed points into an octree with cells of `cell` (m); `seed` is not used.

    Raises:
        ObservationError: no labels or no objects.
        MissingDependencyError: pyoctomap is not installed.
    """
    try:
        import pyoctomap
    except ImportError as error:
        raise MissingDependencyError(
            "OctoMap needs pyoctomap: pip install 'vprism_plan[experiments]'"
        ) from error

    object_ids = observation.require_objects()
    tree = pyoctomap.OcTree(cell)
    image = observation.point_image()
    image[observation.sees_robot] = np.nan
    for part in range(_PARTS**2):
        cloud = image[part // _PARTS :: _PARTS, part % _PARTS :: _PARTS].reshape(-1, 3)
        cloud = np.ascontiguousarray(cloud[np.isfinite(cloud[:, 0])]) + 0.5 * cell
        tree.insertPointCloud(cloud, observation.camera_center + 0.5 * cell, lazy_eval=True)
    tree.updateInnerOccupancy()
    points, labels = observation.points()
    keys, classes = _majority(points, np.searchsorted((0, *object_ids), labels), cell)
    return OctoMapReconstruction(object_ids, tree, cell, keys, classes)


def _keys(points: Float[np.ndarray, "n 3"], cell: float) -> Int64[np.ndarray, " n"]:
    """One number per cell; cells are centred on multiples of `cell` (m)."""
    index = np.floor(points / cell + 0.5).astype(np.int64) + (1 << 20)
    return np.asarray((index[:, 0] << 42) | (index[:, 1] << 21) | index[:, 2])


def _majority(
    points: Float[np.ndarray, "n 3"], classes: Int[np.ndarray, " n"], cell: float
) -> tuple[Int64[np.ndarray, " c"], Int64[np.ndarray, " c"]]:
    """Return the cells with points, sorted, and the class of most points in each."""
    keys, inverse = np.unique(_keys(points, cell), return_inverse=True)
    count = np.zeros((len(keys), int(classes.max()) + 1), dtype=np.int64)
    np.add.at(count, (inverse.reshape(-1), classes), 1)
    return keys, count.argmax(axis=1)
