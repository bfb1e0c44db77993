# SPDX-License-Identifier: BSD-3-Clause
"""Verdicts with reasons. Keys of the dictionaries mirror MoveIt's messages."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from vprism_plan._files import jsonable
from vprism_plan.world.grid import Vector
from vprism_plan.world.sources import SourceKind, spoken

Kind = SourceKind | Literal["risk", "self", "joint_limit", "not_finite"]

Point = tuple[float, float, float]

_ROBOT_LINK, _WORLD_OBJECT = 0, 1  # moveit_msgs/ContactInformation body types


def as_point(values: Vector) -> Point:
    """Return three numbers as a tuple."""
    x, y, z = (float(v) for v in values)
    return x, y, z


class Answer:
    """A dataclass that can become JSON: of numbers, text, and others of its kind."""

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-ready values; null where a number is not finite."""
        return {name: jsonable(v) for name, v in vars(self).items() if not callable(v)}


@dataclass(frozen=True)
class Contact(Answer):
    """One reason why a configuration is refused; metres, world frame.

    Attributes:
        kind: What the link touches.
        link: Link that touches (for a joint limit: the joint).
        body: Name of what is touched (see `world.sources`), another link, or the limit.
        depth: How far the clearance falls short of what is required (for a joint limit: how far
            outside, radians or metres; for a risk: by how much its upper bound exceeds `max_risk`).
        sphere: Index of the collision sphere, or -1.
        position: Point of contact.
        normal: Unit direction that leads out of the contact.
        probability: Largest P(occupied) of the map inside the sphere (for a risk: the share of the
            posterior worlds in which this link touches this body); None where the cause is not the
            map's to judge (self, limits, known geometry).
        detail: The rule that decided, in words.
        required: Distance that was asked for: the margin and the link's padding. So `required -
            depth` is how far apart the two are, negative where they overlap.
    """

    kind: Kind
    link: str
    body: str
    depth: float
    sphere: int = -1
    position: Point | None = None
    normal: Point | None = None
    probability: float | None = None
    detail: str = ""
    required: float = 0.0

    def text(self) -> str:
        """Return the reason as one phrase."""
        if self.kind in {"joint_limit", "not_finite"}:
            return self.detail
        if self.kind == "risk":
            return (
                f"{self.link} touches {self.body} with probability {self.probability:.2f} "
                f"({self.detail})"
            )
        at = "" if not self.position else " at ({:.3f}, {:.3f}, {:.3f})".format(*self.position)
        sure = "" if self.probability is None else f", P(occupied) {self.probability:.2f}"
        why = f" ({self.detail})" if self.detail else ""
        body = spoken(self.body)
        way = f"{1000 * abs(self.required - self.depth):.1f}"
        if way == "0.0":
            return f"{self.link} touches {body}{at}{sure}{why}"
        if self.depth > self.required:
            return f"{self.link} is {way} mm into {body}{at}{sure}{why}"
        asked = f"{1000 * self.required:.1f} mm asked for"
        return f"{self.link} is {way} mm from {body}, {asked}{at}{sure}{why}"

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-ready keys of moveit_msgs/ContactInformation, and ours."""
        values = super().to_dict()
        return {
            "contact_body_1": values.pop("link"),
            "body_type_1": _ROBOT_LINK,
            "contact_body_2": values.pop("body"),
            "body_type_2": _ROBOT_LINK if self.kind == "self" else _WORLD_OBJECT,
            **values,
        }


@dataclass(frozen=True)
class StateReport(Answer):
    """Why a configuration is accepted or refused.

    Attributes:
        valid: The verdict; `contacts` is never empty when it is False.
        contacts: Reasons, deepest first, one per link and touched body; what `max_risk` refuses
            comes last.
        clearance: Lower bound of the distance to the world, metres; nan if q is not finite.
        self_clearance: Smallest gap between links that may collide, metres; inf if none.
        margin: Clearance that was required, metres.
        shares: Share of the robot's sphere volume that nobody has seen: "occluded", "unobserved" or
            "outside" the grid.
        policies: What the world does with those spaces ("occupied", "free", "posterior").
        allowed: Contacts that the rules permit.
        warnings: What is usable but odd about the world and the robot, with the remedy.
    """

    valid: bool
    contacts: tuple[Contact, ...]
    clearance: float
    self_clearance: float
    margin: float
    shares: dict[str, float] = field(default_factory=dict)
    policies: dict[str, str] = field(default_factory=dict)
    allowed: tuple[Contact, ...] = ()
    warnings: tuple[str, ...] = ()

    def text(self) -> str:
        """Return the verdict in one line."""
        if self.valid:
            unseen = ", ".join(f"{k} {100 * v:.0f}%" for k, v in self.shares.items() if v > 0.005)
            touching = ", ".join(f"{c.link} touches {c.body}" for c in self.allowed)
            return (
                f"free, clearance {1000 * self.clearance:.1f} mm"
                + (f"; allowed: {touching}" if touching else "")
                + (f"; volume not seen: {unseen}" if unseen else "")
            )
        return "; ".join(contact.text() for contact in self.contacts)

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-ready keys of moveit_msgs/GetStateValidity (valid, contacts,
        cost_sources), and ours. A cost source's cost is the map's P(occupied)."""
        return {
            **super().to_dict(),
            "cost_sources": [
                {"cost_density": c.probability, "aabb_center": c.position, "contact_body": c.body}
                for c in self.contacts
                if c.probability is not None
            ],
        }


