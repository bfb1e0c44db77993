# SPDX-License-Identifier: BSD-3-Clause
"""What the spheres of a robot are worth: do they hold the links, and how far do they stand out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from vprism_plan.robots._geometry import PrimitiveGeometry
from vprism_plan.robots._mesh_files import MeshFile
from vprism_plan.robots._sphere_checks import enclosed, protrusion, sphere_gap, surface_samples
from vprism_plan.robots._spheres import link_triangles

# A prism of so many sides is a cylinder to within a ten-thousandth of its radius.
_SIDES = 256
_QUICK = 400  # samples of a link's surface, and its corners
_BARE = 0.001  # metres by which a link must stand out of its spheres to be named


@dataclass(frozen=True)
class LinkReport:
    """The spheres of one link against its collision geometry.

    Attributes:
        link: Its name.
        spheres: How many it has.
        source: "file", "urdf" (spheres of its own), "tiled" or "fitted"; "-" for none.
        geometry: What the URDF has, in words.
        missing: Mesh files that are not there; then nothing below is known.
        enclosed: Whether every point of its surface is proved to lie in the spheres; None
            without geometry. False for geometry without a sphere: that is not checked at all.
        coverage: Share of 4000 points of the surface, uniform by area, that do; or None.
        bare: How far the farthest of these is from the spheres, metres; 0 if all are inside.
        protrusion: How far the spheres stand out of the link at most, metres, measured on
            200 points of each sphere; or None.
        mean_protrusion: The same on average over the spheres' outer points.
    """

    link: str
    spheres: int
    source: str
    geometry: str
    missing: tuple[str, ...] = ()
    enclosed: bool | None = None
    coverage: float | None = None
    bare: float | None = None
    protrusion: float | None = None
    mean_protrusion: float | None = None

    @property
    def unchecked(self) -> bool:
        """Whether it has geometry and no sphere."""
        return bool(self.geometry) and self.spheres == 0


@dataclass(frozen=True)
class RobotReport:
    """The spheres of all links, and the pairs of links that are not tested.

    Attributes:
        robot: The robot's name.
        joints: Joints of a configuration.
        links: All links with spheres or with collision geometry.
        tested_pairs: How many pairs of links are tested against each other.
        disabled_pairs: (link, link, reason), sorted.
    """

    robot: str
    joints: tuple[str, ...]
    links: tuple[LinkReport, ...]
    tested_pairs: int
    disabled_pairs: tuple[tuple[str, str, str], ...]

    @property
    def spheres(self) -> int:
        """Number of spheres of all links."""
        return sum(link.spheres for link in self.links)

    @property
    def enclosed(self) -> bool | None:
        """Whether all links are proved to be enclosed; None where a link's mesh is missing, and
        where no link has geometry to compare with.
        """
        known = [link.enclosed for link in self.links if link.geometry]
        return False if False in known else True if known and None not in known else None

    @property
    def protrusion(self) -> float:
        """The largest of all links, metres; 0 where none is known."""
        return max((link.protrusion or 0.0 for link in self.links), default=0.0)

    def text(self) -> str:
        """Return the links as a table, lengths in millimetres."""
        header = ("link", "spheres", "from", "enclosed", "coverage", "stands out", "mean")
        rows: list[tuple[str, ...]] = [header]
        rows += [_row(link) for link in self.links]
        widths = [max(len(row[c]) for row in rows) for c in range(len(rows[0]))]
        lines = []
        for row in rows:
            cells = [row[0].ljust(widths[0]), row[1].rjust(widths[1]), row[2].ljust(widths[2])]
            cells.append(row[3].ljust(widths[3]))
            cells += [row[c].rjust(widths[c]) for c in (4, 5, 6)]
            lines.append("  ".join(cells).rstrip())
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-ready values."""
        return {
            **asdict(self),
            "spheres": self.spheres,
            "enclosed": self.enclosed,
            "protrusion": self.protrusion,
        }


def _row(link: LinkReport) -> tuple[str, ...]:
    def millimetres(value: float | None) -> str:
        return "-" if value is None else f"{1000.0 * value:.1f} mm"

    if link.unchecked:
        verdict = "NOT CHECKED"
    elif link.enclosed is None:
        verdict = "mesh missing" if link.missing else "no geometry"
    else:
        verdict = "proved" if link.enclosed else f"no, {1000.0 * (link.bare or 0.0):.1f} mm bare"
    return (
        link.link,
        str(link.spheres),
        link.source,
        verdict,
        "-" if link.coverage is None else f"{100.0 * link.coverage:.1f} %",
        millimetres(link.protrusion),
        millimetres(link.mean_protrusion),
    )


