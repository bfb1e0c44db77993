# SPDX-License-Identifier: BSD-3-Clause
"""
Trajectory optimisation
=======================

Many trajectories are bent at once until they are short, smooth and clear of what the map says; the
best one that the checker accepts edge by edge is returned. ::

    python examples/04_trajectory_optimisation.py [--picture FILE.png] [--map MAP.safetensors]
"""

import argparse
from pathlib import Path

import numpy as np
import torch

import vprism_plan as vp
from vprism_plan.trajopt import EntropyCost, default_cost, optimize
from vprism_plan.viz import save_figure, trajopt_figure

DATA = Path(vp.__file__).parent / "data"
START = [0.5, 0.67, 0.0, -1.6, 0.0, 2.27, 0.785]  # radians
GOAL = [-0.35, 0.3, 0.0, -1.85, 0.0, 2.15, 0.785]
BASE = np.array([[0, -1, 0, 0.05], [1, 0, 0, -0.6], [0, 0, 1, 0], [0, 0, 0, 1.0]])

parser = argparse.ArgumentParser(description="Optimise trajectories across the bundled table.")
parser.add_argument("--picture", type=Path, default=Path("out/examples/04.png"))
parser.add_argument("--map", type=Path, help="a saved map instead of the bundled view")
arguments = parser.parse_args()

# %%
# World, robot and checker as in the examples before.
m = (
    vp.load_map(arguments.map)
    if arguments.map
    else vp.fit_map(vp.load_observation(DATA / "demo_scene"))
)
robot = vp.Robot.from_urdf(DATA / "urdf" / "panda.urdf", base_pose=BASE)
checker = vp.CollisionChecker(vp.World(m), robot)

# %%
# From nothing: a straight line, detours and smooth noise are optimised side by side. Without a cost
# of your own the checker's is minimised: squared velocity and a little acceleration, clearance,
# self-collision and joint limits. Gradients only lead to the nearest minimum, so several beginnings
# are worth their time; here they agree.
result = optimize(checker, START, GOAL, seeds=6)
print(f"from nothing: {result.status}, {result.message}")
for seed in result.report.seeds:
    print(f"  {seed.name}: cost {seed.cost:.3f}, {seed.iterations} iterations, {seed.stopped}")

# %%
# From a planner's path: RRTConnect's, as it comes, wanders. It gets shorter and, with
# ``keep_clearance``, comes no nearer to anything than it came, at no point of any edge.
raw = vp.plan(checker, START, GOAL, simplify=False).path
kept = optimize(checker, START, GOAL, initial=raw, seeds=1, keep_clearance=True)
for name, path in (("RRTConnect", raw), ("optimised", kept.path)):
    length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    print(f"{name}: {length:.2f} rad, {checker.min_clearance(path).text()}")

# %%
# Costs are torch modules and add up. Here a path is also to stay away from what the map is unsure
# of, whether or not that is an obstacle; it pays with a little length.
unsure = EntropyCost(checker, exact=False)
careful = optimize(checker, START, GOAL, cost=default_cost(checker) + 20.0 * unsure, seeds=3)
for name, one in (("default cost", result), ("and entropy", careful)):
    nats = float(unsure(torch.from_numpy(one.path)))
    print(f"{name}: {one.report.path_length:.3f} rad, {nats:.4f} nats on average")

# %%
# Above, the hand's paths: how the seeds began, and what was returned. Below, what the returned
# seed's cost consists of, and the costs of all seeds.
save_figure(trajopt_figure(checker, kept, given=raw), arguments.picture)
