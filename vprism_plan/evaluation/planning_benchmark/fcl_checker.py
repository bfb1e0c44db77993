# SPDX-License-Identifier: BSD-3-Clause
"""What a user of meshes has: extracted surfaces and FCL, asked by the planner.

The verdicts are those of `MeshChecker`. A distance field of the same level set, which never
says more than the true distance to the meshes, answers first: what it calls free is free for
FCL too, and only the rest is asked of FCL. That changes no verdict on a configuration and
makes FCL fast enough for the same time limit as the others. Edges that the field cannot
clear are checked at configurations between which no point of the robot moves more than a step.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float

from vprism_plan.collision import CollisionChecker, MeshChecker
from vprism_plan.collision.protocols import Numbers
from vprism_plan.collision.reports import StateReport
from vprism_plan.robots import Robot
from vprism_plan.world import World

__all__ = ["FclChecker"]


@dataclass(frozen=True)
class DiscreteReport:
    """Verdict on an edge that was checked at discrete configurations."""

    valid: bool
    certified: bool
    tolerance: float

    def text(self) -> str:
        """Return the verdict in one line."""
        return "free" if self.valid else "a configuration on the edge collides"


class FclChecker:
    """A `CheckerLike` whose verdicts are FCL's on the mean map's meshes.

    Args:
        world: a `World` with `occluded="free"`: its level set, and the support surface.
        robot: its collision spheres are FCL's shapes, as every other checker sees it.
        step: motion between two configurations of an edge, metres.
    """

    def __init__(self, world: World, robot: Robot, step: float = 0.005) -> None:
        self._step = step
        self.robot = robot
        self.meshes = MeshChecker(world, robot, links="spheres")
        self._field = CollisionChecker(world, robot)

    def is_valid(self, q: Numbers) -> bool:
        """Return FCL's verdict on a configuration (dof,)."""
        return self.is_valid_buffer(np.ascontiguousarray(q, dtype=np.float64))

    def is_valid_buffer(self, q: Float[np.ndarray, "dof"]) -> bool:
        """`is_valid` for a contiguous float64 array."""
        return self._field.is_valid_buffer(q) or self.meshes.is_valid(q)

    def check_motion(self, qa: Numbers, qb: Numbers) -> bool:
        """Return whether the straight edge is free at its configurations."""
        ends = (np.ascontiguousarray(q, dtype=np.float64) for q in (qa, qb))
        return self.check_motion_buffer(*ends)

    def check_motion_buffer(
        self, qa: Float[np.ndarray, "dof"], qb: Float[np.ndarray, "dof"]
    ) -> bool:
        """`check_motion` for contiguous float64 arrays: the middle first, then the quarters."""
        if self._field.check_motion_buffer(qa, qb):
            return True
        delta = qb - qa
        pieces = max(1, int(np.ceil(self.meshes.placed.motion_bound(delta) / self._step)))
        return all(self.is_valid_buffer(qa + k / pieces * delta) for k in bisected(pieces))

    def clearance(self, q: Numbers) -> float:
        """Return a lower bound of the distance to the meshes and the table, metres.

        The field's: FCL's own distance takes milliseconds, and planners only report it.
        """
        return self._field.clearance(q)

    def explain(self, q: Numbers) -> StateReport:
        """Return the verdict with FCL's contacts."""
        valid = self.is_valid(q)
        contacts = () if valid else self.meshes.contacts(q)
        return StateReport(valid, contacts, self.clearance(q), np.inf, 0.0)

    def check_motion_report(self, qa: Numbers, qb: Numbers) -> Any:
        """Return the verdict on an edge, and how far apart it was looked at."""
        return DiscreteReport(self.check_motion(qa, qb), False, 0.5 * self._step)


def bisected(pieces: int) -> list[int]:
    """Return 0..pieces, both ends first, then each time the middles of what is left."""
    order = [0, pieces]
    known = [0, pieces]
    while len(known) < pieces + 1:
        middles = [(a + b) // 2 for a, b in pairwise(known) if b - a > 1]
        order += middles
        known = sorted({*known, *middles})
    return order
