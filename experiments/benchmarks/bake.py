# SPDX-License-Identifier: BSD-3-Clause
"""What baking a world costs, step by step, beside the fit that it needs.

    python -m experiments.benchmarks.bake [--map FILE] [--repeat 3]

Times are wall clock of the fastest repetition, after one bake that compiles or loads
the kernels. Read them as shares of one run: machines and their load differ. Steps that run at the
same time add up to more than the whole.
"""

import argparse
import resource
import time
from pathlib import Path

import numpy as np

from vprism_plan._threads import worker_count
from vprism_plan.mapping import fit_map, load_map
from vprism_plan.simulation.scenes import demo_scene
from vprism_plan.world import World, WorldConfig, extract_meshes


def main() -> None:
    parser = argparse.ArgumentParser(description="Time the bake of the demo scene.")
    parser.add_argument("--map", type=Path, help="a saved map to use instead of fitting one")
    parser.add_argument("--repeat", type=int, default=3, help="repetitions; the fastest counts")
    arguments = parser.parse_args()

    start = time.perf_counter()
    map_ = load_map(arguments.map) if arguments.map else fit_map(demo_scene().observation, seed=0)
    fit = time.perf_counter() - start
    start = time.perf_counter()
    world = World(map_, WorldConfig())
    first = time.perf_counter() - start
    runs = []
    for _ in range(arguments.repeat):
        start = time.perf_counter()
        world = World(map_, WorldConfig())
        runs.append((time.perf_counter() - start, world.timings))
    total, steps = min(runs, key=lambda run: run[0])

    shape = " x ".join(str(n) for n in world.grid.shape)
    print(f"{len(map_.object_ids)} objects, grid {shape} at {world.grid.spacing} m, "
          f"{worker_count()} threads")  # fmt: skip
    print(f"{'load' if arguments.map else 'fit'} the map {fit:8.2f} s")
    print(f"bake, first time   {first:8.2f} s")
    print(f"bake               {total:8.2f} s")
    for name, seconds in steps.items():
        print(f"  {name:22s} {seconds:6.2f} s  {100 * seconds / total:5.1f} %")

    points = np.random.default_rng(0).uniform(world.grid.origin, world.grid.upper, (500_000, 3))
    start = time.perf_counter()
    world.field.lower_bound(points)
    bound = time.perf_counter() - start
    start = time.perf_counter()
    map_.predict_proba(points[:50_000])
    predict = 10 * (time.perf_counter() - start)
    print(f"a field query costs 1/{predict / bound:.0f} of a query of the map")
    start = time.perf_counter()
    extract_meshes(map_)
    print(f"meshes             {time.perf_counter() - start:8.2f} s")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"peak memory of all this {peak:.0f} MB")


if __name__ == "__main__":
    main()
