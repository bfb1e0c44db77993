# SPDX-License-Identifier: BSD-3-Clause
"""A scene of triangle meshes with known geometry."""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int

from experiments.generation.raycasting import observe
from experiments.generation.truth import MeshTruth
from experiments.protocols import checked_points
from vprism_plan.errors import ConfigError
from vprism_plan.perception.observation import Observation
from vprism_plan.perception.plane import Plane
from vprism_plan.simulation.camera import Camera, DepthNoise

if TYPE_CHECKING:
    import trimesh

_CACHES = ("_truths", "table")


@dataclass(frozen=True, eq=False)
class MeshObject:
    """A mesh at rest.

    Attributes:
        name: of the mesh it was made from.
        vertices: corners in the object's own frame, metres.
        faces: corners of each triangle, counter-clockwise from outside.
        pose: object to world.
    """

    name: str
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    pose: Float[np.ndarray, "4 4"]

    def mesh(self) -> "trimesh.Trimesh":
        """Return the mesh in the world frame, metres."""
        import trimesh

        corners = self.vertices @ self.pose[:3, :3].T + self.pose[:3, 3]
        return trimesh.Trimesh(corners, self.faces, process=False)

    def to_local(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return world points in the object's own frame."""
        return np.asarray((points - self.pose[:3, 3]) @ self.pose[:3, :3])


@dataclass(frozen=True, eq=False)
class MeshScene:
    """Meshes at rest on the table z = 0, the camera, and what the camera saw.

    Satisfies `protocols.TrueScene`. `objects[i]` carries the label i + 1. Pickles
    without its search trees, which are built again on first use.

    Attributes:
        objects: the meshes with their poses.
        camera: the one view.
        observation: what it saw, with the noise.
        noise: of the observation, or None for exact depth.
        seed: that the scene was made from.
        name: unique per kind, number of objects asked for and seed.
        kind: the source of the objects.
    """

    objects: tuple[MeshObject, ...]
    camera: Camera
    observation: Observation
    noise: DepthNoise | None = None
    seed: int = 0
    name: str = field(default="scene")
    kind: str = "folder"

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key not in _CACHES}

    @cached_property
    def table(self) -> Plane:
        """The plane z = 0 that the objects rest on; below it everything is table."""
        return Plane(np.array([0.0, 0.0, 1.0]), 0.0)

    @property
    def object_ids(self) -> tuple[int, ...]:
        """Labels of all objects, those that no pixel shows included."""
        return tuple(range(1, len(self.objects) + 1))

    def signed_distance(
        self, points: Float[np.ndarray, "n 3"], *, table: bool = False
    ) -> Float[np.ndarray, "n"]:
        """Return the signed distance to the nearest true surface, metres, negative inside.

        With `table`, the half-space z <= 0 counts too. The distance to each mesh is
        exact; an object whose box lies farther than another's surface is not asked.

        Raises:
            ConfigError: points that are not (n, 3) or not finite.
        """
        points = checked_points(points, ConfigError)
        best = points[:, 2].copy() if table else np.full(len(points), np.inf)
        local = [body.to_local(points) for body in self.objects]
        away = np.stack(
            [truth.box_distance(p) for truth, p in zip(self._truths, local, strict=True)]
        )
        # The object with the nearest box first: most others then need no look.
        nearest = away.argmin(axis=0)
        for first in (True, False):
            for index, truth in enumerate(self._truths):
                asked = (nearest == index) == first
                asked &= (away[index] < best) | (away[index] == 0.0)
                rows = np.flatnonzero(asked)
                if len(rows):
                    best[rows] = np.minimum(best[rows], truth.signed_distance(local[index][rows]))
        return best

    def object_of(self, points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n"]:
        """Return the id of the object that contains each point, 0 for none.

        Raises:
            ConfigError: points that are not (n, 3) or not finite.
        """
        points = checked_points(points, ConfigError)
        ids = np.zeros(len(points), dtype=np.int64)
        for label, body, truth in zip(self.object_ids, self.objects, self._truths, strict=True):
            ids[truth.contains(body.to_local(points))] = label
        return ids

    def truth_meshes(self) -> "dict[int, trimesh.Trimesh]":
        """Return the true surface of each object in the world, metres."""
        return {
            label: body.mesh() for label, body in zip(self.object_ids, self.objects, strict=True)
        }

    def render(
        self, camera: Camera, *, noise: DepthNoise | None = None, seed: int = 0
    ) -> Observation:
        """Return what another camera sees, or this one with other noise."""
        meshes = [body.mesh() for body in self.objects]
        return observe(meshes, self.object_ids, camera, noise, seed)

    def save(self, path: str | Path) -> None:
        """Write the scene as a BOP scene folder, see `saving.save_scene`."""
        from experiments.generation.saving import save_scene

        save_scene(self, path)

    @cached_property
    def _truths(self) -> tuple[MeshTruth, ...]:
        return tuple(MeshTruth(body.vertices, body.faces) for body in self.objects)