@dataclass(frozen=True)
class FirstContact(Answer):
    """What a path touches first, in some of the worlds where it touches anything.

    Attributes:
        body: as in `Contact`.
        link: link that touches it.
        waypoint: index of the waypoint where, or after which, it does.
        share: share of the colliding worlds; the shares of all causes sum to 1.
    """

    body: str
    link: str
    waypoint: int
    share: float

    def text(self) -> str:
        """Return the cause as one phrase."""
        return (
            f"{self.link} touches {self.body} at or after waypoint {self.waypoint} in "
            f"{100 * self.share:.0f}% of them"
        )


@dataclass(frozen=True, eq=False)
class RiskEstimate(Answer):
    """The joint probability that a path collides, over worlds drawn from the posterior.

    Attributes:
        probability: share of the worlds in which any sphere touches anything anywhere on the path;
            the same world for the whole path. A voxel counts as the ball inside it. 1 if a certain
            obstacle is hit.
        lower: Clopper-Pearson bound of the worlds that occupy a voxel's centre inside a sphere,
            less what skipping certain voxels may add.
        upper: Clopper-Pearson bound of the worlds with a voxel whose corners a sphere reaches, and
            what skipping certain voxels may hide; above 0 even if no world collides. `max_risk`
            goes by it.
        confidence: of the interval (lower, upper), two-sided; it holds the size of voxels.
        n_worlds: worlds drawn.
        seed: of the draws.
        per_waypoint: (T,) the same probability at each waypoint alone.
        certain: whether the path hits what is an obstacle in every world: support surface,
            background, unseen space by policy, known geometry.
        spacing: no sphere centre moves more than this between two samples, metres; what lies
            between is covered by growing the spheres.
        configurations: samples on the path.
        trace, volume: find `first_contact` and `shares`, which cost more and are often not asked
            for.
    """

    probability: float
    lower: float
    upper: float
    confidence: float
    n_worlds: int
    seed: int
    per_waypoint: Float[np.ndarray, " t"]
    certain: bool
    spacing: float
    configurations: int
    trace: Callable[[], tuple[FirstContact, ...]] = field(repr=False)
    volume: Callable[[], dict[str, float]] = field(repr=False)

    @cached_property
    def first_contact(self) -> tuple[FirstContact, ...]:
        """What the worlds collide with first: causes, the most frequent first; empty if no
        world collides."""
        return self.trace()

    @cached_property
    def shares(self) -> dict[str, float]:
        """Share of the swept volume that the map cannot judge, by kind: "occluded" (hidden,
        without support), "unobserved", "outside" (the grid)."""
        return self.volume()

    @property
    def unsupported_share(self) -> float:
        """Share of the swept volume in space that the map cannot judge."""
        return sum(self.shares.values())

    def __getstate__(self) -> dict[str, Any]:
        """Find what is left to find before the estimate leaves the process."""
        found = {"first_contact": self.first_contact, "shares": self.shares}
        return {**self.__dict__, **found, "trace": tuple, "volume": dict}

    def text(self) -> str:
        """Return the estimate in one line."""
        line = (
            f"P(collision) {self.probability:.3f} "
            f"({100 * self.confidence:.0f}% interval {self.lower:.3f} to {self.upper:.3f}, "
            f"{self.n_worlds} worlds)"
        )
        if self.first_contact:
            line += f"; {self.first_contact[0].text()}"
        if self.unsupported_share > 0.005:
            line += f"; {100 * self.unsupported_share:.0f}% of the swept volume is not judged"
        return line

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-ready values, what is left to find among them."""
        found = {name: getattr(self, name) for name in ("first_contact", "shares")}
        return super().to_dict() | jsonable(found | {"unsupported_share": self.unsupported_share})


@dataclass(frozen=True)
class MotionReport:
    """Why an edge is accepted or refused.

    Attributes:
        valid: The verdict.
        certified: Every point of the edge is covered by a computed clearance, so nothing was left
            to sampling. False for a refused edge.
        tolerance: Largest motion, metres, between any point of the edge and a configuration known
            to be free (0 when certified).
        collision_fraction: Where along the edge the collision that refused it was found, 0 to 1;
            None when valid. Not necessarily the first one.
        configurations: How many configurations were checked.
        motion_bound: Upper bound of any sphere's path length along the edge, metres.
        state: Report of the refused configuration; None when valid.
        risk: Estimate along the edge, when `max_risk` is what refused it.
    """

    valid: bool
    certified: bool
    tolerance: float
    collision_fraction: float | None
    configurations: int
    motion_bound: float
    state: StateReport | None = None
    risk: RiskEstimate | None = None

    def text(self) -> str:
        """Return the verdict in one line."""
        if self.valid:
            how = "certified" if self.certified else f"to within {1000 * self.tolerance:.2f} mm"
            return f"free ({how}, {self.configurations} configurations)"
        if self.risk is not None:
            return f"too risky: {self.risk.text()}"
        if self.state is not None and self.state.valid:
            return f"not certified within {self.configurations:,} configurations; ask for parts"
        reason = "" if self.state is None else f": {self.state.text()}"
        return f"in collision at {self.collision_fraction:.3f} of the edge{reason}"
