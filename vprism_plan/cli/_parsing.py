# SPDX-License-Identifier: BSD-3-Clause
"""What can be asked for on the command line, and arguments turned into that.

Nothing heavy is imported here, so `--help` answers at once.
"""

import argparse
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

PROGRAM = "vprism-plan"
_DESCRIPTION = (
    "Plan robot motions around what one depth image shows and hides. Exit codes: 0 done, "
    "1 no safe answer, 2 bad input."
)
Command = argparse.Namespace


class UsageError(Exception):
    """The arguments cannot be used; the message is one line."""


class _Parser(argparse.ArgumentParser):
    """Raises instead of leaving the process, and takes -1e-3 for a number, not for an option."""

    def __init__(self, *args: Any, **options: Any) -> None:
        options |= {"allow_abbrev": False, "formatter_class": argparse.RawDescriptionHelpFormatter}
        super().__init__(*args, **options)
        self._negative_number_matcher = re.compile(r"^-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")

    def error(self, message: str) -> NoReturn:
        """Say what is wrong in one line."""
        raise UsageError(f"{message}; see {PROGRAM} --help")

    def take(self, what: str, kind: Any, text: str, default: Any = None, **more: Any) -> None:
        """Add an argument, whose default is added to its text.

        what: "VIEW" for one that must be there, "--level P" for an option, "--base-xyz X Y Z"
        for one of three values, "--q Q ..." for one of any number, "--fit" for a flag.
        kind: of its values: a type, or those to choose from.
        """
        name, *values = what.split()
        if not name.startswith("--"):
            self.add_argument(more.pop("dest"), type=kind, metavar=name, help=text, **more)
            return
        if kind is bool:
            self.add_argument(name, action="store_true", help=text)
            return
        if isinstance(kind, tuple):
            more["choices"] = kind
            text += f": {', '.join(kind)}"
        else:
            more["type"] = kind
        more["metavar"] = values[0]
        if values[-1:] == ["..."]:
            more["nargs"] = "+"
        elif len(values) > 1:
            more |= {"nargs": len(values), "metavar": tuple(values)}
        if default not in (None, ()):
            text += f" ({default})"
        self.add_argument(name, default=default, help=text, **more)


def parse(arguments: Sequence[str]) -> Command:
    """Return the options of a command, its name as `command`; exits with 0 after `--help`.

    Raises:
        UsageError: what is wrong with the arguments.
    """
    if not arguments:
        raise UsageError(f"no command given; see {PROGRAM} --help")
    parser = _Parser(PROGRAM, description=_DESCRIPTION)
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for add in (_demo, _map, _plan, _query, _mesh, _export, _view, _robot, _warmup):
        lines = [line.strip() for line in (add.__doc__ or "").splitlines()]
        text = "\n".join(lines).strip()
        command = commands.add_parser(add.__name__[1:], help=lines[0], description=text)
        add(command)
        command.take("--json", bool, "print one JSON object instead of text")
    return parser.parse_args(list(arguments))


def _demo(command: _Parser) -> None:
    """Fit a map of the bundled scene, plan a Panda arm across it, write pictures and results."""
    _results(command, "out/demo")
    command.take("--seed N", int, "of the fit and of the planner", 0)
    command.set_defaults(planner="RRTConnect", time_limit=5.0)


def _map(command: _Parser) -> None:
    """Fit a map to one view or several and save it.

    VIEW is an .npz, a folder (depth.png, camera.json, optional labels.png), a BOP scene,
    X-depth.png beside camera.json, a point cloud (.pcd, .ply, .npy), a recording (.bag, .mcap,
    .db3, ROS 2 folder), or a folder of such views. Without labels it is segmented; without a
    camera pose, which several views need, the world is laid on the table (z up, table at z = 0).
    """
    take = command.take
    take("VIEW", Path, "the views", dest="input", nargs="+")
    take("--output FILE", Path, "file to write", Path("map.safetensors"))
    _source(command)
    text = "settings of the fit, calibrated for planning or the paper's Table III"
    take("--preset NAME", ("default", "paper"), text, "default")
    take("--seed N", int, "of the sampling", 0)
    _strict(command)


