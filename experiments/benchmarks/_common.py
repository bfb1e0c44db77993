# SPDX-License-Identifier: BSD-3-Clause
"""What several benchmarks share: the demo's checker, a query, and times taken in turns."""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import vprism_plan as vp
from experiments.planning_benchmark.grid_world import benchmark_robot

ROOT = Path(__file__).resolve().parents[2]
DEMO = Path(vp.__file__).parent / "data" / "demo_scene"
START = np.array([0.5, 0.67, 0.0, -1.6, 0.0, 2.27, 0.785])
GOAL = np.array([-0.35, 0.3, 0.0, -1.85, 0.0, 2.15, 0.785])


def demo_checker(map_file: Path | None = None) -> vp.CollisionChecker:
    """The bundled scene, or a saved map of it, with a Panda beside the clutter."""
    fitted = vp.load_map(map_file) if map_file else vp.fit_map(vp.load_observation(DEMO))
    config = vp.CheckerConfig(max_risk=None)  # level sets; who measures bounds asks for them
    return vp.CollisionChecker(vp.World(fitted), benchmark_robot(), config)


def in_turns(tasks: dict[str, Callable[[], object]], rounds: int) -> dict[str, np.ndarray]:
    """Seconds of every task in every round, after one that warms up.

    They take turns, so that what else the machine does falls on all alike.
    """
    times: dict[str, list[float]] = {name: [] for name in tasks}
    for _ in range(rounds + 1):
        for name, task in tasks.items():
            start = time.perf_counter()
            task()
            times[name].append(time.perf_counter() - start)
    return {name: np.array(own[1:]) for name, own in times.items()}
