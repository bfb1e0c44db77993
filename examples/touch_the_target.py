# SPDX-License-Identifier: BSD-3-Clause
"""Let the hand touch one object, and nothing else touch anything.

    python examples/touch_the_target.py

The goal presses the hand against an object. Without a rule it is refused, and the refusal
names the object; with `allowed_contacts` the path ends there, and the report says what it
touches.
"""

from pathlib import Path

import numpy as np

import vprism_plan as vp

HERE = Path(__file__).resolve().parent.parent
START = [-0.35, 0.3, 0.0, -1.85, 0.0, 2.15, 0.785]
TOUCHING = [0.48, 0.7, -0.11, -1.8, -0.23, 2.27, 0.88]
TARGET = 1
BASE = np.array([[0, -1, 0, 0.05], [1, 0, 0, -0.6], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def main() -> None:
    scene = vp.load_observation(Path(vp.__file__).parent / "data" / "demo_scene")
    world = vp.World(vp.fit_map(scene))
    robot = vp.Robot.from_urdf(HERE / "urdf" / "panda.urdf", base_pose=BASE)

    refused = vp.plan(vp.CollisionChecker(world, robot), START, TOUCHING)
    print(f"without a rule: {refused.status}: {refused.message}")

    rules = vp.CheckerConfig(allowed_contacts={"hand": {TARGET}})
    result = vp.plan(vp.CollisionChecker(world, robot, rules), START, TOUCHING)
    print(f"with it: {result.status}")
    for contact in result.report.allowed_contacts:
        print(f"  {contact.link} ends touching {contact.body}, {1000 * contact.depth:.0f} mm deep")


if __name__ == "__main__":
    main()
