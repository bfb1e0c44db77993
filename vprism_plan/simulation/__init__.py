# SPDX-License-Identifier: BSD-3-Clause
"""Scenes of analytic solids, seen by a camera, for the demo, the examples and the tests."""

from vprism_plan.simulation.camera import Camera, DepthNoise
from vprism_plan.simulation.scene_io import load_ground_truth, save_scene
from vprism_plan.simulation.scenes import (
    Scene,
    demo_scene,
    hidden_object_scene,
    random_scene,
    render,
)
from vprism_plan.simulation.solids import Box, Capsule, Frustum, Solid, cylinder, sphere

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