def robot_report(robot: Any) -> RobotReport:
    """See :meth:`Robot.report`."""
    shaped = (*robot.geometry_as_read, *robot.meshes_as_read)
    names = [
        *robot.link_spheres,
        *(name for name in dict.fromkeys(shaped) if name not in robot.link_spheres),
    ]
    pairs = sorted((*sorted(pair), why) for pair, why in robot.disabled_pairs.items())
    return RobotReport(
        robot.name,
        robot.joint_names,
        tuple(_link_report(robot, name) for name in names),
        len(robot.collision_pairs),
        tuple((pair[0], pair[-2], pair[-1]) for pair in pairs),
    )


def robot_warnings(robot: Any) -> tuple[str, ...]:
    """See :attr:`Robot.warnings`. Samples, no proof: that takes a second (`Robot.report`)."""
    bare, unread, unchecked = [], [], []
    for name in dict.fromkeys((*robot.geometry_as_read, *robot.meshes_as_read)):
        solids, meshes = robot.geometry_as_read.get(name, ()), robot.meshes_as_read.get(name, ())
        rows = robot.link_spheres.get(name, np.empty((0, 4)))
        if len(rows) == 0:
            unchecked.append(name)
        elif any(mesh.path is None for mesh in meshes):
            unread.append(name)
        elif robot.sphere_sources.get(name) not in {"fitted", "tiled"}:  # those hold their link
            surface = link_triangles(solids, meshes, _SIDES)
            points = surface_samples(surface, _QUICK) if len(surface) else np.empty((0, 3))
            stands_out = float(sphere_gap(points, rows).max(initial=0.0))
            if stands_out > _BARE:
                bare.append(f"{name} by {1000.0 * stands_out:.0f} mm")
    found = []
    if bare:
        found.append(
            f"collision spheres do not hold their links: {', '.join(bare)} stand out and are not "
            'checked; fit spheres (spheres="fit"), or enlarge them'
        )
    if unread:
        found.append(
            f"whether spheres hold {', '.join(unread)} is not known: their meshes were not found; "
            "give package_dirs"
        )
    if unchecked:
        found.append(f"links without spheres are not checked: {', '.join(unchecked)}")
    return tuple(found)


def _link_report(robot: Any, name: str) -> LinkReport:
    solids, meshes = robot.geometry_as_read.get(name, ()), robot.meshes_as_read.get(name, ())
    rows = robot.link_spheres.get(name, np.empty((0, 4)))
    missing = tuple(mesh.filename for mesh in meshes if mesh.path is None)
    source = robot.sphere_sources.get(name, "-")
    stated = LinkReport(name, len(rows), source, _described(solids, meshes), missing)
    if (solids or meshes) and len(rows) == 0:
        return replace(stated, enclosed=False, coverage=0.0)
    if missing or not (solids or meshes):
        return stated
    held = [solid for solid in solids if solid.kind == "sphere" and _in_one(solid, rows)]
    rest = [solid for solid in solids if solid not in held]
    surface = link_triangles(rest, meshes, _SIDES)
    points = np.empty((0, 3))
    if len(surface):
        points = surface_samples(surface)
    gap = sphere_gap(points, rows)
    proved = len(surface) == 0 or enclosed(surface, rows)
    in_meshes = link_triangles((), meshes) if meshes else None
    worst, mean = protrusion(solids, in_meshes, rows)
    return LinkReport(
        *(name, len(rows), source, stated.geometry, ()),
        enclosed=proved,
        coverage=float((gap <= 0.0).mean()) if len(gap) else 1.0,
        bare=max(0.0, float(gap.max())) if len(gap) else 0.0,
        protrusion=worst,
        mean_protrusion=mean,
    )


def _in_one(solid: PrimitiveGeometry, rows: np.ndarray) -> bool:
    away = np.linalg.norm(rows[:, :3] - solid.T_link[:3, 3], axis=1)
    return bool((away + solid.size[0] <= rows[:, 3] * (1.0 + 1e-12)).any())


def _described(solids: Sequence[PrimitiveGeometry], meshes: Sequence[MeshFile]) -> str:
    kinds = [solid.kind for solid in solids] + ["mesh"] * len(meshes)
    return ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))
