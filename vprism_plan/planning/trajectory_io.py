# SPDX-License-Identifier: BSD-3-Clause
"""Trajectories as `trajectory_msgs/JointTrajectory` in JSON."""

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from vprism_plan._files import read_json, reading, write_text
from vprism_plan._numbers import is_whole
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
    path = Path(path_file)
    message = read_json(path, PlanningError)
    with reading(path, "readable as trajectory_msgs/JointTrajectory", PlanningError):
        names = tuple(str(name) for name in message["joint_names"])
        points = message["points"]
        ticks = [_ticks(p["time_from_start"]) for p in points]
        rows = (len(points), len(names))
        trajectory = Trajectory(
            np.array(ticks, dtype=np.float64) / _NANOSECONDS,
            np.array([p["positions"] for p in points], dtype=np.float64).reshape(rows),
            np.array([p["velocities"] for p in points], dtype=np.float64).reshape(rows),
        )
        wrong = _no_motion(trajectory)
        if wrong:
            raise PlanningError(f"{path} is no motion: {wrong}")
        return names, trajectory


def _ticks(time: Any) -> int:
    parts = time["sec"], time["nanosec"]
    if not all(is_whole(part) for part in parts):  # a text times a billion fills the memory
        raise ValueError(f"time_from_start is {time!r}; sec and nanosec must be whole numbers")
    return int(parts[0] * _NANOSECONDS + parts[1])


def _no_motion(trajectory: Trajectory) -> str:
    """Why these are not times and values of a motion; empty if they are."""
    values = (trajectory.times, trajectory.positions, trajectory.velocities)
    if len(trajectory.times) == 0:
        return "it has no points"
    if not all(np.isfinite(value).all() for value in values):
        return "some of its values are not finite"
    if trajectory.times[0] < 0.0 or not (np.diff(trajectory.times) > 0.0).all():
        return "its times must rise, from 0 or later"
    return ""
