# SPDX-License-Identifier: BSD-3-Clause
"""What a checker answers beyond yes and no: probabilities, margins, uncertainty."""

import threading

import numpy as np
from jaxtyping import Float, Int

from vprism_plan.collision._packing import require_prismatic_limits
from vprism_plan.collision._path_risk import PathRisk
from vprism_plan.collision._risk_setting import Setting
from vprism_plan.collision._travel import refuse_far
from vprism_plan.collision.config import CheckerConfig
from vprism_plan.collision.entropy import PathEntropy, path_entropy
from vprism_plan.collision.margin_reports import SafetyMargins
from vprism_plan.collision.margins import safety_margin
from vprism_plan.collision.path_margins import (
    PathClearance,
    SafeMotion,
    max_safe_motion,
    min_clearance,
)
from vprism_plan.collision.protocols import BakedWorld, Numbers, RuledWorld, SphereRobot
from vprism_plan.collision.reports import Contact
from vprism_plan.collision.risk import RiskEstimate
from vprism_plan.errors import ConfigError, RobotError
from vprism_plan.robots.kinematics import joint_values


class Queries:
    """The part of `CollisionChecker` that planners' inner loops do not touch."""

    world: BakedWorld
    robot: SphereRobot
    config: CheckerConfig
    _dof: int
    _slides: bool
    _rules: list[frozenset[int]]
    _link_rules: Int[np.ndarray, " links"]
    _lock: threading.Lock
    _path_risk: PathRisk | None
    _bounded: PathRisk | None

    # --- margins -----------------------------------------------------------------------
    def safety_margin(self, q_or_path: Numbers, tolerance: float = 0.002) -> SafetyMargins:
        """Return the margin of every link to every obstacle; see `margins.safety_margin`."""
        return safety_margin(self, q_or_path, tolerance)

    def min_clearance(self, path: Numbers, tolerance: float = 0.0005) -> PathClearance:
        """Return a bound on the clearance over a path; see `path_margins.min_clearance`."""
        return min_clearance(self, path, tolerance)

    def max_safe_motion(self, q: Numbers, dq: Numbers, tolerance: float = 0.0005) -> SafeMotion:
        """Return how far along dq stays safe; see `path_margins.max_safe_motion`."""
        return max_safe_motion(self, q, dq, tolerance)

    def path_entropy(self, q_or_path: Numbers, resolution: float = 0.01) -> PathEntropy:
        """Return the map's entropy where the robot sweeps; see `entropy.path_entropy`."""
        return path_entropy(self, q_or_path, resolution)

    # --- risk --------------------------------------------------------------------------
    @property
    def max_risk(self) -> float | None:
        """Bound on the probability of collision of what is valid, or None."""
        return self.config.max_risk

    def collision_probability(self, path: Numbers, held_out: bool = False) -> RiskEstimate:
        """Return the probability that a path (or a configuration) touches anything.

        The share of worlds, drawn from the map's posterior, in which any sphere of any
        moving link touches an occupied voxel that it may not touch, or a certain obstacle,
        anywhere on the path: the same world for the whole path. Edges are straight in joint
        space and swept without gaps. Margin, self-collision and joint limits do not enter.

        Args:
            path: (T, dof) waypoints, or (dof,) one configuration, radians or metres.
            held_out: ask other worlds than those that `max_risk` is checked with. A path
                that a planner found with this checker was selected by the worlds it was
                checked with, so their verdict on it is too mild.

        Raises:
            RobotError: a wrong shape, a value that is not finite, or a prismatic joint
                outside its limits (no bound on the motion holds there).
        """
        array = joint_values(path, self.robot, "a path")
        rows = array[None] if array.ndim == 1 else array
        if rows.ndim != 2 or rows.shape[1] != self._dof or len(rows) == 0:
            raise RobotError(
                f"path has shape {array.shape}; {self.robot.name} needs (T, {self._dof}) or "
                f"({self._dof},): {', '.join(self.robot.joint_names)}"
            )
        refuse_far(rows, "waypoint")
        if self._slides:
            require_prismatic_limits(self.robot, rows)
        risk = self._risk()
        if held_out:
            risk = risk.held_out()
        return risk.estimate(rows)

    def _ruled_world(self) -> RuledWorld:
        if not isinstance(self.world, RuledWorld):
            raise ConfigError(
                f"probabilities and allowed contacts need a vprism_plan.World; "
                f"{type(self.world).__name__} has no posterior and no fields per object"
            )
        return self.world

    def _risk(self) -> PathRisk:
        with self._lock:
            if self._path_risk is None:
                self._path_risk = PathRisk(
                    self._ruled_world(), self.robot, self.config, self._rules, self._link_rules
                )
            return self._path_risk

    def risk_setting(self) -> Setting:
        """Return what probabilities are counted with, for planners' objectives."""
        return self._risk().setting

    def risk_contacts(self, q: Float[np.ndarray, "dof"]) -> tuple[Contact, ...]:
        """Return what makes a configuration too risky; empty if it is not, or has no bound."""
        bounded = self._bounded
        if bounded is None or bounded.hits_at(q) <= bounded.allowed:
            return ()
        return bounded.contacts(q)
