# SPDX-License-Identifier: BSD-3-Clause
"""From a parsed command to the code that runs it, loaded only then."""

from vprism_plan.cli._commands import Command, Demo, Eval, Map, Mesh, Query
from vprism_plan.cli._console import Console


def run(command: Command) -> int:
    """Run one command; return its exit code."""
    console = Console(as_json=command.json)
    if isinstance(command, Map | Mesh):
        from vprism_plan.cli import _maps

        if isinstance(command, Map):
            return _maps.run_map(command, console)
        return _maps.run_mesh(command, console)
    if isinstance(command, Query):
        from vprism_plan.cli._query import run_query

        return run_query(command, console)
    if isinstance(command, Eval):
        from vprism_plan.cli._evaluate import run_eval

        return run_eval(command, console)
    if isinstance(command, Demo):
        from vprism_plan.demo import run_demo

        return run_demo(command.output, command.seed, console)
    from vprism_plan.cli._motions import run_plan

    return run_plan(command, console)
