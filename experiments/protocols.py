# SPDX-License-Identifier: BSD-3-Clause
"""What the experiments ask of a scene and of a reconstruction, whoever made them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from jaxtyping import Float, Int

from vprism_plan.errors import VPrismError
from vprism_plan.perception.observation import Observation
from vprism_plan.simulation.camera import Camera

if TYPE_CHECKING:
    import trimesh


def checked_points(points: Any, error: type[VPrismError]) -> Float[np.ndarray, "n 3"]:
    """Return points as finite float64 (n, 3), metres, or raise `error`."""
    array = np.ascontiguousarray(points, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise error(f"points have shape {array.shape}; they must be (n, 3), world, in m")
    finite = np.isfinite(array).all(axis=1)
    if not finite.all():
        row = int(np.argmin(finite))
        raise error(f"point {row} is {array[row].tolist()}; coordinates must be finite")
    return array


class TrueScene(Protocol):
    """A scene whose geometry is known: objects on the support plane z = 0, seen once."""

    @property
    def name(self) -> str:
        """Name that is unique among the scenes of an experiment."""

    @property
    def seed(self) -> int:
        """Seed that the scene was made from."""

    @property
    def camera(self) -> Camera:
        """The one view."""

    @property
    def observation(self) -> Observation:
        """What the camera saw: depth, labels, intrinsics, pose."""

    @property
    def object_ids(self) -> tuple[int, ...]:
        """Labels of all labelled objects in rising order, wholly hidden ones included."""

    def signed_distance(
        self, points: Float[np.ndarray, "n 3"], *, table: bool = False
    ) -> Float[np.ndarray, "n"]:
        """Signed distance to the nearest true surface, metres, negative inside."""

    def object_of(self, points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n"]:
        """Object id at each point; 0 for none, -1 for clutter that carries no label."""

    def truth_meshes(self) -> "dict[int, trimesh.Trimesh]":
        """True surface of each labelled object in the world, metres."""


class Reconstruction(Protocol):
    """What one method makes of one observation."""

    @property
    def object_ids(self) -> tuple[int, ...]:
        """Labels of the reconstructed objects, in the order of the columns 1 to C."""

    def predict_proba(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n k"]:
        """Probability of *empty* (column 0) and of each object at world points (m).

        Rows sum to 1 unless the method treats objects apart (sigmoid maps, PointSDF),
        where column 0 is the product of the objects' complements.
        """


@dataclass(frozen=True)
class Method:
    """One row of a table: a named way from an observation to a reconstruction.

    Attributes:
        key: short name on the command line and in files.
        label: name in tables and pictures.
        fit: observation and seed in, reconstruction out; same input, same result.
        level: probability from which a point belongs to an object.
        continuous: whether it answers at any point, or per voxel.
        uncertainty: whether its probabilities are meant as such.
    """

    key: str
    label: str
    fit: Callable[[Observation, int], Reconstruction]
    level: float = 0.5
    continuous: bool = True
    uncertainty: bool = True
