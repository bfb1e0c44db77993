# SPDX-License-Identifier: BSD-3-Clause
"""How long from a labelled image to a checker that answers with probabilities?

    python -m experiments.benchmarks.answer [--objects 2 4 8 16 32] [--rounds 5]

Wall clock, medians of some rounds after one that compiles or loads the kernels; every step of a
round starts from nothing but what the step before made. For scenes of several numbers of objects
also the processor time and what the process ever held: run on idle cores.
"""

import argparse
import resource
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

import vprism_plan as vp
from experiments.baselines import method
from experiments.benchmarks._common import DEMO, GOAL, START
from experiments.planning_benchmark.checkers import Bench
from experiments.planning_benchmark.grid_world import benchmark_robot
from vprism_plan.simulation.scenes import random_scene

Q = (START + GOAL) / 2.0


def steps(observation: Any) -> dict[str, tuple[float, float]]:
    """Return wall and processor seconds of each step."""
    took = {}

    def timed(name: str, step: Callable[[], Any]) -> Any:
        wall, own = time.perf_counter(), time.process_time()
        made = step()
        took[name] = time.perf_counter() - wall, time.process_time() - own
        return made

    robot = benchmark_robot()
    fitted = timed("fit", lambda: vp.fit_map(observation))
    world = timed("world", lambda: vp.World(fitted))
    checker = timed("checker", lambda: vp.CollisionChecker(world, robot))
    timed("first is_valid", lambda: checker.is_valid(Q))
    timed("first probability", lambda: checker.collision_probability(Q))
    timed("first plan", lambda: vp.plan(checker, START, GOAL))
    return took


def peers(observation: Any) -> dict[str, float]:
    """Return wall seconds from an image to the first verdict with other maps of it."""
    bench = Bench(SimpleNamespace(observation=observation), benchmark_robot(), 0)  # type: ignore[arg-type]
    config = vp.CheckerConfig(max_risk=None)
    made: dict[str, Callable[[], Any]] = {
        "point cloud": bench.point_world,
        "OctoMap, 1 cm, unknown free": lambda: bench.octomap_world(
            method("octomap").fit(observation, 0), "free"
        ),
        "ours without draws": lambda: vp.World(vp.fit_map(observation)),
    }
    took = {}
    for name, make in made.items():
        since = time.perf_counter()
        vp.CollisionChecker(make(), bench.robot, config).is_valid(Q)
        took[name] = time.perf_counter() - since
    return took


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--objects", type=int, nargs="*", default=[2, 4, 8, 16, 32])
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    demo = vp.load_observation(DEMO)
    rounds = [steps(demo) for _ in range(arguments.rounds + 1)][1:]
    print("demo scene, wall seconds")
    for name in rounds[0]:
        print(f"  {name:<18} {np.median([one[name][0] for one in rounds]):.2f}")
    others = [peers(demo) for _ in range(arguments.rounds + 1)][1:]
    print("image to first verdict, wall seconds")
    for name in others[0]:
        print(f"  {name:<28} {np.median([one[name] for one in others]):.2f}")
    answer = [sum(wall for wall, _ in list(one.values())[:5]) for one in rounds]
    print(f"  {'ours, with a probability':<28} {np.median(answer):.2f}")
    for count in arguments.objects:
        took = list(steps(random_scene(count, 0).observation).values())[:5]
        wall, own = np.sum(took, axis=0)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"{count:>3} objects: {wall:.1f} s, {own:.1f} s of processor, peak {peak:.0f} MB")


if __name__ == "__main__":
    main()
