# SPDX-License-Identifier: BSD-3-Clause
"""The command `query`: one configuration, everything there is to know about it."""

from typing import TYPE_CHECKING, Any

import numpy as np

from vprism_plan.cli._console import Console
from vprism_plan.cli._motions import bake, checks, standing
from vprism_plan.cli._parsing import Command
from vprism_plan.cli._placing import Surroundings

if TYPE_CHECKING:
    from vprism_plan.collision import StateReport
    from vprism_plan.collision.entropy import PathEntropy


def run_query(command: Command, console: Console) -> int:
    """Answer for one configuration; exit code 0 if it is free, else 1."""
    from vprism_plan.collision import CollisionChecker
    from vprism_plan.mapping import load_map
    from vprism_plan.robots import Robot

    robot = Robot.from_urdf(command.robot)
    console.warn(robot.warnings)
    q = robot.check_configuration(command.q)
    config = checks(command, robot)
    with console.stage("load"):
        m = load_map(command.map)
    world = bake(m, command, console)
    robot = standing(command, robot, world, Surroundings.of(m))
    with console.stage("check"):  # compiles on first use
        checker = CollisionChecker(world, robot, config)
        report = checker.explain(q)
    with console.stage("margins"):
        margins = checker.safety_margin(q)
        entropy = checker.path_entropy(q)
    with console.stage("risk"):
        risk = checker.collision_probability(q)
    base = robot.base_pose
    payload: dict[str, Any] = {
        **report.to_dict(),
        "text": report.text(),
        "margins": margins.to_dict(),
        "risk": risk.to_dict(),
        "entropy": entropy.to_dict(),
        "q": q,
        "joint_names": list(robot.joint_names),
        "base_pose": base,
        "timings": console.timings,
        "compile_seconds": console.compile_seconds,
    }
    rows = len(margins.margins) if command.rows == 0 else max(command.rows, 0)
    lines = [
        *_verdict(report),
        risk.text(),
        *margins.text(rows).splitlines(),
        _entropy_line(entropy),
        "volume not seen: "
        + (", ".join(f"{k} {100 * v:.0f} %" for k, v in report.shares.items()) or "none"),
        f"base at {np.round(base[:3, 3], 3).tolist()} m",
    ]
    console.finish(payload, lines)
    return 0 if report.valid else 1


def _verdict(report: "StateReport") -> list[str]:
    verdict = "free" if report.valid else "refused"
    touching = [f"  allowed: {c.link} touches {c.body}" for c in report.allowed]
    return [
        f"{verdict}: clearance {1000 * report.clearance:.1f} mm (required "
        f"{1000 * report.margin:.1f} mm), self-clearance {1000 * report.self_clearance:.1f} mm",
        *(f"  {contact.text()}" for contact in report.contacts),
        *touching,
    ]


def _entropy_line(entropy: "PathEntropy") -> str:
    share = 100 * entropy.waypoint_unsupported[0]
    if np.isnan(entropy.waypoint_mean[0]):
        return "map entropy: none, the robot is nowhere near what the map knows"
    return (
        f"map entropy: mean {entropy.waypoint_mean[0]:.2f} nats, largest of a sphere "
        f"{entropy.waypoint_max[0]:.2f}; {share:.0f} % of the robot's volume without support"
    )
