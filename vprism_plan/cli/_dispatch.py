# SPDX-License-Identifier: BSD-3-Clause
"""From a parsed command to the code that runs it, loaded only then."""

from importlib import import_module

from vprism_plan.cli._commands import Command, Demo, Map, Mesh, Plan, Query, RobotInfo, View
from vprism_plan.cli._console import Console

# Command -> module of this folder and its function (command, console) -> exit code.
_RUNNERS: dict[type, tuple[str, str]] = {
    Map: ("_maps", "run_map"),
    Mesh: ("_maps", "run_mesh"),
    Plan: ("_motions", "run_plan"),
    Query: ("_query", "run_query"),
    View: ("_view", "run_view"),
    RobotInfo: ("_robot", "run_robot"),
}


def run(command: Command) -> int:
    """Run one command; return its exit code."""
    console = Console(as_json=command.json, strict=getattr(command, "strict", False))
    if isinstance(command, Demo):
        from vprism_plan.demo import run_demo

        return run_demo(command.output, command.seed, console)
    module, function = _RUNNERS[type(command)]
    code: int = getattr(import_module(f"vprism_plan.cli.{module}"), function)(command, console)
    return code
