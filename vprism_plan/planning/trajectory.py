# SPDX-License-Identifier: BSD-3-Clause
"""From a verified path to a timed trajectory.

The checker certified straight lines in joint space. Without it the motion never leaves them: it
stops where the direction changes, and nowhere else; between stops all joints share one trapezoidal
profile along the line. With it corners are rounded to parabolas (constant acceleration from one
line's velocity to the next one's), each where the checker accepts it. Files hold
`trajectory_msgs/JointTrajectory` as JSON, YAML or in the bytes of ROS 2.
"""

import json
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from vprism_plan._arguments import is_whole, number
from vprism_plan._files import optional, read_json, reading, replacing, write_text
from vprism_plan.errors import PlanningError
from vprism_plan.planning.protocols import Configuration

# Without stated acceleration limits a joint reaches its full speed in this time.
_SECONDS_TO_FULL_SPEED = 0.5
# Unit directions closer than this are one line; the path is left by no more.
_SAME_DIRECTION = 1e-9
_NANOSECONDS = 10**9
_SLOWER, _TRIES = 1.5, 6  # how, and how often, a corner that is refused is taken more slowly


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A motion over time, as cubic pieces.

    Every change of acceleration is a point, so cubic interpolation of positions and velocities,
    as controllers do without accelerations, is the motion itself.

    Attributes:
        times: (n,) seconds from the start, increasing, the first is 0.
        positions: (n, dof) radians or metres.
        velocities: (n, dof) per second.
    """

    times: np.ndarray
    positions: np.ndarray
    velocities: np.ndarray

    @property
    def duration(self) -> float:
        """Seconds from start to end."""
        return float(self.times[-1])

    def sample(
        self, times: Float[np.ndarray, " m"]
    ) -> tuple[Float[np.ndarray, "m dof"], Float[np.ndarray, "m dof"]]:
        """Return positions and velocities at given times, held at rest outside the motion."""
        t = np.clip(np.asarray(times, dtype=np.float64), 0.0, self.duration)
        if len(self.times) == 1:
            return self.positions[np.zeros(len(t), int)], self.velocities[np.zeros(len(t), int)]
        from scipy.interpolate import CubicHermiteSpline

        motion = CubicHermiteSpline(self.times, self.positions, self.velocities)
        return motion(t), motion(t, 1)


def time_parameterize(
    robot: Any,
    path: Float[np.ndarray, "t dof"],
    velocity_limits: ArrayLike | None = None,
    acceleration_limits: ArrayLike | None = None,
    scale: float = 1.0,
    checker: Any = None,
) -> Trajectory:
    """Time a path so that no joint exceeds its velocity or acceleration limit.

    Args:
        robot: brings `joint_names` and the default limits.
        path: waypoints (t, dof), at least one, as in `PlanResult.path`.
        velocity_limits: (dof,) rad/s or m/s; the robot's own if None.
        acceleration_limits: (dof,) per s^2; None: the robot's own, else a joint is at full speed
            in half a second.
        scale: share of both limits to use, more than 0 and at most 1.
        checker: the `CollisionChecker` of the path, where corners may be rounded: as fast as it
            accepts, slower, or not at all. It is asked about each whole parabola, with margin for
            what straight pieces leave out, and for its `max_risk` about the whole motion.

    Returns:
        At rest at both ends. Without a checker on the path, through every waypoint, at rest at
        every corner; with one beside the path at rounded corners.

    Raises:
        PlanningError: the path or a limit is not usable; names the joint and the value.
    """
    path = np.asarray(path, dtype=np.float64)
    names = tuple(robot.joint_names)
    if path.ndim != 2 or path.shape[1] != len(names) or len(path) == 0:
        needed = f"it must be (waypoints, {len(names)}) with at least one waypoint"
        raise PlanningError(f"path has shape {path.shape}; {needed}")
    if not np.isfinite(path).all():
        raise PlanningError("the path holds NaN or infinite values")
    number("scale", scale, 0.0, 1.0, above=True, error=PlanningError)
    given = robot.velocity_limits if velocity_limits is None else velocity_limits
    speed = _limits("velocity", given, names)
    push = speed / _SECONDS_TO_FULL_SPEED
    stated = getattr(robot, "acceleration_limits", None)
    if acceleration_limits is None and stated is not None:
        acceleration_limits = np.where(np.isfinite(stated), stated, push)
    if acceleration_limits is not None:
        push = _limits("acceleration", acceleration_limits, names)

    if checker is not None and not hasattr(checker, "check_blend"):
        needed = "a CollisionChecker judges rounded corners"
        raise PlanningError(f"checker is a {type(checker).__name__}; {needed}")
    lines = list(_straight_lines(path))
    if checker is not None and len(lines) > 1:
        corners = np.array([path[0], *(line[-1] for line in lines)])
        rounded = _joined(path[0], [_rounded(corners, scale * speed, scale * push, checker)])
        every = np.union1d(np.arange(0.0, rounded.duration, 0.01), rounded.times)
        most = checker.max_risk
        # Corners were accepted by the worlds that verdicts have seen; others judge the whole.
        moved = rounded.sample(every)[0]
        if most is None or checker.collision_probability(moved, held_out=True).upper <= most:
            return rounded
    return _joined(path[0], (_timed(line, scale * speed, scale * push) for line in lines))


def _joined(start: Configuration, pieces: Iterable[Iterable[Any]]) -> Trajectory:
    """Join pieces of (time, position, velocity), each from rest, its start left out."""
    points = [(0.0, start, np.zeros(len(start)))]
    for piece in pieces:
        began = points[-1][0]
        points += [(began + t, q, v) for t, q, v in piece]
    times, positions, velocities = map(np.array, zip(*points, strict=True))
    return Trajectory(times, positions, velocities)


def _limits(kind: str, values: ArrayLike, names: tuple[str, ...]) -> Configuration:
    limits = np.asarray(values, dtype=np.float64)
    if limits.shape != (len(names),):
        needed = f"one per joint is needed: {', '.join(names)}"
        raise PlanningError(f"{kind} limits have shape {limits.shape}; {needed}")
    for name, limit in zip(names, limits, strict=True):
        hint = f"(pass {kind}_limits if the robot's description has none)"
        what = f"{kind} limit of joint {name!r}"
        number(what, float(limit), 0.0, unit=hint, above=True, error=PlanningError)
    return limits


def _straight_lines(path: Float[np.ndarray, "t dof"]) -> Iterator[Float[np.ndarray, "k dof"]]:
    """Yield the waypoints of each maximal straight piece, both ends included."""
    moved = np.concatenate([[True], np.any(np.diff(path, axis=0) != 0.0, axis=1)])
    points = path[moved]
    steps = np.diff(points, axis=0)
    directions = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    first = 0
    for i in range(1, len(points)):
        last = i == len(points) - 1
        if last or np.linalg.norm(directions[i] - directions[first]) > _SAME_DIRECTION:
            yield points[first : i + 1]
            first = i


def _timed(
    line: Float[np.ndarray, "k dof"], speed: Configuration, push: Configuration
) -> Iterator[tuple[float, np.ndarray, np.ndarray]]:
    """Yield (time, position, velocity) along a line, its start left out.

    With s in [0, 1] along the line and s' <= v, s'' <= a, each the tightest of the
    joints' limits, the fastest motion from rest to rest is a trapezoid in s'.
    """
    whole = line[-1] - line[0]
    moving = whole != 0.0
    size = np.abs(whole[moving])
    v, a = float(np.min(speed[moving] / size)), float(np.min(push[moving] / size))
    ramp = min(v / a, math.sqrt(1.0 / a))
    top = a * ramp
    rate, cruise = top / ramp, 1.0 / top - ramp
    total = cruise + 2.0 * ramp

    climb = 0.5 * top * ramp  # s at the first knee

    def time_at(s: float) -> float:
        """Time at which the trapezoid reaches s."""
        if s <= climb:
            return math.sqrt(2.0 * s / rate)
        if s <= 1.0 - climb:
            return s / top + 0.5 * ramp
        return total - math.sqrt(2.0 * (1.0 - s) / rate)

    inner = np.linalg.norm(line[1:-1] - line[0], axis=1) / np.linalg.norm(whole)
    events = [(time_at(float(s)), q) for s, q in zip(inner, line[1:-1], strict=True)]
    events.append((ramp, line[0] + climb * whole))
    if cruise > 1e-9 * total:
        events.append((ramp + cruise, line[0] + (1.0 - climb) * whole))
    events.sort(key=lambda event: event[0])
    knots, rates = (0.0, ramp, ramp + cruise, total), (0.0, top, top, 0.0)
    previous = 0.0
    for t, q in events:
        # A knee that falls on a waypoint is one point, not two.
        if t - previous > 1e-9 * total and total - t > 1e-9 * total:
            yield t, q, np.interp(t, knots, rates) * whole
            previous = t
    yield total, line[-1], 0.0 * whole


def _rounded(
    corners: Float[np.ndarray, "n dof"], speed: Configuration, push: Configuration, checker: Any
) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Return (time, position, velocity) along straight lines with rounded corners, the start left
    out. A corner that stays refused is a stop, and its two sides are timed apart."""
    delta = np.diff(corners, axis=0)
    least = (np.abs(delta) / speed).max(axis=1)
    for _ in range(_TRIES):
        times, blends, speeds = _cruise(delta, least, push)
        start = corners - 0.5 * blends[:, None] * speeds[:-1]
        end = corners + 0.5 * blends[:, None] * speeds[1:]
        inner = range(1, len(delta))
        refused = [i for i in inner if not checker.check_blend(start[i], corners[i], end[i])]
        if not refused:
            break
        for i in refused:
            least[i - 1 : i + 1] = _SLOWER * times[i - 1 : i + 1]
    else:
        parts = corners[: refused[0] + 1], corners[refused[0] :]
        points, more = (_rounded(part, speed, push, checker) for part in parts)
        return points + [(points[-1][0] + t, q, v) for t, q, v in more]
    half = 0.5 * blends
    middle = half[0] + np.concatenate([[0.0], np.cumsum(times)])
    t = np.stack([middle - half, middle + half], axis=1).ravel()
    sides = (start, end), (speeds[:-1], speeds[1:])
    q, v = (np.stack(pair, axis=1).reshape(len(t), -1) for pair in sides)
    kept = 1 + np.flatnonzero(np.diff(t) > 1e-9 * t[-1])  # two blends may leave a line no room
    return list(zip(t[kept], q[kept], v[kept], strict=True))


