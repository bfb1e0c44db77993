# SPDX-License-Identifier: BSD-3-Clause
"""`vprism-plan`: maps, plans, queries and meshes from the command line.

Exit codes: 0 done, 1 no safe answer, 2 bad input. Nothing heavy is imported before a
command runs, so `--help` answers at once.
"""

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from vprism_plan.errors import ConfigError, VPrismError

DONE, NO_SAFE_ANSWER, BAD_INPUT = 0, 1, 2

Json = Annotated[bool, tyro.conf.FlagCreatePairsOff]
Input = Annotated[Path, tyro.conf.Positional]
Values = Annotated[tuple[float, ...] | None, tyro.conf.arg(metavar="FLOAT ...")]


@dataclass(frozen=True)
class Demo:
    """Fit, bake and plan on the bundled scene, and draw what happened."""

    output: Path = Path("out/demo")
    """Folder for pictures, map, meshes, trajectory and report."""
    planner: str = "RRTConnect"
    """RRTConnect, RRTstar, InformedRRTstar, BITstar, KPIECE1 or AORRTC."""
    seed: int = 0
    """Seed of the fit and of the planner."""
    json: Json = False
    """Print the report as JSON."""

    def run(self) -> int:
        """Run the command."""
        from vprism_plan import demo

        with _progress() as announce:
            result = demo.run(self.output, announce, self.planner, self.seed)
        _print(result.report if self.json else None, *result.lines)
        return DONE if result.solved else NO_SAFE_ANSWER


@dataclass(frozen=True)
class Map:
    """Fit a map to one view. Unlabelled input is segmented, unposed input aligned to the table."""

    input: Input
    """An .npz, a folder (depth.png, camera.json, labels.png), a BOP scene, or NAME-depth.png."""
    output: Path
    """File to write, .safetensors."""
    picture: Path | None = None
    """Also draw occupancy and entropy slices into this PNG."""
    seed: int = 0
    """Seed of the samples."""
    json: Json = False
    """Print the result as JSON."""

    def run(self) -> int:
        """Run the command."""
        from vprism_plan import workflow

        if self.output.suffix != ".safetensors":
            raise ConfigError(f"--output is {self.output}; maps are written as .safetensors files")
        with _progress() as announce:
            timings = workflow.Timings(announce)
            map_ = workflow.map_of(self.input, timings, self.seed)
            self.output.parent.mkdir(parents=True, exist_ok=True)
            map_.save(self.output)
            if self.picture is not None:
                from vprism_plan import viz

                timings.announce("draw")
                viz.save_figure(viz.map_figure(map_), self.picture)
        report = {
            "map": self.output,
            "objects": list(map_.object_ids),
            "hinge_points": len(map_.hinge_points),
            "seconds": timings.seconds,
        }
        _print(
            workflow.plain(report) if self.json else None,
            f"{len(map_.object_ids)} objects, {len(map_.hinge_points)} hinge points, "
            f"{sum(timings.seconds.values()):.1f} s; wrote {self.output}",
        )
        return DONE


@dataclass(frozen=True)
class Plan:
    """Plan a verified motion. Without a base, start or goal, sensible ones are chosen and told."""

    input: Input
    """A view (see `map`) or a saved map (.safetensors)."""
    robot: Path
    """URDF of the robot."""
    output: Path
    """Folder for trajectory.json, plan.png, map.png and report.json."""
    base_xyz: tuple[float, float, float] | None = None
    """Position of the robot's base in the world, metres."""
    base_yaw: float = 0.0
    """Turn of the base about z, radians (with --base-xyz)."""
    start: Values = None
    """Start configuration, radians (prismatic joints: metres)."""
    goal: Values = None
    """Goal configuration, radians (prismatic joints: metres)."""
    goal_pose: Annotated[
        tuple[float, float, float, float, float, float, float] | None,
        tyro.conf.arg(metavar="X Y Z QW QX QY QZ"),
    ] = None
    """Goal pose of the hand: position, metres, and unit quaternion w x y z."""
    planner: str = "RRTConnect"
    """RRTConnect, RRTstar, InformedRRTstar, BITstar, KPIECE1 or AORRTC."""
    time_limit: float = 5.0
    """Wall time for the search, seconds."""
    margin: float = 0.0
    """Clearance to keep from the world, metres."""
    occluded: Literal["occupied", "posterior", "free"] = "occupied"
    """What space behind seen surfaces counts as; posterior: what the map says, where it can."""
    unobserved: Literal["free", "occupied"] = "free"
    """What space outside every view counts as."""
    seed: int = 0
    """Seed of the fit and of the planner."""
    json: Json = False
    """Print the result as JSON."""

    def run(self) -> int:
        """Run the command."""
        from vprism_plan import _plan_command

        with _progress() as announce:
            report, lines, solved = _plan_command.run(self, announce)
        _print(report if self.json else None, *lines)
        return DONE if solved else NO_SAFE_ANSWER


