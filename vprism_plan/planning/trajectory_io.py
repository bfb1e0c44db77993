# SPDX-License-Identifier: BSD-3-Clause
"""Trajectories as `trajectory_msgs/JointTrajectory` in JSON."""

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from vprism_plan._files import write_text
from vprism_plan.errors import PlanningError
from vprism_plan.planning.trajectory import Trajectory

_NANOSECONDS = 10**9


def write_trajectory(
    path_file: str | Path, robot: Any, trajectory: Trajectory, frame_id: str = ""
) -> None:
    """Write a trajectory as `trajectory_msgs/JointTrajectory`, whole or not at all.

    Accelerations and efforts stay empty, which the message allows: given accelerations,
    controllers fit quintics, which a trapezoidal profile is not.

    Args:
        path_file: the file to write.
        robot: brings `joint_names`, in the order of the columns.
        trajectory: what to write; radians, metres, seconds.
        frame_id: frame for the header; joint motions need none.

    Raises:
        PlanningError: joints and columns differ in number, or two points fall on the
            same nanosecond.
    """
    names = [str(name) for name in robot.joint_names]
    if trajectory.positions.shape[1:] != (len(names),):
        raise PlanningError(
            f"the trajectory has {trajectory.positions.shape[1:]} joints, the robot {len(names)}: "
            f"{', '.join(names)}"
        )
    ticks = [round(float(t) * _NANOSECONDS) for t in trajectory.times]
    if any(b <= a for a, b in pairwise(ticks)):
        raise PlanningError("points of the trajectory are less than a nanosecond apart")
    message = {
        "header": {"stamp": _duration(0), "frame_id": frame_id},
        "joint_names": names,
        "points": [
            {
                "positions": q.tolist(),
                "velocities": v.tolist(),
                "accelerations": [],
                "effort": [],
                "time_from_start": _duration(tick),
            }
            for tick, q, v in zip(ticks, trajectory.positions, trajectory.velocities, strict=True)
        ],
    }
    write_text(path_file, json.dumps(message, indent=1, allow_nan=False) + "\n")


def _duration(ticks: int) -> dict[str, int]:
    return {"sec": ticks // _NANOSECONDS, "nanosec": ticks % _NANOSECONDS}


def read_trajectory(path_file: str | Path) -> tuple[tuple[str, ...], Trajectory]:
    """Read what `write_trajectory` wrote: joint names and the trajectory.

    Raises:
        PlanningError: the file is missing or is not such a message.
    """
    try:
        message = json.loads(Path(path_file).read_text(encoding="utf-8"))
        names = tuple(str(name) for name in message["joint_names"])
        points = message["points"]
        ticks = [
            p["time_from_start"]["sec"] * _NANOSECONDS + p["time_from_start"]["nanosec"]
            for p in points
        ]
        rows = (len(points), len(names))
        return names, Trajectory(
            np.array(ticks, dtype=np.float64) / _NANOSECONDS,
            np.array([p["positions"] for p in points], dtype=np.float64).reshape(rows),
            np.array([p["velocities"] for p in points], dtype=np.float64).reshape(rows),
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise PlanningError(
            f"{path_file} cannot be read as trajectory_msgs/JointTrajectory: "
            f"{type(error).__name__}: {error}"
        ) from error
