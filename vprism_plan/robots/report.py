# SPDX-License-Identifier: BSD-3-Clause
"""What the spheres of a robot are worth: do they hold the links, and how far do they stand out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from vprism_plan._shapes import Points, Spheres, Triangles, Values
from vprism_plan.robots.geometry import PrimitiveGeometry
from vprism_plan.robots.surfaces import (
    Surface,
    halved_triangles,
    link_triangles,
    split_triangles,
    surface_samples,
    with_hull,
)

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
        """Whether all links are proved to be enclosed; None where no link or mesh is known."""
        known = [link.enclosed for link in self.links if link.geometry]
        return False if False in known else True if known and None not in known else None

    @property
    def protrusion(self) -> float:
        """The largest of all links, metres; 0 where none is known."""
        return max((link.protrusion or 0.0 for link in self.links), default=0.0)

    def text(self) -> str:
        """Return the links as a table, lengths in millimetres."""
        header = ("link", "spheres", "from", "enclosed", "coverage", "stands out", "mean")
        rows = [header, *map(_row, self.links)]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        aligned = (str.ljust, str.rjust, str.ljust, str.ljust, str.rjust, str.rjust, str.rjust)
        lines = (
            "  ".join(a(cell, w) for a, cell, w in zip(aligned, row, widths, strict=True))
            for row in rows
        )
        return "\n".join(line.rstrip() for line in lines)

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-ready values."""
        derived = {key: getattr(self, key) for key in ("spheres", "enclosed", "protrusion")}
        return asdict(self) | derived


def _row(link: LinkReport) -> tuple[str, ...]:
    def text(value: float | None, factor: float, unit: str) -> str:
        return "-" if value is None else f"{factor * value:.1f} {unit}"

    if link.unchecked:
        verdict = "NOT CHECKED"
    elif link.enclosed is None:
        verdict = "mesh missing" if link.missing else "no geometry"
    else:
        verdict = "proved" if link.enclosed else f"no, {1000.0 * (link.bare or 0.0):.1f} mm bare"
    lengths = (text(value, 1000.0, "mm") for value in (link.protrusion, link.mean_protrusion))
    coverage = text(link.coverage, 100.0, "%")
    return link.link, str(link.spheres), link.source, verdict, coverage, *lengths


def robot_report(robot: Any) -> RobotReport:
    """See :meth:`Robot.report`."""
    names = dict.fromkeys((*robot.link_spheres, *robot.geometry_as_read, *robot.meshes_as_read))
    pairs = sorted((*sorted(pair), why) for pair, why in robot.disabled_pairs.items())
    return RobotReport(
        robot.name,
        robot.joint_names,
        tuple(_link_report(robot, name) for name in names),
        len(robot.collision_pairs),
        tuple((pair[0], pair[-2], pair[-1]) for pair in pairs),
    )


def _of_link(robot: Any, name: str) -> tuple[tuple, tuple, np.ndarray]:
    """Its solids, its meshes and its spheres, as they were read."""
    solids, meshes = robot.geometry_as_read.get(name, ()), robot.meshes_as_read.get(name, ())
    return solids, meshes, robot.link_spheres.get(name, np.empty((0, 4)))


def robot_warnings(robot: Any) -> tuple[str, ...]:
    """See :attr:`Robot.warnings`. Samples, no proof: that takes a second (`Robot.report`)."""
    parts = robot._parts
    model, file, found = parts.model, parts.chosen.file, [*parts.semantics.warnings]
    if file.missing:
        found.append(f"{file.source} names what {model.name} lacks, left out: {file.missing}")
    still = [joint.name for joint in model.joints if joint.kind in ("floating", "planar")]
    if still:
        found.append(f"floating or planar joints stand still, as base_pose says: {still}")
    bare, unread, unchecked = [], [], []
    for name in dict.fromkeys((*robot.geometry_as_read, *robot.meshes_as_read)):
        solids, meshes, rows = _of_link(robot, name)
        if len(rows) == 0:
            unchecked.append(name)
        elif any(mesh.path is None for mesh in meshes):
            unread.append(name)
        elif robot.sphere_sources.get(name) not in {"fitted", "tiled"}:  # those hold their link
            points = surface_samples(link_triangles(solids, meshes, _SIDES), _QUICK)
            stands_out = float(sphere_gap(points, rows).max(initial=0.0))
            if stands_out > _BARE:
                bare.append(f"{name} by {1000.0 * stands_out:.0f} mm")
    for name, link in model.links.items():
        if link.seen and name not in (*robot.link_spheres, *unchecked):
            unchecked.append(f"{name} (it has only a <visual>)")
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
    solids, meshes, rows = _of_link(robot, name)
    missing = tuple(mesh.filename for mesh in meshes if mesh.path is None)
    kinds = [solid.kind for solid in solids] + ["mesh"] * len(meshes)
    geometry = ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))
    source = robot.sphere_sources.get(name, "-")
    stated = LinkReport(name, len(rows), source, geometry, missing)
    if (solids or meshes) and len(rows) == 0:
        return replace(stated, enclosed=False, coverage=0.0)
    if missing or not (solids or meshes):
        return stated
    rest = [solid for solid in solids if solid.kind != "sphere" or not _in_one(solid, rows)]
    surface = link_triangles(rest, meshes, _SIDES)
    gap = sphere_gap(surface_samples(surface), rows)
    worst, mean = protrusion(solids, link_triangles((), meshes) if meshes else None, rows)
    return replace(
        stated,
        enclosed=enclosed(surface, rows),
        coverage=float((gap <= 0.0).mean()) if len(gap) else 1.0,
        bare=float(gap.max(initial=0.0)),
        protrusion=worst,
        mean_protrusion=mean,
    )


