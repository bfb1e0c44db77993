# SPDX-License-Identifier: BSD-3-Clause
"""Robots: URDF in, collision spheres in world coordinates out."""

from vprism_plan.robots._arrays import KinematicArrays
from vprism_plan.robots._geometry import PrimitiveGeometry
from vprism_plan.robots._mesh_files import MeshFile
from vprism_plan.robots._sphere_files import read_spheres, write_spheres
from vprism_plan.robots._sphere_fit import SphereFit, fit_spheres
from vprism_plan.robots._spheres import enclosing_spheres
from vprism_plan.robots.report import LinkReport, RobotReport
from vprism_plan.robots.robot import Robot

__all__ = [
    "KinematicArrays",
    "LinkReport",
    "MeshFile",
    "PrimitiveGeometry",
    "Robot",
    "RobotReport",
    "SphereFit",
    "enclosing_spheres",
    "fit_spheres",
    "read_spheres",
    "write_spheres",
]
