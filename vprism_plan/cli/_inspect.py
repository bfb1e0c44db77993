# SPDX-License-Identifier: BSD-3-Clause
"""Commands that only look: `query` at a configuration, `robot` at a URDF, `view` in the browser."""

import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vprism_plan._files import read_json, reading
from vprism_plan.cli._console import Console
from vprism_plan.cli._maps import load
from vprism_plan.cli._parsing import Command
from vprism_plan.cli._placing import Surroundings, read_robot, standing
from vprism_plan.cli._plans import POLICIES, bake, checks
from vprism_plan.errors import ConfigError, MapError, PlanningError

if TYPE_CHECKING:
    from vprism_plan.collision import CollisionChecker
    from vprism_plan.mapping import VPrismMap
    from vprism_plan.planning import NextView
    from vprism_plan.robots import Robot

_OFTEN = 0.3  # of random configurations: a pair of links that overlaps in more is named


def run_query(command: Command, console: Console) -> int:
    """Answer for one configuration; exit code 0 if it is free, else 1."""
    from vprism_plan.collision import CollisionChecker

    robot = read_robot(command)
    console.warn(robot.warnings)
    q = robot.check_configuration(command.q)
    config = checks(command, robot)
    world = bake(load(command.map, console), command, console)
    robot = standing(command, robot, world)
    with console.stage("check"):  # compiles on first use
        checker = CollisionChecker(world, robot, config)
        report = checker.explain(q)
    with console.stage("margins"):
        margins = checker.safety_margin(q)
        entropy = checker.path_entropy(q)
    with console.stage("risk"):
        risk = checker.collision_probability(q)
    payload: dict[str, Any] = {
        **report.to_dict(),
        "text": report.text(),
        "margins": margins.to_dict(),
        "risk": risk.to_dict(),
        "entropy": entropy.to_dict(),
        "q": q,
        "joint_names": list(robot.joint_names),
        "base_pose": robot.base_pose,
    }
    rows = len(margins.margins) if command.rows == 0 else max(command.rows, 0)
    known = "none, the robot is nowhere near what the map knows"
    if not np.isnan(entropy.waypoint_mean[0]):
        known = (
            f"mean {entropy.waypoint_mean[0]:.2f} nats, largest of a sphere "
            f"{entropy.waypoint_max[0]:.2f}; {100 * entropy.waypoint_unsupported[0]:.0f} % of the "
            "robot's volume without support"
        )
    unseen = ", ".join(f"{kind} {100 * share:.0f} %" for kind, share in report.shares.items())
    lines = [
        f"{'free' if report.valid else 'refused'}: clearance {1000 * report.clearance:.1f} mm "
        f"(required {1000 * report.margin:.1f} mm), self-clearance "
        f"{1000 * report.self_clearance:.1f} mm",
        *(f"  {contact.text()}" for contact in report.contacts),
        *(f"  allowed: {c.link} touches {c.body}" for c in report.allowed),
        risk.text(),
        *margins.text(rows).splitlines(),
        f"map entropy: {known}",
        f"volume not seen: {unseen or 'none'}",
        f"base at {np.round(robot.base_pose[:3, 3], 3).tolist()} m",
    ]
    console.finish(payload, lines)
    return 0 if report.valid else 1


