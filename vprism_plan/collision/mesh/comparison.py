# SPDX-License-Identifier: BSD-3-Clause
"""Where the distance field and the meshes disagree, and why: of configurations and of paths."""

import math
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vprism_plan.collision.mesh import fcl
from vprism_plan.collision.mesh.seen import SEEN
from vprism_plan.collision.packing import Configuration, Numbers, configurations
from vprism_plan.collision.reports import Answer, Contact
from vprism_plan.world.grid import Vector
from vprism_plan.world.sources import SOURCES, object_id, source_of

_TOLERANCE = 1e-5  # metres: FCL's own, where its iterations end
# Grid steps that the field may refuse beyond a surface: its interpolation gives up less than
# one (half a cell's diagonal), its cover less than half.
_INFLATION = 1.5
# Kinds of causes, and what they mean.
CAUSES: dict[str, str] = {
    # the field refuses, meshes accept
    "conservative spheres": "the link's spheres reach it, its solids do not",
    "margin": "nothing touches, but the field's checker keeps a margin",
    "voxel inflation": "the field's cells reach beyond the surface",
    **{name: source.beyond for name, source in SOURCES.items() if source.beyond},
    "thin seen part": "its cells reach farther than the points of a part that the map smooths away",
    "too small for the mesh": "the object has no surface on the mesh's lattice",
    # meshes refuse, the field accepts
    "solids outside spheres": "the link's spheres do not hold its solids",
    "coarse mesh": "the mesh reaches beyond the level set",
    "rounding": "the two differ by less than FCL's tolerance",
    "edge tolerance": "the field refuses it, too, and accepted the edge within its tolerance",
    "missed by the field": "the map, or the shadow of what was seen, says occupied and the field "
    "says free",
    "seen by a camera": "the checker missed what a camera saw there",
    # either
    "contact rules": "the two permit different contacts",
    "posterior risk": "posterior worlds judge the objects",
    "unexplained": "no known cause",
}


@dataclass(frozen=True)
class Cause(Answer):
    """Why one contact is refused by one checker and not by the other."""

    kind: str  # the cause
    link: str  # link in contact
    body: str  # what it touches
    # metres: how far the solids stay from the surface ("conservative spheres"), the spheres do
    # ("margin", "voxel inflation"), or the depth of the contact
    amount: float

    def text(self) -> str:
        """Return the cause as one phrase."""
        return f"{self.link} and {self.body}: {self.kind} ({CAUSES[self.kind]})"


@dataclass(frozen=True)
class Disagreement:
    """A configuration on which two checkers disagree."""

    index: int  # row of the configurations that were compared
    field_valid: bool  # verdict of the checker on the distance field
    mesh_valid: bool  # verdict of the checker on meshes
    causes: tuple[Cause, ...]  # one per contact of the checker that refuses, deepest first


@dataclass(frozen=True)
class Comparison:
    """Two checkers on the same configurations.

    Attributes:
        both_free: how many both accept.
        both_refused: how many both refuse.
        disagreements: the others.
    """

    both_free: int
    both_refused: int
    disagreements: tuple[Disagreement, ...]

    @property
    def field_refuses(self) -> tuple[Disagreement, ...]:
        """What the field refuses and meshes accept: the price of being conservative."""
        return tuple(d for d in self.disagreements if d.mesh_valid)

    @property
    def mesh_refuses(self) -> tuple[Disagreement, ...]:
        """What meshes refuse and the field accepts: to be looked into."""
        return tuple(d for d in self.disagreements if d.field_valid)

    def counts(self) -> dict[str, int]:
        """How many configurations each kind of cause has a part in."""
        return dict(Counter(k for d in self.disagreements for k in {c.kind for c in d.causes}))

    def text(self) -> str:
        """Return the comparison in one line."""
        kinds = ", ".join(f"{kind} {n}" for kind, n in sorted(self.counts().items()))
        return (
            f"{self.both_free} free and {self.both_refused} refused by both; field refuses "
            f"{len(self.field_refuses)} that meshes accept, meshes refuse "
            f"{len(self.mesh_refuses)} that the field accepts" + (f": {kinds}" if kinds else "")
        )


