# SPDX-License-Identifier: BSD-3-Clause
"""What a user of meshes has: extracted surfaces and FCL, asked by the planner.

The verdicts are those of `MeshChecker`. A distance field of the same level set, which never
says more than the true distance to the meshes, answers first: what it calls free is free for
FCL too, and only the rest is asked of FCL. That changes no verdict on a configuration and
makes FCL fast enough for the same time limit as the others. Edges that the field cannot
clear are checked at configurations between which no point of the robot moves more than a step.
"""

from functools import partial

import numpy as np
from jaxtyping import Float

from vprism_plan.collision import CheckerConfig, CollisionChecker, MeshChecker
from vprism_plan.collision.packing import Numbers
from vprism_plan.robots import Robot
from vprism_plan.world import World


class FclChecker(MeshChecker):
    """FCL's verdicts on the mean map's meshes and the support surface, no more.

    Args:
        world: a `World` with `occluded="free"`: its level set, and the support surface.
        robot: its collision spheres are FCL's shapes, as every other checker sees it.
        step: motion between two configurations of an edge, metres.
        margin: distance to keep, metres.
    """

    def __init__(
        self, world: World, robot: Robot, step: float = 0.005, margin: float = 0.0
    ) -> None:
        config = CheckerConfig(margin=margin, max_risk=None)
        super().__init__(world, robot, config, links="spheres", step=step, seen=False)
        self._made = partial(FclChecker, world, robot, step, margin)
        self._field = CollisionChecker(world, robot, config)

    def is_valid_buffer(self, q: Float[np.ndarray, "dof"]) -> bool:
        """Return FCL's verdict on a configuration (dof,)."""
        return self._field.is_valid_buffer(q) or super().is_valid_buffer(q)

    def check_motion_buffer(
        self, qa: Float[np.ndarray, "dof"], qb: Float[np.ndarray, "dof"]
    ) -> bool:
        """Return whether the straight edge is free at its configurations."""
        return self._field.check_motion_buffer(qa, qb) or super().check_motion_buffer(qa, qb)

    def clearance(self, q: Numbers) -> float:
        """Return a lower bound of the distance to the meshes and the table, metres.

        The field's: FCL's own distance takes milliseconds, and planners only report it.
        """
        return self._field.clearance(q)
