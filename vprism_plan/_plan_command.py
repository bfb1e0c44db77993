# SPDX-License-Identifier: BSD-3-Clause
"""What `vprism-plan plan` does, apart from its arguments."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from vprism_plan import workflow
from vprism_plan.errors import PlanningError

if TYPE_CHECKING:
    from vprism_plan.cli import Plan, Query
    from vprism_plan.collision import CollisionChecker
    from vprism_plan.mapping import VPrismMap


def make_checker(
    command: "Plan | Query",
    map_: "VPrismMap",
    base_xyz: tuple[float, float, float] | None,
    timings: workflow.Timings,
) -> "CollisionChecker":
    """Bake the world and stand the robot in it, as a command's arguments say."""
    import vprism_plan as vp

    config = vp.WorldConfig(occluded=command.occluded, unobserved=command.unobserved)
    checks = vp.CheckerConfig(margin=command.margin)
    base = workflow.pose_at(base_xyz or (0.0, 0.0, 0.0), command.base_yaw)
    robot = vp.Robot.from_urdf(command.robot, base_pose=base)
    world = timings.run("bake world", vp.World, map_, config)
    return vp.CollisionChecker(world, robot, checks)


def run(
    command: "Plan", announce: Callable[[str], None]
) -> tuple[dict[str, Any], tuple[str, ...], bool]:
    """Return the report, lines for people, and whether a verified path was found."""
    import vprism_plan as vp
    from vprism_plan import viz

    if command.goal is not None and command.goal_pose is not None:
        raise PlanningError("--goal and --goal-pose are both given; give one of them")
    timings = workflow.Timings(announce)
    map_ = workflow.map_of(command.input, timings, command.seed)
    checker = make_checker(command, map_, command.base_xyz, timings)
    task = timings.run("choose start and goal", _task, command, checker)
    goal = _pose(command.goal_pose) if command.goal_pose is not None else task.goal
    result = timings.run(
        "plan and verify",
        vp.plan,
        task.checker,
        task.start,
        goal,
        planner=command.planner,
        time_limit=command.time_limit,
        seed=command.seed,
    )
    robot: Any = task.checker.robot
    report = {
        "plan": workflow.plan_summary(result),
        "base_pose": robot.base_pose,
        "joint_names": robot.joint_names,
        "start": task.start,
        "goal": goal,
        "path": result.path,
        "seconds": timings.seconds,
    }
    lines = [f"{result.status}: {result.message}", f"robot: {task.note}"]
    timings.announce("draw and write")
    command.output.mkdir(parents=True, exist_ok=True)
    viz.save_figure(viz.scene_figure(map_.views[0]), command.output / "scene.png")
    viz.save_figure(viz.map_figure(map_), command.output / "map.png")
    if result.path is not None:
        numbers = result.report
        title = f"{command.planner}: {numbers.waypoints} waypoints, verified edge by edge"
        workflow.write_plan(command.output, result, task, vp.extract_meshes(map_), title)
        lines.append(
            f"{numbers.waypoints} waypoints, clearance {1000 * numbers.min_clearance:.1f} mm, "
            f"search {1000 * numbers.planning_time:.0f} ms"
        )
    workflow.write_report(command.output / "report.json", report)
    lines.append(f"wrote {command.output}")
    return workflow.plain(report), tuple(lines), result.solved


def _task(command: "Plan", checker: "CollisionChecker") -> workflow.Task:
    """Return what was asked for, with what was left out chosen."""
    robot: Any = checker.robot
    start = None if command.start is None else robot.check_configuration(command.start)
    has_goal = command.goal is not None or command.goal_pose is not None
    note = f"base at {np.round(robot.base_pose[:3, 3], 3).tolist()}"
    if has_goal and start is None:
        start = robot.named_states.get("ready", robot.neutral)
        note += ", start in its ready state"
    if has_goal and start is not None:
        goal = start if command.goal is None else robot.check_configuration(command.goal)
        return workflow.Task(checker, start, goal, note)
    fixed = command.base_xyz is not None or start is not None
    return workflow.across_the_objects(checker, command.seed, fixed, start)


def _pose(values: tuple[float, ...]) -> np.ndarray:
    """Return the (4, 4) pose of x y z qw qx qy qz."""
    from scipy.spatial.transform import Rotation

    quaternion = np.asarray(values[3:], dtype=np.float64)
    norm = float(np.linalg.norm(quaternion))
    if not abs(norm - 1.0) < 1e-3:
        raise PlanningError(
            f"--goal-pose has the quaternion {quaternion.tolist()} of length {norm:.4f}; "
            "give a unit quaternion w x y z after the position"
        )
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    pose[:3, 3] = values[:3]
    return pose
