# SPDX-License-Identifier: BSD-3-Clause
"""
Plan with bounded risk
======================

A plan is accepted if the whole path touches anything with a probability of at most `max_risk`, 0.1
by default. The probability is that of the path, not of its points: a world drawn from the map's
posterior holds from start to goal. ::

    python examples/03_plan_with_bounded_risk.py [--picture FILE.png] [--map MAP.safetensors]
"""

import argparse
from pathlib import Path

import numpy as np

import vprism_plan as vp
from vprism_plan.viz import risk_figure, save_figure

DATA = Path(vp.__file__).parent / "data"
START = [0.5, 0.67, 0.0, -1.6, 0.0, 2.27, 0.785]  # radians
GOAL = [-0.35, 0.3, 0.0, -1.85, 0.0, 2.15, 0.785]
RISKY = [-0.04, 0.45, -0.11, -1.83, -0.04, 2.0, 0.6]
BASE = np.array([[0, -1, 0, 0.05], [1, 0, 0, -0.6], [0, 0, 1, 0], [0, 0, 0, 1.0]])

parser = argparse.ArgumentParser(description="Bound the probability that a path touches anything.")
parser.add_argument("--picture", type=Path, default=Path("out/examples/03.png"))
parser.add_argument("--map", type=Path, help="a saved map instead of the bundled view")
arguments = parser.parse_args()

# %%
# A map of the view, a world made of it, and the robot.
m = (
    vp.load_map(arguments.map)
    if arguments.map
    else vp.fit_map(vp.load_observation(DATA / "demo_scene"))
)
world = vp.World(m)
robot = vp.Robot.from_urdf(DATA / "urdf" / "panda.urdf", base_pose=BASE)

# %%
# Without a bound, and without margins, the checker refuses the level set P(occupied) >= 0.5 and
# nothing short of it. The straight motion goes through objects. The planned path keeps out of the
# level set, but only just, and the true surface may lie a little farther out.
plain = vp.CollisionChecker(world, robot, vp.CheckerConfig(max_risk=None))
straight = plain.collision_probability([START, GOAL])
print(f"straight to the goal: {straight.text()}")
for cause in straight.first_contact[:3]:
    print(f"  {cause.text()}")
shortest = vp.plan(plain, START, GOAL, margins=None)
print(f"planned, no bound: {plain.collision_probability(shortest.path).text()}")

# %%
# With a bound, every edge of the search is judged by draws from the posterior, and the whole path
# at the end by draws that the search has not seen: a path that was selected with some draws looks
# too good to them. What counts is the upper end of the confidence interval.
bounded = vp.CollisionChecker(world, robot, vp.CheckerConfig(max_risk=0.05))
result = vp.plan(bounded, START, GOAL)
print(f"planned, max_risk 0.05: {result.status}, {result.risk.text()}")

# %%
# Where only riskier motions exist, the answer is the safest one that was found, and how risky it
# is. Here the end itself is so near to what may be there that no bound below its probability can
# hold; nothing was found that is worth it at ten to one.
risky = vp.plan(vp.CollisionChecker(world, robot), START, RISKY)
print(f"a goal beside an object: {risky.status}: {risky.message}")

# %%
# Where the path sweeps through the map and what the map knows there; below, entropy and
# probability along it. A dashed line gives the joint probability of the path: it is neither the
# largest value along the path nor their sum.
save_figure(risk_figure(bounded, result.path), arguments.picture)
