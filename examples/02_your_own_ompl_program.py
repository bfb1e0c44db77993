# SPDX-License-Identifier: BSD-3-Clause
"""
Your own OMPL program
=====================

You have a program that plans with OMPL. Two lines give it the world that the camera saw: a state
validity checker and a motion validator. Space, planner, objectives and everything else stay
yours. ::

    python examples/02_your_own_ompl_program.py [--picture FILE.png] [--map MAP.safetensors]
"""

import argparse
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
from ompl import base as ob
from ompl import geometric as og

import vprism_plan as vp
from vprism_plan.planning import VPrismMotionValidator, VPrismStateValidityChecker, to_array
from vprism_plan.viz import plan_figure, save_figure

DATA = Path(vp.__file__).parent / "data"
START = [0.5, 0.67, 0.0, -1.6, 0.0, 2.27, 0.785]  # radians
GOAL = [-0.35, 0.3, 0.0, -1.85, 0.0, 2.15, 0.785]
BESIDE_THE_CLUTTER = np.array([[0, -1, 0, 0.05], [1, 0, 0, -0.6], [0, 0, 1, 0], [0, 0, 0, 1.0]])

parser = argparse.ArgumentParser(description="An OMPL program with a V-PRISM world.")
parser.add_argument("--picture", type=Path, default=Path("out/examples/02.png"))
parser.add_argument("--map", type=Path, help="a saved map instead of the bundled view")
arguments = parser.parse_args()

# %%
# A map of the view, a world made of it, the robot, and the checker that knows all three.
m = (
    vp.load_map(arguments.map)
    if arguments.map
    else vp.fit_map(vp.load_observation(DATA / "demo_scene"))
)
robot = vp.Robot.from_urdf(DATA / "urdf" / "panda.urdf", base_pose=BESIDE_THE_CLUTTER)
checker = vp.CollisionChecker(vp.World(m), robot)


# %%
# The OMPL program. It is a function that returns plain numbers, so that everything OMPL owns ends
# with it: the Python binding complains about objects that outlive the interpreter's modules.
# OMPL counts an approximate solution as a solution; ``haveExactSolutionPath`` does not.
def plan_with_ompl() -> np.ndarray:
    space = ob.RealVectorStateSpace(robot.dof)
    bounds = ob.RealVectorBounds(robot.dof)
    for i in range(robot.dof):
        bounds.setLow(i, float(robot.lower[i]))
        bounds.setHigh(i, float(robot.upper[i]))
    space.setBounds(bounds)

    setup = og.SimpleSetup(space)
    si = setup.getSpaceInformation()
    si.setStateValidityChecker(VPrismStateValidityChecker(si, checker))
    si.setMotionValidator(VPrismMotionValidator(si, checker))

    start, goal = space.allocState(), space.allocState()
    start[0 : robot.dof], goal[0 : robot.dof] = START, GOAL
    setup.setStartAndGoalStates(start, goal)
    setup.setPlanner(og.RRTConnect(si))
    setup.solve(5.0)
    if not setup.haveExactSolutionPath():
        sys.exit(f"no path. Start: {checker.explain(START).text()}. "
                 f"Goal: {checker.explain(GOAL).text()}")  # fmt: skip
    return np.array([to_array(space, state) for state in setup.getSolutionPath().getStates()])


path = plan_with_ompl()
print(f"{len(path)} waypoints from\n{path[0].round(3)} to\n{path[-1].round(3)}")

# %%
# The motion validator covers edges continuously, so the path needs no finer resolution. This is
# the planner's path as it came, with its detours: ``vp.plan`` (the next example) also shortens it
# and verifies every edge again.
checked = [checker.check_motion(a, b) for a, b in pairwise(path)]
print(f"{sum(checked)} of {len(checked)} edges free; {checker.min_clearance(path).text()}")

# %%
# The arm as the spheres that were checked, the objects as the map believes them.
save_figure(plan_figure(vp.extract_meshes(m), robot, path), arguments.picture)
