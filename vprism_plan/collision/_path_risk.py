# SPDX-License-Identifier: BSD-3-Clause
"""Counts the posterior worlds in which a robot collides."""

import copy
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from vprism_plan._kernels import checking
from vprism_plan.collision._causes import first_contacts, risky_contacts
from vprism_plan.collision._counting import count_at, count_each, count_path, recount
from vprism_plan.collision._risk_setting import (
    CORNER,
    PADDINGS,
    Setting,
    grown,
    make_setting,
    with_margin,
)
from vprism_plan.collision._unsupported import SpaceCodes
from vprism_plan.collision.config import CheckerConfig
from vprism_plan.collision.protocols import NodeField, RuledWorld, SphereRobot
from vprism_plan.collision.reports import Contact
from vprism_plan.collision.risk import RiskEstimate, clopper_pearson, tolerated_hits

_HELD_OUT = 1_000_003  # added to the seed of the draws


class PathRisk:
    """A robot among the posterior worlds of one map; see `make_setting` for the arguments.

    Attributes:
        allowed: how many worlds may collide with what is valid, under `config.max_risk`.
    """

    def __init__(
        self,
        world: RuledWorld,
        robot: SphereRobot,
        config: CheckerConfig,
        rules: Sequence[Collection[int]],
        link_rules: Int[np.ndarray, " l"],
    ) -> None:
        # Probabilities are of touching; verdicts keep the margin as well, and touch a voxel
        # at its corners.
        self._at = make_setting(world, robot, config, rules, link_rules)
        self._corners = grown(self._at, CORNER)
        self._kept = grown(with_margin(self._at, config.margin), CORNER)
        worlds = self._at.worlds
        lower, upper = clopper_pearson(config.n_worlds, config.confidence)
        self._lower = np.maximum(lower - worlds.error_occupied, 0.0)
        # Where something may be touched, a voxel said to be its own may hide another object.
        hidden = worlds.error_free + (worlds.error_occupied if any(rules) else 0.0)
        self._upper = np.minimum(upper + hidden, 1.0)
        self._codes: SpaceCodes | None = None
        self._held_out: PathRisk | None = None
        self.allowed = 0
        if config.max_risk is not None:
            self.allowed = tolerated_hits(config.max_risk, self._upper, config.n_worlds)
            for ids in rules:
                worlds.bake(without=ids)

    @property
    def setting(self) -> Setting:
        """What probabilities of touching are counted with."""
        return self._at

    @property
    def fields(self) -> list[NodeField]:
        """Distance to the certain obstacles, one per contact rule."""
        return list(self._at.fields)

    @property
    def packed(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The same for the kernels, with the margin."""
        return self._kept.packed

    def tightened(self, level: int) -> "PathRisk | None":
        """Return the same with a stricter bound on verdicts, None if there is none left.

        Halves the worlds that may collide, down to none, then grows the spheres by half, one
        and two voxels. What the stricter one accepts, this one accepts.
        """
        stricter = copy.copy(self)
        halvings = self.allowed.bit_length()  # after so many, none is left
        stricter.allowed = self.allowed >> min(level, halvings)
        if level > halvings:
            if level - halvings > len(PADDINGS):
                return None
            stricter._kept = grown(self._kept, PADDINGS[level - halvings - 1])
        return stricter

    def held_out(self) -> "PathRisk":
        """Return the same with worlds that no verdict has seen."""
        if self._held_out is None:
            other = copy.copy(self)
            worlds = self._at.worlds
            other._at = replace(self._at, worlds=worlds.redrawn(worlds.seed + _HELD_OUT))
            other._corners = grown(other._at, CORNER)
            self._held_out = other
        return self._held_out

    # --- verdicts ----------------------------------------------------------------------
    def hits(self, path: Float[np.ndarray, "t dof"]) -> int:
        """Return how many worlds come within the margin anywhere on a path, certain obstacles
        aside."""
        return int(count_path(self._kept, path).touched.sum())

    def hits_at(self, q: Float[np.ndarray, "dof"]) -> int:
        """Return how many worlds come within the margin of a configuration."""
        return count_at(self._kept, q)[1]

    def hits_each(self, Q: Float[np.ndarray, "n dof"]) -> Int[np.ndarray, " n"]:
        """Return `hits_at` of each row."""
        return count_each(self._kept, Q).counts

    def exceeded_at(self, edge: Float[np.ndarray, "2 dof"]) -> float:
        """Return where along an edge, 0 to 1, more worlds have collided than are allowed."""
        sweep = count_path(self._kept, edge)
        first = np.sort(sweep.first[sweep.first >= 0])
        return float(first[self.allowed]) / max(1, len(sweep.counts) - 1)

    def contacts(self, q: Float[np.ndarray, "dof"]) -> tuple[Contact, ...]:
        """Return which links touch which objects in how many worlds, the most frequent first."""
        sweep = count_path(self._kept, q[None])
        return risky_contacts(self._kept, sweep, float(self._upper[int(sweep.touched.sum())]))

    # --- estimates ---------------------------------------------------------------------
    def estimate(self, path: Float[np.ndarray, "t dof"], with_margin: bool = False) -> RiskEstimate:
        """Return the joint probability of collision along a path, or of coming within the
        margin; of a configuration, where the path has one row."""
        at = grown(self._kept, -CORNER) if with_margin else self._at
        path = path.copy()
        n, inside = at.worlds.n_worlds, 0
        around = sweep = count_path(self._kept if with_margin else self._corners, path)
        if around.touched.any():
            sweep = recount(at, around)
            # A draw that occupies the centre of a voxel occupies that point, whatever voxels are.
            inside = int(recount(grown(at, -0.5), around, within=True).touched.sum())
        clear = np.empty(len(path), np.bool_)
        checking.is_valid_batch(path, at.floats, at.ints, *at.packed, clear)
        stats = np.zeros(4)
        edge = -1 if clear.all() else 0
        if len(path) > 1:
            edge = checking.check_path(
                path, at.floats, at.ints, *at.packed, at.config.min_motion, stats
            )
        certain = edge >= 0
        per_waypoint = sweep.counts[sweep.waypoints] / n
        per_waypoint[~clear] = 1.0
        return RiskEstimate(
            probability=1.0 if certain else float(sweep.touched.sum()) / n,
            lower=1.0 if certain else float(self._lower[inside]),
            upper=1.0 if certain else float(self._upper[int(around.touched.sum())]),
            confidence=at.config.confidence,
            n_worlds=n,
            seed=at.worlds.seed,
            per_waypoint=per_waypoint,
            certain=certain,
            spacing=at.spacing,
            configurations=len(sweep.centers),
            trace=lambda: first_contacts(at, path, sweep, edge, float(stats[0])),
            volume=lambda: self._shares(at, sweep.centers),
        )

    def _shares(self, at: Setting, centers: Float[np.ndarray, "n 3 s"]) -> dict[str, float]:
        if self._codes is None:
            self._codes = SpaceCodes(at.world)
        return self._codes.shares(centers, at.radii, at.sphere_tables)