def _cruise(
    delta: Float[np.ndarray, "n dof"], least: Float[np.ndarray, " n"], push: Configuration
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " m"], Float[np.ndarray, "k dof"]]:
    """Return how long each line would take at its constant speed, at least `least`; how long each
    change of speed takes, so that half of both at its ends fit into each line; all speeds, those of
    the rests before and after with them."""
    times = least.copy()
    for steps in range(100, -1, -1):
        speeds = np.pad(delta / times[:, None], ((1, 1), (0, 0)))
        blends = (np.abs(np.diff(speeds, axis=0)) / push).max(axis=1)
        short = np.sqrt(np.maximum(0.5 * (blends[:-1] + blends[1:]) / times, 1.0))
        if short.max() == 1.0:
            break
        # All of them slower by one factor fit in any case: blends get shorter as lines get longer.
        times *= np.where(short > 1.0, 1.001 * short, 1.0) if steps > 1 else 1.001 * short.max()
    return times, blends, speeds


def write_trajectory(
    path_file: str | Path, robot: Any, trajectory: Trajectory, frame_id: str = ""
) -> None:
    """Write a trajectory as `trajectory_msgs/JointTrajectory`, whole or not at all: as YAML
    (`.yaml`, `.yml`), as CDR (`.cdr`: bytes that a ROS 2 publisher takes as they are; extra
    `export`), else as JSON.

    Accelerations and efforts stay empty, which the message allows: given accelerations,
    controllers fit quintics, which a trapezoidal profile is not. Joint motions need no
    `frame_id`. The robot brings `joint_names`, in the order of the columns, or is these names.

    Raises:
        PlanningError: joints and columns differ in number, or two points fall on the
            same nanosecond.
        MissingDependencyError: rosbags is not installed.
    """
    names = [str(name) for name in getattr(robot, "joint_names", robot)]
    if trajectory.positions.shape[1:] != (len(names),):
        given = f"{trajectory.positions.shape[1:]} joints"
        raise PlanningError(f"the trajectory has {given}, the robot {', '.join(names)}")
    ticks = [round(float(t) * _NANOSECONDS) for t in trajectory.times]
    if any(b <= a for a, b in pairwise(ticks)):
        raise PlanningError("points of the trajectory are less than a nanosecond apart")
    points = [
        {
            "positions": q.tolist(),
            "velocities": v.tolist(),
            "accelerations": [],
            "effort": [],
            "time_from_start": {"sec": tick // _NANOSECONDS, "nanosec": tick % _NANOSECONDS},
        }
        for tick, q, v in zip(ticks, trajectory.positions, trajectory.velocities, strict=True)
    ]
    header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": frame_id}
    message = {"header": header, "joint_names": names, "points": points}
    suffix = Path(path_file).suffix.lower()
    if suffix == ".cdr":
        serialized = _cdr(message)
        with replacing(path_file) as temporary:
            temporary.write_bytes(serialized)
    elif suffix in (".yaml", ".yml"):
        import yaml  # type: ignore[import-untyped]

        write_text(path_file, yaml.safe_dump(message, default_flow_style=None, sort_keys=False))
    else:
        write_text(path_file, json.dumps(message, indent=1, allow_nan=False) + "\n")


def _cdr(message: dict[str, Any]) -> bytes:
    """Serialize a message as ROS 2 sends it, little-endian."""
    rosbags = optional("rosbags.typesys", "export", "messages in CDR need")
    store = rosbags.get_typestore(rosbags.Stores.ROS2_HUMBLE)

    def make(name: str, **values: Any) -> Any:
        return store.types[name](**values)

    def of(kind: str, time: dict[str, int]) -> Any:
        return make(f"builtin_interfaces/msg/{kind}", **time)

    header = message["header"]
    stamp = of("Time", header["stamp"])
    points = [
        make(
            "trajectory_msgs/msg/JointTrajectoryPoint",
            time_from_start=of("Duration", point["time_from_start"]),
            **{k: np.array(v, np.float64) for k, v in point.items() if k != "time_from_start"},
        )
        for point in message["points"]
    ]
    kind = "trajectory_msgs/msg/JointTrajectory"
    stamped = make("std_msgs/msg/Header", stamp=stamp, frame_id=header["frame_id"])
    whole = make(kind, header=stamped, joint_names=message["joint_names"], points=points)
    return bytes(store.serialize_cdr(whole, kind))


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
        times, wrong = np.array(ticks, dtype=np.float64) / _NANOSECONDS, ""
        positions, velocities = (
            np.array([p[key] for p in points], np.float64).reshape(len(points), len(names))
            for key in ("positions", "velocities")
        )
        if len(times) == 0:
            wrong = "it has no points"
        elif not all(np.isfinite(value).all() for value in (times, positions, velocities)):
            wrong = "some of its values are not finite"
        elif times[0] < 0.0 or not (np.diff(times) > 0.0).all():
            wrong = "its times must rise, from 0 or later"
        if wrong:
            raise PlanningError(f"{path} is no motion: {wrong}")
        return names, Trajectory(times, positions, velocities)


def _ticks(time: Any) -> int:
    parts = time["sec"], time["nanosec"]
    if not all(is_whole(part) for part in parts):  # a text times a billion fills the memory
        raise ValueError(f"time_from_start is {time!r}; sec and nanosec must be whole numbers")
    return int(parts[0] * _NANOSECONDS + parts[1])
