# SPDX-License-Identifier: BSD-3-Clause
"""Examples for the shape prior's network: crops of made scenes, and what fills their voxels.

Masks are cut, merged and fringed, depth is missing in places, some crops have two views.
Everything of a scene follows from its seed.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Int, UInt8
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter

from experiments.generation.dropping import drop
from experiments.generation.raycasting import observe
from experiments.generation.scene import MeshObject, MeshScene
from experiments.prior.shapes import TrainingShapes
from vprism_plan.mapping.shape_network import CHANNELS, SIDE, Crop, crop_features
from vprism_plan.perception.observation import Observation
from vprism_plan.simulation.camera import Camera, DepthNoise
from vprism_plan.simulation.scenes import upright

FIRST_SEED, HELD_OUT_SEED = 500_000, 590_000
_PER_FILE = 10  # scenes
_VIEWS = 3
_LEAST_PIXELS = 60
_BLUR = 0.5  # voxels over which the target falls from 1 to 0 across a surface


@dataclass(frozen=True, eq=False)
class Examples:
    """Crops of some scenes.

    Attributes:
        features: (N, C, 32, 32, 32) int8, 127 times `crop_features`.
        targets: (N, 2, 32, 32, 32) uint8, 255 times the share that this object, and that
            anything, fills.
    """

    features: Int[np.ndarray, "n c x y z"]
    targets: UInt8[np.ndarray, "n 2 x y z"]

    @classmethod
    def merged(cls, parts: "list[Examples]") -> "Examples":
        """Return all examples of several parts."""
        return cls(
            np.concatenate([p.features for p in parts]), np.concatenate([p.targets for p in parts])
        )

    def save(self, path: Path) -> None:
        """Write a compressed file; complete or not at all."""
        aside = path.with_suffix(".part.npz")
        np.savez_compressed(aside, features=self.features, targets=self.targets)
        aside.rename(path)

    @classmethod
    def load(cls, path: Path) -> "Examples":
        """Read what `save` wrote."""
        with np.load(path) as data:
            return cls(data["features"], data["targets"])


def training_scene(seed: int) -> MeshScene:
    """Return 1 to 9 shapes, dropped on a heap or stood side by side, without a view yet."""
    rng = np.random.default_rng([seed, 0x5A9E])
    shapes = TrainingShapes()
    while True:
        drawn = [shapes.draw(rng) for _ in range(int(rng.integers(1, 10)))]
        poses = _stood(drawn, rng) if rng.random() < 0.5 else drop(drawn, rng)
        if poses is not None:
            break
    objects = tuple(
        MeshObject(shape.name, shape.vertices, shape.faces, pose)
        for shape, pose in zip(drawn, poses, strict=True)
    )
    camera = _camera(rng)
    blank = Observation(np.ones((2, 2)), np.zeros((2, 2), np.int32), np.eye(3))
    return MeshScene(objects, camera, blank, None, seed, f"prior-{seed}", "folder")


def _stood(shapes: list, rng: np.random.Generator) -> np.ndarray | None:
    """Return poses of shapes that stand on the table as they were made, or on a side."""
    poses, taken = [], np.zeros((0, 3))
    sides = [np.eye(3), np.eye(3)[[1, 2, 0]], np.eye(3)[[2, 0, 1]]]
    reach = 0.05
    for shape in shapes:
        pose = upright(np.zeros(2), 0.0, float(rng.uniform(-np.pi, np.pi)))
        side = sides[int(rng.choice(3, p=[0.7, 0.15, 0.15]))]
        flip = np.diag([1.0, -1.0, -1.0]) if rng.random() < 0.15 else np.eye(3)
        pose[:3, :3] = pose[:3, :3] @ flip @ side
        corners = shape.vertices @ pose[:3, :3].T
        low, high = corners.min(axis=0), corners.max(axis=0)
        radius = 0.5 * float(np.linalg.norm((high - low)[:2])) * rng.uniform(0.75, 1.0)
        for _ in range(200):
            angle = rng.uniform(-np.pi, np.pi)
            place = reach * np.sqrt(rng.random()) * np.array([np.cos(angle), np.sin(angle)])
            apart = np.linalg.norm(taken[:, :2] - place, axis=1) - taken[:, 2]
            if (apart > radius).all():
                break
            reach *= 1.02
        else:
            return None
        taken = np.vstack([taken, [*place, radius]])
        pose[:3, 3] = [*(place - 0.5 * (low + high)[:2]), -low[2]]
        poses.append(pose)
    return np.stack(poses)


def _camera(rng: np.random.Generator) -> Camera:
    focal = float(rng.uniform(450.0, 900.0))
    intrinsics = np.array([[focal, 0.0, 319.5], [0.0, focal, 239.5], [0.0, 0.0, 1.0]])
    return Camera.orbit(
        np.array([*rng.uniform(-0.05, 0.05, 2), rng.uniform(0.0, 0.1)]),
        float(rng.uniform(0.5, 1.3)),
        float(rng.uniform(-np.pi, np.pi)),
        float(np.deg2rad(rng.uniform(12.0, 75.0))),
        intrinsics=intrinsics,
    )


def examples_of(seed: int) -> Examples:
    """Return the examples of scene `seed`: every object in each of three views."""
    rng = np.random.default_rng([seed, 0x10AD])
    scene = training_scene(seed)
    meshes = [body.mesh() for body in scene.objects]
    group = np.arange(len(meshes) + 1)  # which label an object carries
    if len(meshes) > 2 and rng.random() < 0.1:
        group[2] = 1  # two objects in one mask
    views = []
    for index in range(_VIEWS):
        camera = scene.camera if index == 0 else _camera(rng)
        noise = DepthNoise(sigma_at_1m=float(rng.uniform(0.0005, 0.003)))
        seen = observe(meshes, scene.object_ids, camera, noise, seed * 10 + index)
        views.append(_spoiled(replace(seen, labels=group[seen.labels].astype(np.int32)), rng))
    features, targets = [], []
    for index, view in enumerate(views):
        used = [view]
        if rng.random() < 0.15:
            used.append(views[(index + 1) % _VIEWS])
        cloud, labels = view.points()
        for k in view.object_ids:
            points = cloud[labels == k]
            if len(points) < _LEAST_PIXELS:
                continue
            crop = Crop.around(
                points, view.camera_center, scene.table, float(rng.uniform(0.9, 1.3))
            )
            channels = crop_features(crop, used, k)
            features.append(np.rint(127.0 * channels).astype(np.int8))
            targets.append(_filled(scene, group, k, crop))
    shape = (SIDE, SIDE, SIDE)
    if not features:
        return Examples(
            np.zeros((0, CHANNELS, *shape), np.int8), np.zeros((0, 2, *shape), np.uint8)
        )
    return Examples(np.stack(features), np.stack(targets))


def _filled(
    scene: MeshScene, group: np.ndarray, k: int, crop: Crop
) -> UInt8[np.ndarray, "2 x y z"]:
    """Return 255 times the share of each voxel that object k, and that anything, fills."""
    centers = crop.centers()
    own = np.full(len(centers), np.inf)
    others = np.full(len(centers), np.inf)
    for label, body, truth in zip(scene.object_ids, scene.objects, scene._truths, strict=True):
        local = body.to_local(centers)
        near = np.flatnonzero(truth.box_distance(local) < crop.voxel)
        if len(near):
            target = own if group[label] == k else others
            target[near] = np.minimum(target[near], truth.signed_distance(local[near]))
    both = np.stack([own, np.minimum(own, others)]) / (_BLUR * crop.voxel)
    share = np.clip(0.5 - both, 0.0, 1.0).reshape(2, SIDE, SIDE, SIDE)
    return np.rint(255.0 * share).astype(np.uint8)


def _spoiled(view: Observation, rng: np.random.Generator) -> Observation:
    """Return a view as segmentation and sensors spoil it, in a third of the cases."""
    labels, depth = view.labels.copy(), view.depth.copy()
    if rng.random() < 0.3:  # masks that are too wide or too narrow by some pixels
        size = int(rng.choice([3, 5, 7]))
        if rng.random() < 0.5:
            labels = maximum_filter(labels, size)
        else:
            inner = minimum_filter(labels, size) == maximum_filter(labels, size)
            labels = np.where(inner, labels, 0)
    if rng.random() < 0.2 and view.object_ids:  # a mask that lacks a part
        k = int(rng.choice(view.object_ids))
        rows, columns = np.nonzero(labels == k)
        if len(rows):
            turn = rng.uniform(-np.pi, np.pi)
            way = rows * np.sin(turn) + columns * np.cos(turn)
            cut = way > np.quantile(way, rng.uniform(0.5, 0.9))
            labels[rows[cut], columns[cut]] = 0
    if rng.random() < 0.25:  # patches without a return
        noise = gaussian_filter(rng.standard_normal(depth.shape), rng.uniform(4.0, 12.0))
        depth[noise > np.quantile(noise, rng.uniform(0.9, 0.99))] = 0.0
    return replace(view, labels=labels.astype(np.int32), depth=depth, warnings=())


def data_files(scenes: int, folder: Path) -> tuple[list[Path], list[Path]]:
    """Return the files of the held-out scenes, a thirtieth as many, and of the others."""
    held_out = range(HELD_OUT_SEED, HELD_OUT_SEED + max(scenes // 30, 1), _PER_FILE)
    others = range(FIRST_SEED, FIRST_SEED + scenes, _PER_FILE)
    return [folder / f"{n}.npz" for n in held_out], [folder / f"{n}.npz" for n in others]


def write(path: Path) -> None:
    """Write the examples of a file's scenes, unless they are there."""
    if not path.exists():
        first = int(path.stem)
        Examples.merged([examples_of(first + k) for k in range(_PER_FILE)]).save(path)
