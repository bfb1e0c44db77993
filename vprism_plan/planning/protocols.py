# SPDX-License-Identifier: BSD-3-Clause
"""What planning needs from a robot, from a checker and from a second judge.

`vprism_plan.collision.CollisionChecker` satisfies `CheckerLike`; so does any other object with
these members, such as a user's own checker.
"""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

# Radians or metres, in the order of the robot's joints; rows of any number.
Configuration = Float[np.ndarray, " dof"]
Waypoints = Float[np.ndarray, "_ dof"]
Now = Callable[[], float]  # reads a clock, seconds


@runtime_checkable
class CheckerLike(Protocol):
    """Verdicts about configurations and straight motions of one robot in one world.

    The two `*_buffer` forms take float64 C-contiguous arrays of length dof, unchecked (but NaN
    is never valid), and must be safe to call from several threads. With a `max_risk` that is not
    None, `collision_probability(path, held_out=True)` and `tightened(level, ends)` are asked,
    too; see `attempts.within_risk`.
    """

    @property
    def robot(self) -> Any:
        """The robot: `dof` joints that are planned for, and in one fixed order their `joint_names`,
        limits `lower` and `upper` (radians or metres; ignored where continuous), and whether they
        turn without limit, `continuous`."""

    def is_valid(self, q: Any) -> bool:
        """Whether configuration q (dof,) is allowed."""

    def is_valid_buffer(self, q: Any) -> bool:
        """`is_valid` without conversion or checks of the input."""

    def check_motion(self, qa: Any, qb: Any) -> bool:
        """Whether the whole straight motion is allowed, both ends included.

        It is the line from qa to qb as written: no joint takes a shorter way round.
        """

    def check_motion_buffer(self, qa: Any, qb: Any) -> bool:
        """`check_motion` without conversion or checks of the input."""

    def clearance(self, q: Any) -> float:
        """Metres to the nearest obstacle, negative inside one."""

    def explain(self, q: Any) -> Any:
        """A report on a configuration: `valid`, `text()`, and `shares`, the part of the robot's
        volume in each kind of unseen space."""

    def check_motion_report(self, qa: Any, qb: Any) -> Any:
        """`check_motion` with reasons: `valid`, `certified`, `tolerance` (metres), `text()`."""


@runtime_checkable
class SecondOpinion(Protocol):
    """Another judge of paths, see `vprism_plan.collision.MeshChecker`."""

    @property
    def robot(self) -> Any:
        """The robot, as that of `CheckerLike`."""

    def review(self, checker: Any, path: Any) -> Any:
        """An opinion on a path (T, dof) that `checker` accepted: `valid` and `text()`."""
