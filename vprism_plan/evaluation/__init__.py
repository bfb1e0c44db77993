# SPDX-License-Identifier: BSD-3-Clause
"""How good is it, against what: scenes with ground truth."""

from vprism_plan.evaluation.camera import Camera, DepthNoise
from vprism_plan.evaluation.scene_io import load_ground_truth, save_scene
from vprism_plan.evaluation.scenes import (
    Scene,
    demo_scene,
    hidden_object_scene,
    random_scene,
    render,
)
from vprism_plan.evaluation.solids import Box, Capsule, Frustum, Solid, cylinder, sphere

__all__ = [
    "Box",
    "Camera",
    "Capsule",
    "DepthNoise",
    "Frustum",
    "Scene",
    "Solid",
    "cylinder",
    "demo_scene",
    "hidden_object_scene",
    "load_ground_truth",
    "random_scene",
    "render",
    "save_scene",
    "sphere",
]
