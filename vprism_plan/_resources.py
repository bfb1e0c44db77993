# SPDX-License-Identifier: BSD-3-Clause
"""Where the files that come with this package are."""

from pathlib import Path

from vprism_plan.errors import VPrismError

_PACKAGE = Path(__file__).resolve().parent


def data_path(name: str) -> Path:
    """Return the path of bundled data, such as "demo_scene"."""
    return _existing([_PACKAGE / "data" / name])


def urdf_path(name: str) -> Path:
    """Return the path of a bundled robot: "panda", "ur5e" or "planar3".

    A checkout has them in `urdf/`; an installed package carries them in its data.
    """
    file = f"{name}.urdf"
    return _existing([_PACKAGE.parent / "urdf" / file, _PACKAGE / "data" / "urdf" / file])


def _existing(places: list[Path]) -> Path:
    for place in places:
        if place.exists():
            return place
    raise VPrismError(f"{places[-1]} is missing from this installation; install the package again")
