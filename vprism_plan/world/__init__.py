# SPDX-License-Identifier: BSD-3-Clause
"""A map in, obstacles out: fields that answer in microseconds, and meshes."""

from vprism_plan.world.config import Box, Cylinder, HalfSpace, KnownMesh, Sphere, WorldConfig
from vprism_plan.world.exports import Cells
from vprism_plan.world.meshes import extract_meshes, extract_union_mesh
from vprism_plan.world.posterior_worlds import PosteriorWorlds
from vprism_plan.world.world import World

__all__ = [
    "Box",
    "Cells",
    "Cylinder",
    "HalfSpace",
    "KnownMesh",
    "PosteriorWorlds",
    "Sphere",
    "World",
    "WorldConfig",
    "extract_meshes",
    "extract_union_mesh",
]
