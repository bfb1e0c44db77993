# SPDX-License-Identifier: BSD-3-Clause
"""What the costs of trajectories cost, next to pytorch-kinematics on the same batch.

    python -m experiments.benchmarks.trajopt_costs [--trajectories 64] [--waypoints 32]
        [--repeats 15]

Forward and backward of each cost over a batch of the Panda's trajectories (straight lines
between valid configurations, bent by smooth noise) among the bundled scene's objects, and of
pytorch-kinematics' own kinematics (poses of all frames, its analytic gradient) over the same
waypoints. All are measured in turns, so that what else the machine does falls on all alike; the
medians' ratios are printed. One thread each.
"""

import argparse
import os

os.environ.setdefault("VPRISM_PLAN_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

from collections.abc import Callable

import numpy as np
import torch

import vprism_plan as vp
from experiments.benchmarks._common import DEMO, ROOT, in_turns
from vprism_plan.trajopt import (
    ClearanceCost,
    EntropyCost,
    JointLimitCost,
    OccupancyCost,
    RiskCost,
    SelfCollisionCost,
    SmoothnessCost,
    TrajectoryCost,
)
from vprism_plan.trajopt.cost import Subdivision, sample_paths

SPACING = 0.05  # metres between samples: the costs' default


def batch(checker: vp.CollisionChecker, count: int, waypoints: int, seed: int) -> np.ndarray:
    """Bent lines between valid configurations: (count, waypoints, dof)."""
    rng = np.random.default_rng(seed)
    robot = checker.robot
    Q = rng.uniform(robot.lower, robot.upper, (200 * count, robot.dof))
    ends = Q[checker.is_valid_batch(Q)][: 2 * count].reshape(count, 2, robot.dof)
    t = np.linspace(0.0, 1.0, waypoints)[None, :, None]
    lines = ends[:, :1] + t * (ends[:, 1:] - ends[:, :1])
    return lines + np.sin(np.pi * t) * rng.normal(scale=0.2, size=(count, 1, robot.dof))


def kinematics(robot: vp.Robot, q: torch.Tensor) -> Callable[[], None]:
    """Forward and backward of pytorch-kinematics alone."""
    rows = q.detach().reshape(-1, q.shape[-1])
    robot.sphere_centers(rows)
    chain, q_index, *_ = robot._torch._chains[q.dtype, q.device]
    joints = rows[:, q_index].clone().requires_grad_()

    def run() -> None:
        joints.grad = None
        chain.forward_kinematics_tensor(joints, analytical_grad=True).sum().backward()

    return run


def both_ways(cost: TrajectoryCost, q: torch.Tensor) -> Callable[[], None]:
    """Forward and backward of a cost."""

    def run() -> None:
        q.grad = None
        cost(q).sum().backward()

    return run


def costs_of(world: vp.World, robot: vp.Robot, subsamples: int | None) -> dict[str, TrajectoryCost]:
    """Costs on baked fields."""
    options = {"spacing": SPACING, "subsamples": subsamples}
    parts: dict[str, TrajectoryCost] = {
        "clearance": ClearanceCost(world, robot, **options),
        "self-collision": SelfCollisionCost(robot, **options),
        "smoothness": SmoothnessCost(acceleration=1e-3),
        "joint limits": JointLimitCost(robot),
    }
    four = parts["clearance"] + parts["self-collision"]
    whole = four + parts["smoothness"] + parts["joint limits"]
    return {
        "**all four**": whole,
        **parts,
        "clearance, arc length": ClearanceCost(world, robot, arc_length=True, **options),
        "occupancy, baked": OccupancyCost(world, robot, exact=False, **options),
        "entropy, baked": EntropyCost(world, robot, exact=False, **options),
        "risk, 64 draws": RiskCost(world, robot, **options),
    }


def main() -> None:
    """Measure and print a table per way of dividing edges."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trajectories", type=int, default=64)
    parser.add_argument("--waypoints", type=int, default=32)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--exact-repeats", type=int, default=2)
    args = parser.parse_args()
    torch.set_num_threads(1)
    world = vp.World(vp.fit_map(vp.load_observation(DEMO), vp.MapConfig(), seed=0))
    base = np.eye(4)
    base[0, 3] = -0.5
    robot = vp.Robot.from_urdf(ROOT / "urdf" / "panda.urdf", base_pose=base)
    checker = vp.CollisionChecker(world, robot, vp.CheckerConfig(max_risk=None))
    paths = batch(checker, args.trajectories, args.waypoints, seed=0)
    q = torch.from_numpy(paths).float().requires_grad_()
    print(f"{robot.name}: {len(robot.sphere_radii)} spheres, batch {tuple(q.shape)}, float32")
    for subsamples in (1, None):
        found = sample_paths(robot, q.detach(), Subdivision(SPACING, subsamples))
        how = "waypoints only" if subsamples else f"samples at most {SPACING * 100:g} cm apart"
        print(f"\n{how}: {len(found.q)} configurations for {paths[..., 0].size} waypoints\n")
        tasks = {"pytorch-kinematics": kinematics(robot, q)}
        costs = costs_of(world, robot, subsamples)
        tasks |= {name: both_ways(cost, q) for name, cost in costs.items()}
        report(in_turns(tasks, args.repeats))
    print("\nthe exact posterior, waypoints only\n")
    exact: dict[str, Callable[[], None]] = {"pytorch-kinematics": kinematics(robot, q)}
    for kind in (OccupancyCost, EntropyCost):
        cost = kind(world, robot, subsamples=1)
        exact[f"{cost.name}, exact"] = both_ways(cost, q)
    report(in_turns(exact, args.exact_repeats))


def report(times: dict[str, np.ndarray]) -> None:
    """Print medians and their ratio to the first."""
    first = float(np.median(next(iter(times.values()))))
    print("| forward and backward | ms | ratio |\n|---|---|---|")
    for name, own in times.items():
        print(f"| {name} | {1e3 * np.median(own):.1f} | {np.median(own) / first:.2f} |")


if __name__ == "__main__":
    main()
