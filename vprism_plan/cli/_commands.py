# SPDX-License-Identifier: BSD-3-Clause
"""What can be asked for on the command line: one dataclass per command, help with units.

Nothing heavy is imported here, so `--help` answers at once.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import AvoidSubcommands, Positional, arg, subcommand

Planner = Literal["RRTConnect", "RRTstar", "InformedRRTstar", "BITstar", "KPIECE1", "AORRTC"]
Triple = tuple[float, float, float]
Pose7 = tuple[float, float, float, float, float, float, float]

_XYZ = arg(metavar="X Y Z")
_JOINTS = arg(metavar="Q1 Q2 ...")


@dataclass(frozen=True)
class Demo:
    """Fit a map of the bundled scene, plan a Panda arm across it, write pictures and results."""

    output: Path = Path("out/demo")
    """Folder for scene.png, map.png, plan.png, map.safetensors, meshes/, trajectory.json
    and report.json."""
    seed: int = 0
    """Seed of the fit and of the planner."""
    json: bool = False
    """Print one JSON object instead of text."""


@dataclass(frozen=True)
class Map:
    """Fit a map to one view and save it.

    INPUT is an .npz, a folder (depth.png, camera.json, optional labels.png), a BOP scene or
    X-depth.png beside camera.json. Without labels it is segmented; without a camera pose the
    world is laid on the table (z up, table at z = 0).
    """

    input: Positional[Path]
    """The view."""
    output: Path = Path("map.safetensors")
    """File to write."""
    frame: Annotated[int | None, arg(metavar="INT")] = None
    """Image of a BOP scene; default the first."""
    preset: Literal["default", "paper"] = "default"
    """Settings of the fit: calibrated for planning, or the paper's Table III."""
    seed: int = 0
    """Seed of the sampling."""
    strict: bool = False
    """Refuse (exit code 2) what is usable but odd, in place of a warning."""
    json: bool = False
    """Print one JSON object instead of text."""


@dataclass(frozen=True)
class Plan:
    """Plan a motion around what a view shows, and verify it.

    INPUT is a view (as for `map`) or a .safetensors map. What is not given is chosen and
    reported: the base beside the objects, start and goal with the hand on either side of them.
    """

    input: Positional[Path]
    """The view or the map."""
    robot: Annotated[Path, arg(metavar="URDF")]
    """Robot description; an SRDF of the same name beside it is used."""
    output: Path = Path("out/plan")
    """Folder for scene.png, map.png, plan.png, map.safetensors, meshes/, trajectory.json
    and report.json."""
    base_xyz: Annotated[Triple | None, _XYZ] = None
    """Position of the robot's root link in the world (m)."""
    base_yaw: Annotated[float | None, arg(metavar="RAD")] = None
    """Turn of the root link about world z (rad); default: facing the objects."""
    start: Annotated[tuple[float, ...] | None, _JOINTS] = None
    """Start configuration (rad, m for sliding joints), in the URDF's joint order."""
    goal: Annotated[tuple[float, ...] | None, _JOINTS] = None
    """Goal configuration (rad, m for sliding joints)."""
    goal_pose: Annotated[Pose7 | None, arg(metavar="X Y Z QW QX QY QZ")] = None
    """Instead of a goal: pose of the end effector in the world (m, unit quaternion wxyz)."""
    planner: Planner = "RRTConnect"
    """OMPL planner."""
    time_limit: float = 5.0
    """Wall time for the search (s)."""
    margin: float = 0.005
    """Clearance to keep from everything (m); the true surface can lie a few millimetres
    outside the map's."""
    max_risk: Annotated[float | None, arg(metavar="P")] = None
    """Bound on the probability that the path touches anything (0 to 1): objects are then
    judged by draws from the map's posterior, not by its level set."""
    allow: Annotated[tuple[str, ...], arg(metavar="LINK:ID ...")] = ()
    """Contacts to allow: a link or group of the robot and the id of an object, as hand:3."""
    occluded: Literal["occupied", "posterior", "free"] = "occupied"
    """What space behind visible surfaces counts as."""
    unobserved: Literal["free", "occupied"] = "free"
    """What space outside the image counts as."""
    frame: Annotated[int | None, arg(metavar="INT")] = None
    """Image of a BOP scene; default the first."""
    seed: int = 0
    """Seed of the fit, of what is chosen, and of the planner."""
    strict: bool = False
    """Refuse (exit code 2) what is usable but odd, in place of a warning."""
    json: bool = False
    """Print one JSON object instead of text."""


