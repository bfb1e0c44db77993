# SPDX-License-Identifier: BSD-3-Clause
"""
MPlib plans, our checker judges
===============================

MPlib 0.2.1 needs numpy below 2, so it runs in an environment of its own and gets files: the world
as a distance field's occupied cells, the robot as URDF. Every edge of its path is checked here. ::

    python3 -m venv mplib && mplib/bin/pip install mplib "numpy<2"
    python examples/peers/mplib_plans.py --peer mplib/bin/python [--map MAP.safetensors]
"""

import argparse
import subprocess
import tempfile
from itertools import pairwise
from pathlib import Path

import numpy as np

START = [0.5, 0.67, 0.0, -1.6, 0.0, 2.27, 0.785]  # radians
GOAL = [-0.35, 0.3, 0.0, -1.85, 0.0, 2.15, 0.785]
BASE = np.array([[0, -1, 0, 0.05], [1, 0, 0, -0.6], [0, 0, 1, 0], [0, 0, 0, 1.0]])

parser = argparse.ArgumentParser(description="MPlib on an exported world.")
parser.add_argument("--map", type=Path, help="a saved map instead of the bundled view")
parser.add_argument("--peer", help="Python interpreter that has mplib")
parser.add_argument("--plan", nargs=2, type=Path, help=argparse.SUPPRESS)
arguments = parser.parse_args()


def mplib_plans(folder: Path, urdf: Path) -> None:
    """What MPlib's interpreter runs: nothing of this package is needed."""
    import mplib
    from mplib.collision_detection import fcl

    planner = mplib.Planner(urdf, "panda_hand", srdf=urdf.with_suffix(".srdf"))
    planner.set_base_pose(mplib.Pose(BASE))
    world = np.load(folder / "boxes.npz")
    shapes = [fcl.CollisionObject(fcl.Box(size)) for size in world["size"]]
    poses = [mplib.Pose(p=middle) for middle in world["middle"]]
    planner.planning_world.add_object(fcl.FCLObject("world", mplib.Pose(), shapes, poses))
    mplib.set_global_seed(1)
    fixed = np.zeros(len(planner.user_joint_names) - 7)  # fingers
    goals, start = [np.array(GOAL)], np.concatenate([START, fixed])
    found = planner.plan_qpos(goals, start, planning_time=5.0)
    print("MPlib:", found["status"])
    np.save(folder / "path.npy", found["position"][:, :7])


if arguments.plan:
    mplib_plans(*arguments.plan)
    raise SystemExit

# %%
# Our side: the world as boxes, but for the surface that the arm is bolted to.
import vprism_plan as vp  # noqa: E402
from vprism_plan.world import Cells  # noqa: E402

DATA = Path(vp.__file__).parent / "data"
saved, urdf = arguments.map, DATA / "urdf" / "panda.urdf"
m = vp.load_map(saved) if saved else vp.fit_map(vp.load_observation(DATA / "demo_scene"))
world = vp.World(m)
checker = vp.CollisionChecker(world, vp.Robot.from_urdf(urdf, base_pose=BASE))
cells = Cells.of(world)
ends = [cells.boxes(own) for name, own in cells.bodies() if name != "support surface"]
low, high = (np.concatenate(corner) for corner in zip(*ends, strict=True))

# %%
# MPlib samples its edges and keeps no margin; what it calls free and we do not is counted.
with tempfile.TemporaryDirectory() as folder:
    np.savez(Path(folder) / "boxes.npz", size=high - low, middle=0.5 * (low + high))
    subprocess.run([arguments.peer, __file__, "--plan", folder, urdf], check=True)
    path = np.load(Path(folder) / "path.npy")
free = [checker.check_motion(a, b) for a, b in pairwise(path)]
print(f"{len(low)} boxes; our checker: {sum(free)} of {len(free)} edges free")
print(checker.collision_probability(path).text())
