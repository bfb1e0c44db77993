# SPDX-License-Identifier: BSD-3-Clause
"""Counts the posterior worlds in which a robot collides."""

import copy
import dataclasses
from collections import Counter
from collections.abc import Callable, Collection, Sequence

import numpy as np
from jaxtyping import Float, Int

from vprism_plan._kernels import checking, risk
from vprism_plan.collision._explain import nearest_source
from vprism_plan.collision._packing import pack_robot, pack_world
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
_PADDINGS = (0.5, 1.0, 2.0)  # voxels by which spheres grow when no world may collide any more
_HELD_OUT = 1_000_003  # added to the seed of the draws


@dataclasses.dataclass(frozen=True)
class Sweep:
    """Samples of a path and what they touch.

    Attributes:
        centers: (n, 3, S) sphere centres, metres.
        slack: (n, S) metres by which the spheres grow to cover the way to the next sample.
        waypoints: (T,) samples that are waypoints.
        touched: (n_worlds,) worlds that touch anything.
        counts: (n,) worlds that touch at each sample.
        first: (n_worlds,) sample of the first touch, -1 if none.
    """

    centers: Float[np.ndarray, "n 3 s"]
    slack: Float[np.ndarray, "n s"]
    waypoints: Int[np.ndarray, " t"]
    touched: np.ndarray
    counts: Int[np.ndarray, " n"]
    first: Int[np.ndarray, " w"]


