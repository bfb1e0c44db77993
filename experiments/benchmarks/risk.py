# SPDX-License-Identifier: BSD-3-Clause
"""What a probability costs beside a yes or no, and worlds beside the fit they are drawn from.

python -m experiments.benchmarks.risk

Everything is timed in one run, in turns; medians of the rounds, ratios of the medians.
"""

import time
from collections.abc import Callable
from functools import partial

import numpy as np

import vprism_plan as vp
from experiments.benchmarks._common import DEMO, GOAL, START, demo_checker, in_turns

ROUNDS = 15
CONFIGURATIONS = 500


def each(ask: Callable[[np.ndarray], object], rows: np.ndarray) -> None:
    for q in rows:
        ask(q)


def medians(tasks: dict[str, Callable[[], object]], rounds: int = ROUNDS) -> dict[str, float]:
    """Median seconds of each task."""
    return {name: float(np.median(took)) for name, took in in_turns(tasks, rounds).items()}


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
        asks = {
            "is_valid": checker.is_valid,
            "is_valid with max_risk": bounded.is_valid,
            "collision_probability": checker.collision_probability,
        }
        took = medians({k: partial(each, ask, rows) for k, ask in asks.items()})
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
        took = medians({"path": lambda path=path: checker.collision_probability(path)})["path"]
        began = time.perf_counter()
        _ = estimate.first_contact
        causes = time.perf_counter() - began
        print(
            f"{name}, 100 waypoints: {1e3 * took:.2f} ms for {estimate.configurations} samples "
            f"(P {estimate.probability:.3f}); causes, if asked, {1e3 * causes:.2f} ms more"
        )


def building(checker: vp.CollisionChecker) -> None:
    """256 worlds from nothing, everything baked, beside the fit of the map."""
    observation = vp.load_observation(DEMO)

    def worlds() -> vp.PosteriorWorlds:
        made = vp.PosteriorWorlds(checker.world.map, n_worlds=256, reach=0.13)
        made.bake()
        return made

    fit, build = medians({"fit": lambda: vp.fit_map(observation), "bake": worlds}, 3).values()
    print(
        f"256 worlds of the demo scene, all blocks: {build:.2f} s, {worlds().nbytes / 1e6:.0f} MB; "
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
