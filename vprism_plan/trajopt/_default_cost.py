# SPDX-License-Identifier: BSD-3-Clause
"""What `optimize` minimises when nobody says: short, smooth, and clear of what is refused."""

from functools import cached_property
from typing import Any

from vprism_plan.collision import CollisionChecker
from vprism_plan.errors import PlanningError
from vprism_plan.trajopt.cost import SumCost, TrajectoryCost
from vprism_plan.trajopt.joint_costs import JointLimitCost, SmoothnessCost
from vprism_plan.trajopt.risk_cost import RiskCost
from vprism_plan.trajopt.sphere_costs import ClearanceCost, SelfCollisionCost

_MARGIN = 0.02  # metres beyond the checker's margin from which obstacles push
_APART = 0.005  # the same of links from each other
_LIMITS = 0.02  # the same of joint limits, radians or metres
_CLEAR, _OWN, _WITHIN = 300.0, 300.0, 300.0  # weights against squared velocity
_RISK = 0.1  # the same of a risk that is as large as `max_risk`
_BEND = 1e-3  # weight of squared acceleration: corners cost, curves hardly do
_GROWTH = 0.005  # metres by which a repair's margin exceeds that of the one before


def has_world(checker: Any) -> bool:
    """Return whether costs can be made from a checker."""
    return isinstance(checker, CollisionChecker)


def default_cost(checker: Any, kept: float | None = None) -> TrajectoryCost:
    """Return the cost that `optimize` minimises if it is given none.

    Squared velocity (which makes paths short and waypoints even) and a little acceleration,
    plus clearance, self-collision and joint limits, each with a margin beyond what the
    checker refuses, so that a converged trajectory passes. If the checker bounds risk, the
    objects of the map enter as `RiskCost`, in the draws that edges are checked with: instead,
    or beside their level set where the bound is below the world's `level`.

    Args:
        checker: a `CollisionChecker`; its margins, allowed contacts and bound on risk count.
        kept: clearance, metres, that is to be kept, if that is more than the margin.

    Raises:
        PlanningError: the checker is something else.
    """
    return Defaults(checker, kept).cost()


class Defaults:
    """The default cost of a checker, and what repairs add to it.

    Args:
        checker, kept: see `default_cost`.

    Raises:
        PlanningError: see there.
    """

    def __init__(self, checker: Any, kept: float | None = None) -> None:
        if not has_world(checker):
            raise PlanningError(
                f"there is no default cost for a {type(checker).__name__}; pass `cost`, or use "
                "a CollisionChecker"
            )
        self._checker = checker
        beyond = 0.0 if kept is None else kept - float(checker.config.margin)
        self._margin = max(_MARGIN, beyond + 0.5 * _MARGIN)

    def cost(self) -> TrajectoryCost:
        """What is minimised."""
        smooth = SmoothnessCost(velocity=1.0, acceleration=_BEND, robot=self._checker.robot)
        return SumCost(smooth, *self._keep_off(self._margin))

    def guard(self, level: int) -> TrajectoryCost:
        """What repair number `level`, from 1, adds: all but smoothness, from farther away."""
        return SumCost(*self._keep_off(self._margin + _GROWTH * level))

    def _keep_off(self, margin: float) -> list[TrajectoryCost]:
        checker = self._checker
        return [
            ClearanceCost(checker, margin=margin, weight=_CLEAR),
            *self._risk,
            SelfCollisionCost(checker, margin=_APART, weight=_OWN),
            JointLimitCost(checker.robot, margin=_LIMITS, weight=_WITHIN),
        ]

    @cached_property
    def _risk(self) -> list[TrajectoryCost]:
        """What stands for the map's objects where the checker judges them by draws."""
        config = self._checker.config
        if config.max_risk is None:
            return []
        return [RiskCost(self._checker, seed=config.risk_seed, weight=_RISK / config.max_risk)]