@dataclass(frozen=True)
class Query:
    """Ask whether one configuration is free, by what margin, and if not, why."""

    map: Input
    """A saved map (.safetensors) or a view (see `map`)."""
    robot: Path
    """URDF of the robot."""
    q: Annotated[tuple[float, ...], tyro.conf.arg(metavar="FLOAT ...")]
    """Configuration, radians (prismatic joints: metres)."""
    base_xyz: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of the robot's base in the world, metres."""
    base_yaw: float = 0.0
    """Turn of the base about z, radians."""
    margin: float = 0.0
    """Clearance to keep from the world, metres."""
    occluded: Literal["occupied", "posterior", "free"] = "occupied"
    """What space behind seen surfaces counts as; posterior: what the map says, where it can."""
    unobserved: Literal["free", "occupied"] = "free"
    """What space outside every view counts as."""
    json: Json = False
    """Print the verdict as JSON (keys of moveit_msgs/GetStateValidity)."""

    def run(self) -> int:
        """Run the command."""
        from vprism_plan import _plan_command, workflow

        with _progress() as announce:
            timings = workflow.Timings(announce)
            map_ = workflow.map_of(self.map, timings)
            checker = _plan_command.make_checker(self, map_, self.base_xyz, timings)
            report = checker.explain(self.q)
        verdict = "free" if report.valid else "refused"
        _print(
            workflow.plain(report.to_dict()) if self.json else None,
            f"{verdict}: clearance {1000 * report.clearance:.1f} mm, between links "
            f"{1000 * report.self_clearance:.1f} mm",
            *(f"  {contact.kind:12s} {contact.text()}" for contact in report.contacts),
            "unseen share of the robot's volume: "
            + ", ".join(f"{name} {100 * share:.1f} %" for name, share in report.shares.items()),
        )
        return DONE if report.valid else NO_SAFE_ANSWER


@dataclass(frozen=True)
class Mesh:
    """Extract a watertight mesh per object."""

    map: Input
    """A saved map (.safetensors) or a view (see `map`)."""
    output: Path
    """Folder for object_ID.ply, metres, world frame."""
    level: float = 0.5
    """P(occupied) of the surface, between 0 and 1."""
    resolution: float = 0.01
    """Edge of the marching cubes, metres."""
    json: Json = False
    """Print the result as JSON."""

    def run(self) -> int:
        """Run the command."""
        import vprism_plan as vp
        from vprism_plan import workflow

        with _progress() as announce:
            timings = workflow.Timings(announce)
            map_ = workflow.map_of(self.map, timings)
            meshes = timings.run(
                "extract meshes", vp.extract_meshes, map_, self.level, self.resolution
            )
            written = workflow.write_meshes(self.output, meshes)
        report = {
            str(i): {"faces": len(m.faces), "volume_m3": m.volume, "file": str(f)}
            for (i, m), f in zip(meshes.items(), written, strict=True)
        }
        lines = [f"object {i}: {r['faces']} faces, {r['file']}" for i, r in report.items()]
        _print(workflow.plain(report) if self.json else None, *lines)
        return DONE if meshes else NO_SAFE_ANSWER


Command = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Map, tyro.conf.subcommand("map")]
    | Annotated[Plan, tyro.conf.subcommand("plan")]
    | Annotated[Query, tyro.conf.subcommand("query")]
    | Annotated[Mesh, tyro.conf.subcommand("mesh")]
)


def _print(report: Any, *lines: str) -> None:
    """Print JSON if there is a report, else the lines for people."""
    text = "\n".join(lines) if report is None else json.dumps(report, indent=2)
    sys.stdout.write(text + "\n")


@contextmanager
def _progress() -> Iterator[Any]:
    """Yield a function that shows the running step on stderr, with its seconds when it ends."""
    import time

    from rich.console import Console

    console = Console(stderr=True)
    running: list[tuple[str, float]] = []

    def finish() -> None:
        if running:
            name, start = running.pop()
            if console.is_terminal:  # a log wants the result, not the way there
                console.print(f"{name}: {time.perf_counter() - start:.1f} s", style="dim")

    with console.status("starting") as status:

        def announce(name: str) -> None:
            finish()
            running.append((name, time.perf_counter()))
            status.update(name)

        yield announce
        finish()


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; always leaves through SystemExit with one of the codes above."""
    command = tyro.cli(
        Command,  # type: ignore[arg-type]
        prog="vprism-plan",
        description="Plan around what a depth camera saw and did not see. Metres, radians, seconds.",
        args=arguments,
    )
    try:
        code = command.run()
    except VPrismError as error:
        sys.stderr.write(f"vprism-plan: {' '.join(str(error).split())}\n")
        code = BAD_INPUT
    except KeyboardInterrupt:
        sys.stderr.write("vprism-plan: interrupted\n")
        code = 130
    sys.exit(code)


if __name__ == "__main__":
    main()
