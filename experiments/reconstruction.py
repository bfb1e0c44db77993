# SPDX-License-Identifier: BSD-3-Clause
"""How well one method reconstructs one scene: the paper's IoU and Chamfer, and calibration.

Object k of a reconstruction is {x : P(k | x) >= level}, as in the paper. Per object, IoU is
taken over the grid points within 0.2 m of its true centre along each axis, 1.5 cm apart.
Chamfer is between the surface of that set inside the same cube (marching cubes) and the
true surface: 10,000 seeded points on each, the mean distance to the nearest of the other,
both directions added, metres. Two samples of one surface of 300 cm2 are 1.7 mm apart by
that measure: no reconstruction goes below it.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float32
from scipy.spatial import cKDTree

from experiments.metrics import Reliability
from experiments.protocols import Reconstruction, TrueScene
from experiments.scene_truth import PARTS, NodeUnion, SceneTruth, surface_points
from experiments.stored import Stored
from vprism_plan.errors import ConfigError
from vprism_plan.world.config import check_level

_CHUNK = 1 << 16
MESH_SPACING, MESH_SHIFT = 0.01, 0.0
# A method that answers per voxel of 1 cm is looked at twice per voxel and axis, at the same
# distance from its sides, wherever its voxels begin: on their sides a lattice would shift it.
VOXEL_SPACING, VOXEL_SHIFT = 0.005, 0.5


@dataclass(frozen=True)
class ObjectScore(Stored):
    """One object of one scene.

    Attributes:
        object_id: its label.
        pixels: labelled pixels with depth that show it.
        intersection, union: grid points in both, and in either, of truth and level set.
        chamfer: metres; NaN if the object is lost: its level set is empty.
    """

    object_id: int
    pixels: int
    intersection: int
    union: int
    chamfer: float

    @property
    def iou(self) -> float:
        """Intersection over union; NaN if no grid point is in either."""
        return self.intersection / self.union if self.union else math.nan

    @property
    def lost(self) -> bool:
        """Whether the reconstruction has no surface for it (IoU then counts as it is, 0)."""
        return math.isnan(self.chamfer)


@dataclass(frozen=True)
class ReconstructionScores(Stored):
    """What a method made of one or more scenes.

    Attributes:
        objects: every object with labelled pixels.
        hidden: labelled objects without any; they are in no other figure.
        parts: P(occupied) against the truth in each of `PARTS`, over the grid points above
            the table of all objects together, each once.
        entropy: summed entropy of the class probabilities (nats) in each of `PARTS`.
    """

    objects: tuple[ObjectScore, ...]
    hidden: int
    parts: tuple[Reliability, ...]
    entropy: tuple[float, ...]

    @property
    def mean_iou(self) -> float:
        """Mean over objects; NaN without any."""
        return _mean(o.iou for o in self.objects)

    @property
    def mean_chamfer(self) -> float:
        """Mean over objects that are not lost, metres; NaN without any."""
        return _mean(o.chamfer for o in self.objects)

    @property
    def lost(self) -> int:
        """Number of objects without any reconstructed surface."""
        return sum(o.lost for o in self.objects)

    def mean_entropy(self, *parts: int) -> float:
        """Mean over the grid points of some parts, nats; NaN without points."""
        n = sum(self.parts[k].n for k in parts)
        return sum(self.entropy[k] for k in parts) / n if n else math.nan

    @classmethod
    def merged(cls, scenes: "Iterable[ReconstructionScores]") -> "ReconstructionScores":
        """Return the figures of several scenes together; at least one."""
        scenes = list(scenes)
        if not scenes:
            raise ConfigError("merged needs the scores of at least one scene")
        return cls(
            tuple(o for s in scenes for o in s.objects),
            sum(s.hidden for s in scenes),
            tuple(Reliability.merged(s.parts[k] for s in scenes) for k in range(len(PARTS))),
            tuple(sum(s.entropy[k] for s in scenes) for k in range(len(PARTS))),
        )


def evaluate_reconstruction(
    scene: TrueScene,
    found: Reconstruction,
    level: float = 0.5,
    *,
    continuous: bool = True,
    truth: SceneTruth | None = None,
) -> ReconstructionScores:
    """Compare a reconstruction of a scene with the truth.

    Args:
        scene: the table is z = 0.
        found: reconstruction from `scene.observation`.
        level: probability from which a point belongs to an object.
        continuous: False for methods that answer per voxel of 1 cm: their surface is then
            taken on a lattice that does not shift it.
        truth: `SceneTruth.of(scene)`, if several methods are compared.

    Raises:
        ConfigError: the level is not a probability, or `found` has objects that are not
            in the observation.
    """
    check_level(level)
    truth = SceneTruth.of(scene) if truth is None else truth
    strange = set(found.object_ids) - set(truth.object_ids)
    if strange:
        raise ConfigError(
            f"the reconstruction has objects {sorted(strange)}, the observation only "
            f"{list(truth.object_ids)}"
        )
    proba = _predict(found, truth.grid.points())
    chamfers = _chamfers(scene, found, level, continuous, truth)
    objects = []
    for cube, (k, pixels) in enumerate(zip(truth.object_ids, truth.pixels, strict=True)):
        near = truth.grid.members(cube)
        there = truth.ids[near] == k
        held = np.zeros_like(there)
        if k in found.object_ids:
            held = proba[near, 1 + found.object_ids.index(k)] >= level
        both, either = int((there & held).sum()), int((there | held).sum())
        objects.append(ObjectScore(int(k), pixels, both, either, chamfers[k]))
    occupied, truly = np.clip(1.0 - proba[:, 0], 0.0, 1.0), truth.ids != 0
    uncertainty = class_entropy(proba)
    masks = [truth.part == part for part in range(len(PARTS))]
    return ReconstructionScores(
        tuple(objects),
        len(truth.hidden),
        tuple(Reliability.of(occupied[mask], truly[mask]) for mask in masks),
        tuple(float(uncertainty[mask].sum()) for mask in masks),
    )


def class_entropy(proba: Float[np.ndarray, "n k"]) -> Float[np.ndarray, " n"]:
    """Return the entropy (nats) of each row, scaled to sum 1 where objects are apart."""
    p = proba / np.maximum(proba.sum(axis=1, keepdims=True), 1e-300)
    return np.asarray(-(p * np.log(np.maximum(p, 1e-300))).sum(axis=1))


def cloud_distance(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "m 3"]) -> float:
    """Return the Chamfer distance of two clouds (m): both mean nearest distances, added."""
    return float(np.mean(cKDTree(b).query(a)[0]) + np.mean(cKDTree(a).query(b)[0]))


def _predict(found: Reconstruction, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n k"]:
    """Probabilities at all points, in pieces of a size that any method can take."""
    pieces = [
        np.asarray(found.predict_proba(points[start : start + _CHUNK]), dtype=np.float64)
        for start in range(0, len(points), _CHUNK)
    ]
    return np.concatenate(pieces)


def _chamfers(
    scene: TrueScene, found: Reconstruction, level: float, continuous: bool, truth: SceneTruth
) -> dict[int, float]:
    """Chamfer distance of every object that counts, NaN for the lost."""
    spacing, shift = (MESH_SPACING, MESH_SHIFT) if continuous else (VOXEL_SPACING, VOXEL_SHIFT)
    nodes = NodeUnion.around(truth.centers, spacing, shift)
    points = nodes.points()
    values = np.empty((len(points), len(found.object_ids)), dtype=np.float32)
    for start in range(0, len(points), _CHUNK):
        values[start : start + _CHUNK] = found.predict_proba(points[start : start + _CHUNK])[:, 1:]
    result = {}
    for cube, k in enumerate(truth.object_ids):
        result[k] = math.nan
        if k not in found.object_ids:
            continue
        box = np.zeros(nodes.inside.shape, dtype=np.float32)
        box[nodes.inside] = values[:, found.object_ids.index(k)]
        origin = spacing * (nodes.first[cube] + shift)
        mesh = level_surface(box[nodes.window(cube)], level, origin, spacing)
        if mesh is not None:
            cloud = surface_points(mesh, seed=[scene.seed, k, 1])
            result[k] = cloud_distance(cloud, truth.clouds[k])
    return result


def level_surface(
    values: Float32[np.ndarray, "nx ny nz"],
    level: float,
    origin: Float[np.ndarray, " 3"],
    spacing: float,
) -> Any:
    """Return the surface of {values >= level} as a trimesh, closed at the box; None if empty.

    Unlike `world.meshes.surface` it may have triangles without area: points are drawn by
    area, and no set is refused for its shape.
    """
    import trimesh
    from skimage.measure import marching_cubes

    if not (values >= level).any():
        return None
    # At the level itself no surface would run: such nodes are in, as in the IoU.
    lowest = np.nextafter(np.float32(level), np.float32(0.0))
    padded = np.pad(values, 1)
    vertices, faces, _, _ = marching_cubes(padded, float(lowest))
    return trimesh.Trimesh(
        origin + spacing * (vertices.astype(np.float64) - 1.0), faces, process=False
    )


def _mean(values: Iterable[float]) -> float:
    """Mean of what is not NaN."""
    kept = [value for value in values if not math.isnan(value)]
    return sum(kept) / len(kept) if kept else math.nan


__all__ = [
    "PARTS", "ObjectScore", "ReconstructionScores", "class_entropy", "cloud_distance",
    "evaluate_reconstruction", "level_surface",
]  # fmt: skip
