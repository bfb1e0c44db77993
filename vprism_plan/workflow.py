# SPDX-License-Identifier: BSD-3-Clause
"""The steps that the command line and the demo share: from a file to a verified motion."""

import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vprism_plan._files import replacing, write_text
from vprism_plan.errors import RobotError, VPrismError

if TYPE_CHECKING:
    import trimesh

    from vprism_plan.collision import CollisionChecker
    from vprism_plan.mapping import VPrismMap
    from vprism_plan.perception import Observation
    from vprism_plan.planning import PlanResult

# Where the robot is tried when nobody says: direction from the objects to its base,
# seen along the camera's view (x), and distance beyond the objects' edge, metres.
_SIDES = (-90.0, 90.0, -135.0, 135.0, 180.0)
_DISTANCES = (0.45, 0.55, 0.35)
# Where the hand is tried on each side of the objects: beyond their edge, and height, metres.
_BESIDE = (0.12, 0.18, 0.25)
_HEIGHTS = (0.12, 0.2, 0.3, 0.4)
_REACH_SLACK = 0.9


@dataclass
class Timings:
    """Wall seconds of named steps, in order; announces each step as it starts."""

    announce: Callable[[str], None] = lambda _: None
    seconds: dict[str, float] = field(default_factory=dict)

    def run(self, name: str, step: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """Run a step and keep its wall time under its name."""
        self.announce(name)
        start = time.perf_counter()
        result = step(*args, **kwargs)
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
        return result


def bundled_urdf(name: str) -> Path:
    """Return the path of a URDF that comes with the project: panda, ur5e or planar3.

    Raises:
        RobotError: there is no such robot; the message lists those there are.
    """
    package = Path(__file__).resolve().parent
    folders = (package.parent / "urdf", package / "data" / "urdf")
    for folder in folders:
        path = folder / f"{name}.urdf"
        if path.is_file():
            return path
    known = sorted({path.stem for folder in folders for path in folder.glob("*.urdf")})
    raise RobotError(
        f"no bundled robot is called {name!r}; there are {', '.join(known) or 'none installed'}"
    )


def compile_kernels() -> float:
    """Compile (or load from the cache) everything that is compiled, on a tiny scene.

    Returns:
        Seconds it took: some ten the first time, about one later.
    """
    import vprism_plan as vp
    from vprism_plan.evaluation.camera import Camera
    from vprism_plan.evaluation.scenes import Scene, render
    from vprism_plan.evaluation.solids import Box

    start = time.perf_counter()
    pose = np.eye(4)
    pose[2, 3] = 0.05
    camera = Camera.orbit(np.array([0.0, 0.0, 0.05]), 0.8, 0.3, 0.7)
    box = Box((0.05, 0.05, 0.05), pose=pose)
    view = render(Scene((box,), (1,), camera), camera)
    config = vp.MapConfig(hinge_spacing=0.06, surface_hinges=4, iterations=1)
    map_ = vp.fit_map(view, config)
    map_.predict_proba(np.zeros((1, 3)))
    checker = vp.CollisionChecker(
        vp.World(map_, vp.WorldConfig(resolution=0.04)), vp.Robot.from_urdf(bundled_urdf("planar3"))
    )
    q = np.zeros(checker.robot.dof)
    checker.is_valid_batch(q[None])
    checker.check_motion(q, q)
    checker.explain(q)
    return time.perf_counter() - start


def observe(path: str | Path, seed: int = 0) -> "Observation":
    """Return a labelled observation in a frame whose z is up, from any supported input.

    Unlabelled input is segmented from its support plane and clusters; unposed input is
    aligned to the table, which becomes z = 0.
    """
    import vprism_plan as vp

    observation = vp.load_observation(path)
    if observation.labels is None:
        observation = vp.segment_tabletop(observation, seed=seed)
    if not observation.posed:
        observation = vp.align_to_table(observation, seed=seed)
    return observation


def map_of(path: str | Path, timings: Timings, seed: int = 0) -> "VPrismMap":
    """Return a saved map (`.safetensors`), or fit one to an observation."""
    import vprism_plan as vp

    if Path(path).suffix == ".safetensors":
        return timings.run("load map", vp.load_map, path)
    observation = timings.run("load and segment", observe, path, seed)
    return timings.run("fit map", vp.fit_map, observation, seed=seed)


def objects_box(map_: "VPrismMap") -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of a box that holds the observed objects, stray points left out."""
    points = []
    for view in map_.views:
        xyz, labels = view.points()
        points += [xyz[labels == k] for k in map_.object_ids]
    low = np.min([np.percentile(p, 1.0, axis=0) for p in points if len(p)], axis=0)
    high = np.max([np.percentile(p, 99.0, axis=0) for p in points if len(p)], axis=0)
    return low, high


def pose_at(xyz: Sequence[float], yaw: float) -> np.ndarray:
    """Return the (4, 4) pose at a position (metres) turned by yaw (radians) about z."""
    pose = np.eye(4)
    c, s = math.cos(yaw), math.sin(yaw)
    pose[:2, :2] = [[c, -s], [s, c]]
    pose[:3, 3] = xyz
    return pose


@dataclass(frozen=True)
class Task:
    """A robot that stands somewhere, and a motion it is asked for."""

    checker: "CollisionChecker"
    start: np.ndarray
    goal: np.ndarray
    note: str


def across_the_objects(
    checker: "CollisionChecker", seed: int, fixed_base: bool, start: np.ndarray | None
) -> Task:
    """Stand the robot beside the objects and ask for a motion from one side to the other.

    Tries base positions around the objects (unless the base is fixed) and hand
    positions on both sides of them, low first, and keeps the first pair of
    configurations that the checker accepts. The hand points down.

    Args:
        checker: brings the world and the robot.
        seed: of the inverse kinematics.
        fixed_base: whether the robot already stands where it should.
        start: start configuration, if it is given.

    Raises:
        VPrismError: no free pair of configurations was found; says what refused them.
    """
    low, high = objects_box(checker.world.map)
    middle = 0.5 * (low + high)
    refusals: list[str] = []
    for placed, name in _placements(checker, low, high, fixed_base):
        base = placed.robot.base_pose[:2, 3]
        toward = middle[:2] - base
        toward /= max(float(np.linalg.norm(toward)), 1e-9)
        across = np.array([toward[1], -toward[0]])
        half = 0.5 * float(np.abs(across) @ (high - low)[:2])
        ends: list[np.ndarray] = [] if start is None else [np.asarray(start, dtype=np.float64)]
        for side in (1.0, -1.0) if start is None else (-1.0,):
            found = _hand_beside(placed, middle, across * side, half, toward, seed)
            if found is None:
                refusals.append(f"{name}: no free reach {'right' if side > 0 else 'left'}")
                break
            ends.append(found)
        if len(ends) == 2:
            return Task(placed, ends[0], ends[1], name)
    raise VPrismError(
        "no start and goal on both sides of the objects are free and in reach "
        f"({'; '.join(refusals[:4])}); give --base-xyz, --start and --goal"
    )


def _placements(checker: "CollisionChecker", low: np.ndarray, high: np.ndarray, fixed: bool) -> Any:
    """Yield checkers of robots standing around the objects, and where that is in words."""
    from vprism_plan.collision import CollisionChecker

    if fixed:
        yield checker, "base as given"
        return
    middle = 0.5 * (low + high)
    table = _table_height(checker.world.map, middle)
    view = middle[:2] - checker.world.map.views[0].camera_center[:2]
    heading = math.atan2(view[1], view[0])
    for distance in _DISTANCES:
        for side in _SIDES:
            angle = heading + math.radians(side)
            out = np.array([math.cos(angle), math.sin(angle)])
            half = 0.5 * float(np.abs(out) @ (high - low)[:2])
            x, y = middle[:2] + (half + distance) * out
            base = pose_at((x, y, table), angle + math.pi)
            robot = checker.robot.with_base_pose(base)  # type: ignore[attr-defined]
            words = f"base at ({x:.2f}, {y:.2f}, {table:.2f})"
            yield CollisionChecker(checker.world, robot, checker.config), words


def _table_height(map_: "VPrismMap", at: np.ndarray) -> float:
    """Return z of the support plane under a point, metres."""
    n, offset = np.asarray(map_.plane.normal), float(map_.plane.offset)
    return float((offset - n[0] * at[0] - n[1] * at[1]) / n[2])


def _hand_beside(
    checker: "CollisionChecker",
    middle: np.ndarray,
    side: np.ndarray,
    half: float,
    toward: np.ndarray,
    seed: int,
) -> np.ndarray | None:
    """Return a free configuration with the hand beside the objects, or None."""
    from vprism_plan.planning import PoseGoalConfig
    from vprism_plan.planning.goals import configurations_at_pose

    robot = checker.robot
    table = _table_height(checker.world.map, middle)
    config = PoseGoalConfig(attempts=24, iterations=60)
    reference = robot.named_states.get("ready", robot.neutral)  # type: ignore[attr-defined]
    base = robot.base_pose[:3, 3]  # type: ignore[attr-defined]
    for height in _HEIGHTS:
        for beside in _BESIDE:
            xy = middle[:2] + side * (half + beside)
            at = np.array([*xy, table + height])
            if np.linalg.norm(at - base) > _REACH_SLACK * robot.reach:  # type: ignore[attr-defined]
                continue
            pose = pose_at(at, math.atan2(toward[1], toward[0]))
            pose[:3, 1:3] *= -1.0  # the hand looks down
            found = configurations_at_pose(checker, pose, reference, seed, config)
            if len(found.valid):
                return found.valid[0]
    return None


def write_plan(
    directory: Path,
    result: "PlanResult",
    task: Task,
    meshes: "dict[int, trimesh.Trimesh]",
    title: str,
) -> list[Path]:
    """Write `trajectory.json` and `plan.png` of a solved query; return the paths."""
    from vprism_plan import viz
    from vprism_plan.planning import time_parameterize, write_trajectory

    assert result.path is not None
    robot: Any = task.checker.robot
    trajectory = directory / "trajectory.json"
    write_trajectory(trajectory, robot, time_parameterize(robot, result.path))
    map_ = task.checker.world.map
    low, high = objects_box(map_)
    picture = directory / "plan.png"
    figure = viz.plan_figure(
        meshes,
        robot,
        result.path,
        table_height=_table_height(map_, 0.5 * (low + high)),
        camera_center=map_.views[0].camera_center,
        title=title,
    )
    viz.save_figure(figure, picture)
    return [trajectory, picture]


def write_meshes(directory: Path, meshes: "dict[int, trimesh.Trimesh]") -> list[Path]:
    """Write one PLY per object; return the paths."""
    written = []
    for object_id, mesh in meshes.items():
        path = directory / f"object_{object_id}.ply"
        with replacing(path) as temporary:
            mesh.export(temporary, file_type="ply")
        written.append(path)
    return written


def plain(value: Any) -> Any:
    """Return a value with numpy scalars, arrays, paths and non-finite numbers made JSON-ready."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, Path):
        return str(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_report(path: Path, report: dict[str, Any]) -> None:
    """Write a JSON report, whole or not at all."""
    write_text(path, json.dumps(plain(report), indent=2) + "\n")


def plan_summary(result: "PlanResult") -> dict[str, Any]:
    """Return status, message and numbers of a planning result, JSON-ready."""
    return plain({"status": result.status, "message": result.message, **asdict(result.report)})
