# SPDX-License-Identifier: BSD-3-Clause
"""
Costs in scipy's L-BFGS-B
=========================

Any optimiser that takes a value and a gradient can minimise the costs. Scipy's L-BFGS-B also keeps
bounds, which makes joint limits exact. ::

    python examples/04b_costs_in_scipy.py [--picture FILE.png] [--map MAP.safetensors]
"""

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from scipy.optimize import minimize

import vprism_plan as vp
from vprism_plan.trajopt import ClearanceCost, SelfCollisionCost, SmoothnessCost
from vprism_plan.viz import hand_path, resample, save_figure

DATA = Path(vp.__file__).parent / "data"
START = [0.5, 0.67, 0.0, -1.6, 0.0, 2.27, 0.785]  # radians
GOAL = [-0.35, 0.3, 0.0, -1.85, 0.0, 2.15, 0.785]
BASE = np.array([[0, -1, 0, 0.05], [1, 0, 0, -0.6], [0, 0, 1, 0], [0, 0, 0, 1.0]])

parser = argparse.ArgumentParser(description="Optimise a trajectory with scipy's L-BFGS-B.")
parser.add_argument("--picture", type=Path, default=Path("out/examples/04b.png"))
parser.add_argument("--map", type=Path, help="a saved map instead of the bundled view")
arguments = parser.parse_args()

# %%
# World, robot, checker and costs as in the example before, without the joint limits.
m = (
    vp.load_map(arguments.map)
    if arguments.map
    else vp.fit_map(vp.load_observation(DATA / "demo_scene"))
)
robot = vp.Robot.from_urdf(DATA / "urdf" / "panda.urdf", base_pose=BASE)
checker = vp.CollisionChecker(vp.World(m), robot)
cost = (
    SmoothnessCost(velocity=1.0, acceleration=1e-3)
    + 300.0 * ClearanceCost(checker, margin=0.02)
    + 300.0 * SelfCollisionCost(checker, margin=0.005)
)

# %%
# Scipy wants one flat vector: the inner waypoints. Both ends are added inside the function, so they
# are no variables.
line = np.linspace(START, GOAL, 24)
ends = torch.tensor(line[[0, -1]])
costs = []


def value_and_gradient(x: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the cost of the trajectory and its gradient."""
    inner = torch.tensor(x.reshape(-1, robot.dof), requires_grad=True)
    value = cost(torch.cat([ends[:1], inner, ends[1:]]))
    value.backward()
    costs.append(float(value.detach()))
    return costs[-1], inner.grad.numpy().ravel()


limits = list(zip(robot.lower, robot.upper, strict=True)) * (len(line) - 2)
found = minimize(
    value_and_gradient,
    line[1:-1].ravel(),
    jac=True,
    method="L-BFGS-B",
    bounds=limits,
    options={"maxiter": 200},
)
path = np.concatenate([line[:1], found.x.reshape(-1, robot.dof), line[-1:]])
print(f"{found.message}: cost {costs[0]:.2f} to {found.fun:.2f}, {found.nfev} evaluations")

# %%
# The checker has the last word.
free = sum(checker.check_motion(a, b) for a, b in pairwise(path))
print(f"{free} of {len(path) - 1} edges free, {checker.min_clearance(path).text()}")

# %%
# The cost of every evaluation, and the hand's height before and after.
figure = Figure(figsize=(10.0, 3.8), layout="constrained")
left, right = figure.subplots(1, 2)
left.semilogy(costs)
left.set(xlabel="evaluation", ylabel="cost", title="what scipy saw")
for name, rows in (("straight line", line), ("optimised", path)):
    hand = hand_path(robot, resample(rows, 100))
    right.plot(hand[:, 0], hand[:, 2], label=name)
right.set(xlabel="x (m)", ylabel="z (m)", title="path of the hand, from the side")
right.legend()
for axis in (left, right):
    axis.grid(alpha=0.25)
save_figure(figure, arguments.picture)