def run_robot(command: Command, console: Console) -> int:
    """Read a robot, compare its spheres with its geometry; write what was asked for."""
    from vprism_plan.robots.sphere_fit import SphereFit

    if command.fit and command.spheres is not None:
        raise ConfigError("--fit does not go with --spheres FILE; leave one of them out")
    began = time.perf_counter()
    with console.stage("robot"):
        fit = SphereFit(tolerance=command.tolerance, max_spheres=command.max_spheres)
        robot = read_robot(command, fit=fit, **({"spheres": "fit"} if command.fit else {}))
    with console.stage("report"):
        report = robot.report()
        shares = robot.touching_shares().items()
        often: list[Any] = [(*sorted(pair), share) for pair, share in shares if share > _OFTEN]
        often.sort(key=lambda row: -row[2])
    if command.spheres_output is not None:
        robot.write_spheres(command.spheres_output)
    if command.srdf_output is not None:
        robot.write_srdf(command.srdf_output)
    if command.picture is not None:
        with console.stage("picture"):
            from vprism_plan.viz import robot_figure, save_figure

            save_figure(robot_figure(robot), command.picture)
    outputs = (command.spheres_output, command.srdf_output, command.picture)
    written = [path for path in outputs if path is not None]
    locked = f"; locked: {', '.join(robot.locked)}" if robot.locked else ""
    reasons = Counter(reason or "no reason given" for *_, reason in report.disabled_pairs)
    counted = ", ".join(f"{reason} {count}" for reason, count in sorted(reasons.items()))
    unchecked = ", ".join(link.link for link in report.links if link.unchecked)
    if report.enclosed:
        verdict = "every link is proved to be enclosed"
    elif report.enclosed is not None:
        verdict = "NOT every link is enclosed: what is bare is not checked"
        verdict += f" (no spheres at all: {unchecked})" if unchecked else ""
    elif any(link.missing for link in report.links):
        verdict = "some meshes are missing, so nothing is known of their links"
    else:
        verdict = "unknown whether they enclose the links: there is no geometry to compare with"
    payload = {
        **report.to_dict(),
        "often_touching": often,
        "locked": robot.locked,
        "lower": robot.lower,
        "upper": robot.upper,
        "continuous": robot.continuous,
        "seconds": time.perf_counter() - began,
        "written": written,
    }
    lines = [
        f"{robot.name}: {robot.dof} joints ({', '.join(robot.joint_names)}){locked}",
        *report.text().splitlines(),
        f"{report.spheres} spheres; {verdict}; they stand out by "
        f"{1000 * report.protrusion:.1f} mm at most",
        f"{report.tested_pairs} pairs of links are tested; not tested: {counted or 'none'}",
        *(
            f"  {a} and {b} overlap in {100 * share:.0f} % of random configurations"
            for a, b, share in often
        ),
        *(f"wrote {path}" for path in written),
    ]
    console.finish(payload, lines)
    return 0


def run_view(command: Command, console: Console) -> int:
    """Serve until interrupted; exit code 0.

    Raises:
        VPrismError: nothing to show in the input, or a robot that does not fit it.
    """
    from vprism_plan.viz.viewer import Viewer, require_viser

    require_viser()
    robot = None if command.robot is None else read_robot(command)
    m, plan = _map_and_plan(command.input, console)
    trajectory, file = None, command.input / "trajectory.json"
    if robot is not None:
        if plan is not None and file.is_file():
            from vprism_plan.planning import read_trajectory

            names, trajectory = read_trajectory(file)
            if names != robot.joint_names:
                raise PlanningError(
                    f"{command.input} was planned for the joints {list(names)}; {robot.name} has "
                    f"{list(robot.joint_names)}: give the robot it was planned for"
                )
        robot = _placed(command, robot, m, plan or {}, console)
    asked: dict[str, Any] = {"level": command.level}
    if robot is not None and plan is not None:
        asked["checker"], asked["look"] = _risk_and_look(m, robot, plan, console)
    look = asked.get("look")
    with console.stage("scene"):
        viewer = Viewer(m, robot, trajectory, **asked, host=command.host, port=command.port)
    try:
        shown = sorted({path.split("/")[1] for path in viewer.nodes})
        payload: dict[str, Any] = {"url": viewer.url, "shown": shown, "nodes": sorted(viewer.nodes)}
        payload["risk"] = None if viewer.risk is None else viewer.risk.to_dict()
        payload["next_view"] = None if look is None else look.text()
        lines = [f"{command.input}: {', '.join(shown)}"]
        lines += [] if viewer.risk is None else [viewer.risk.text()]
        lines += [] if look is None else [look.text()]
        if robot is None and plan is not None:
            lines.append("give --robot URDF to see the robot and its path")
        console.finish(payload, [*lines, f"open {viewer.url} in a browser; Ctrl-C ends it"])
        viewer.wait()
    except KeyboardInterrupt:  # the way to end it, hence no error
        pass
    finally:
        viewer.stop()
    return 0


