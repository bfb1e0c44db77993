# SPDX-License-Identifier: BSD-3-Clause
"""What `optimize` minimises when nobody says: short, smooth, and clear of what is refused."""

from typing import Any

from vprism_plan.collision import CollisionChecker
from vprism_plan.errors import PlanningError
from vprism_plan.trajopt.clearance import ClearanceCost
from vprism_plan.trajopt.cost import SumCost, TrajectoryCost
from vprism_plan.trajopt.joint_costs import JointLimitCost, SmoothnessCost
from vprism_plan.trajopt.self_collision import SelfCollisionCost

_MARGIN = 0.02  # metres beyond the checker's margin from which obstacles push
_APART = 0.005  # the same of links from each other
_LIMITS = 0.02  # the same of joint limits, radians or metres
_CLEAR, _OWN, _WITHIN = 300.0, 300.0, 300.0  # weights against squared velocity
_BEND = 1e-3  # weight of squared acceleration: corners cost, curves hardly do
_GROWTH = 0.005  # metres by which a repair's margin exceeds that of the one before


def has_world(checker: Any) -> bool:
    """Return whether costs can be made from a checker."""
    return isinstance(checker, CollisionChecker)


def default_cost(checker: Any, kept: float | None = None) -> TrajectoryCost:
    """Return the cost that `optimize` minimises if it is given none.

    Squared velocity (which makes paths short and waypoints even) and a little acceleration,
    plus clearance, self-collision and joint limits, each with a margin beyond what the
    checker refuses, so that a converged trajectory passes.

    Args:
        checker: a `CollisionChecker`; its margins, allowed contacts and bound on risk count.
        kept: clearance, metres, that is to be kept, if that is more than the margin.

    Raises:
        PlanningError: the checker is something else.
    """
    if not has_world(checker):
        raise PlanningError(
            f"there is no default cost for a {type(checker).__name__}; pass `cost`, or use a "
            "CollisionChecker"
        )
    smooth = SmoothnessCost(velocity=1.0, acceleration=_BEND, robot=checker.robot)
    return SumCost(smooth, *_keep_off(checker, _beyond(checker, kept)))


def default_guard(checker: Any, level: int, kept: float | None = None) -> TrajectoryCost:
    """Return what repair number `level`, from 1, adds: the same with a larger margin."""
    return SumCost(*_keep_off(checker, _beyond(checker, kept) + _GROWTH * level))


def _beyond(checker: Any, kept: float | None) -> float:
    """Metres, beyond the checker's margin, from which obstacles push."""
    if kept is None:
        return _MARGIN
    return max(_MARGIN, kept - float(checker.config.margin) + 0.5 * _MARGIN)


def _keep_off(checker: Any, margin: float) -> list[TrajectoryCost]:
    return [
        ClearanceCost(checker, margin=margin, weight=_CLEAR),
        SelfCollisionCost(checker, margin=_APART, weight=_OWN),
        JointLimitCost(checker.robot, margin=_LIMITS, weight=_WITHIN),
    ]
