"""Scenes and maps small enough that a slow oracle can go through all of their voxels."""

import numpy as np

from vprism_plan.mapping import MapConfig, fit_map
from vprism_plan.simulation.camera import Camera
from vprism_plan.simulation.scenes import Scene
from vprism_plan.simulation.solids import Box, sphere


def at(x, y, z):
    """A pose without rotation."""
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def small_camera(elevation=20.0):
    """Looks along +x, so that shadows fall towards +x."""
    return Camera.orbit(np.array([0.0, 0.0, 0.03]), 1.0, np.pi, np.deg2rad(elevation))


def small_scene():
    """A ball (object 2) and a box (object 5) beside each other."""
    box = Box((0.02, 0.025, 0.04), pose=at(0.01, 0.055, 0.04))
    return Scene((sphere(0.03, at(0.0, -0.05, 0.03)), box), (2, 5), small_camera())


def small_config(**changes):
    """Few hinges, close to the objects; unsure of what it does not see."""
    numbers = {"hinge_spacing": 0.04, "hinge_radius": 0.07, "hinge_margin": 0.05}
    prior = {"prior_logit_variance": 60.0, "prior_occupancy": 0.45}
    return MapConfig(**{"surface_hinges": 8, "iterations": 2, **numbers, **prior, **changes})


def small_map(**changes):
    """The map of the small scene."""
    return fit_map(small_scene().observation, small_config(**changes), seed=0, prior=None)