@dataclass(frozen=True)
class Query:
    """Ask whether one configuration is free, and why not: margins, risk, entropy.

    The table names the nearest pairs of a link and an obstacle: clearance (mm, a lower
    bound), the map's P(occupied) and entropy (nats) at the obstacle's nearest point, and
    the joint that changes the clearance most (mm per rad or m). Exit code 0: free; 1: refused.
    """

    map: Positional[Path]
    """A .safetensors map."""
    robot: Annotated[Path, arg(metavar="URDF")]
    """Robot description."""
    q: Annotated[tuple[float, ...], _JOINTS]
    """Configuration (rad, m for sliding joints), in the URDF's joint order."""
    base_xyz: Annotated[Triple | None, _XYZ] = None
    """Position of the robot's root link in the world (m); default: the place that `plan`
    chooses beside the objects."""
    base_yaw: Annotated[float | None, arg(metavar="RAD")] = None
    """Turn of the root link about world z (rad); default: facing the objects."""
    margin: float = 0.0
    """Clearance that is required (m)."""
    max_risk: Annotated[float | None, arg(metavar="P")] = None
    """Bound on the probability of touching anything (0 to 1), as for `plan`."""
    allow: Annotated[tuple[str, ...], arg(metavar="LINK:ID ...")] = ()
    """Contacts to allow: a link or group of the robot and the id of an object, as hand:3."""
    rows: int = 10
    """Length of the table of margins; 0 for all. JSON has them all."""
    occluded: Literal["occupied", "posterior", "free"] = "occupied"
    """What space behind visible surfaces counts as."""
    unobserved: Literal["free", "occupied"] = "free"
    """What space outside the image counts as."""
    seed: int = 0
    """Seed of the choice of a base, as for `plan`."""
    strict: bool = False
    """Refuse (exit code 2) what is usable but odd, in place of a warning."""
    json: bool = False
    """Print one JSON object instead of text."""


@dataclass(frozen=True)
class Mesh:
    """Write the surface of every object of a map as PLY (m, world frame)."""

    map: Positional[Path]
    """A .safetensors map."""
    output: Path
    """Folder for object_ID.ply."""
    level: float = 0.5
    """Probability of being occupied at the surface."""
    resolution: float = 0.01
    """Edge of the grid (m)."""
    json: bool = False
    """Print one JSON object instead of text."""


@dataclass(frozen=True)
class View:
    """Look at a map, and at a plan, in the browser; Ctrl-C ends it.

    Surfaces of the objects at any P(occupied), the observed points, the entropy as a cloud and
    as a slice; the robot along the planned trajectory, or moved by hand. Needs the extra
    `viewer`.
    """

    input: Positional[Annotated[Path, arg(metavar="MAP_OR_PLAN")]]
    """A .safetensors map, or the output folder of `plan` or `demo`."""
    robot: Annotated[Path | None, arg(metavar="URDF")] = None
    """Robot description; for a plan, the one it was made with. Without it no robot is shown."""
    base_xyz: Annotated[Triple | None, _XYZ] = None
    """Position of the robot's root link in the world (m); default: that of the plan, else the
    place that `plan` chooses beside the objects."""
    base_yaw: Annotated[float | None, arg(metavar="RAD")] = None
    """Turn of the root link about world z (rad); default: that of the plan, else facing the
    objects."""
    level: float = 0.5
    """P(occupied) at the surfaces, to begin with."""
    host: str = "127.0.0.1"
    """Address to listen at; 0.0.0.0 lets other machines connect."""
    port: int = 8080
    """Port to listen at; if it is busy, the next free one."""
    json: bool = False
    """Print one JSON object instead of text."""


@dataclass(frozen=True)
class RobotInfo:
    """Show what a URDF becomes: joints, collision spheres, pairs of links that are not tested.

    Spheres come from --spheres, else from STEM_spheres.yml beside the URDF, else they are fitted
    to its collision geometry. The table says of each link whether they enclose it (proved) and
    how far they stand out of it.
    """

    urdf: Positional[Path]
    """The robot description (xacro expanded)."""
    srdf: Annotated[Path | None, arg(metavar="SRDF")] = None
    """Groups, states and pairs not to test; default STEM.srdf beside the URDF, else pairs are
    generated from random configurations."""
    spheres: Annotated[Path | None, arg(metavar="FILE")] = None
    """Collision spheres: YAML of this package or of cuRobo, or XRDF."""
    fit: bool = False
    """Fit spheres even if there is a file of them beside the URDF."""
    tolerance: float = 0.03
    """How far fitted spheres may stand out of a link (m), where --max-spheres suffice for it."""
    max_spheres: Annotated[int | None, arg(metavar="INT")] = None
    """At most so many fitted spheres for each link; default 12, more for links above 0.35 m."""
    group: Annotated[str | None, arg(metavar="NAME")] = None
    """SRDF group whose joints make a configuration; default "arm", else all joints."""
    package_dirs: Annotated[tuple[Path, ...], arg(metavar="DIR ...")] = ()
    """Folders that hold the packages of package:// names; folders above the URDF and
    ROS_PACKAGE_PATH, AMENT_PREFIX_PATH are searched in any case."""
    spheres_output: Annotated[Path | None, arg(metavar="FILE")] = None
    """Write the spheres as YAML: as STEM_spheres.yml beside the URDF they are read from then on."""
    srdf_output: Annotated[Path | None, arg(metavar="FILE")] = None
    """Write an SRDF with the joints as group "arm" and the pairs that are not tested."""
    picture: Annotated[Path | None, arg(metavar="PNG")] = None
    """Write a picture: the collision geometry, and the spheres over it."""
    json: bool = False
    """Print one JSON object instead of text."""


Command = Demo | Map | Plan | Query | Mesh | View | RobotInfo
CommandLine = AvoidSubcommands[
    Annotated[Demo, subcommand("demo")]
    | Annotated[Map, subcommand("map")]
    | Annotated[Plan, subcommand("plan")]
    | Annotated[Query, subcommand("query")]
    | Annotated[Mesh, subcommand("mesh")]
    | Annotated[View, subcommand("view")]
    | Annotated[RobotInfo, subcommand("robot")]
]
