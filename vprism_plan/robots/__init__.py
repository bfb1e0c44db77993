# SPDX-License-Identifier: BSD-3-Clause
"""Robots: URDF in, collision spheres in world coordinates out."""

from vprism_plan.robots.report import LinkReport, RobotReport
from vprism_plan.robots.robot import Robot
from vprism_plan.robots.sphere_files import read_spheres, write_spheres
from vprism_plan.robots.sphere_fit import enclosing_spheres, fit_spheres

__all__ = [
    "LinkReport",
    "Robot",
    "RobotReport",
    "enclosing_spheres",
    "fit_spheres",
    "read_spheres",
    "write_spheres",
]
