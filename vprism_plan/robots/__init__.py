# SPDX-License-Identifier: BSD-3-Clause
"""Robots: URDF in, collision spheres in world coordinates out."""

from vprism_plan.robots._arrays import KinematicArrays
from vprism_plan.robots._geometry import PrimitiveGeometry
from vprism_plan.robots._spheres import enclosing_spheres
from vprism_plan.robots.robot import Robot

__all__ = ["KinematicArrays", "PrimitiveGeometry", "Robot", "enclosing_spheres"]
