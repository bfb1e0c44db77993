# SPDX-License-Identifier: BSD-3-Clause
"""Every obstacle of a world by itself: how far from a point, and which way out."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from vprism_plan.collision.reports import Kind
from vprism_plan.world.distance import DistanceField
from vprism_plan.world.source_fields import source_field


@dataclass(frozen=True, eq=False)
class Body:
    """One obstacle.

    Attributes:
        name: "object:3", "support surface", "background", "occluded", "unobserved" or
            "known:NAME".
        kind: what it is.
        plane: (4,) normal and offset of a half-space, else None.
        field: distances to everything else, else None.
    """

    name: str
    kind: Kind
    plane: Float[np.ndarray, " 4"] | None = None
    field: DistanceField | None = None

    @property
    def of_map(self) -> bool:
        """Whether the map has something to say of it: not of planes and known geometry."""
        return self.kind not in {"support", "known"}

    def bound(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Lower bound of the signed distance from points (world, metres); exact for planes."""
        if self.field is None:
            return np.asarray(points @ self._row[:3] - self._row[3])
        return self.field.lower_bound(points)

    def nearest(
        self, points: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """Nearest points of the obstacle (of what is not the obstacle, from inside it), and
        the unit directions in which the distance grows (0 where it has no slope).

        One step down the slope of the nodes' distances, to within a voxel; from beyond the
        grid, the nearest as seen from the grid's face. Directions are within a degree for
        most points, a few degrees off within a voxel of an edge.
        """
        if self.field is None:
            normal = np.tile(self._row[:3], (len(points), 1))
            return points - self.bound(points)[:, None] * normal, normal
        inside = points
        if not self.field.solid_outside:
            inside = np.clip(points, self.field.origin, self.field.upper)
        distance, normal = _slope(self.field, inside)
        # Not nearer than is proven: the interpolated distance can be a voxel off.
        found = inside - np.maximum(distance, self.bound(inside))[:, None] * normal
        beyond = (inside != points).any(axis=1)
        away = points[beyond] - found[beyond]
        normal[beyond] = away / np.linalg.norm(away, axis=1, keepdims=True)
        return found, normal

    @property
    def _row(self) -> Float[np.ndarray, " 4"]:
        assert self.plane is not None
        return self.plane


def _slope(
    field: DistanceField, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Interpolated distance and its unit slope, from differences over one voxel.

    Over a voxel, because the slope of a trilinear interpolation itself is constant along
    each axis of a cell: off a ball it errs by three degrees, these by less than one.
    """
    import torch

    half = 0.5 * field.spacing
    steps = np.concatenate([np.zeros((1, 3)), half * np.eye(3), -half * np.eye(3)])
    asked = points + steps[:, None]
    if not field.solid_outside:  # beyond the faces distances are bounds, not distances
        asked[1:] = np.clip(asked[1:], field.origin, field.upper)
    with torch.no_grad():
        around = field.distance_at(torch.from_numpy(asked)).numpy()
    apart = np.stack([asked[1 + k, :, k] - asked[4 + k, :, k] for k in range(3)], axis=1)
    gradient = (around[1:4] - around[4:7]).T / apart
    length = np.linalg.norm(gradient, axis=1, keepdims=True)
    return around[0], np.where(length > 0, gradient / np.where(length > 0, length, 1.0), 0.0)


def bodies_of(world: Any, without: frozenset[int] = frozenset()) -> tuple[Body, ...]:
    """All obstacles that a world has: half-spaces, then `world.sources` in order.

    Their fields are baked on first use: about half a second each for a table top at
    1 cm, 6 bytes per node while the world lives.

    Args:
        world: a `World`.
        without: objects that may be touched; occluded space inside them goes, too.
    """
    found = [
        Body(name, "support" if name == "support surface" else "known", plane=row)
        for name, row in zip(world.plane_names, world.planes, strict=True)
    ]
    for name in world.sources:
        field = source_field(world, name, without)
        if field.source.flat[0] >= 0:
            found.append(Body(name, kind_of(name), field=field))
    return tuple(found)


def kind_of(name: str) -> Kind:
    """Return what the name of a source stands for."""
    kinds: dict[str, Kind] = {
        "object": "object",
        "background": "background",
        "occluded": "occluded",
        "unobserved": "unobserved",
        "support surface": "support",
    }
    return kinds.get(name.split(":", 1)[0], "known")
