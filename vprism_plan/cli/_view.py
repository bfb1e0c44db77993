# SPDX-License-Identifier: BSD-3-Clause
"""The command `view`: a map or a plan in the browser."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vprism_plan._files import read_json, reading
from vprism_plan.cli._console import Console
from vprism_plan.cli._motions import standing
from vprism_plan.cli._parsing import Command
from vprism_plan.cli._placing import Surroundings, base_pose
from vprism_plan.errors import MapError, PlanningError

if TYPE_CHECKING:
    from vprism_plan.mapping import VPrismMap
    from vprism_plan.planning import Trajectory
    from vprism_plan.robots import Robot


def run_view(command: Command, console: Console) -> int:
    """Serve until interrupted; exit code 0.

    Raises:
        VPrismError: nothing to show in the input, or a robot that does not fit it.
    """
    from vprism_plan.viz.viewer import Viewer, require_viser

    require_viser()
    robot = _robot(command)
    with console.stage("load"):
        m, plan = load(command.input)
        trajectory = None if robot is None else motion_of(command.input, plan, robot)
    if robot is not None:
        robot = _placed(command, robot, m, plan, console)
    with console.stage("scene"):
        viewer = Viewer(
            m, robot, trajectory, level=command.level, host=command.host, port=command.port
        )
    try:
        shown = sorted({path.split("/")[1] for path in viewer.nodes})
        payload = {
            "url": viewer.url,
            "shown": shown,
            "nodes": sorted(viewer.nodes),
            "timings": console.timings,
        }
        lines = [f"{command.input}: {', '.join(shown)}"]
        if robot is None and plan is not None:
            lines.append("give --robot URDF to see the robot and its path")
        console.finish(payload, [*lines, f"open {viewer.url} in a browser; Ctrl-C ends it"])
        viewer.wait()
    except KeyboardInterrupt:  # the way to end it, hence no error
        pass
    finally:
        viewer.stop()
    return 0


def load(path: Path) -> tuple["VPrismMap", dict[str, Any] | None]:
    """Return the map, and the report of the plan if `path` is the folder of one.

    Raises:
        MapError: there is no map, or a report that cannot be read.
    """
    from vprism_plan.mapping import load_map

    if not path.is_dir():
        if path.suffix != ".safetensors" and path.exists():
            raise MapError(
                f"{path} is no .safetensors map and no folder that `plan` wrote; make a map of a "
                f"view first: vprism-plan map {path} --output map.safetensors"
            )
        return load_map(path), None
    file = path / "report.json"
    if not (path / "map.safetensors").is_file() or not file.is_file():
        raise MapError(
            f"{path} holds no map.safetensors and report.json; give the output folder of "
            "`vprism-plan plan` or `demo`, or a .safetensors map"
        )
    report = read_json(file, MapError)
    with reading(file, "a report of `plan`", MapError):
        if "base_pose" in report:
            report["base_pose"] = np.array(report["base_pose"], dtype=np.float64)
    return load_map(path / "map.safetensors"), report


def motion_of(folder: Path, plan: dict[str, Any] | None, robot: "Robot") -> "Trajectory | None":
    """Return the trajectory that a plan wrote; None for a map, or a plan without a path.

    Raises:
        PlanningError: it is of other joints than the robot's.
    """
    from vprism_plan.planning import read_trajectory

    if plan is None or not (folder / "trajectory.json").is_file():
        return None
    names, trajectory = read_trajectory(folder / "trajectory.json")
    if names != robot.joint_names:
        raise PlanningError(
            f"{folder} was planned for the joints {list(names)}; {robot.name} has "
            f"{list(robot.joint_names)}: give the robot it was planned for"
        )
    return trajectory


def _robot(command: Command) -> "Robot | None":
    from vprism_plan.robots import Robot

    return None if command.robot is None else Robot.from_urdf(command.robot)


def _placed(
    command: Command, robot: "Robot", m: "VPrismMap", plan: dict[str, Any] | None, console: Console
) -> "Robot":
    """Return the robot where it is asked to stand, where it stood, or where it would stand."""
    around = Surroundings.of(m)
    if plan is not None and "base_pose" in plan and command.base_xyz is None:
        pose = plan["base_pose"]
        if command.base_yaw is not None:
            pose = base_pose(pose[:3, 3], around, command.base_yaw)
        return robot.with_base_pose(pose)
    if command.base_xyz is not None:
        pose = base_pose(np.array(command.base_xyz), around, command.base_yaw)
        return robot.with_base_pose(pose)
    from vprism_plan.world import World

    with console.stage("bake"):
        world = World(m)
    return standing(command, robot, world, around)
