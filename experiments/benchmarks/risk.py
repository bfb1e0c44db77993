# SPDX-License-Identifier: BSD-3-Clause
"""What a probability costs beside a yes or no, and worlds beside the fit they are drawn from.

python -m experiments.benchmarks.risk

Everything is timed in one run, in turns; medians of the rounds, ratios of the medians.
"""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import vprism_plan as vp
from experiments.benchmarks.checking import demo_checker

ROUNDS = 15
CONFIGURATIONS = 500
START = np.array([0.5, 0.67, 0.0, -1.6, 0.0, 2.27, 0.785])
GOAL = np.array([-0.35, 0.3, 0.0, -1.85, 0.0, 2.15, 0.785])


def seconds(work: Callable[[], object]) -> float:
    """Wall time of one call."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def each(ask: Callable[[np.ndarray], object], rows: np.ndarray) -> Callable[[], None]:
    """A round: ask about every row."""

    def work() -> None:
        for q in rows:
            ask(q)

    return work


def in_turns(works: dict[str, Callable[[], object]]) -> dict[str, float]:
    """Median seconds of each, over rounds in which they take turns."""
    for work in works.values():
        work()
    times: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(ROUNDS):
        for name, work in works.items():
            times[name].append(seconds(work))
    return {name: float(np.median(values)) for name, values in times.items()}


def configurations(checker: vp.CollisionChecker) -> dict[str, np.ndarray]:
    """Random valid ones, and valid ones about the start, where worlds disagree."""
    robot, rng = checker.robot, np.random.default_rng(0)
    anywhere = rng.uniform(robot.lower, robot.upper, (8 * CONFIGURATIONS, robot.dof))
    near = np.clip(START + rng.normal(0.0, 0.3, anywhere.shape), robot.lower, robot.upper)
    return {
        name: rows[checker.is_valid_batch(rows)][:CONFIGURATIONS]
        for name, rows in (("random valid", anywhere), ("valid, near the objects", near))
    }


def per_configuration(checker: vp.CollisionChecker, bounded: vp.CollisionChecker) -> None:
    """One configuration: yes or no, yes or no by worlds, and the probability itself."""
    for name, rows in configurations(checker).items():
        took = in_turns(
            {
                "is_valid": each(checker.is_valid, rows),
                "is_valid with max_risk": each(bounded.is_valid, rows),
                "collision_probability": each(checker.collision_probability, rows),
            }
        )
        base = took["is_valid"]
        print(f"{name} ({len(rows)} configurations):")
        for what, value in took.items():
            print(f"  {what:24s} {1e6 * value / len(rows):7.2f} us  {value / base:5.1f} x is_valid")


def per_path(checker: vp.CollisionChecker, bounded: vp.CollisionChecker) -> None:
    """Paths of 100 waypoints: a planned one, and the straight one through the objects."""
    planned = vp.plan(bounded, START, GOAL)
    if planned.path is None:
        raise SystemExit(f"no path to time: {planned.message}")
    paths = {"planned": planned.path, "straight, colliding": np.stack([START, GOAL])}
    for name, corners in paths.items():
        at = np.linspace(0.0, len(corners) - 1.0, 100)
        path = np.stack([np.interp(at, range(len(corners)), column) for column in corners.T], 1)
        estimate = checker.collision_probability(path)
        took = in_turns({"path": lambda path=path: checker.collision_probability(path)})["path"]
        causes = seconds(lambda estimate=estimate: estimate.first_contact)
        print(
            f"{name}, 100 waypoints: {1e3 * took:.2f} ms for {estimate.configurations} samples "
            f"(P {estimate.probability:.3f}); causes, if asked, {1e3 * causes:.2f} ms more"
        )


def building(checker: vp.CollisionChecker) -> None:
    """256 worlds from nothing, everything baked, beside the fit of the map."""
    observation = vp.load_observation(Path(vp.__file__).parent / "data" / "demo_scene")
    fits, builds, size = [], [], 0
    for _ in range(3):
        fits.append(seconds(lambda: vp.fit_map(observation)))
        began = time.perf_counter()
        worlds = vp.PosteriorWorlds(checker.world.map, n_worlds=256, reach=0.13)
        worlds.bake()
        builds.append(time.perf_counter() - began)
        size = worlds.nbytes
    fit, build = float(np.median(fits)), float(np.median(builds))
    print(
        f"256 worlds of the demo scene, all blocks: {build:.2f} s, {size / 1e6:.0f} MB; "
        f"fit {fit:.2f} s; ratio {build / fit:.2f}"
    )


def main() -> None:
    checker = demo_checker()
    bounded = vp.CollisionChecker(checker.world, checker.robot, vp.CheckerConfig(max_risk=0.05))
    per_configuration(checker, bounded)
    per_path(checker, bounded)
    building(checker)


if __name__ == "__main__":
    main()
