# SPDX-License-Identifier: BSD-3-Clause
"""
Your robot
==========

Any URDF will do. Meshes are read where it names them; spheres that enclose every link are fitted
where there are none; pairs of links that need no test are found by sampling where there is no
SRDF. ::

    python examples/07_your_robot.py [--picture FILE.png] [--map MAP.safetensors]

The robot here is the KUKA iiwa of ``pybullet_data`` (``pip install pybullet``), as it comes.
"""

import argparse
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np
import pybullet_data

import vprism_plan as vp
from vprism_plan.viz import robot_figure, save_figure

DATA = Path(vp.__file__).parent / "data"
URDF = Path(pybullet_data.getDataPath()) / "kuka_iiwa" / "model.urdf"
BASE = np.array([[0, -1, 0, 0.05], [1, 0, 0, -0.6], [0, 0, 1, 0], [0, 0, 0, 1.0]])
START = [-0.12, 1.02, -0.19, -1.36, 0.06, 0.78, -0.41]  # radians
GOAL = [0.42, 1.07, 0.08, -1.40, -0.34, 0.74, -0.75]

parser = argparse.ArgumentParser(description="Load a URDF with meshes, fit spheres, plan with it.")
parser.add_argument("--picture", type=Path, default=Path("out/examples/07.png"))
parser.add_argument("--map", type=Path, help="a saved map instead of the bundled view")
arguments = parser.parse_args()

# %%
# Loading fits the spheres: as few as hold each link and stand out of it by no more than a
# tolerance (``SphereFit``). ``package://`` names are looked for in ``package_dirs=`` and around
# the URDF.
robot = vp.Robot.from_urdf(URDF, base_pose=BASE)
print(f"{robot.name}: {', '.join(robot.joint_names)}")

# %%
# The report says for every link whether its spheres hold it (proved, not sampled), and how far they
# stand out. What stands out is room that the robot cannot use.
report = robot.report()
print(report.text())

# %%
# Which pairs of links are not tested against each other, and why.
reasons = Counter(reason for _, _, reason in report.disabled_pairs)
print(f"{report.tested_pairs} pairs tested; not tested: {dict(reasons)}")

# %%
# Both can be written beside the URDF and are read from then on, which spares the fit. Look at them
# first: a sampled "Never" is no proof.
with tempfile.TemporaryDirectory() as folder:
    robot.write_spheres(Path(folder) / "model_spheres.yml")
    robot.write_srdf(Path(folder) / "model.srdf")
    again = vp.Robot.from_urdf(
        URDF, srdf=Path(folder) / "model.srdf", spheres=Path(folder) / "model_spheres.yml"
    )
print("the same spheres when read:", bool((again.sphere_radii == robot.sphere_radii).all()))

# %%
# From here on it is a robot like any other.
m = (
    vp.load_map(arguments.map)
    if arguments.map
    else vp.fit_map(vp.load_observation(DATA / "demo_scene"))
)
checker = vp.CollisionChecker(vp.World(m), robot, vp.CheckerConfig(margin=0.005))
result = vp.plan(checker, START, GOAL)
print(result.status, result.message)

# %%
# The meshes as they come, and the spheres over them. ``vprism-plan robot URDF --picture FILE``
# draws the same.
save_figure(robot_figure(robot, START), arguments.picture)
