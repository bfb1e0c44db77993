# SPDX-License-Identifier: BSD-3-Clause
"""What planning needs from a robot and from a checker.

`vprism_plan.collision.CollisionChecker` satisfies `CheckerLike`; so does any other
object with these members, which is how the adapter is tested and how a user brings
a checker of their own.
"""

from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float


@runtime_checkable
class RobotLike(Protocol):
    """The joints of a robot, in one fixed order."""

    @property
    def dof(self) -> int:
        """Number of joints that are planned for."""

    @property
    def joint_names(self) -> Any:
        """Sequence of dof names, in the order of a configuration."""

    @property
    def lower(self) -> Float[np.ndarray, " dof"]:
        """Lower limits, radians or metres; ignored for continuous joints."""

    @property
    def upper(self) -> Float[np.ndarray, " dof"]:
        """Upper limits, radians or metres; ignored for continuous joints."""

    @property
    def continuous(self) -> Bool[np.ndarray, " dof"]:
        """True where a joint turns without limit."""


@runtime_checkable
class CheckerLike(Protocol):
    """Verdicts about configurations and straight motions of one robot in one world.

    The two `*_buffer` forms take float64 C-contiguous arrays of length dof and skip
    all validation except that NaN is never valid; they must be safe to call from
    several threads.
    """

    @property
    def robot(self) -> Any:
        """The robot, see `RobotLike`."""

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
        """A `ReasonedReport` on a configuration."""

    def check_motion_report(self, qa: Any, qb: Any) -> Any:
        """A report on a motion: `valid`, `certified`, `tolerance` (metres) and `text()`."""


@runtime_checkable
class RiskChecker(CheckerLike, Protocol):
    """A checker that bounds the probability of collision."""

    @property
    def max_risk(self) -> float | None:
        """Bound on the probability of collision, None for no bound."""

    def collision_probability(self, path: Any, held_out: bool = False) -> Any:
        """A `RiskEstimate` of a path (T, dof); `held_out`: by worlds no verdict has seen."""

    def tightened(self, level: int) -> Any:
        """The same checker with a stricter bound, None if there is none."""


@runtime_checkable
class SecondOpinion(Protocol):
    """Another judge of paths, see `vprism_plan.collision.MeshChecker`."""

    @property
    def robot(self) -> Any:
        """The robot, see `RobotLike`."""

    def review(self, checker: Any, path: Any) -> Any:
        """An opinion on a path (T, dof) that `checker` accepted: `valid` and `text()`."""


@runtime_checkable
class ReasonedReport(Protocol):
    """A verdict on a configuration that can say why, and what nobody has seen."""

    @property
    def valid(self) -> bool:
        """The verdict."""

    @property
    def shares(self) -> dict[str, float]:
        """Share of the robot's volume per kind of unseen space."""

    def text(self) -> str:
        """The verdict in one line."""
