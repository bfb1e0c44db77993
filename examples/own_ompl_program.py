# SPDX-License-Identifier: BSD-3-Clause
"""An OMPL program of your own, with what the camera saw in it: two lines attach the world.

python examples/own_ompl_program.py
"""

import sys
from pathlib import Path

import numpy as np
from ompl import base as ob
from ompl import geometric as og

import vprism_plan as vp
from vprism_plan.planning import VPrismMotionValidator, VPrismStateValidityChecker, to_array

START = [0.5, 0.67, 0.0, -1.6, 0.0, 2.27, 0.785]
GOAL = [-0.35, 0.3, 0.0, -1.85, 0.0, 2.15, 0.785]


def main() -> np.ndarray:
    """Plan across the bundled table; everything OMPL owns ends with this function."""
    observation = vp.load_observation(Path(vp.__file__).parent / "data" / "demo_scene")
    world = vp.World(vp.fit_map(observation))
    beside_the_clutter = np.eye(4)
    beside_the_clutter[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    beside_the_clutter[:3, 3] = [0.05, -0.6, 0.0]
    urdf = Path(__file__).parent.parent / "urdf" / "panda.urdf"
    robot = vp.Robot.from_urdf(urdf, base_pose=beside_the_clutter)
    checker = vp.CollisionChecker(world, robot)

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
    if not setup.haveExactSolutionPath():  # an approximate solution is none
        sys.exit(f"no path. Start: {checker.explain(START).text()}. "
                 f"Goal: {checker.explain(GOAL).text()}")  # fmt: skip
    return np.array([to_array(space, state) for state in setup.getSolutionPath().getStates()])


if __name__ == "__main__":
    path = main()
    print(f"{len(path)} waypoints from\n{path[0].round(3)} to\n{path[-1].round(3)}")
