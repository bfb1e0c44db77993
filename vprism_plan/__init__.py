# SPDX-License-Identifier: BSD-3-Clause
"""Collision checking for motion planners on V-PRISM maps.

What the camera saw, what it did not, and how sure the map is. Names are loaded on
first use, so importing this package costs milliseconds although torch, numba and
OMPL stand behind it.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from vprism_plan import errors
from vprism_plan.errors import VPrismError

if TYPE_CHECKING:
    from vprism_plan.collision import CheckerConfig, CollisionChecker, MeshChecker
    from vprism_plan.mapping import MapConfig, VPrismMap, fit_map, load_map
    from vprism_plan.perception import (
        Observation,
        align_to_table,
        ignore_robot,
        ignore_self,
        load_observation,
        save_observation,
        segment_tabletop,
    )
    from vprism_plan.planning.looking import NextView, next_view
    from vprism_plan.planning.plan import plan
    from vprism_plan.robots import Robot
    from vprism_plan.world import PosteriorWorlds, World, WorldConfig, extract_meshes

__version__ = "0.1.0"

_HOMES = {
    "CheckerConfig": "collision",
    "CollisionChecker": "collision",
    "MeshChecker": "collision",
    "MapConfig": "mapping",
    "VPrismMap": "mapping",
    "fit_map": "mapping",
    "load_map": "mapping",
    "Observation": "perception",
    "align_to_table": "perception",
    "ignore_robot": "perception",
    "ignore_self": "perception",
    "load_observation": "perception",
    "save_observation": "perception",
    "segment_tabletop": "perception",
    "NextView": "planning",
    "next_view": "planning",
    "plan": "planning",
    "Robot": "robots",
    "PosteriorWorlds": "world",
    "World": "world",
    "WorldConfig": "world",
    "extract_meshes": "world",
}

__all__ = [
    "CheckerConfig",
    "CollisionChecker",
    "MapConfig",
    "MeshChecker",
    "NextView",
    "Observation",
    "PosteriorWorlds",
    "Robot",
    "VPrismError",
    "VPrismMap",
    "World",
    "WorldConfig",
    "__version__",
    "align_to_table",
    "errors",
    "extract_meshes",
    "fit_map",
    "ignore_robot",
    "ignore_self",
    "load_map",
    "load_observation",
    "next_view",
    "plan",
    "save_observation",
    "segment_tabletop",
]


def __getattr__(name: str) -> Any:
    """Load a public name from the folder it lives in, once."""
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{home}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
