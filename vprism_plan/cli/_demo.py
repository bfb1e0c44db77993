# SPDX-License-Identifier: BSD-3-Clause
"""The command `demo`: one bundled view, a map, a Panda that crosses the clutter it only half sees.

The camera looks along +x; the arm stands at the side and moves its hand from the
camera's side of the clutter to the far side, where short objects stand hidden behind
tall ones. The truth about the scene enters only the report and the pictures.
"""

from dataclasses import replace

import numpy as np

from vprism_plan._resources import data_path, urdf_path
from vprism_plan.cli._console import Console
from vprism_plan.cli._maps import fit, observe
from vprism_plan.cli._motions import choose_ends, solve
from vprism_plan.cli._outcome import Situation
from vprism_plan.cli._parsing import Command
from vprism_plan.cli._placing import Surroundings, base_pose

BASE_XYZ = (0.05, -0.6, 0.0)  # metres, beside the clutter
BASE_YAW = np.pi / 2  # radians, facing it
MARGIN = 0.005  # metres that every sphere keeps from all that may be occupied


def run_demo(command: Command, console: Console) -> int:
    """Fit, bake, plan, verify, and write everything; return the exit code."""
    from vprism_plan.collision import CheckerConfig, CollisionChecker
    from vprism_plan.errors import PlanningError
    from vprism_plan.robots import Robot
    from vprism_plan.simulation import load_ground_truth
    from vprism_plan.world import World

    folder, seed = data_path("demo_scene"), command.seed
    obs = observe(folder, None, seed, console)
    m = fit(obs, seed, console)
    with console.stage("bake"):
        world = World(m)
    around = Surroundings.of(m)
    pose = base_pose(np.array(BASE_XYZ), around, BASE_YAW)
    robot = Robot.from_urdf(urdf_path("panda"), base_pose=pose)
    with console.stage("check"):  # compiles on first use
        checker = CollisionChecker(world, robot, CheckerConfig(margin=MARGIN))
    with console.stage("place"):
        # Left of the arm is the camera's side: it starts where everything is seen.
        ends = choose_ends(checker, robot, around, np.random.default_rng(seed))
    if ends is None:
        raise PlanningError(f"seed {seed} finds no start and goal for the demo; try another seed")
    situation = Situation(
        checker, robot, ends[1], ends[0], ("start", "goal"), title="vprism-plan demo"
    )
    truth = load_ground_truth(folder)
    return solve(
        replace(situation, truth=truth.signed_distance),
        planner="RRTConnect",
        time_limit=5.0,
        seed=seed,
        output=command.output,
        console=console,
    )