def _in_one(solid: PrimitiveGeometry, rows: np.ndarray) -> bool:
    away = np.linalg.norm(rows[:, :3] - solid.T_link[:3, 3], axis=1)
    return bool((away + solid.size[0] <= rows[:, 3] * (1.0 + 1e-12)).any())


_FINEST = 2e-6  # metres: a triangle with shorter edges that is in no single sphere is bare
_ON_SPHERE, _ROWS = 200, 20_000


def enclosed(triangles: Triangles, spheres: Spheres) -> bool:
    """Whether every point of a surface lies in the union of spheres: a proof, no sampling.

    A triangle whose corners lie in one sphere lies in it. Others are halved, until all do
    (proved) or a corner lies in none (refuted), or nearly so.
    """
    waiting = [triangles[i : i + _ROWS] for i in range(0, len(triangles), _ROWS)]
    while waiting:
        part = waiting.pop()
        away = np.linalg.norm(part[:, :, None] - spheres[None, None, :, :3], axis=3)
        inside = away <= spheres[:, 3]
        if not inside.any(axis=2).all():
            return False
        part = part[~inside.all(axis=1).any(axis=1)]
        if len(part) == 0:
            continue
        edges = np.linalg.norm(np.roll(part, -1, axis=1) - part, axis=2)
        if float(edges.max(axis=1).min()) < _FINEST:
            return False
        halves = halved_triangles(part, edges)
        waiting += [halves[i : i + _ROWS] for i in range(0, len(halves), _ROWS)]
    return True


def sphere_gap(points: Points, spheres: Spheres) -> Values:
    """Signed distance of points to the union of spheres, metres: negative inside."""
    gap = np.full(len(points), math.inf)
    for *centre, radius in spheres:
        gap = np.minimum(gap, np.linalg.norm(points - centre, axis=1) - radius)
    return gap


def protrusion(
    primitives: Sequence[PrimitiveGeometry], triangles: Triangles | None, spheres: Spheres
) -> tuple[float, float]:
    """How far the union of spheres stands out of a link at most, and on average, metres.

    Measured at 200 points of each sphere that lie in no other: their distance to the link, 0
    inside it (an open shell is solid up to its convex hull). To a mesh it is taken to points,
    and too large by half a millimetre at most from two centimetres on.
    """
    i = np.arange(_ON_SPHERE) + 0.5
    height, turn = 1.0 - 2.0 * i / _ON_SPHERE, math.pi * (1.0 + math.sqrt(5.0)) * i
    rim = np.sqrt(1.0 - height**2)
    unit = np.stack([rim * np.cos(turn), rim * np.sin(turn), height], axis=1)
    points = (spheres[:, None, :3] + spheres[:, None, 3:] * unit).reshape(-1, 3)
    points = points[sphere_gap(points, spheres) > -1e-9]
    if len(points) == 0:
        return 0.0, 0.0
    away = np.full(len(points), math.inf)
    for solid in primitives:
        away = np.minimum(away, solid.signed_distance(points))
    if triangles is not None:
        away = np.minimum(away, _mesh_distance(triangles, points))
    away = np.maximum(away, 0.0)
    return float(away.max()), float(away.mean())


def _mesh_distance(triangles: Triangles, points: Points) -> Values:
    """Distance to a surface, 0 where the surface encloses the point."""
    triangles = with_hull(triangles)
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    edge = max(0.003, float((high - low).max()) / 60.0)
    dense = split_triangles(triangles, edge)
    samples = np.concatenate([dense.reshape(-1, 3), dense.mean(axis=1)])
    away = np.asarray(cKDTree(samples).query(points)[0])
    # Points in cells that the surface encloses, as the fit sees it.
    surface = Surface.of(triangles, math.inf)
    at = np.floor((points - surface.lower) / surface.cell).astype(np.int64)
    there = ((at >= 0) & (at < surface.inner.shape)).all(axis=1)
    away[there] *= ~surface.inner[tuple(at[there].T)]
    return away
