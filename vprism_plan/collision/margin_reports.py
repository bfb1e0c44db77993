# SPDX-License-Identifier: BSD-3-Clause
"""What `safety_margin` answers: a row per link and obstacle."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from vprism_plan.collision.reports import Kind
from vprism_plan.errors import RobotError

_SPOKEN = {"occluded": "occluded space", "unobserved": "unobserved space"}


@dataclass(frozen=True)
class BodyMargin:
    """Where one link and one obstacle are nearest to each other.

    Attributes:
        link: the link.
        body: the obstacle, named as in `Contact.body`.
        kind: what it is.
        clearance: lower bound of the distance between them, metres; negative inside.
            Along a path: over all of it, edges included.
        gradient: (dof,) change of the distance per radian or metre of each joint, at the
            configuration where they are nearest, from the slope of the distance field;
            zeros where that has none (in the middle of an obstacle).
        nearest: point of the obstacle nearest to the sphere's centre, world, metres, to
            within a voxel of the world's field (exact for half-spaces; rough from beyond
            the grid). From a centre inside the obstacle: the nearest way out.
        witness: point of the link's surface nearest to it, world, metres.
        sphere: the link's collision sphere on which `witness` lies.
        occupancy: the map's P(occupied) at `nearest`; None where the map has no say
            (support surface, known geometry).
        entropy: the map's entropy there, nats; None likewise.
        allowed: whether a contact rule lets this link touch this object.
        place: where on the path: number of the edge plus the fraction of it; 0 for a
            single configuration.
    """

    link: str
    body: str
    kind: Kind
    clearance: float
    gradient: tuple[float, ...]
    nearest: tuple[float, float, float]
    witness: tuple[float, float, float]
    sphere: int
    occupancy: float | None
    entropy: float | None
    allowed: bool = False
    place: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-ready values."""
        return dict(self.__dict__)


@dataclass(frozen=True)
class SafetyMargins:
    """Answer of `safety_margin`: every moving link against every obstacle.

    Attributes:
        margins: one per link and obstacle, nearest first.
        clearance: lower bound of the distance to all of them that count, metres (that of
            `CollisionChecker.clearance`; contacts that a rule allows do not count).
        self_clearance: lower bound of the gap between links that may collide, metres.
        margin: clearance that the checker requires, metres.
        joint_names: names of the gradients' entries.
        joint_units: their units, "rad" or "m".
        resolution: voxel of the world's field, metres: how exact `nearest` is.
        tolerance: what was subtracted, metres, so that the bounds hold between the
            configurations that were looked at; 0 for a single one.
        configurations: how many that were.
    """

    margins: tuple[BodyMargin, ...]
    clearance: float
    self_clearance: float
    margin: float
    joint_names: tuple[str, ...]
    joint_units: tuple[str, ...]
    resolution: float
    tolerance: float
    configurations: int

    def between(self, link: str, body: str) -> BodyMargin:
        """Return the margin of one link and one obstacle.

        Raises:
            RobotError: there is none; the message lists what there is.
        """
        for margin in self.margins:
            if (margin.link, margin.body) == (link, body):
                return margin
        links = ", ".join(dict.fromkeys(m.link for m in self.margins))
        bodies = ", ".join(dict.fromkeys(m.body for m in self.margins))
        raise RobotError(
            f"no margin between {link!r} and {body!r}; links that move: {links}; "
            f"obstacles: {bodies}"
        )

    def of_bodies(self) -> dict[str, BodyMargin]:
        """Return the smallest margin of each obstacle, nearest first."""
        nearest: dict[str, BodyMargin] = {}
        for margin in self.margins:
            nearest.setdefault(margin.body, margin)
        return nearest

    def text(self, rows: int = 10) -> str:
        """Return the nearest pairs as a table: clearance, P(occupied), entropy, steepest joint."""
        table: list[tuple[str, ...]] = [
            ("link", "body", "clearance", "P(occ)", "entropy", "steepest joint")
        ]
        table += [self._row(margin) for margin in self.margins[:rows]]
        widths = [max(len(row[c]) for row in table) for c in range(len(table[0]))]
        lines = []
        for row in table:
            cells = [row[0].ljust(widths[0]), row[1].ljust(widths[1])]
            cells += [row[c].rjust(widths[c]) for c in (2, 3, 4)]
            lines.append("  ".join([*cells, row[5]]).rstrip())
        if len(self.margins) > rows:
            lines.append(f"and {len(self.margins) - rows} farther pairs")
        return "\n".join(lines)

    def _row(self, margin: BodyMargin) -> tuple[str, ...]:
        steepest = int(np.argmax(np.abs(margin.gradient)))
        slope = 1000 * margin.gradient[steepest]
        joint = f"{self.joint_names[steepest]} {slope:+.0f} mm/{self.joint_units[steepest]}"
        return (
            margin.link,
            _SPOKEN.get(margin.body, margin.body) + (" (allowed)" if margin.allowed else ""),
            f"{1000 * margin.clearance:.1f} mm",
            "-" if margin.occupancy is None else f"{margin.occupancy:.2f}",
            "-" if margin.entropy is None else f"{margin.entropy:.2f}",
            joint if abs(slope) >= 0.5 else "-",
        )

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-ready values."""
        return {**self.__dict__, "margins": [margin.to_dict() for margin in self.margins]}
