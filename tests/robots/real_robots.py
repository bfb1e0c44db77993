# SPDX-License-Identifier: BSD-3-Clause
"""Where published robot descriptions are, if the packages that carry them are installed."""

import importlib.metadata
import importlib.util
from dataclasses import dataclass
from pathlib import Path

EXAMPLES, BULLET = "example-robot-data", "pybullet"


@dataclass(frozen=True)
class Published:
    """A robot of a package; `height` is where its base stands over a table, metres."""

    package: str
    urdf: str
    srdf: str | None = None
    group: str | None = None
    joints: tuple[str, ...] | None = None
    height: float = 0.0


@dataclass(frozen=True)
class Found:
    """Its files."""

    urdf: Path
    srdf: Path | None
    group: str | None
    joints: tuple[str, ...] | None
    height: float


TIAGO_ARM = tuple(f"arm_{k}_joint" for k in range(1, 8))
ROBOTS = {
    "panda": Published(
        EXAMPLES, "panda_description/urdf/panda.urdf", "panda_description/srdf/panda.srdf"
    ),
    "ur5": Published(
        EXAMPLES, "ur_description/urdf/ur5_robot.urdf", "ur_description/srdf/ur5.srdf", height=0.1
    ),
    "xarm7": Published(
        EXAMPLES, "xarm_description/urdf/xarm7.urdf", "xarm_description/srdf/xarm7.srdf"
    ),
    "pr2": Published(
        EXAMPLES, "pr2_description/urdf/pr2.urdf", "pr2_description/srdf/pr2.srdf", "right_arm"
    ),
    "tiago": Published(EXAMPLES, "tiago_description/robots/tiago.urdf", joints=TIAGO_ARM),
    "kuka_iiwa": Published(BULLET, "kuka_iiwa/model.urdf"),
    "franka_panda": Published(BULLET, "franka_panda/panda.urdf"),
}


def found(name: str) -> Found | None:
    """The files of a robot, or None where its package is not installed."""
    robot = ROBOTS[name]
    root = _root(robot.package)
    if root is None:
        return None
    srdf = root / robot.srdf if robot.srdf else None
    return Found(root / robot.urdf, srdf, robot.group, robot.joints, robot.height)


def _root(package: str) -> Path | None:
    if package == BULLET:
        spec = importlib.util.find_spec("pybullet_data")
        return Path(spec.origin).parent if spec is not None and spec.origin else None
    try:
        files = importlib.metadata.files(package) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    # Its README is among the robots; there is no module to import.
    robots = next((f for f in files if "robots" in f.parts and f.suffix == ".urdf"), None)
    if robots is None:
        return None
    path = Path(str(robots.locate())).resolve()
    return path.parents[len(robots.parts) - 2 - robots.parts.index("robots")]