@dataclass(frozen=True)
class PathFinding(Answer):
    """A collision on an edge of a path."""

    edge: int  # number of the edge; edge 0 leads from waypoint 0 to waypoint 1
    fraction: float  # where on the edge, 0 to 1; the first of the configurations looked at
    configuration: tuple[float, ...]  # the joint values there
    contacts: tuple[Contact, ...]  # what touches what
    causes: tuple[Cause, ...] = ()  # why another checker accepted it, if one was named

    def text(self) -> str:
        """Return the finding in one line."""
        reasons = "; ".join(contact.text() for contact in self.contacts)
        why = "; ".join(cause.text() for cause in self.causes)
        why = f" (why: {why})" if why else ""
        return f"edge {self.edge} at {self.fraction:.3f}: {reasons}{why}"


@dataclass(frozen=True)
class PathOpinion(Answer):
    """Whether a path is free of surfaces, at discrete configurations.

    Attributes:
        valid: the verdict.
        step: metres that no point of the robot exceeds between two configurations.
        configurations: how many were checked.
        findings: one per refused edge.
        judge: who gives the opinion.
    """

    valid: bool
    step: float
    configurations: int
    findings: tuple[PathFinding, ...] = field(default=())
    judge: str = "MeshChecker"

    def text(self) -> str:
        """Return the opinion in one line."""
        how = f"{self.configurations} configurations, {1000 * self.step:g} mm apart"
        if self.valid:
            return f"{self.judge} agrees ({how})"
        return f"{self.judge} disagrees ({how}): " + "; ".join(f.text() for f in self.findings)


def compare(checker: Any, mesh_checker: Any, Q: Numbers) -> Comparison:
    """Compare the verdicts of the field and of meshes, and name a cause for every difference.

    Args:
        checker: a `CollisionChecker`.
        mesh_checker: the second opinion, on the same world and robot.
        Q: (n, dof) finite configurations.

    Returns:
        A disagreement has one cause per contact of the checker that refuses: each of them alone
        would have made the difference.
    """
    both, neither, found = 0, 0, []
    for index, q in enumerate(configurations(mesh_checker.robot, Q, finite=True)):
        by_field, by_mesh = bool(checker.is_valid(q)), mesh_checker.is_valid(q)
        if by_field == by_mesh:
            both += by_field
            neither += not by_field
            continue
        causes = causes_between(checker, mesh_checker, q)
        found.append(Disagreement(index, by_field, by_mesh, causes))
    return Comparison(both, neither, tuple(found))


def causes_between(checker: Any, mesh_checker: Any, q: Configuration) -> tuple[Cause, ...]:
    """Name why the two disagree on q; "edge tolerance" if both refuse it, empty if none does."""
    by_field = checker.explain(q)
    touching = mesh_checker.contacts(q)
    if by_field.valid:
        return tuple(_of_mesh(checker, mesh_checker, contact, q) for contact in touching)
    if touching:
        return tuple(Cause("edge tolerance", c.link, c.body, c.depth) for c in touching)
    return tuple(_of_field(checker, mesh_checker, contact, q) for contact in by_field.contacts)


def _of_field(checker: Any, meshes: Any, contact: Contact, q: Configuration) -> Cause:
    amount = contact.depth
    if contact.body in SOURCES and SOURCES[contact.body].beyond:
        kind = contact.body
    elif contact.kind == "risk":
        kind = "posterior risk"
    elif contact.kind == "object" and meshes.allows(contact.link, contact.body):
        kind = "contact rules"
    elif contact.kind == "self" or contact.body in checker.world.plane_names:
        # Both are exact for spheres: what is left is the margin, or what spheres add.
        own = contact.kind == "self"
        margin = checker.config.self_margin if own else checker.config.margin
        kind = "conservative spheres" if contact.depth > margin else "margin"
        amount = meshes.link_distance(q, contact.link, contact.body)
    elif contact.kind in {"object", "known"} and contact.sphere >= 0:
        kind, amount = _of_surface(checker, meshes, contact, q)
    else:
        kind = "unexplained"
    return Cause(kind, contact.link, contact.body, float(amount))


