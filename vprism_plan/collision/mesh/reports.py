# SPDX-License-Identifier: BSD-3-Clause
"""What a second opinion says: of a path, and of where two checkers disagree and why."""

from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Literal

from vprism_plan.collision.reports import Contact

CauseKind = Literal[
    "conservative spheres", "margin", "voxel inflation", "occluded", "unobserved", "background",
    "thin seen part", "too small for the mesh",
    "solids outside spheres", "coarse mesh", "rounding", "edge tolerance", "missed by the field",
    "seen by a camera",
    "contact rules", "posterior risk", "unexplained",
]  # fmt: skip

SEEN = "a camera saw it there"  # the detail of contacts with observed points
_WHY: dict[CauseKind, str] = {
    # the field refuses, meshes accept
    "conservative spheres": "the link's spheres reach it, its solids do not",
    "margin": "nothing touches, but the field's checker keeps a margin",
    "voxel inflation": "the field's cells reach beyond the surface",
    "occluded": "no camera saw it, and meshes touch nothing that they ask about",
    "unobserved": "no camera looked there, and meshes touch nothing that they ask about",
    "background": "its cells reach farther than the points of the unlabelled clutter",
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
class Cause:
    """Why one contact is refused by one checker and not by the other.

    Attributes:
        kind: the cause.
        link: link in contact.
        body: what it touches.
        amount: metres: how far the solids stay from the surface ("conservative spheres"),
            the spheres do ("margin", "voxel inflation"), or the depth of the contact.
    """

    kind: CauseKind
    link: str
    body: str
    amount: float

    def text(self) -> str:
        """Return the cause as one phrase."""
        return f"{self.link} and {self.body}: {self.kind} ({_WHY[self.kind]})"


@dataclass(frozen=True)
class Disagreement:
    """A configuration on which two checkers disagree.

    Attributes:
        index: row of the configurations that were compared.
        field_valid: verdict of the checker on the distance field.
        mesh_valid: verdict of the checker on meshes.
        causes: one per contact of the checker that refuses, deepest first.
    """

    index: int
    field_valid: bool
    mesh_valid: bool
    causes: tuple[Cause, ...]


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
class PathFinding:
    """A collision on an edge of a path.

    Attributes:
        edge: number of the edge; edge 0 leads from waypoint 0 to waypoint 1.
        fraction: where on the edge, 0 to 1; the first of the configurations looked at.
        configuration: the joint values there.
        contacts: what touches what.
        causes: why another checker accepted it, if one was named.
    """

    edge: int
    fraction: float
    configuration: tuple[float, ...]
    contacts: tuple[Contact, ...]
    causes: tuple[Cause, ...] = ()

    def text(self) -> str:
        """Return the finding in one line."""
        reasons = "; ".join(contact.text() for contact in self.contacts)
        why = "; ".join(cause.text() for cause in self.causes)
        why = f" (why: {why})" if why else ""
        return f"edge {self.edge} at {self.fraction:.3f}: {reasons}{why}"

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-ready values."""
        return {
            **vars(self),
            "configuration": list(self.configuration),
            "contacts": [contact.to_dict() for contact in self.contacts],
            "causes": [dict(vars(cause)) for cause in self.causes],
        }


@dataclass(frozen=True)
class PathOpinion:
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

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-ready keys."""
        return {**vars(self), "findings": [found.to_dict() for found in self.findings]}
