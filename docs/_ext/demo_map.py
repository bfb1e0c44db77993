# SPDX-License-Identifier: BSD-3-Clause
"""The bundled scene's map, fitted at most once in a build, however many pages ask for it."""

from functools import cache
from pathlib import Path
from typing import Any


@cache
def fitted() -> Any:
    """Return the map."""
    import vprism_plan as vp

    return vp.fit_map(vp.load_observation(Path(vp.__file__).parent / "data" / "demo_scene"))


@cache
def saved(folder: Path) -> Path:
    """Return a file with the map."""
    file = folder / "demo_map.safetensors"
    fitted().save(file)
    return file