def _of_surface(checker: Any, meshes: Any, contact: Contact, q: Configuration) -> tuple[str, float]:
    """Cause and amount where the field refuses a sphere for an object or known geometry."""
    margin = float(checker.config.margin)
    center = meshes.robot.sphere_centers(q)[contact.sphere]
    radius = float(meshes.robot.sphere_radii[contact.sphere])
    gap = _ball_gap(meshes, center, radius, contact.body)
    left = meshes.link_distance(q, contact.link, contact.body)
    if gap <= _TOLERANCE and left > gap + _TOLERANCE:
        return "conservative spheres", left
    if gap <= margin:
        return "margin", gap
    if contact.kind == "object":
        # The level sets alone, without thin seen parts.
        fields = map(checker.world.object_field, checker.world.map.object_ids)
        nearest = min(float(field.lower_bound(center[None])[0]) for field in fields)
        if nearest - radius > margin:
            return "thin seen part", contact.depth
        if contact.body not in {body.name for body in meshes.surfaces.bodies}:
            return "too small for the mesh", contact.depth
    within = margin + _INFLATION * float(checker.world.field.spacing)
    return "voxel inflation" if gap <= within else "unexplained", gap


def _ball_gap(meshes: Any, center: Vector, radius: float, named: str) -> float:
    """Signed distance of a ball to the surfaces of the kind that a contact names. For an object: to
    any of them, since the field names the nearest to a grid node."""
    surfaces = meshes.surfaces
    objects = object_id(named) is not None
    inside = objects and surfaces.object_at(center[None])[0] > 0
    best = math.inf
    for body in surfaces.bodies:
        if body.name != named and not (objects and body.class_index):
            continue
        if not body.shape.hollow:
            ball = fcl.Shape("sphere", (radius,))
            ball.place(np.eye(3), center)
            best = min(best, fcl.signed_gap(body.shape, ball))
            continue
        way, _ = fcl.point_distance(body.shape, center)
        hidden = inside if objects else body.contains(center)
        best = min(best, (-way if hidden else way) - radius)
    return best


def _of_mesh(checker: Any, meshes: Any, contact: Contact, q: Configuration) -> Cause:
    bound = checker.config.max_risk  # draws judge objects in place of the level set above its level
    draws_judge = bound is not None and bound >= checker.world.config.level
    kind = "seen by a camera" if contact.detail == SEEN else "missed by the field"
    links = (contact.link, contact.body) if contact.kind == "self" else (contact.link,)
    if contact.position is None:
        kind = "unexplained"  # a joint limit: both know the same
    elif contact.kind == "object" and any(
        object_id(contact.body) in ids and contact.link in checker.robot.links_of(name)
        for name, ids in checker.config.allowed_contacts.items()
    ):
        kind = "contact rules"
    elif contact.kind == "object" and contact.detail != SEEN and draws_judge:
        kind = "posterior risk"
    elif contact.depth <= _TOLERANCE and not source_of(contact.body).policy:
        kind = "rounding"
    elif contact.sphere < 0 and not _in_spheres(meshes, q, links, contact):
        kind = "solids outside spheres"
    elif contact.kind == "object" and not contact.detail and not _in_level_set(checker, contact):
        kind = "coarse mesh"
    return Cause(kind, contact.link, contact.body, contact.depth)


def _in_level_set(checker: Any, contact: Contact) -> bool:
    """Whether the map calls the point of contact, or the deepest one behind it, occupied."""
    point = np.array(contact.position)
    deepest = point - max(0.0, contact.depth - contact.required) * np.array(contact.normal)
    occupied = np.asarray(checker.world.map.occupancy(np.stack([point, deepest])))
    return bool((occupied >= checker.world.config.level).any())


def _in_spheres(meshes: Any, q: Configuration, links: tuple[str, ...], contact: Contact) -> bool:
    """Whether the collision spheres of each link are as near to the place of a contact as the
    solids are, to FCL's tolerance."""
    point, apart = np.array(contact.position), max(0.0, contact.required - contact.depth)
    robot = meshes.robot
    away = np.linalg.norm(robot.sphere_centers(q) - point, axis=1)
    held = away <= robot.sphere_radii + apart + _TOLERANCE
    owners = {robot.link_names[int(link)] for link in robot.sphere_links[held]}
    return owners >= set(links)
