# SPDX-License-Identifier: BSD-3-Clause
"""
Costs in a torch loop of your own
=================================

The costs are modules that take trajectories ``(..., T, dof)`` and return one number each. They work
in any loop; verifying what comes out is then up to you. ::

    python examples/04a_costs_in_a_torch_loop.py [--picture FILE.png] [--map MAP.safetensors]
"""

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

import vprism_plan as vp
from vprism_plan.trajopt import ClearanceCost, JointLimitCost, SelfCollisionCost, SmoothnessCost
from vprism_plan.viz import resample, save_figure

DATA = Path(vp.__file__).parent / "data"
START = [0.5, 0.67, 0.0, -1.6, 0.0, 2.27, 0.785]  # radians
GOAL = [-0.35, 0.3, 0.0, -1.85, 0.0, 2.15, 0.785]
BASE = np.array([[0, -1, 0, 0.05], [1, 0, 0, -0.6], [0, 0, 1, 0], [0, 0, 0, 1.0]])

parser = argparse.ArgumentParser(description="Optimise a trajectory with torch.optim.Adam.")
parser.add_argument("--picture", type=Path, default=Path("out/examples/04a.png"))
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
# Costs compose with ``+`` and numbers. Given the checker, clearance is what the checker means by
# it, its margin and allowed contacts included.
cost = (
    SmoothnessCost(velocity=1.0, acceleration=1e-3)
    + 300.0 * ClearanceCost(checker, margin=0.02)
    + 300.0 * SelfCollisionCost(checker, margin=0.005)
    + 300.0 * JointLimitCost(robot, margin=0.02)
)

# %%
# Only the inner waypoints are variables, so start and goal stay what they are, bit for bit.
line = torch.tensor(np.linspace(START, GOAL, 24))
inner = line[1:-1].clone().requires_grad_()
optimizer = torch.optim.Adam([inner], lr=0.02)
history = []
for _ in range(250):
    q = torch.cat([line[:1], inner, line[-1:]])
    terms = cost.terms(q)
    loss = sum(terms.values())
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    history.append([float(value.detach()) for value in terms.values()])
path = torch.cat([line[:1], inner, line[-1:]]).detach().numpy()
print(f"cost {sum(history[0]):.2f} to {sum(history[-1]):.2f}")

# %%
# A cost is no verdict: it looks at samples. The checker covers every edge.
for name, rows in (("straight line", line.numpy()), ("optimised", path)):
    free = sum(checker.check_motion(a, b) for a, b in pairwise(rows))
    print(f"{name}: {free} of {len(rows) - 1} edges free")

# %%
# The terms while the loop runs, and the clearance along the trajectory before and after.
figure = Figure(figsize=(10.0, 3.8), layout="constrained")
left, right = figure.subplots(1, 2)
for name, values in zip(terms, np.transpose(history), strict=True):
    left.semilogy(np.where(values > 0.0, values, np.nan), label=name)
left.set(xlabel="iteration", ylabel="cost", title="terms")
for name, rows in (("straight line", line.numpy()), ("optimised", path)):
    right.plot(1000 * checker.clearance_batch(resample(rows, 200)), label=name)
right.axhline(0.0, color="0.5", linewidth=0.8)
right.set(xlabel="place on the trajectory (of 200)", ylabel="clearance (mm)", title="clearance")
for axis in (left, right):
    axis.grid(alpha=0.25)
    axis.legend()
save_figure(figure, arguments.picture)
