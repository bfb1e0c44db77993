# SPDX-License-Identifier: BSD-3-Clause
"""The command `plan`, and what `query` shares with it: world, base, what is asked for."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vprism_plan.cli._console import Console
from vprism_plan.cli._maps import fit, observe
from vprism_plan.cli._outcome import Situation, report_plan
from vprism_plan.cli._parsing import Command
from vprism_plan.cli._placing import (
    Surroundings,
    base_pose,
    candidate_bases,
    reach_for,
    stands_free,
)
from vprism_plan.errors import PlanningError

if TYPE_CHECKING:
    from vprism_plan.collision import CheckerConfig, CollisionChecker
    from vprism_plan.mapping import VPrismMap
    from vprism_plan.robots import Robot
    from vprism_plan.world import World


class NoPlaceError(Exception):
    """Nothing sensible was found for what the user left open: an answer, not bad input."""


def run_plan(command: Command, console: Console) -> int:
    """Plan and write the results; exit code 0, or 1 without a verified path."""
    from vprism_plan.planning.planners import planner_kind
    from vprism_plan.robots import Robot

    planner_kind(command.planner)  # before the long work, as all that may be wrong
    robot = Robot.from_urdf(command.robot)
    console.warn(robot.warnings)
    _check_lengths(command, robot)
    config = checks(command, robot)
    m = _map_from(command.input, command.frame, command.seed, console)
    world = bake(m, command, console)
    try:
        with console.stage("place"):
            situation = _place(command, robot, world, config)
    except NoPlaceError as error:
        console.finish(
            {
                "solved": False,
                "plan": {"status": "no_place", "message": str(error)},
                "timings": console.timings,
            },
            [f"no safe answer (no_place): {error}"],
        )
        return 1
    return solve(
        situation,
        planner=command.planner,
        time_limit=command.time_limit,
        seed=command.seed,
        output=command.output,
        console=console,
    )


def solve(
    situation: Situation,
    *,
    planner: str,
    time_limit: float,
    seed: int,
    output: Path,
    console: Console,
) -> int:
    """Plan in a prepared situation, write everything, report; return the exit code."""
    from vprism_plan.planning import plan

    with console.stage("plan"):
        result = plan(
            situation.checker,
            situation.start,
            situation.goal,
            planner=planner,
            time_limit=time_limit,
            seed=seed,
        )
    return report_plan(situation, result, output, console)


def _map_from(path: Path, frame: int | None, seed: int, console: Console) -> "VPrismMap":
    if path.suffix != ".safetensors":
        return fit(observe(path, frame, seed, console), seed, console)
    from vprism_plan.mapping import load_map

    with console.stage("load"):
        return load_map(path)


def bake(m: "VPrismMap", command: Command, console: Console) -> "World":
    """Return the world with the policies that were asked for."""
    from vprism_plan.world import World, WorldConfig

    config = WorldConfig(occluded=command.occluded, unobserved=command.unobserved)
    with console.stage("bake"):
        world = World(m, config)
    console.warn(world.warnings)
    return world


def checks(command: Command, robot: "Robot") -> "CheckerConfig":
    """Return what the checker is asked for; refuses bad values before the long work.

    Raises:
        PlanningError, RobotError, ConfigError: what is wrong.
    """
    from vprism_plan.collision import CheckerConfig

    allowed: dict[str, set[int]] = {}
    for text in command.allow:
        name, colon, number = text.rpartition(":")
        if not (colon and name and number.isdigit()):
            raise PlanningError(
                f"--allow {text!r} is not LINK:ID; give a link or group and an object's id, "
                "for example hand:3"
            )
        robot.links_of(name)
        allowed.setdefault(name, set()).add(int(number))
    return CheckerConfig(margin=command.margin, max_risk=command.max_risk, allowed_contacts=allowed)


def _check_lengths(command: Command, robot: "Robot") -> None:
    """Refuse malformed configurations before the long work.

    Raises:
        PlanningError, RobotError: what is wrong.
    """
    if command.goal is not None and command.goal_pose is not None:
        raise PlanningError("both --goal and --goal-pose are given; give one of them")
    for q in (command.start, command.goal):
        if q is not None:
            robot.check_configuration(q)
    if command.goal_pose is not None:
        pose_matrix(command.goal_pose)


def pose_matrix(pose: tuple[float, ...]) -> np.ndarray:
    """Return (4, 4) from x y z (m) and a quaternion in wxyz order of unit length."""
    x, y, z, qw, qx, qy, qz = pose
    quaternion = np.array([qx, qy, qz, qw])
    length = float(np.linalg.norm(quaternion))
    if not (np.isfinite(pose).all() and abs(length - 1.0) < 1e-3):
        raise PlanningError(
            f"--goal-pose has the quaternion {pose[3:]} of length {length:.4g}; give finite "
            "x y z (m) and qw qx qy qz of length 1"
        )
    from scipy.spatial.transform import Rotation

    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(quaternion / length).as_matrix()
    matrix[:3, 3] = (x, y, z)
    return matrix


def standing(command: Command, robot: "Robot", world: "World", around: Surroundings) -> "Robot":
    """Return the robot on the base that was given, else on the first free place."""
    if command.base_xyz is not None:
        return robot.with_base_pose(base_pose(np.array(command.base_xyz), around, command.base_yaw))
    for pose in candidate_bases(robot, around):
        placed = robot.with_base_pose(base_pose(pose[:3, 3], around, command.base_yaw))
        if stands_free(placed, world):
            return placed
    raise PlanningError("no free place for the base beside the objects; give --base-xyz")


def _place(command: Command, robot: "Robot", world: "World", config: "CheckerConfig") -> Situation:
    """Return robot, checker, start and goal; what is open is chosen so that it is valid.

    Raises:
        NoPlaceError: no valid start and goal on both sides of the objects.
    """
    from vprism_plan.collision import CollisionChecker

    around = Surroundings.of(world.map)
    if command.base_xyz is not None:
        poses = [base_pose(np.array(command.base_xyz), around, command.base_yaw)]
    else:
        poses = [
            base_pose(pose[:3, 3], around, command.base_yaw)
            for pose in candidate_bases(robot, around)
        ]
    for number, pose in enumerate(poses):
        placed = robot.with_base_pose(pose)
        if command.base_xyz is None and not stands_free(placed, world):
            continue
        checker = CollisionChecker(world, placed, config)
        rng = np.random.default_rng([command.seed, number])
        ends = choose_ends(
            checker,
            placed,
            around,
            rng,
            start=command.start,
            goal=command.goal if command.goal_pose is None else pose_matrix(command.goal_pose),
        )
        if ends is not None:
            chosen = [
                name
                for name, given in (
                    ("base", command.base_xyz),
                    ("start", command.start),
                    ("goal", command.goal or command.goal_pose),
                )
                if given is None
            ]
            return Situation(checker, placed, *ends, tuple(chosen))
    where = "from the given base" if command.base_xyz is not None else "from any base beside them"
    raise NoPlaceError(
        f"the hand has no valid configuration on both sides of the objects {where}; "
        "give --base-xyz, --start and --goal"
    )


def choose_ends(
    checker: "CollisionChecker",
    robot: "Robot",
    around: Surroundings,
    rng: np.random.Generator,
    *,
    start: Any = None,
    goal: Any = None,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return start and goal; what is None is chosen on the other side of the objects.

    A given start or goal is kept as it is, valid or not: that verdict is the planner's.
    None if nothing valid was found for what is open.
    """
    from vprism_plan.viz import hand_path

    sides = around.sides(robot.base_pose[:3, 3])
    left = sides[1] - sides[0]
    left = left / np.linalg.norm(left)
    middle = np.array([*around.middle, 0.0])

    def side_of(end: np.ndarray) -> float:
        at = end[:3, 3] if end.shape == (4, 4) else hand_path(robot, end[None])[0]
        return 1.0 if (at - middle) @ left > 0 else -1.0

    def reach(sign: float, like: np.ndarray) -> np.ndarray | None:
        edge = around.half_width(left[:2])
        target = sides[1 if sign > 0 else 0]
        return reach_for(
            checker, robot, target, lambda hand: sign * ((hand - middle) @ left) > edge, like, rng
        )

    first = None if start is None else np.asarray(start, dtype=np.float64)
    last = None if goal is None else np.asarray(goal, dtype=np.float64)
    if first is None:
        like = robot.neutral if last is None or last.ndim != 1 else last
        first = reach(-1.0 if last is None else -side_of(last), like)
    if first is not None and last is None:
        last = reach(-side_of(first), first)
    return None if first is None or last is None else (first, last)
