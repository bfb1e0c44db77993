# SPDX-License-Identifier: BSD-3-Clause
"""Is a map's occupancy probability true? Fitted maps against scenes whose solids are known.

Space is split by what the camera and the map know of it, since a mean over everything
would be a mean over mostly visible, easy points.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from experiments.metrics import Reliability, object_iou
from experiments.stored import Stored
from vprism_plan.mapping import MapConfig, VPrismMap, fit_map
from vprism_plan.simulation.scenes import Scene, hidden_object_scene, random_scene
from vprism_plan.world import WorldConfig
from vprism_plan.world.visibility import OCCLUDED, SEEN, classify_points, make_view

PARTS = ("visible", "occluded, supported", "occluded, unsupported")
VISIBLE, SUPPORTED, UNSUPPORTED, ELSEWHERE = 0, 1, 2, 3
_ROOM = 0.12  # metres around the true solids that are looked at
_ABOVE = 0.002  # metres over the support plane from which points count


def calibration_scene(seed: int) -> Scene:
    """Return scene number `seed` of the calibration: 1 to 8 objects close together.

    Every sixth is a `hidden_object_scene`, with an object that no pixel shows.
    """
    if seed % 6 == 5:
        return hidden_object_scene(seed)
    return random_scene(1 + (7 * seed + seed // 6) % 8, seed)


@dataclass(frozen=True)
class VoxelCalibration(Stored):
    """What a map says of the voxels of one or more scenes, against the truth.

    Attributes:
        parts: one reliability table per part of `PARTS`.
        ious: intersection over union of every observed object with its level set.
        found, true: occluded voxels inside solids: those that the level set holds, all.
        found_supported, true_supported: the same where the map has support.
        hinge_points: of each map.
    """

    parts: tuple[Reliability, Reliability, Reliability]
    ious: tuple[float, ...]
    found: int
    true: int
    found_supported: int
    true_supported: int
    hinge_points: tuple[int, ...]

    @property
    def mean_iou(self) -> float:
        """Mean over objects; NaN without any."""
        return float(np.mean(self.ious)) if self.ious else float("nan")

    @property
    def recall(self) -> float:
        """Share of the occluded occupied space that the level set holds; NaN without any."""
        return self.found / self.true if self.true else float("nan")

    @property
    def recall_supported(self) -> float:
        """The same where the map has support."""
        return self.found_supported / self.true_supported if self.true_supported else float("nan")

    @classmethod
    def merged(cls, scenes: "list[VoxelCalibration]") -> "VoxelCalibration":
        """Return the figures of several scenes together, every voxel counted alike."""
        visible, supported, unsupported = (
            Reliability.merged(scene.parts[part] for scene in scenes) for part in range(3)
        )
        return cls(
            (visible, supported, unsupported),
            tuple(iou for scene in scenes for iou in scene.ious),
            sum(scene.found for scene in scenes),
            sum(scene.true for scene in scenes),
            sum(scene.found_supported for scene in scenes),
            sum(scene.true_supported for scene in scenes),
            tuple(count for scene in scenes for count in scene.hinge_points),
        )


def evaluation_points(scene: Scene, spacing: float) -> Float[np.ndarray, "n 3"]:
    """Return the whole multiples of `spacing` (m) near the true solids and above the plane."""
    reach = np.array([[*solid.center, solid.bounding_radius] for solid in scene.solids])
    lower = (reach[:, :3] - reach[:, 3:]).min(axis=0) - _ROOM
    upper = (reach[:, :3] + reach[:, 3:]).max(axis=0) + _ROOM
    lower[2] = _ABOVE
    axes = [
        spacing * np.arange(np.ceil(a / spacing), np.floor(b / spacing) + 1.0)
        for a, b in zip(lower, upper, strict=True)
    ]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return grid[scene.signed_distance(grid) <= _ROOM]


def knowledge(
    fitted: VPrismMap, points: Float[np.ndarray, "n 3"], config: WorldConfig | None = None
) -> UInt8[np.ndarray, " n"]:
    """Return what is known of each point (m): VISIBLE, SUPPORTED, UNSUPPORTED or ELSEWHERE.

    As a `World` decides it: occluded is what lies behind a return by more than the sensor's
    noise, supported is what has `WorldConfig.min_support` kernel mass. ELSEWHERE is
    outside the images, behind missing returns, or under the support plane.
    """
    config = WorldConfig() if config is None else config
    views = [make_view(v, config.occlusion_tolerance, fitted.plane) for v in fitted.views]
    status = classify_points(views, points)
    part = np.full(len(points), ELSEWHERE, dtype=np.uint8)
    part[status == SEEN] = VISIBLE
    supported = np.asarray(fitted.support(points)) >= config.min_support
    part[status == OCCLUDED] = np.where(supported, SUPPORTED, UNSUPPORTED)[status == OCCLUDED]
    part[fitted.plane.signed_distance(points) < 0.0] = ELSEWHERE
    return part


def evaluate_voxels(scene: Scene, fitted: VPrismMap, spacing: float = 0.01) -> VoxelCalibration:
    """Compare a map of a scene with its solids, at voxel centres `spacing` (m) apart."""
    points = evaluation_points(scene, spacing)
    part = knowledge(fitted, points)
    proba = np.asarray(fitted.predict_proba(points))
    occupied = np.minimum(proba[:, 1:].sum(axis=1), 1.0)
    truth = scene.signed_distance(points) <= 0.0
    visible, supported, unsupported = (
        Reliability.of(occupied[part == k], truth[part == k])
        for k in (VISIBLE, SUPPORTED, UNSUPPORTED)
    )
    inside = occupied >= 0.5
    ids = np.where(inside, np.array(fitted.object_ids)[proba[:, 1:].argmax(axis=1)], 0)
    iou = object_iou(ids, scene.object_of(points), fitted.object_ids)
    hidden = truth & ((part == SUPPORTED) | (part == UNSUPPORTED))
    here = truth & (part == SUPPORTED)
    return VoxelCalibration(
        (visible, supported, unsupported),
        tuple(iou.values()),
        int((hidden & inside).sum()),
        int(hidden.sum()),
        int((here & inside).sum()),
        int(here.sum()),
        (len(fitted.space.hinges),),
    )


def calibrate_voxels(
    seed: int, config: MapConfig | None = None, spacing: float = 0.01
) -> VoxelCalibration:
    """Fit calibration scene `seed` and evaluate it; the same arguments give the same figures."""
    scene = calibration_scene(seed)
    return evaluate_voxels(scene, fit_map(scene.observation, config, seed=seed), spacing)