def _map_and_plan(path: Path, console: Console) -> tuple["VPrismMap", dict[str, Any] | None]:
    """Return the map, and the report of the plan if `path` is the folder of one.

    Raises:
        MapError: there is no map, or a report that cannot be read.
    """
    if not path.is_dir():
        if path.suffix != ".safetensors" and path.exists():
            raise MapError(
                f"{path} is no .safetensors map and no folder that `plan` wrote; make a map of a "
                f"view first: vprism-plan map {path} --output map.safetensors"
            )
        return load(path, console), None
    saved, file = path / "map.safetensors", path / "report.json"
    if not (saved.is_file() and file.is_file()):
        raise MapError(
            f"{path} holds no map.safetensors and report.json; give the output folder of "
            "`vprism-plan plan` or `demo`, or a .safetensors map"
        )
    from vprism_plan.collision import CheckerConfig
    from vprism_plan.planning import PlanReport, PlanResult
    from vprism_plan.world import WorldConfig

    report = read_json(file, MapError)
    with reading(file, "a report of `plan`", MapError):
        report["base_pose"] = np.array(report["base_pose"], dtype=np.float64)
        said, rules = report["plan"], report["world"]
        numbers = PlanReport(said["planner"], said["seed"], said["time_limit"])
        paths = [
            None if report[name] is None else np.array(report[name], dtype=np.float64)
            for name in ("path", "approximate_path")
        ]
        report["result"] = PlanResult(
            paths[0], said["status"], numbers, said["message"], approximate_path=paths[1]
        )
        report["world"] = WorldConfig(**{name: rules[name] for name in POLICIES})
        own = {name: rules[name] for name in ("margin", "max_risk", "allowed_contacts")}
        report["checker"] = CheckerConfig(**own)
    return load(saved, console), report


def _risk_and_look(
    m: "VPrismMap", robot: "Robot", plan: dict[str, Any], console: Console
) -> tuple["CollisionChecker", "NextView | None"]:
    """Return the checker that a plan was made with, and where to look next for its motion, among
    64 places around the objects, as far as the first camera; None without a bound on risk."""
    from vprism_plan.collision import CollisionChecker
    from vprism_plan.planning import next_view
    from vprism_plan.simulation import Camera
    from vprism_plan.world import World

    with console.stage("bake"):
        world = World(m, plan["world"])
    checker = CollisionChecker(world, robot, plan["checker"])
    if checker.max_risk is None:
        return checker, None
    around = Surroundings.of(m)
    middle = np.array([*around.middle, around.table])
    away = float(np.linalg.norm(around.camera - middle))
    views = [
        Camera.orbit(middle, away, azimuth, elevation).T_world_camera
        for azimuth in np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
        for elevation in (0.5, 0.7, 0.9, 1.1)
    ]
    with console.stage("look"):
        return checker, next_view(checker, None, None, views, result=plan["result"])


def _placed(
    command: Command, robot: "Robot", m: "VPrismMap", plan: dict[str, Any], console: Console
) -> "Robot":
    """Return the robot where it is asked to stand, where it stood, or where it would stand."""
    around, xyz = Surroundings.of(m), command.base_xyz
    if xyz is None and plan:
        if command.base_yaw is None:
            return robot.with_base_pose(plan["base_pose"])
        xyz = plan["base_pose"][:3, 3]
    if xyz is not None:
        return robot.with_base_pose(around.base_pose(xyz, command.base_yaw))
    from vprism_plan.world import World

    with console.stage("bake"):
        world = World(m)
    return standing(command, robot, world)