def _plan(command: _Parser) -> None:
    """Plan a motion around what a view shows, and verify it.

    VIEW is a view (as for `map`) or a .safetensors map. What is not given is chosen and
    reported: the base beside the objects, start and goal with the hand on either side of them.
    """
    take = command.take
    take("VIEW", Path, "the view or the map", dest="input")
    take("--robot URDF", Path, "robot description", required=True)
    _description(command)
    _results(command, "out/plan")
    _base(command, "facing the objects")
    text = "configuration (rad, m for sliding joints), in the robot's joint order"
    take("--start Q ...", float, f"start {text}")
    take("--goal Q ...", float, f"goal {text}")
    text = "instead of a goal: pose of the end effector in the world (m, unit quaternion wxyz)"
    take("--goal-pose X Y Z QW QX QY QZ", float, text)
    take("--planner NAME", str, "OMPL planner; a name that is none lists them", "RRTConnect")
    take("--time-limit S", float, "wall time for the search, s", 5.0)
    text = "clearance to keep, m; if there is room all along, the path keeps 5 to 20 mm more"
    take("--margin M", float, text, 0.0)
    _rules(command)
    _source(command)
    take("--seed N", int, "of the fit, of what is chosen, and of the planner", 0)
    _strict(command)


def _query(command: _Parser) -> None:
    """Ask whether one configuration is free, and why not: margins, risk, entropy.

    The table names the nearest pairs of a link and an obstacle: clearance (mm, a lower
    bound), the map's P(occupied) and entropy (nats) at the obstacle's nearest point, and
    the joint that changes the clearance most (mm per rad or m). Exit code 0: free; 1: refused.
    """
    take = command.take
    take("MAP", Path, "a .safetensors map", dest="map")
    take("--robot URDF", Path, "robot description", required=True)
    _description(command)
    text = "configuration (rad, m for sliding joints), in the robot's joint order"
    take("--q Q ...", float, text, required=True)
    _base(command, "where `plan` puts it, facing the objects")
    take("--margin M", float, "clearance that is required, m", 0.0)
    _rules(command)
    take("--rows N", int, "length of the table of margins, 0 for all; JSON has them all", 10)
    take("--seed N", int, "of the choice of a base, as for `plan`", 0)
    _strict(command)


def _mesh(command: _Parser) -> None:
    """Write the surface of every object of a map as PLY (m, world frame)."""
    take = command.take
    take("MAP", Path, "a .safetensors map", dest="map")
    take("--output FOLDER", Path, "for object_ID.ply", required=True)
    take("--level P", float, "probability of being occupied at the surface", 0.5)
    take("--resolution M", float, "edge of the grid, m", 0.01)


def _export(command: _Parser) -> None:
    """Write a map's world, or a planned trajectory, for another stack; the suffix says as what.

    A world: .bt .ot (OctoMap), .scene .yaml (MoveIt's planning scene), .npz (distance field and
    occupancy), .obj .glb .stl .ply (surfaces), .usd .usda .usdc. A trajectory.json of `plan`:
    .json .yaml (JointTrajectory), .cdr (the bytes of that message in ROS 2). Nothing that is an
    obstacle is free in the file; outside of its box it says nothing. OctoMap, USD and .cdr need
    the extra `export`.
    """
    take = command.take
    take("MAP_OR_TRAJECTORY", Path, "a .safetensors map, or trajectory.json", dest="input")
    take("--output FILE", Path, "file to write", required=True)
    take("--resolution M", float, "edge of a cell, m", 0.01)
    text = "lower and upper corner of the box, m; default: around the objects"
    take("--bounds X Y Z X Y Z", float, text)
    take("--frame-id NAME", str, "name of the world frame", "world")
    _policies(command)


def _view(command: _Parser) -> None:
    """Look at a map, and at a plan, in the browser; Ctrl-C ends it.

    The cameras and what each saw, the surfaces of the objects at any P(occupied), the entropy; the
    robot moved by hand, or along its plan (of a refused one along the safest motion that was found)
    with the probability of collision; and where to look next for it, of 64 places around the
    objects. Needs the extra `viewer`.
    """
    take = command.take
    text = "a .safetensors map, or the output folder of `plan` or `demo`"
    take("MAP_OR_PLAN", Path, text, dest="input")
    text = "robot description; for a plan, the one it was made with; without it none is shown"
    take("--robot URDF", Path, text)
    _description(command)
    _base(command, "that of the plan, else where `plan` puts it")
    take("--level P", float, "P(occupied) at the surfaces, to begin with", 0.5)
    text = "address to listen at; 0.0.0.0 lets other machines connect"
    take("--host ADDRESS", str, text, "127.0.0.1")
    take("--port N", int, "port to listen at; if it is busy, the next free one", 8080)