class PathRisk:
    """A robot among the posterior worlds of one map.

    Args:
        world: a `vprism_plan.world.World` (`posterior_worlds` and `certain_field`).
        robot: whose paths are asked about.
        config: margin, worlds, seed and confidence.
        rules: object ids that may be touched, one set per contact rule.
        link_rules: (links,) the rule of each link.
    """

    def __init__(
        self,
        world: RuledWorld,
        robot: SphereRobot,
        config: CheckerConfig,
        rules: Sequence[Collection[int]],
        link_rules: Int[np.ndarray, " l"],
    ) -> None:
        self.config = config
        self._world, self._robot = world, robot
        arrays = robot.arrays
        moving = ~np.asarray(arrays.link_fixed)[arrays.sphere_link]
        self._radii = arrays.sphere_radius + config.margin
        largest = float(np.max(self._radii[moving], initial=0.0))
        resolution = float(world.field.spacing)
        # Room for a voxel and a half (the centre's offset, and the way between samples), and
        # for what `tightened` adds.
        room = 2.5 if config.max_risk is None else 2.5 + _PADDINGS[-1]
        self.worlds = world.posterior_worlds(
            config.n_worlds, config.risk_seed, reach=largest + room * resolution
        )
        self.spacing = min(resolution, 0.5 * world.map.kernel_length)
        self._voxel, self._steps = self.worlds.first, self.worlds.scale
        self._table_of = np.array([self.worlds.rule(ids) for ids in rules], dtype=np.int64)
        per_link = np.where(arrays.link_fixed, -1, self._table_of[link_rules])
        self._sphere_rules = per_link[arrays.sphere_link].astype(np.int64)
        self.fields: list[NodeField] = [world.certain_field(ids) for ids in rules]
        baked = pack_world(world, self.fields, config.margin)
        self.packed = baked.distance, baked.blocks, baked.floats
        # The world alone: no limits, no pairs.
        endless = np.full(robot.dof, np.inf)
        alone = dataclasses.replace(
            arrays, pairs=np.empty((0, 2), np.int64), lower=-endless, upper=endless
        )
        if (arrays.kind == 2).any():
            alone = dataclasses.replace(alone, lower=arrays.lower, upper=arrays.upper)
        packed = pack_robot(alone, rules=link_rules)
        self._rf, self._ri = packed.floats, packed.ints
        _open_limits(self._rf, self._ri)
        self._lower, self._upper = clopper_pearson(config.n_worlds, config.confidence)
        self._lower = np.maximum(self._lower - self.worlds.error_occupied, 0.0)
        self._upper = np.minimum(self._upper + self.worlds.error_free, 1.0)
        self._codes: SpaceCodes | None = None
        self._held_out: PathRisk | None = None
        self.allowed = 0
        if config.max_risk is not None:
            self.allowed = tolerated_hits(config.max_risk, self._upper, config.n_worlds)
            for ids in rules:
                self.worlds.bake(without=ids)

    def tightened(self, level: int) -> "PathRisk | None":
        """Return the same with a stricter bound on verdicts, None if there is none left.

        Halves the worlds that may collide, down to none, then grows the spheres by half, one
        and two voxels. What the stricter one accepts, this one accepts.
        """
        stricter = copy.copy(self)
        halvings = self.allowed.bit_length()  # after so many, none is left
        stricter.allowed = self.allowed >> min(level, halvings)
        if level > halvings:
            if level - halvings > len(_PADDINGS):
                return None
            stricter._radii = self._radii + _PADDINGS[level - halvings - 1] * self.worlds.resolution
        return stricter

    def held_out(self) -> "PathRisk":
        """Return the same with worlds that no verdict has seen."""
        if self._held_out is None:
            other = copy.copy(self)
            other.worlds = self.worlds.redrawn(self.worlds.seed + _HELD_OUT)
            self._held_out = other
        return self._held_out

    # --- counting ----------------------------------------------------------------------
    def sweep(self, path: Float[np.ndarray, "t dof"]) -> Sweep:
        """Sample a path and count the worlds that it touches."""
        if len(path) == 1:
            centers, slack = self._place(path)
            return Sweep(centers, slack, _FIRST, *self._touch(centers, slack))
        steps = np.empty(len(path) - 1, np.int64)
        n = int(checking.count_steps(path, self._rf, self._ri, self.spacing, steps)) + 1
        centers = np.empty((n, 3, len(self._radii)))
        slack = np.empty((n, len(self._radii)))
        checking.place_path(path, steps, self._rf, self._ri, centers, slack)
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
        worlds = self.worlds
        centers = np.empty((3, len(self._radii)))
        checking.place_spheres(q, self._rf, self._ri, centers)
        tables, (scale, reach) = worlds.tables, self._steps
        hits = risk.touch_one(
            centers, self._radii, self._sphere_rules, tables.distance_row, tables.rows,
            tables.lowest, tables.highest, self._voxel, worlds.resolution, scale, reach,
            np.zeros(worlds.n_worlds, np.uint8),
        )  # fmt: skip
        if hits < 0:  # the first to ask here: bake, then count
            hits = int(self._touch(centers[None], np.zeros((1, len(self._radii))))[1][0])
        return centers, hits

    def hits_each(self, Q: Float[np.ndarray, "n dof"]) -> Int[np.ndarray, " n"]:
        """Return `hits_at` of each row."""
        return self._touch(*self._place(Q))[1]

    def _place(
        self, Q: Float[np.ndarray, "n dof"]
    ) -> tuple[Float[np.ndarray, "n 3 s"], Float[np.ndarray, "n s"]]:
        """Sphere centres at each row, and no slack."""
        centers = np.empty((len(Q), 3, len(self._radii)))
        checking.place_spheres_batch(Q, self._rf, self._ri, centers)
        return centers, np.zeros((len(Q), len(self._radii)))

    def _touch(
        self, centers: Float[np.ndarray, "n 3 s"], slack: Float[np.ndarray, "n s"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        worlds = self.worlds
        scale, reach = worlds.scale
        while True:
            tables = worlds.tables
            touched = np.zeros(worlds.n_worlds, np.uint8)
            counts = np.empty(len(centers), np.int64)
            first = np.full(worlds.n_worlds, -1, np.int64)
            wanted = worlds.new_marks()
            missing = risk.touch(
                centers, slack, self._radii, self._sphere_rules, tables.distance_row,
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
        edge = -1 if checking.is_valid(q, self._rf, self._ri, *self.packed) else 0
        per_waypoint = np.array([1.0 if edge >= 0 else hits / self.worlds.n_worlds])

        def trace() -> tuple[FirstContact, ...]:
            path = q[None].copy()
            return self._first_contacts(path, self.sweep(path), edge, 0.0)

        return self._result(hits, edge, per_waypoint, centers[None], trace)

    def estimate(self, path: Float[np.ndarray, "t dof"]) -> RiskEstimate:
        """Return the joint probability of collision along a path."""
        sweep = self.sweep(path)
        clear = np.empty(len(path), np.bool_)
        checking.is_valid_batch(path, self._rf, self._ri, *self.packed, clear)
        stats = np.zeros(4)
        edge = checking.check_path(
            path, self._rf, self._ri, *self.packed, self.config.min_motion, stats
        )
        per_waypoint = sweep.counts[sweep.waypoints] / self.worlds.n_worlds
        per_waypoint[~clear] = 1.0
        kept, fraction = path.copy(), float(stats[0])

        def trace() -> tuple[FirstContact, ...]:
            return self._first_contacts(kept, sweep, edge, fraction)

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
        n = self.worlds.n_worlds
        return RiskEstimate(
            probability=1.0 if edge >= 0 else hits / n,
            lower=1.0 if edge >= 0 else float(self._lower[hits]),
            upper=1.0 if edge >= 0 else float(self._upper[hits]),
            confidence=self.config.confidence,
            n_worlds=n,
            seed=self.worlds.seed,
            per_waypoint=per_waypoint,
            certain=edge >= 0,
            spacing=self.spacing,
            configurations=len(centers),
            trace=trace,
            volume=lambda: self._shares(centers),
        )

    def contacts(self, q: Float[np.ndarray, "dof"]) -> tuple[Contact, ...]:
        """Return which links touch which objects in how many worlds, the most frequent first.

        Each world counts for its deepest contact alone, so the shares add up to the
        probability of collision.
        """
        sweep = self.sweep(q[None])
        n = self.worlds.n_worlds
        excess = float(self._upper[int(sweep.touched.sum())]) - float(self.config.max_risk or 0.0)
        found = []
        for (sphere, owner, _), count in self._touching(sweep, sweep.first).most_common():
            x, y, z = (float(v) for v in sweep.centers[0, :, sphere])
            found.append(
                Contact(
                    kind="risk",
                    link=self._robot.link_names[int(self._robot.sphere_links[sphere])],
                    body=f"object:{self._world.map.object_ids[owner - 1]}",
                    depth=excess,
                    sphere=sphere,
                    position=(x, y, z),
                    probability=count / n,
                    detail=f"upper bound of all {self._upper[int(sweep.touched.sum())]:.3f}, "
                    f"max_risk {self.config.max_risk}",
                )
            )
        return tuple(found)

    def _shares(self, centers: Float[np.ndarray, "n 3 s"]) -> dict[str, float]:
        if self._codes is None:
            self._codes = SpaceCodes(self._world)
        return self._codes.shares(centers, self._radii, self._sphere_rules)

    def _first_contacts(
        self, path: Float[np.ndarray, "t dof"], sweep: Sweep, edge: int, fraction: float
    ) -> tuple[FirstContact, ...]:
        """Rank what the worlds collide with first; certain obstacles stop all that are left."""
        if edge < 0 and not sweep.touched.any():
            return ()
        first = sweep.first.copy()
        n = len(first)
        found: Counter[tuple[str, str, int]] = Counter()
        if edge >= 0:
            start = int(sweep.waypoints[edge])
            stop = int(sweep.waypoints[min(edge + 1, len(sweep.waypoints) - 1)])
            late = (first < 0) | (first > start + fraction * (stop - start))
            body, link = self._certain_cause(path, edge, fraction)
            found[body, link, edge] = int(late.sum())
            first[late] = -1
        for (sphere, owner, sample), count in self._touching(sweep, first).items():
            link = self._robot.link_names[int(self._robot.sphere_links[sphere])]
            waypoint = int(np.searchsorted(sweep.waypoints, sample, side="right")) - 1
            body = f"object:{self._world.map.object_ids[owner - 1]}"
            found[body, link, waypoint] += count
        total = n if edge >= 0 else int(sweep.touched.sum())
        ranked = sorted(found.items(), key=lambda item: (-item[1], item[0]))
        return tuple(
            FirstContact(body, link, waypoint, count / total)
            for (body, link, waypoint), count in ranked
            if count > 0
        )

    def _touching(
        self, sweep: Sweep, first: Int[np.ndarray, " w"]
    ) -> Counter[tuple[int, int, int]]:
        """Count (sphere, owner, sample) of the first touch over the worlds."""
        n = len(first)
        sphere, owner = np.empty(n, np.int64), np.empty(n, np.int64)
        worlds, tables = self.worlds, self.worlds.tables
        rows, owners, origin = worlds.owner_tables
        scale, reach = worlds.scale
        risk.causes(
            sweep.centers, sweep.slack, self._radii, self._sphere_rules, tables.distance_row,
            tables.rows, worlds.first, worlds.resolution, scale, reach, first,
            worlds.counting(), rows, owners, origin, sphere, owner,
        )  # fmt: skip
        hit = np.flatnonzero(sphere >= 0)
        return Counter((int(sphere[s]), int(owner[s]), int(first[s])) for s in hit)

    def _certain_cause(
        self, path: Float[np.ndarray, "t dof"], edge: int, fraction: float
    ) -> tuple[str, str]:
        """Name the body and the link of the deepest certain contact at a point of an edge."""
        robot = self._robot
        qa, qb = path[edge], path[min(edge + 1, len(path) - 1)]
        turns = np.where(robot.continuous, np.round((qb - qa) / (2.0 * np.pi)), 0.0)
        q = qa + fraction * (qb - qa - 2.0 * np.pi * turns)
        n = len(self._radii)
        centers, plane, field = np.empty((3, n)), np.empty(n), np.empty(n)
        which = np.empty(n, np.int64)
        checking.sphere_clearances(
            q, self._rf, self._ri, *self.packed, centers, plane, which, field
        )
        gap = np.where(self._sphere_rules >= 0, np.minimum(plane, field), np.inf)
        s = int(np.argmin(gap))
        link = int(robot.sphere_links[s])
        if plane[s] <= field[s]:
            return self._world.plane_names[which[s]], robot.link_names[link]
        rule = int(np.flatnonzero(self._table_of == self._sphere_rules[s])[0])
        body, _ = nearest_source(self._world, self.fields[rule], centers[:, s])
        return body, robot.link_names[link]


def _open_limits(rf: Float[np.ndarray, " f"], ri: Int[np.ndarray, " i"]) -> None:
    """Let every joint value pass the limits of a packed robot."""
    start, dof = int(ri[19]), int(ri[4])
    rf[start : start + 2 * dof : 2] = -np.inf
    rf[start + 1 : start + 2 * dof : 2] = np.inf
