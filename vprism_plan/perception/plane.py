# SPDX-License-Identifier: BSD-3-Clause
"""A plane, and the support surface as one."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from vprism_plan._read_only import make_read_only
from vprism_plan.errors import ObservationError


@dataclass(frozen=True, eq=False)
class Plane:
    """The plane {x : normal . x = offset}; the normal points to the side of the camera.

    Attributes:
        normal: (3,) unit vector, read-only.
        offset: metres along the normal.

    Raises:
        ObservationError: the normal is not a finite, non-zero 3-vector, or the offset is
            not finite. A normal that is not of unit length is scaled, with its offset.
    """

    normal: Any
    offset: float

    def __post_init__(self) -> None:
        normal = np.array(self.normal, dtype=np.float64)
        offset = float(self.offset)
        if normal.shape != (3,) or not np.isfinite(normal).all() or not np.isfinite(offset):
            raise ObservationError(
                f"plane normal {normal.tolist()} and offset {offset} must be a finite 3-vector "
                "and a finite number of metres"
            )
        length = float(np.linalg.norm(normal))
        if length < 1e-9:
            raise ObservationError("plane normal is zero; it must point away from the surface")
        object.__setattr__(self, "normal", normal / length)
        object.__setattr__(self, "offset", offset / length)
        make_read_only(self.__dict__)

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        make_read_only(state)

    def signed_distance(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch"]:
        """Height of points above the plane, metres; negative on the far side."""
        return np.asarray(np.asarray(points, dtype=np.float64) @ self.normal - self.offset)

    def project(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Foot of the perpendicular from every point to the plane."""
        points = np.asarray(points, dtype=np.float64)
        return points - self.signed_distance(points)[..., None] * self.normal

    def transformed(self, transform: Float[np.ndarray, "4 4"]) -> "Plane":
        """Return the same plane seen from another frame: `T_a_b` maps a plane in b to a."""
        normal = transform[:3, :3] @ self.normal
        return Plane(normal, self.offset + float(normal @ transform[:3, 3]))

    def axes(self) -> Float[np.ndarray, "2 3"]:
        """Return two orthonormal directions in the plane; with the normal they are right-handed."""
        helper = np.eye(3)[int(np.argmin(np.abs(self.normal)))]
        first = np.cross(helper, self.normal)
        first /= np.linalg.norm(first)
        return np.stack([first, np.cross(self.normal, first)])
