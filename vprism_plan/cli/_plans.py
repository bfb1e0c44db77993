# SPDX-License-Identifier: BSD-3-Clause
"""The commands `plan` and `demo`: a query, its answer, pictures, files and lines on both."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vprism_plan._resources import data_path, urdf_path
from vprism_plan.cli._console import Console, dump_json, staged
from vprism_plan.cli._maps import asked_of, describe_map, fit_views, load, write_meshes
from vprism_plan.cli._parsing import Command
from vprism_plan.cli._placing import Surroundings, choose_ends, places, read_robot
from vprism_plan.cli._warmup import compile_checks_meanwhile
from vprism_plan.errors import PlanningError

if TYPE_CHECKING:
    from vprism_plan.collision import CheckerConfig, CollisionChecker
    from vprism_plan.mapping import VPrismMap
    from vprism_plan.planning import PlanResult
    from vprism_plan.robots import Robot
    from vprism_plan.world import World

_PICTURES = ("scene.png", "map.png", "plan.png")
_DATA = ("map.safetensors", "meshes/object_*.ply", "trajectory.json", "report.json")
PLAN_FILES = (*_PICTURES, *_DATA)
POLICIES = ("occluded", "unobserved", "level", "resolution")  # of a world, in the report
_PROFILE = 64  # clearances along the path in the report

_HIDDEN = {
    "posterior": "judged by its probability where the map can, else an obstacle",
    "occupied": "an obstacle",
    "free": "judged by its probability",
}

Distance = Callable[[np.ndarray], np.ndarray]


def run_demo(command: Command, console: Console) -> int:
    """Map the bundled view, and plan a Panda across the clutter that it only half shows.

    The camera looks along +x; the arm stands at the side and moves its hand from the
    camera's side of the clutter to the far side, where short objects stand hidden behind
    tall ones. The truth about the scene enters only the report and the pictures.
    """
    from vprism_plan.collision import CollisionChecker
    from vprism_plan.robots import Robot
    from vprism_plan.simulation import load_ground_truth
    from vprism_plan.world import World

    folder, seed = data_path("demo_scene"), command.seed
    compile_checks_meanwhile()
    m = fit_views([folder], seed, console)
    with console.stage("bake"):
        world = World(m)
    around = Surroundings.of(m)
    pose = around.base_pose([0.05, -0.6, 0.0], np.pi / 2)  # beside the clutter, facing it
    robot = Robot.from_urdf(urdf_path("panda"), base_pose=pose)
    with console.stage("check"):  # compiles on first use
        checker = CollisionChecker(world, robot)
    with console.stage("place"):
        ends = choose_ends(checker, around, np.random.default_rng(seed))
    if ends is None:
        raise PlanningError(f"seed {seed} finds no start and goal for the demo; try another seed")
    truth = load_ground_truth(folder).signed_distance
    # Left of the arm is the camera's side: it starts where everything is seen.
    return solve(command, console, checker, ends[::-1], ["start", "goal"], truth)


def run_plan(command: Command, console: Console) -> int:
    """Plan and write the results; exit code 0, or 1 without a verified path."""
    from vprism_plan.collision import CollisionChecker
    from vprism_plan.planning.planners import planner_kind

    planner_kind(command.planner)  # before the long work, as all that may be wrong
    robot = read_robot(command)
    console.warn(robot.warnings)
    if command.goal is not None and command.goal_pose is not None:
        raise PlanningError("both --goal and --goal-pose are given; give one of them")
    for q in (command.start, command.goal):
        if q is not None:
            robot.check_configuration(q)
    goal = command.goal if command.goal_pose is None else pose_matrix(command.goal_pose)
    config = checks(command, robot)
    if command.input.suffix == ".safetensors":
        m = load(command.input, console)
    else:
        compile_checks_meanwhile()
        m = fit_views([command.input], command.seed, console, asked=asked_of(command))
    world = bake(m, command, console)
    around, ends = Surroundings.of(m), None
    with console.stage("place"):
        for number, placed in places(command, robot, world, around):
            checker = CollisionChecker(world, placed, config)
            rng = np.random.default_rng([command.seed, number])
            ends = choose_ends(checker, around, rng, start=command.start, goal=goal)
            if ends is not None:
                break
    if ends is None:
        where = "any base beside them" if command.base_xyz is None else "the given base"
        message = (
            f"the hand has no valid configuration on both sides of the objects from {where}; "
            "give --base-xyz, --start and --goal"
        )
        plan = {"status": "no_place", "message": message}
        payload = {"solved": False, "plan": plan}
        console.finish(payload, [f"no safe answer (no_place): {message}"])
        return 1
    given = {"base": command.base_xyz, "start": command.start}
    given["goal"] = command.goal or command.goal_pose
    chosen = [name for name, value in given.items() if value is None]
    return solve(command, console, checker, ends, chosen)


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
    max_risk = None if command.max_risk == 1.0 else command.max_risk
    return CheckerConfig(margin=command.margin, max_risk=max_risk, allowed_contacts=allowed)


def pose_matrix(pose: tuple[float, ...]) -> np.ndarray:
    """Return (4, 4) from x y z (m) and a quaternion in wxyz order of unit length."""
    from scipy.spatial.transform import Rotation

    quaternion = np.array(pose[3:])
    length = float(np.linalg.norm(quaternion))
    if not (np.isfinite(pose).all() and abs(length - 1.0) < 1e-3):
        raise PlanningError(
            f"--goal-pose has the quaternion {pose[3:]} of length {length:.4g}; give finite "
            "x y z (m) and qw qx qy qz of length 1"
        )
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(quaternion / length, scalar_first=True).as_matrix()
    matrix[:3, 3] = pose[:3]
    return matrix


def solve(
    command: Command,
    console: Console,
    checker: "CollisionChecker",
    ends: tuple[np.ndarray, np.ndarray],
    chosen: list[str],
    truth: Distance | None = None,
) -> int:
    """Plan, write everything to the output folder, print the summary; return the exit code.

    `chosen` names what the user left open; `truth` is the signed distance to the real
    objects (N, 3) -> (N,), metres, where it is known: for pictures and the report only.
    """
    from vprism_plan.planning import plan, time_parameterize, write_trajectory
    from vprism_plan.planning.path import interpolated

    options = {"planner": command.planner, "time_limit": command.time_limit, "seed": command.seed}
    with console.stage("plan"):
        result = plan(checker, *ends, **options)
    console.warn(result.warnings)
    world, robot, path, report = checker.world, checker.robot, result.path, result.report
    with staged(command.output, PLAN_FILES) as aside:
        with console.stage("mesh"):
            meshes = write_meshes(world.map, aside / "meshes", world.config.level, 0.01)
        world.map.save(aside / "map.safetensors")
        with console.stage("pictures"):
            _draw(checker, path, meshes, truth, aside)
        payload = {
            "solved": result.solved,
            "robot": robot.name,
            "joint_names": list(robot.joint_names),
            "base_pose": robot.base_pose,
            "start": ends[0],
            "goal": ends[1],
            "chosen_automatically": chosen,
            "path": path,
            "approximate_path": result.approximate_path,
            "plan": {
                "status": result.status,
                "message": result.message,
                **report.to_dict(),
            },
            "explanation": None if result.explanation is None else result.explanation.text(),
            "map": describe_map(world.map),
            "world": {
                **{name: getattr(world.config, name) for name in POLICIES},
                "nodes": list(world.field.distance.shape),
                "margin": checker.config.margin,
                "max_risk": checker.config.max_risk,
                "allowed_contacts": {
                    name: sorted(ids) for name, ids in checker.config.allowed_contacts.items()
                },
            },
            "meshes": {str(i): {"triangles": len(mesh.faces)} for i, mesh in meshes.items()},
        }
        if path is not None:
            timed = time_parameterize(robot, path, checker=checker)
            write_trajectory(aside / "trajectory.json", robot, timed, frame_id="world")
            payload["trajectory"] = {"duration": timed.duration, "points": len(timed.times)}
            dense = interpolated(path, 0.01)
            clearance = checker.clearance_batch(dense)
            shown = np.linspace(0, len(dense) - 1, min(_PROFILE, len(dense))).astype(int)
            extremes = {"minimum": float(clearance.min()), "mean": float(clearance.mean())}
            samples = {"samples": len(dense), "profile": clearance[shown]}
            payload["clearance"] = extremes | samples
            if truth is not None:
                payload["truth"] = true_distance(robot, path, truth)
        files = {p.relative_to(aside): p for p in sorted(aside.rglob("*")) if p.is_file()}
        payload["sizes"] = {str(name): file.stat().st_size for name, file in files.items()}
        text = dump_json(payload | console.about())
        (aside / "report.json").write_text(text, encoding="utf-8")
        written = sorted({"report.json", *(name.parts[0] for name in files)})
    payload["output"] = command.output
    wrote = f"wrote {command.output}/: {', '.join(written)}"
    console.finish(payload, [*_lines(payload, result), console.time_line(), wrote])
    return 0 if result.solved else 1


def _draw(
    checker: "CollisionChecker",
    path: np.ndarray | None,
    meshes: dict[int, Any],
    truth: Distance | None,
    folder: Path,
) -> None:
    from vprism_plan.viz import map_figure, plan_figure, save_figure, scene_figure

    m = checker.world.map
    title = None if truth is None else "vprism-plan demo"
    save_figure(scene_figure(m.views[0], title=title), folder / "scene.png")
    save_figure(map_figure(m, truth=truth, title=title), folder / "map.png")
    if path is not None:
        table = float(m.plane.offset / m.plane.normal[2])
        figure = plan_figure(meshes, checker.robot, path, table_height=table, title=title)
        save_figure(figure, folder / "plan.png")


def true_distance(robot: "Robot", path: np.ndarray, truth: Distance) -> dict[str, Any]:
    """Return the smallest distance of the moving spheres to the real objects, metres.

    Also how far any sphere moves between two samples, which bounds what they can miss.
    """
    from vprism_plan.planning.path import interpolated

    moving = np.flatnonzero(~np.asarray(robot.fixed_links)[np.asarray(robot.sphere_links)])
    dense = interpolated(path, 0.0015)
    gaps, places = [], []
    for begin in range(0, len(dense), 256):
        centers = robot.sphere_centers(dense[begin : begin + 256])[:, moving]
        gap = truth(centers.reshape(-1, 3)).reshape(centers.shape[:2])
        gaps.append(gap - robot.sphere_radii[moving])
        places.append(centers)
    gap = np.concatenate(gaps)
    row, sphere = np.unravel_index(int(gap.argmin()), gap.shape)
    moved = np.linalg.norm(np.diff(np.concatenate(places), axis=0), axis=2)
    return {
        "minimum_distance": float(gap[row, sphere]),
        "link": robot.link_names[int(robot.sphere_links[moving[sphere]])],
        "fraction": int(row) / max(1, len(dense) - 1),
        "samples": len(dense),
        "largest_motion_between_samples": float(moved.max(initial=0.0)),
    }


def _lines(payload: dict[str, Any], result: "PlanResult") -> list[str]:
    """At most eight lines on the query and its answer."""
    m, world, chosen = payload["map"], payload["world"], payload["chosen_automatically"]
    base = np.round(np.asarray(payload["base_pose"])[:3, 3], 3).tolist()
    left_open = f"; chosen: {', '.join(chosen)}" if chosen else ""
    lines = [
        f"map: {len(m['objects'])} objects, {m['hinge_points']} hinge points, "
        f"{m['iterations']} iterations",
        f"{payload['robot']}: base at {base} m{left_open}",
    ]
    if not result.solved:
        return [*lines, f"no safe answer ({result.status}): {result.message}"]
    report = result.report
    how = f"to within {1000 * report.tolerance:.1f} mm of motion"
    lines += [
        f"path: {report.waypoints} waypoints, {report.path_length:.2f} rad, every edge "
        f"verified again ({'continuously certified' if report.certified else how})",
        "clearance to what may be occupied: at least "
        f"{1000 * payload['clearance']['minimum']:.1f} mm along the path",
    ]
    if "truth" in payload:
        truth = payload["truth"]
        lines.append(
            f"distance to the true objects: at least {1000 * truth['minimum_distance']:.1f} mm "
            f"({truth['link']}; sampled every "
            f"{1000 * truth['largest_motion_between_samples']:.1f} mm or less)"
        )
    if report.risk is not None:
        lines.append(
            f"risk: {report.risk.text()}; bound {world['max_risk']:g}, judged by draws the search "
            f"has not seen, tightened {report.risk_levels} times"
        )
    if report.allowed_contacts:
        touching = ", ".join(f"{c.link} on {c.body}" for c in report.allowed_contacts)
        lines.append(f"ends touching, as allowed: {touching}")
    share = sum(report.shares.get(kind, 0.0) for kind in ("unobserved", "outside"))
    return [
        *lines,
        f"unseen: up to {100 * share:.0f} % of the arm is where no camera looked, which counts "
        f"as {world['unobserved']}; hidden space: {_HIDDEN[world['occluded']]}",
        f"trajectory: {payload['trajectory']['duration']:.1f} s",
    ]
