# SPDX-License-Identifier: BSD-3-Clause
"""Writes the bundled demo scene: `python -m vprism_plan.simulation.make_demo_scene [FOLDER]`."""

import sys
from pathlib import Path

from vprism_plan.simulation.scene_io import save_scene
from vprism_plan.simulation.scenes import demo_scene

BUNDLED = Path(__file__).parent.parent / "data" / "demo_scene"


def main(folder: str | Path = BUNDLED) -> Path:
    """Render the demo scene into `folder`; the same bytes every time."""
    save_scene(demo_scene(), Path(folder))
    return Path(folder)


if __name__ == "__main__":
    sys.stdout.write(f"wrote {main(*sys.argv[1:2])}\n")