def _robot(command: _Parser) -> None:
    """Show what a URDF becomes: joints, collision spheres, pairs of links that are not tested.

    Spheres come from --spheres, else from STEM_spheres.yml beside the URDF, else they are fitted
    to its collision geometry. The table says of each link whether they enclose it (proved) and
    how far they stand out of it.
    """
    take = command.take
    take("URDF", Path, "the robot description (xacro expanded)", dest="robot")
    _description(command)
    take("--fit", bool, "fit spheres even if there is a file of them beside the URDF")
    text = "how far fitted spheres may stand out of a link, m, where --max-spheres suffice"
    take("--tolerance M", float, text, 0.03)
    text = "at most so many fitted spheres a link; default 12, more for links above 0.35 m"
    take("--max-spheres N", int, text)
    text = "write the spheres; as STEM_spheres.yml beside the URDF they are read from then on"
    take("--spheres-output FILE", Path, text)
    text = 'write an SRDF with the joints as group "arm" and the pairs that are not tested'
    take("--srdf-output FILE", Path, text)
    text = "write a picture: the collision geometry, and the spheres over it"
    take("--picture PNG", Path, text)


def _warmup(command: _Parser) -> None:
    """Compile the kernels now, on all cores, so that no later command waits for that."""


def _description(command: _Parser) -> None:
    """What belongs to a URDF."""
    text = "groups, states, pairs not to test; default STEM.srdf beside the URDF, else generated"
    command.take("--srdf SRDF", Path, text)
    text = "collision spheres: YAML of this package, a robot file of cuRobo, or XRDF"
    command.take("--spheres FILE", Path, text)
    text = (
        'SRDF group whose joints make a configuration; default: of the file of spheres, "arm", all'
    )
    command.take("--group NAME", str, text)
    text = (
        "folders that hold the packages of package:// names; folders above the URDF and "
        "ROS_PACKAGE_PATH, AMENT_PREFIX_PATH are searched in any case"
    )
    command.take("--package-dirs DIR ...", Path, text, ())


def _results(command: _Parser, folder: str) -> None:
    text = (
        "folder for scene.png, map.png, plan.png, map.safetensors, meshes/, trajectory.json "
        "and report.json"
    )
    command.take("--output FOLDER", Path, text, Path(folder))


def _source(command: _Parser) -> None:
    text = "image of a BOP scene, default the first; or TF frame of a recording, the world (z up)"
    command.take("--frame FRAME", _frame, text)
    text = "topic of depth images in a recording; topics are listed if there is a choice"
    command.take("--depth TOPIC", str, text)
    text = "time of a recording's image from its start, s; default the first image"
    command.take("--at S", float, text)
    command.take("--background ID ...", int, "labels that are no object", ())


def _frame(text: str) -> int | str:
    """Return the number of an image, or the name of a frame."""
    return int(text) if text.removeprefix("-").isdecimal() else text


def _strict(command: _Parser) -> None:
    text = "refuse (exit code 2) what is usable but odd, in place of a warning"
    command.take("--strict", bool, text)


def _base(command: _Parser, default: str) -> None:
    text = "position of the robot's root link in the world, m"
    command.take("--base-xyz X Y Z", float, text)
    text = f"turn of the root link about world z, rad; default: {default}"
    command.take("--base-yaw RAD", float, text)


def _rules(command: _Parser) -> None:
    text = (
        "bound on the probability of touching anything, by draws from the map's posterior; 1 for "
        "none: then the level set alone decides"
    )
    command.take("--max-risk P", float, text, 0.1)
    text = "contacts to allow: a link or group of the robot and an object's id, as hand:3"
    command.take("--allow LINK:ID ...", str, text, ())
    _policies(command)


def _policies(command: _Parser) -> None:
    text = "what space behind visible surfaces counts as"
    command.take("--occluded POLICY", ("occupied", "posterior", "free"), text, "posterior")
    text = "what space outside the image counts as"
    command.take("--unobserved POLICY", ("free", "occupied"), text, "free")
