# SPDX-License-Identifier: BSD-3-Clause
"""
Safety margins along a path
===========================

A path is free. By how much, from what, and which joint would use the room up? These margins are
lower bounds over the whole path, edges included, not values at its waypoints. ::

    python examples/05_safety_margins_along_a_path.py [--picture FILE.png] [--map MAP.safetensors]
"""

import argparse
from pathlib import Path

import numpy as np

import vprism_plan as vp
from vprism_plan.viz import margin_figure, save_figure

DATA = Path(vp.__file__).parent / "data"
START = [0.5, 0.67, 0.0, -1.6, 0.0, 2.27, 0.785]  # radians
GOAL = [-0.35, 0.3, 0.0, -1.85, 0.0, 2.15, 0.785]
BASE = np.array([[0, -1, 0, 0.05], [1, 0, 0, -0.6], [0, 0, 1, 0], [0, 0, 0, 1.0]])

parser = argparse.ArgumentParser(description="The room a path leaves to every obstacle.")
parser.add_argument("--picture", type=Path, default=Path("out/examples/05.png"))
parser.add_argument("--map", type=Path, help="a saved map instead of the bundled view")
arguments = parser.parse_args()

# %%
# A path that keeps 1 cm from everything that may be occupied.
m = (
    vp.load_map(arguments.map)
    if arguments.map
    else vp.fit_map(vp.load_observation(DATA / "demo_scene"))
)
robot = vp.Robot.from_urdf(DATA / "urdf" / "panda.urdf", base_pose=BASE)
checker = vp.CollisionChecker(vp.World(m), robot, vp.CheckerConfig(margin=0.01))
path = vp.plan(checker, START, GOAL).path

# %%
# The smallest clearance over all of it, and where it is. ``tolerance`` is the largest error of the
# bound, in metres.
print(checker.min_clearance(path, tolerance=0.0005).text())

# %%
# Every moving link against every obstacle, nearest first: a bound on the distance, the map's belief
# at the obstacle's nearest point, and the joint that changes the distance most. Each obstacle is
# asked alone, so one that stands behind the nearest is in the table too.
margins = checker.safety_margin(path)
print(margins.text(8))
nearest = margins.margins[0]
print(f"nearest: {nearest.link} to {nearest.body} on edge {int(nearest.place)}, "
      f"at {np.round(nearest.nearest, 3)} m")  # fmt: skip

# %%
# How far could the arm go straight for the goal before it had to stop, and why there?
print(checker.max_safe_motion(START, np.subtract(GOAL, START)).text())

# %%
# How well does the map know the space that the arm sweeps? The entropy is averaged where the map
# has support; the rest is reported as a share.
entropy = checker.path_entropy(path)
print(
    f"{1000 * entropy.swept_volume:.0f} litres swept, {100 * entropy.unsupported_share:.0f} % of "
    f"them without support; mean entropy of the rest {entropy.swept_mean:.2f} nats"
)

# %%
# Above, the clearance to every obstacle along the path; below, the smallest of each pair.
save_figure(margin_figure(checker, path), arguments.picture)
