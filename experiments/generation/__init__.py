# SPDX-License-Identifier: BSD-3-Clause
"""Scenes of meshes that were dropped on a table, with everything known about them.

`generate("ycb", seed=1000)` drops three to ten objects until they rest, and looks at
them once with a simulated depth camera. The result is a `MeshScene`: the observation, and
the truth that no map may see. The generator needs the extra `experiments`.
"""

from experiments.generation.generator import generate
from experiments.generation.saving import load_scene, save_scene
from experiments.generation.scene import MeshObject, MeshScene
from experiments.generation.sources import KINDS, SETS, source

__all__ = [
    "KINDS",
    "SETS",
    "MeshObject",
    "MeshScene",
    "generate",
    "load_scene",
    "save_scene",
    "source",
]
