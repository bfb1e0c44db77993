# SPDX-License-Identifier: BSD-3-Clause
"""Compile kernels before the tests start, on a clean clone: each worker would compile them all.

Maps and checks use different kernels, so a process for each keeps two cores busy. The rest
compiles when it is first asked for. Where every kernel file has been compiled, this does nothing.
"""

import subprocess
import sys
from pathlib import Path

KERNELS = Path(__file__).resolve().parent.parent / "vprism_plan" / "_kernels"


def compile_maps() -> None:
    """What fits a map, bakes a world of it and draws worlds from it."""
    import numpy as np
    from oracles.small_scenes import small_map

    from vprism_plan.world import World
    from vprism_plan.world.posterior_worlds import PosteriorWorlds

    m, point = small_map(), np.zeros((1, 3))
    world = World(m)
    world.field.lower_bound(point)
    world.status(point)
    m.occupancy_log_odds(point)
    PosteriorWorlds(m, n_worlds=64, seed=0).touched(point, np.array([0.02]))


def compile_checks() -> None:
    """What a collision checker compiles when it is made."""
    import numpy as np
    from oracles.checker_oracle import BallWorld
    from oracles.random_robots import as_robot, random_arrays

    from vprism_plan.collision import CollisionChecker

    ball = BallWorld(np.array([[0.0, 0.0, 0.9]]), np.array([0.05]), np.zeros((0, 4)))
    CollisionChecker(ball.baked(0.1), as_robot(random_arrays(np.random.default_rng(0))))


JOBS = {"maps": compile_maps, "checks": compile_checks}


def compiled() -> bool:
    """Whether the cache beside every kernel file holds something no older than any of them."""
    files = [file for file in KERNELS.glob("*.py") if file.stem not in {"__init__", "jit"}]
    newest = max(file.stat().st_mtime for file in files)
    return all(
        any(i.stat().st_mtime >= newest for i in KERNELS.glob(f"__pycache__/{file.stem}.*.nbi"))
        for file in files
    )


def main() -> int:
    if sys.argv[1:]:
        JOBS[sys.argv[1]]()
        return 0
    if compiled():
        return 0
    running = [subprocess.Popen([sys.executable, __file__, job]) for job in JOBS]
    return max(abs(process.wait()) for process in running)


if __name__ == "__main__":
    sys.exit(main())
