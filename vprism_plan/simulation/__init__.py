# SPDX-License-Identifier: BSD-3-Clause
"""Scenes of analytic solids, seen by a camera, for the demo, the examples and the tests."""

from vprism_plan.simulation.camera import Camera as Camera
from vprism_plan.simulation.camera import DepthNoise as DepthNoise
from vprism_plan.simulation.scene_io import load_ground_truth as load_ground_truth
from vprism_plan.simulation.scene_io import save_scene as save_scene
from vprism_plan.simulation.scenes import Scene as Scene
from vprism_plan.simulation.scenes import demo_scene as demo_scene
from vprism_plan.simulation.scenes import hidden_object_scene as hidden_object_scene
from vprism_plan.simulation.scenes import random_scene as random_scene
from vprism_plan.simulation.scenes import render as render
from vprism_plan.simulation.solids import Box as Box
from vprism_plan.simulation.solids import Capsule as Capsule
from vprism_plan.simulation.solids import Frustum as Frustum
from vprism_plan.simulation.solids import Solid as Solid
from vprism_plan.simulation.solids import cylinder as cylinder
from vprism_plan.simulation.solids import sphere as sphere
