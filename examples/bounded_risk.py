# SPDX-License-Identifier: BSD-3-Clause
"""Plan so that the whole path touches anything with a probability of at most five percent.

    python examples/bounded_risk.py [--picture FILE.png]

The probability is that of the path, not of its points: one world, drawn from the map's
posterior, holds from start to goal. Prints the risk of a path planned without a bound, of one
planned with it, and what the risky one would touch; draws the bounded one among what the map
believes and how sure it is.
"""

import argparse
from pathlib import Path

import numpy as np

import vprism_plan as vp
from vprism_plan.viz import risk_figure, save_figure

HERE = Path(__file__).resolve().parent.parent
START = [0.5, 0.67, 0.0, -1.6, 0.0, 2.27, 0.785]
GOAL = [-0.35, 0.3, 0.0, -1.85, 0.0, 2.15, 0.785]
BASE = np.array([[0, -1, 0, 0.05], [1, 0, 0, -0.6], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--picture", type=Path, help="PNG to write")
    picture = parser.parse_args().picture
    scene = vp.load_observation(Path(vp.__file__).parent / "data" / "demo_scene")
    world = vp.World(vp.fit_map(scene))
    robot = vp.Robot.from_urdf(HERE / "urdf" / "panda.urdf", base_pose=BASE)

    plain = vp.CollisionChecker(world, robot)
    straight = plain.collision_probability(np.array([START, GOAL]))
    print(f"straight to the goal: {straight.text()}")
    for cause in straight.first_contact[:3]:
        print(f"  {cause.text()}")
    shortest = vp.plan(plain, START, GOAL)
    print(f"planned, no bound: {plain.collision_probability(shortest.path).text()}")

    bounded = vp.CollisionChecker(world, robot, vp.CheckerConfig(max_risk=0.05))
    result = vp.plan(bounded, START, GOAL)
    print(f"planned, max_risk 0.05: {result.status}, {result.report.risk.text()}")
    if result.path is not None:
        print(bounded.safety_margin(result.path).text(5))
        if picture is not None:
            save_figure(risk_figure(bounded, result.path), picture)


if __name__ == "__main__":
    main()
