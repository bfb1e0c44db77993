# SPDX-License-Identifier: BSD-3-Clause
"""Counts the posterior worlds in which a robot collides."""

import copy
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from vprism_plan._kernels import checking, risk
from vprism_plan.collision._causes import Sweep, first_contacts, risky_contacts
from vprism_plan.collision._risk_setting import PADDINGS, make_setting
from vprism_plan.collision._unsupported import SpaceCodes
from vprism_plan.collision.config import CheckerConfig
from vprism_plan.collision.protocols import NodeField, RuledWorld, SphereRobot
from vprism_plan.collision.reports import Contact
from vprism_plan.collision.risk import (
    FirstContact,
    RiskEstimate,
    clopper_pearson,
    tolerated_hits,
)

_FIRST = np.zeros(1, np.int64)
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
        self._at = make_setting(world, robot, config, rules, link_rules)
        worlds = self._at.worlds
        self._voxel, self._steps = worlds.first, worlds.scale
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
    def fields(self) -> list[NodeField]:
        """Distance to the certain obstacles, one per contact rule."""
        return list(self._at.fields)

    @property
    def packed(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The same for the kernels."""
        return self._at.packed

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
            grown = PADDINGS[level - halvings - 1] * self._at.worlds.resolution
            stricter._at = replace(self._at, radii=self._at.radii + grown)
        return stricter

    def held_out(self) -> "PathRisk":
        """Return the same with worlds that no verdict has seen."""
        if self._held_out is None:
            other = copy.copy(self)
            worlds = self._at.worlds
            other._at = replace(self._at, worlds=worlds.redrawn(worlds.seed + _HELD_OUT))
            self._held_out = other
        return self._held_out

    # --- counting ----------------------------------------------------------------------
    def sweep(self, path: Float[np.ndarray, "t dof"]) -> Sweep:
        """Sample a path and count the worlds that it touches."""
        if len(path) == 1:
            centers, slack = self._place(path)
            return Sweep(centers, slack, _FIRST, *self._touch(centers, slack))
        at = self._at
        steps = np.empty(len(path) - 1, np.int64)
        n = int(checking.count_steps(path, at.floats, at.ints, at.spacing, steps)) + 1
        centers = np.empty((n, 3, len(at.radii)))
        slack = np.empty((n, len(at.radii)))
        checking.place_path(path, steps, at.floats, at.ints, centers, slack)
        touched, counts, first = self._touch(centers, slack)
        waypoints = np.concatenate(([0], np.cumsum(steps)))
        return Sweep(centers, slack, waypoints, touched, counts, first)

    def hits(self, path: Float[np.ndarray, "t dof"]) -> int:
        """Return how many worlds collide anywhere on a path, certain obstacles aside."""
        return int(self.sweep(path).touched.sum())

    def exceeded_at(self, edge: Float[np.ndarray, "2 dof"]) -> float:
        """Return where along an edge, 0 to 1, more worlds have collided than are allowed."""
        sweep = self.sweep(edge)
        first = np.sort(sweep.first[sweep.first >= 0])
        return float(first[self.allowed]) / max(1, len(sweep.counts) - 1)

    def hits_at(self, q: Float[np.ndarray, "dof"]) -> int:
        """Return how many worlds collide at a configuration, certain obstacles aside."""
        return self._touch_at(q)[1]

    def _touch_at(self, q: Float[np.ndarray, "dof"]) -> tuple[Float[np.ndarray, "3 s"], int]:
        """Sphere centres at a configuration, and how many worlds they touch."""
        worlds = self._at.worlds
        centers = np.empty((3, len(self._at.radii)))
        checking.place_spheres(q, self._at.floats, self._at.ints, centers)
        tables, (scale, reach) = worlds.tables, self._steps
        hits = risk.touch_one(
            centers, self._at.radii, self._at.sphere_tables, tables.distance_row, tables.rows,
            tables.lowest, tables.highest, self._voxel, worlds.resolution, scale, reach,
            np.zeros(worlds.n_worlds, np.uint8),
        )  # fmt: skip
        if hits < 0:  # the first to ask here: bake, then count
            hits = int(self._touch(centers[None], np.zeros((1, len(self._at.radii))))[1][0])
        return centers, hits

    def hits_each(self, Q: Float[np.ndarray, "n dof"]) -> Int[np.ndarray, " n"]:
        """Return `hits_at` of each row."""
        return self._touch(*self._place(Q))[1]

    def _place(
        self, Q: Float[np.ndarray, "n dof"]
    ) -> tuple[Float[np.ndarray, "n 3 s"], Float[np.ndarray, "n s"]]:
        """Sphere centres at each row, and no slack."""
        centers = np.empty((len(Q), 3, len(self._at.radii)))
        checking.place_spheres_batch(Q, self._at.floats, self._at.ints, centers)
        return centers, np.zeros((len(Q), len(self._at.radii)))

    def _touch(
        self, centers: Float[np.ndarray, "n 3 s"], slack: Float[np.ndarray, "n s"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        worlds = self._at.worlds
        scale, reach = worlds.scale
        while True:
            tables = worlds.tables
            touched = np.zeros(worlds.n_worlds, np.uint8)
            counts = np.empty(len(centers), np.int64)
            first = np.full(worlds.n_worlds, -1, np.int64)
            wanted = worlds.new_marks()
            missing = risk.touch(
                centers, slack, self._at.radii, self._at.sphere_tables, tables.distance_row,
                tables.rows, tables.lowest, tables.highest, worlds.first, worlds.resolution,
                scale, reach, touched, counts, first, wanted,
            )  # fmt: skip
            if not missing:
                return touched, counts, first
            worlds.bake_marked(wanted)

    # --- estimates ---------------------------------------------------------------------
    def estimate_at(self, q: Float[np.ndarray, "dof"]) -> RiskEstimate:
        """Return the probability of collision at a configuration."""
        centers, hits = self._touch_at(q)
        edge = -1 if checking.is_valid(q, self._at.floats, self._at.ints, *self._at.packed) else 0
        per_waypoint = np.array([1.0 if edge >= 0 else hits / self._at.worlds.n_worlds])

        def trace() -> tuple[FirstContact, ...]:
            path = q[None].copy()
            return first_contacts(self._at, path, self.sweep(path), edge, 0.0)

        return self._result(hits, edge, per_waypoint, centers[None], trace)

    def estimate(self, path: Float[np.ndarray, "t dof"]) -> RiskEstimate:
        """Return the joint probability of collision along a path."""
        at, sweep = self._at, self.sweep(path)
        clear = np.empty(len(path), np.bool_)
        checking.is_valid_batch(path, at.floats, at.ints, *at.packed, clear)
        stats = np.zeros(4)
        edge = checking.check_path(
            path, at.floats, at.ints, *at.packed, at.config.min_motion, stats
        )
        per_waypoint = sweep.counts[sweep.waypoints] / at.worlds.n_worlds
        per_waypoint[~clear] = 1.0
        kept, fraction = path.copy(), float(stats[0])

        def trace() -> tuple[FirstContact, ...]:
            return first_contacts(self._at, kept, sweep, edge, fraction)

        hits = int(sweep.touched.sum())
        return self._result(hits, edge, per_waypoint, sweep.centers, trace)

    def _result(
        self,
        hits: int,
        edge: int,
        per_waypoint: Float[np.ndarray, " t"],
        centers: Float[np.ndarray, "n 3 s"],
        trace: Callable[[], tuple[FirstContact, ...]],
    ) -> RiskEstimate:
        n = self._at.worlds.n_worlds
        return RiskEstimate(
            probability=1.0 if edge >= 0 else hits / n,
            lower=1.0 if edge >= 0 else float(self._lower[hits]),
            upper=1.0 if edge >= 0 else float(self._upper[hits]),
            confidence=self._at.config.confidence,
            n_worlds=n,
            seed=self._at.worlds.seed,
            per_waypoint=per_waypoint,
            certain=edge >= 0,
            spacing=self._at.spacing,
            configurations=len(centers),
            trace=trace,
            volume=lambda: self._shares(centers),
        )

    def contacts(self, q: Float[np.ndarray, "dof"]) -> tuple[Contact, ...]:
        """Return which links touch which objects in how many worlds, the most frequent first."""
        sweep = self.sweep(q[None])
        return risky_contacts(self._at, sweep, float(self._upper[int(sweep.touched.sum())]))

    def _shares(self, centers: Float[np.ndarray, "n 3 s"]) -> dict[str, float]:
        if self._codes is None:
            self._codes = SpaceCodes(self._at.world)
        return self._codes.shares(centers, self._at.radii, self._at.sphere_tables)
