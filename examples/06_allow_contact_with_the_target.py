# SPDX-License-Identifier: BSD-3-Clause
"""
Allow contact with the target
=============================

To grasp something the hand must touch it, and only the hand, and only it. A rule names a link or a
group of links and the objects it may touch; everything else stays forbidden. ::

    python examples/06_allow_contact_with_the_target.py [--picture FILE.png] [--map MAP.safetensors]
"""

import argparse
from pathlib import Path

import numpy as np

import vprism_plan as vp
from vprism_plan.viz import plan_figure, save_figure

DATA = Path(vp.__file__).parent / "data"
START = [-0.35, 0.3, 0.0, -1.85, 0.0, 2.15, 0.785]  # radians
TOUCHING = [0.48, 0.7, -0.11, -1.8, -0.23, 2.27, 0.88]  # presses the hand against object 1
TARGET = 1
BASE = np.array([[0, -1, 0, 0.05], [1, 0, 0, -0.6], [0, 0, 1, 0], [0, 0, 0, 1.0]])

parser = argparse.ArgumentParser(description="Let the hand touch one object and nothing else.")
parser.add_argument("--picture", type=Path, default=Path("out/examples/06.png"))
parser.add_argument("--map", type=Path, help="a saved map instead of the bundled view")
arguments = parser.parse_args()

# %%
# World and robot. ``hand`` is a group of the robot's SRDF: the palm and both fingers.
m = (
    vp.load_map(arguments.map)
    if arguments.map
    else vp.fit_map(vp.load_observation(DATA / "demo_scene"))
)
world = vp.World(m)
robot = vp.Robot.from_urdf(DATA / "urdf" / "panda.urdf", base_pose=BASE)
print(f"hand: {', '.join(robot.links_of('hand'))}")

# %%
# Without a rule the goal is refused, and the refusal says what would touch what.
refused = vp.plan(vp.CollisionChecker(world, robot), START, TOUCHING)
print(f"without a rule: {refused.status}: {refused.message}")

# %%
# With the rule a path ends there, and the report says what it ends touching. The hand may pass
# through its target anywhere on the path, so keep the rule to the last part of a motion.
rules = vp.CheckerConfig(allowed_contacts={"hand": {TARGET}})
result = vp.plan(vp.CollisionChecker(world, robot, rules), START, TOUCHING)
print(f"with it: {result.status}")
for contact in result.report.allowed_contacts:
    print(f"  {contact.link} ends touching {contact.body}, {1000 * contact.depth:.0f} mm deep")

# %%
# The depth above is that of the collision spheres in the level set: both are larger than what they
# stand for.
save_figure(plan_figure(vp.extract_meshes(m), robot, result.path), arguments.picture)
