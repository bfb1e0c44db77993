# SPDX-License-Identifier: BSD-3-Clause
"""Far from what the shape prior learned from, a map with it is not worse than a flat one.

The stated bound, per object seen alone: IoU, and Brier score of seen space, not worse;
distances of surfaces at most 0.5 mm worse; Brier score of hidden space at most 0.04 worse.
"""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from trimesh.transformations import rotation_matrix

from experiments.generation.raycasting import observe
from experiments.generation.scene import MeshObject, MeshScene
from experiments.reconstruction import evaluate_reconstruction
from experiments.scene_truth import OCCLUDED, VISIBLE
from vprism_plan.mapping import fit_map
from vprism_plan.simulation.camera import Camera, DepthNoise

INTRINSICS = np.array([[600.0, 0.0, 319.5], [0.0, 600.0, 239.5], [0.0, 0.0, 1.0]])


def box(*size):
    return trimesh.creation.box(size)


def ring(upright=False):
    mesh = trimesh.creation.annulus(0.06, 0.1, 0.03)
    if upright:
        mesh.apply_transform(rotation_matrix(np.pi / 2, [1, 0, 0]))
    return mesh


def l_shape():
    other = box(0.04, 0.16, 0.12)
    other.apply_translation([-0.06, 0.06, 0.0])
    return trimesh.boolean.union([box(0.16, 0.04, 0.12), other])


def two_in_one_mask():
    can, carton = trimesh.creation.cylinder(0.03, 0.09), box(0.07, 0.07, 0.09)
    can.apply_translation([0.0, 0.06, 0.0])
    carton.apply_translation([0.0, -0.06, 0.0])
    return trimesh.util.concatenate([can, carton])


SHAPES = {
    "ring": ring,
    "upright ring": lambda: ring(upright=True),
    "L": l_shape,
    "plate": lambda: box(0.2, 0.2, 0.01),
    "upright plate": lambda: box(0.2, 0.02, 0.15),
    "3 cm": lambda: box(0.03, 0.03, 0.03),
    "50 cm": lambda: box(0.5, 0.2, 0.3),
    "two in one mask": two_in_one_mask,
    "labels upside down": lambda: box(0.1, 0.08, 0.15),
}


def seen_alone(name, azimuth):
    mesh = SHAPES[name]()
    mesh.apply_translation([0.0, 0.0, -mesh.bounds[0, 2]])
    away = 1.6 if name == "50 cm" else 0.8
    camera = Camera.orbit(
        np.array([0.0, 0.0, 0.05]), away, azimuth, np.deg2rad(40.0), intrinsics=INTRINSICS
    )
    seen = observe([mesh], (1,), camera, DepthNoise(sigma_at_1m=0.002), 0)
    if name == "labels upside down":
        seen = replace(seen, labels=np.ascontiguousarray(seen.labels[::-1]))
    body = MeshObject(name, np.asarray(mesh.vertices), np.asarray(mesh.faces), np.eye(4))
    return MeshScene((body,), camera, seen, None, 0, name, "folder")


@pytest.mark.slow
@pytest.mark.parametrize("name", SHAPES)
def test_a_strange_shape_is_no_worse_with_the_prior(name):
    scene = seen_alone(name, 0.4)
    flat, shape = (
        evaluate_reconstruction(scene, fit_map(scene.observation, prior=prior))
        for prior in (None, "shape")
    )
    assert shape.mean_iou >= flat.mean_iou
    assert shape.mean_chamfer <= flat.mean_chamfer + 0.0005
    assert shape.parts[VISIBLE].brier <= flat.parts[VISIBLE].brier
    assert shape.parts[OCCLUDED].brier <= flat.parts[OCCLUDED].brier + 0.04
