# SPDX-License-Identifier: BSD-3-Clause
"""What a validity check costs inside OMPL, and what a query costs on the demo scene.

    python -m experiments.benchmarks.ompl_callbacks [--map map.safetensors]

Ratios are taken within this one run: absolute times depend on the machine.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from ompl import base as ob

import vprism_plan as vp
from experiments.benchmarks._common import GOAL, START, demo_checker, in_turns
from vprism_plan.planning import (
    VPrismMotionValidator,
    VPrismStateValidityChecker,
    plan,
    quiet_ompl,
    state_space,
    to_state,
)

ROUNDS, STATES = 15, 2000


class EmptyCallback(ob.StateValidityChecker):
    """What OMPL's Python bindings cost with nothing behind them."""

    def isValid(self, state: ob.State) -> bool:  # noqa: N802
        return True


def spaces(checker: vp.CollisionChecker) -> tuple[ob.SpaceInformation, ob.SpaceInformation]:
    """An OMPL program with our two classes, and one with an empty callback."""
    ours = ob.SpaceInformation(state_space(checker.robot))
    ours.setStateValidityChecker(VPrismStateValidityChecker(ours, checker))
    ours.setMotionValidator(VPrismMotionValidator(ours, checker))
    empty = ob.SpaceInformation(state_space(checker.robot))
    empty.setStateValidityChecker(EmptyCallback(empty))
    with quiet_ompl():
        ours.setup()
        empty.setup()
    return ours, empty


def callbacks(checker: vp.CollisionChecker) -> None:
    robot = checker.robot
    ours, empty = spaces(checker)
    rng = np.random.default_rng(0)
    sample = rng.uniform(robot.lower, robot.upper, (STATES, robot.dof))
    valid = checker.is_valid_batch(sample)
    along = START + np.linspace(0.0, 1.0, STATES)[:, None] * (GOAL - START)
    sets = {
        "random states": sample,
        "random valid states": sample[valid],
        "random invalid states": sample[~valid],
        "states on the line from start to goal": along,
    }
    print("isValid through OMPL, ours against an empty callback (microseconds per call)")
    for name, configurations in sets.items():
        rows = [np.ascontiguousarray(q) for q in configurations]
        a = [to_state(ours.getStateSpace(), q) for q in rows]
        b = [to_state(empty.getStateSpace(), q) for q in rows]
        tasks = {
            "asked": lambda a=a: [ours.isValid(state) for state in a],
            "nothing": lambda b=b: [empty.isValid(state) for state in b],
            "alone": lambda rows=rows: [checker.is_valid_buffer(q) for q in rows],
        }
        asked, nothing, alone = (own.min() for own in in_turns(tasks, ROUNDS).values())
        scale = 1e6 / len(rows)
        print(
            f"  {name:38s} {scale * asked:6.2f} / {scale * nothing:5.2f} = "
            f"{asked / nothing:5.1f} times   (the check alone {scale * alone:.2f})"
        )


def queries(checker: vp.CollisionChecker, what: str) -> None:
    """Processor times: what else the machine does does not count."""
    plan(checker, START, GOAL)
    times, parts = [], []
    for seed in range(20):
        began = time.process_time()
        result = plan(checker, START, GOAL, "RRTConnect", seed=seed, clock="process")
        times.append(time.process_time() - began)
        if not result.solved:
            raise SystemExit(f"seed {seed}: {result.status}: {result.message}")
        report = result.report
        took = report.simplification_time, report.verification_time, report.risk_time
        parts.append((report.planning_time, *took))
    search, shorten, verify, risk = 1e3 * np.median(parts, axis=0)
    print(
        f"RRTConnect query on the demo scene, {what}, 20 seeds, after warm-up: median "
        f"{1e3 * np.median(times):.1f} ms, slowest {1e3 * max(times):.1f} ms (medians: search "
        f"{search:.1f}, shortening {shorten:.1f}, verification {verify:.1f}, risk {risk:.1f} ms)"
    )


def main() -> None:
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--map", type=Path, help="a saved map of the demo scene, to skip the fit")
    checker = demo_checker(parser.parse_args().map)
    for q in (START, GOAL):
        if not checker.is_valid(q):
            raise SystemExit(f"{q.tolist()} is invalid: {checker.explain(q).text()}")
    callbacks(checker)
    queries(checker, "level sets")
    queries(vp.CollisionChecker(checker.world, checker.robot), "defaults")


if __name__ == "__main__":
    main()
