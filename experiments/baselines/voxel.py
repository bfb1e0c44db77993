# SPDX-License-Identifier: BSD-3-Clause
"""The paper's voxel heuristic: what was not observed is taken for the nearest that was."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from experiments.baselines import voxel_rays
from experiments.baselines._common import counts_per_voxel, one_hot
from experiments.protocols import checked_points
from vprism_plan.errors import MapError
from vprism_plan.mapping.training_data import stray_points
from vprism_plan.perception.observation import Observation
from vprism_plan.perception.plane import Plane
from vprism_plan.perception.plane_fitting import fit_plane

VOXEL = 0.01  # metres; the published code has 0.02, which reconstructs less well
REACH = 0.2  # metres around the objects' boxes that the grid covers
# Of an object's median density; as in `MapConfig`. Flying pixels, left in, are the nearest
# that was observed to much of the shadow behind an object.
_STRAY_SHARE = 0.03


@dataclass(frozen=True, eq=False)
class VoxelReconstruction:
    """One class per voxel; empty outside the grid and below the plane.

    Attributes:
        object_ids: labels of the objects; class k is `object_ids[k - 1]`.
        plane: support surface, world frame.
        first: voxel (i, j, k) is centred on edge * (first + (i, j, k)), m, world.
        edge: of a voxel, m.
        classes: (nx, ny, nz), 0 is empty.
    """

    object_ids: tuple[int, ...]
    plane: Plane
    first: Int[np.ndarray, " 3"]
    edge: float
    classes: Int[np.ndarray, "nx ny nz"]

    def predict_proba(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n k"]:
        """Return 1 for the class of each point's (m) voxel, 0 for the others: (n, K)."""
        points = checked_points(points, MapError)
        index = np.round(points / self.edge).astype(np.int64) - self.first
        inside = ((index >= 0) & (index < self.classes.shape)).all(axis=1)
        inside &= self.plane.signed_distance(points) >= 0.0
        found = np.zeros(len(points), dtype=np.int64)
        found[inside] = self.classes[tuple(index[inside].T)]
        return one_hot(found, len(self.object_ids) + 1)


def fit(observation: Observation, seed: int, edge: float = VOXEL) -> VoxelReconstruction:
    """Label voxels of `edge` (m): occupied, passed by a ray, or as the nearest of either.

    A voxel with points of objects belongs to the one that has most there. One that a ray
    passes, or that holds background, is empty. Flying pixels count for nothing. `seed` is
    of the plane's fit.

    Raises:
        ObservationError: no labels or no objects.
        PlaneNotFoundError: no support plane is known and none can be fitted.
    """
    object_ids = observation.require_objects()
    plane = observation.plane or fit_plane(observation, seed=seed)
    first, classes, observed = observed_voxels(observation, edge)
    return VoxelReconstruction(object_ids, plane, first, edge, filled(classes, observed))


def observed_voxels(
    observation: Observation, edge: float
) -> tuple[Int[np.ndarray, " 3"], Int[np.ndarray, "nx ny nz"], Bool[np.ndarray, "nx ny nz"]]:
    """Return the grid's first index, the classes of its voxels, and which were observed."""
    points, labels = _trusted_points(observation)
    own = points[labels > 0]
    first = np.floor((own.min(axis=0) - REACH) / edge).astype(np.int64)
    last = np.ceil((own.max(axis=0) + REACH) / edge).astype(np.int64)
    shape = tuple((last + 1 - first).tolist())
    observed = np.zeros(shape, dtype=bool)
    voxel_rays.mark_passed(points, observation.camera_center, edge * (first - 0.5), edge, observed)
    classes = np.zeros(shape, dtype=np.int64)
    most = np.zeros(shape, dtype=np.int64)
    for k, object_id in enumerate(observation.object_ids, start=1):
        count = counts_per_voxel(points[labels == object_id], first, edge, shape)
        chosen = count > most
        classes[chosen], most[chosen] = k, count[chosen]
    return first, classes, observed | (most > 0)


def filled(
    classes: Int[np.ndarray, "nx ny nz"], observed: Bool[np.ndarray, "nx ny nz"]
) -> Int[np.ndarray, "nx ny nz"]:
    """Return the classes with unobserved voxels as the nearest observed one."""
    from scipy.ndimage import distance_transform_edt

    nearest = distance_transform_edt(~observed, return_distances=False, return_indices=True)
    return np.asarray(classes[tuple(nearest)])


def _trusted_points(
    observation: Observation,
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
    """Return the observed points (m) and their labels without flying pixels."""
    points, labels = observation.points()
    keep = np.ones(len(points), dtype=bool)
    for object_id in observation.object_ids:
        own = labels == object_id
        keep[own] = ~stray_points(points[own], _STRAY_SHARE)
    return points[keep], labels[keep]
