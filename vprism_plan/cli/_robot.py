# SPDX-License-Identifier: BSD-3-Clause
"""The command `robot`: what a URDF becomes, and what its spheres are worth."""

import time
from collections import Counter
from typing import TYPE_CHECKING, Any

from vprism_plan.cli._console import Console
from vprism_plan.cli._parsing import Command
from vprism_plan.errors import ConfigError

if TYPE_CHECKING:
    from vprism_plan.robots import Robot, RobotReport

_OFTEN = 0.3


def run_robot(command: Command, console: Console) -> int:
    """Read a robot, compare its spheres with its geometry; write what was asked for."""
    from vprism_plan.robots import Robot, SphereFit

    if command.fit and command.spheres is not None:
        raise ConfigError("--fit does not go with --spheres FILE; leave one of them out")
    began = time.perf_counter()
    spheres: Any = "fit" if command.fit else command.spheres
    with console.stage("robot"):
        robot = Robot.from_urdf(
            command.urdf,
            srdf=command.srdf,
            spheres=spheres,
            group=command.group,
            package_dirs=command.package_dirs,
            fit=SphereFit(tolerance=command.tolerance, max_spheres=command.max_spheres),
        )
    with console.stage("report"):
        report = robot.report()
        often = _often_touching(robot)
    written = []
    if command.spheres_output is not None:
        robot.write_spheres(command.spheres_output)
        written.append(command.spheres_output)
    if command.srdf_output is not None:
        robot.write_srdf(command.srdf_output)
        written.append(command.srdf_output)
    if command.picture is not None:
        with console.stage("picture"):
            from vprism_plan.viz import robot_figure, save_figure

            save_figure(robot_figure(robot), command.picture)
        written.append(command.picture)
    payload = {
        **report.to_dict(),
        "often_touching": often,
        "locked": robot.locked,
        "lower": robot.lower,
        "upper": robot.upper,
        "continuous": robot.continuous,
        "seconds": time.perf_counter() - began,
        "timings": console.timings,
        "written": written,
    }
    lines = [*_lines(robot, report, often), *(f"wrote {path}" for path in written)]
    console.finish(payload, lines)
    return 0


def _often_touching(robot: "Robot") -> list[tuple[str, str, float]]:
    """Pairs whose spheres overlap in more than 3 of 10 random configurations."""
    shares = robot.touching_shares()
    found = []
    for pair, share in shares.items():
        if share > _OFTEN:
            first, second = sorted(pair)
            found.append((first, second, share))
    return sorted(found, key=lambda row: -row[2])


def _lines(robot: "Robot", report: "RobotReport", often: list[tuple[str, str, float]]) -> list[str]:
    locked = f"; locked: {', '.join(robot.locked)}" if robot.locked else ""
    reasons = Counter(reason or "no reason given" for *_, reason in report.disabled_pairs)
    counted = ", ".join(f"{reason} {count}" for reason, count in sorted(reasons.items()))
    unchecked = ", ".join(link.link for link in report.links if link.unchecked)
    verdict = {
        True: "every link is proved to be enclosed",
        False: "NOT every link is enclosed: what is bare is not checked"
        + (f" (no spheres at all: {unchecked})" if unchecked else ""),
        None: "some meshes are missing, so nothing is known of their links"
        if any(link.missing for link in report.links)
        else "unknown whether they enclose the links: there is no geometry to compare with",
    }[report.enclosed]
    return [
        f"{robot.name}: {robot.dof} joints ({', '.join(robot.joint_names)}){locked}",
        *report.text().splitlines(),
        f"{report.spheres} spheres; {verdict}; they stand out by "
        f"{1000 * report.protrusion:.1f} mm at most",
        f"{report.tested_pairs} pairs of links are tested; not tested: {counted or 'none'}",
        *(
            f"  {a} and {b} overlap in {100 * share:.0f} % of random configurations"
            for a, b, share in often
        ),
    ]
