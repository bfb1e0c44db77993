# SPDX-License-Identifier: BSD-3-Clause
"""The collision checker: a robot's spheres against a world that knows what it has not seen."""

import copy
from dataclasses import replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float

from vprism_plan._arguments import number
from vprism_plan._kernels import checking as kernels
from vprism_plan._kernels.risk import DEEP, FREE
from vprism_plan._threads import run_chunked
from vprism_plan.collision import entropy, explain, margins, motion
from vprism_plan.collision.config import CheckerConfig, contact_rules
from vprism_plan.collision.packing import (
    MARGIN,
    Configuration,
    Numbers,
    PackedWorld,
    block_bounds,
    configuration,
    configurations,
    pack_robot,
    pack_world,
    waypoints,
    wider,
)
from vprism_plan.collision.reports import Contact, MotionReport, RiskEstimate
from vprism_plan.collision.risk import PathRisk, Setting, make_setting
from vprism_plan.errors import ConfigError
from vprism_plan.world.grid import Chosen, Values

_BATCH_CHUNK = 512
_CHORD = 0.002  # metres that anything moves along a chord of a rounded corner, at most
_ROUNDING = 1e-9  # metres: gaps below it come from rounding, not from sampling


class _AnyDraw:
    """Lower bounds of the distance to what any draw occupies, as far as it has been baked.

    Most of a path keeps away from all draws. That is proven by a few look-ups, as a clearance
    is, where counting the draws that an edge touches takes ten times as long.
    """

    def __init__(self, setting: Setting) -> None:
        self._worlds, self._rules = setting.worlds, setting.tables
        voxel, first = self._worlds.resolution, self._worlds.first
        self._frame = np.array([*(voxel * first), voxel, 0.0, 0.0, 0.0])
        self._known: tuple[Any, ...] = (None, None, (), ())

    def against(self, at: Setting) -> tuple[Any, ...]:
        """The robot with the radii of `at`, and the field, for the kernels."""
        tables, asked, field, answer = self._known
        now = self._worlds.tables
        if tables is not now or asked is not at:
            field = field if tables is now else self._packed(now)
            # A drawn voxel is a ball of at most a voxel, and `check_motion` accepts a motion that
            # is clear up to half of `min_motion`.
            grown = np.max(at.radii - at.robot.arrays.sphere_radius, initial=0.0)
            floats = self._frame.copy()
            floats[MARGIN] = grown + at.worlds.resolution + at.config.min_motion
            answer = at.floats, at.ints, *field, floats
            self._known = now, at, field, answer
        return answer

    def _packed(self, tables: Any) -> tuple[np.ndarray, np.ndarray]:
        voxel, (scale, reach) = self._worlds.resolution, self._worlds.scale
        # Whoever asks where nothing is baked has to count: that bakes it.
        steps = np.append(np.maximum(tables.lowest.astype(np.float32) - DEEP, 0.0), -np.inf)
        row = tables.distance_row[self._rules]
        drawn = steps[np.maximum(row, -1)] / np.float32(scale)
        bound = np.where(row == FREE, np.float32(reach), drawn) * np.float32(voxel * (1.0 - 1e-6))
        blocks = np.stack([block_bounds(one, voxel) for one in bound])
        return np.ascontiguousarray(bound, dtype=np.float32), blocks


class CollisionChecker(explain.Checker):
    """Answers whether configurations and edges of a robot are free of a world.

    A configuration is valid when its joints are within their limits, every collision sphere of
    every moving link keeps more than `config.margin` from the world, and every link pair that may
    collide keeps more than `config.self_margin`. All distances are lower bounds, so an error can
    only refuse. Links that no joint moves are not checked against the world: they stand on it. See
    `CheckerConfig` for `allowed_contacts` and `max_risk`.

    Construction compiles the kernels if they are not cached on disk (some twenty seconds, once per
    machine). Safe to share between threads; the kernels release the GIL. Single queries cost a
    microsecond or two of compiled code: O(frames + links), plus O(spheres) for the links whose
    bounding spheres come near something.

    Args:
        world: a `vprism_plan.World`, or anything that has its `field` (origin, spacing, distance
            and source at nodes), `planes`, `plane_names`, `sources`, `config` (the policies
            `occluded` and `unobserved`), `map.occupancy(points)` and `status(points)`. Contact
            rules and probabilities need a `World`; to any other a bound on risk means nothing more
            than its surfaces.
        robot: a `vprism_plan.Robot`.
        config: margins and tolerances.
    """

    def __init__(self, world: Any, robot: Any, config: CheckerConfig | None = None) -> None:
        if hasattr(world, "for_base") and hasattr(robot, "base_pose"):
            world = world.for_base(robot.base_pose[:3, 3])
        self.world = world
        self.robot = robot
        self.config = CheckerConfig() if config is None else config
        self._rules, self._link_rules = contact_rules(robot, self.config.allowed_contacts)
        self._rf, self._ri = pack_robot(robot.arrays, self.config.self_margin, self._link_rules)
        # What verdicts go by, under each contact rule.
        self.fields = [world.field]
        self.fields += [self._ruled_world().fields_without(ids) for ids in self._rules[1:]]
        # What `clearance` is measured to; verdicts are given by `_world`.
        self._surfaces = pack_world(world, self.fields, self.config.margin)
        self._world = self._surfaces
        self._bounded: PathRisk | None = None  # set when verdicts need it
        self._draws: Any = None
        posterior = hasattr(world, "certain_field") and hasattr(world.map, "sample_weights")
        if self.config.max_risk is not None and posterior:
            self._bounded = self._path_risk
            self._draws = _AnyDraw(self._bounded.setting)
            if self.config.max_risk >= world.config.level:
                self.fields, self._world = self._what_was_seen
        self._warm_up()

    @cached_property
    def _what_was_seen(self) -> tuple[list[Any], PackedWorld]:
        """What verdicts go by beside the draws where these judge the level set: what was seen.

        Touching a point that is occupied with at least the probability `level` breaks a bound below
        the level by itself; the draws, counted as the balls inside voxels, would alone let a
        planner shave millimetres off a surface that everybody sees.
        """
        fields = [self.world.certain_field(ids, seen=True) for ids in self._rules]
        return fields, pack_world(self.world, fields, self.config.margin)

    def _warm_up(self) -> None:
        """Ask every kernel once, so that none compiles inside a planner's time limit."""
        q = np.zeros(self.robot.dof)
        self.is_valid_batch(q[None])
        self.is_valid_buffer(q)
        self.clearance(q)
        self.check_motion_buffer(q, q)
        self.sphere_clearances(q)
        self.pair_gaps(q)

    def is_valid_buffer(self, q: Configuration) -> bool:
        """`is_valid` for planners' inner loops: q must be a contiguous float64 (dof,) array."""
        free = kernels.is_valid(q, self._rf, self._ri, *self._world)
        if not free or self._bounded is None:
            return bool(free)
        return kernels.is_valid(q, *self._far()) or self._bounded.accepts_one(q)

    def is_valid_batch(self, Q: Numbers) -> Chosen:
        """Return `is_valid` for each row of Q; runs on all worker threads."""
        Q = configurations(self.robot, Q)
        out = np.empty(len(Q), dtype=np.bool_)

        def work(part: slice) -> None:
            kernels.is_valid_batch(Q[part], self._rf, self._ri, *self._world, out[part])
            if self._bounded is not None:
                left = part.start + np.flatnonzero(out[part])
                kernels.is_valid_batch(Q[left], *self._far(), far := np.empty(len(left), np.bool_))
                left = left[~far]
                out[left] = self._bounded.accepts_each(Q[left])

        run_chunked(work, len(Q), _BATCH_CHUNK)
        return out

    def clearance(self, q: Numbers) -> float:
        """Return a lower bound of the distance from the robot to the world, metres.

        Negative when a sphere reaches into what the world makes an obstacle. The margin is not
        subtracted, and self-collision and joint limits do not enter. It is measured to the level
        set also when `max_risk` decides what is valid; a link's allowed contacts do not count.
        RobotError if q is not finite.
        """
        return float(self._clearances(configuration(self.robot, q)[None])[0][0])

    def clearance_batch(self, Q: Numbers) -> Values:
        """Return `clearance` for each row of Q, metres."""
        return self._clearances(Q)[0]

    def self_clearance_batch(self, Q: Numbers) -> Values:
        """Return the smallest gap between links that may collide, for each row of Q, metres."""
        return self._clearances(Q)[1]

    def check_motion_buffer(self, qa: Configuration, qb: Configuration) -> bool:
        """`check_motion` for contiguous float64 (dof,) arrays, without looking at shapes.

        Covered by conservative advancement on the clearances, with every link's displacement
        bounded from the kinematic chain. Where clearance is so small that the steps fall below
        `config.min_motion`, it samples: an accepted edge is free up to `config.tolerance` metres of
        motion. With `max_risk`, the worlds that collide anywhere on the edge must be few enough,
        too.
        """
        return self._check_motion(qa, qb, np.empty(4))

    def check_blend(self, qa: Numbers, corner: Numbers, qb: Numbers) -> bool:
        """Return whether a rounded corner is free: the parabola that leaves qa towards the corner,
        and comes to qb from it. Its chords are checked, with as much more margin as they may be
        left by, and links against each other at their ends, with what may happen between."""
        a, c, b = (configuration(self.robot, q) for q in (qa, corner, qb))
        arrays, sides = self.robot.arrays, np.abs(c - a) + np.abs(b - c)
        n = max(8, int(np.ceil(motion.motion_bounds(arrays, sides[None])[0][0] / _CHORD)))
        u = np.linspace(0.0, 1.0, n + 1)[:, None]
        curve = (1.0 - u) ** 2 * a + 2.0 * u * (1.0 - u) * c + u**2 * b
        off = np.abs(a - 2.0 * c + b) / (4.0 * n**2)
        gaps = motion.motion_bounds(arrays, np.abs(np.diff(curve, axis=0)) + 2.0 * off)[1]
        if (self.self_clearance_batch(curve[1:]) < self.config.self_margin + gaps).any():
            return False
        wider = self.with_extra_margin(float(motion.motion_bounds(arrays, off[None])[0][0]))
        return all(wider.check_motion(p, q) for p, q in pairwise(curve))

    def check_motion_report(self, qa: Numbers, qb: Numbers) -> MotionReport:
        """Return the verdict on an edge with its tolerance and, when refused, the reason."""
        qa, qb = configuration(self.robot, qa), configuration(self.robot, qb)
        stats = np.empty(4)
        valid = self._check_motion(qa, qb, stats)
        fraction: float | None = None
        state = risk = None
        if not valid and stats[0] >= 0.0:
            fraction = float(stats[0])
            state = self.explain(qa + fraction * (qb - qa))
        elif self._bounded is not None and not valid:
            edge = np.stack([qa, qb])
            risk, fraction = self._bounded.estimate(edge, True), self._bounded.exceeded_at(edge)
        return MotionReport(
            valid=valid,
            certified=valid and bool(stats[2] <= _ROUNDING),
            tolerance=0.5 * float(stats[2]),
            collision_fraction=fraction,
            configurations=int(stats[1]),
            motion_bound=float(stats[3]),
            state=state,
            risk=risk,
        )

    def tightened(self, level: int, ends: Any = None) -> "CollisionChecker | None":
        """Return a checker with a stricter bound on risk; None if there is no stricter one.

        Each edge of a path may be within `max_risk` and the path still above it. Level by level
        fewer worlds may collide with an edge, then none, then the spheres grow by up to two voxels.
        Worlds in which the robot collides at `ends` (n, dof), if they are given, are lost anyhow:
        what is left of the bound is for the others, and verdicts count these alone.
        Everything is shared with this checker, whose verdicts include those of the stricter one
        between such ends. ConfigError without a `max_risk`.
        """
        if self._bounded is None:
            raise ConfigError("max_risk is None; only a bound on risk can be tightened")
        ends = None if ends is None else configurations(self.robot, ends)
        bounded = self._bounded.tightened(level, ends)
        return None if bounded is None else self._with(_bounded=bounded)

    def with_extra_margin(self, extra: float) -> "CollisionChecker":
        """Return the same checker with `extra` metres more margin from surfaces.

        The bound on risk stays what it is: that of coming within this checker's own margin.
        Everything is shared.
        """
        number("extra", extra, 0.0, unit="metres: a margin can only be widened")
        other = self._with(
            config=replace(self.config, margin=self.config.margin + extra),
            _world=wider(self._world, extra),
        )
        vars(other).pop("_what_was_seen", None)  # packed with the margin
        return other

    def relaxed(self, max_risk: float) -> "CollisionChecker":
        """Return the same checker with another bound on risk, and with the level set left to the
        draws: what was seen, and what is certain, stays out of the question. ConfigError without
        a `max_risk`."""
        if self._bounded is None:
            raise ConfigError("max_risk is None; only a bound on risk can be relaxed")
        config = replace(self.config, max_risk=max_risk)
        fields, world = self._what_was_seen
        bounded = self._bounded.bounded_by(config)
        return self._with(config=config, _bounded=bounded, fields=fields, _world=world)

    def _with(self, **changes: Any) -> "CollisionChecker":
        other = copy.copy(self)
        vars(other).update(changes)
        return other

    def contacts(self, q: Numbers) -> tuple[Contact, ...]:
        """Return every reason to refuse q: the deepest contact of each link and body first,
        what `max_risk` refuses last."""
        q = configuration(self.robot, q)
        limits, bounded = explain.limit_contacts(self.robot, q), self._bounded
        if not np.isfinite(q).all():
            return tuple(limits)
        found = [*explain.world_contacts(self, q), *explain.self_contacts(self, q), *limits]
        risky = bounded is not None and not bounded.accepts_one(q)
        return (*explain.by_depth(found), *(bounded.contacts(q) if bounded and risky else ()))

    def _permitted(self, q: Configuration) -> list[Contact]:
        return explain.allowed_contacts(self, q)

    def _centers(self, q: Configuration) -> Float[np.ndarray, "s 3"]:
        return self.sphere_clearances(q)[0]

    def verdict_field(self, link: int) -> Any:
        """Return the distance field that verdicts check a link (index) against."""
        return self.fields[int(self._link_rules[link])]

    def allowed_objects(self, link: int) -> frozenset[int]:
        """Return the ids of the objects that a link (index) may touch."""
        return self._rules[int(self._link_rules[link])]

    def sphere_clearances(
        self, q: Configuration
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return each sphere's centre (S, 3) in the world; the distance to the nearest half-space
        and its index in `world.planes`; a lower bound of that to the baked obstacles. Metres."""
        n = int(self._ri[1])
        centers, plane, field = np.empty((3, n)), np.empty(n), np.empty(n)
        which = np.empty(n, dtype=np.int64)
        kernels.sphere_clearances(q, self._rf, self._ri, *self._world, centers, plane, which, field)
        return np.ascontiguousarray(centers.T), plane, which, field

    def pair_gaps(self, q: Configuration) -> tuple[np.ndarray, np.ndarray]:
        """Return the gap of each of `robot.collision_pairs`, metres, and the spheres (P, 2)."""
        n = int(self._ri[3])
        gaps, spheres = np.empty(n), np.zeros((n, 2), dtype=np.int64)
        kernels.pair_gaps(q, self._rf, self._ri, gaps, spheres)
        return gaps, spheres

    def _far(self) -> tuple[Any, ...]:
        """What tells the kernels whether a motion keeps clear of every draw."""
        assert self._bounded is not None
        return self._draws.against(self._bounded._kept)

    def _check_motion(self, qa: np.ndarray, qb: np.ndarray, stats: np.ndarray) -> bool:
        free = kernels.check_motion(
            qa, qb, self._rf, self._ri, *self._world, self.config.min_motion, stats
        )
        if not free or self._bounded is None:
            return bool(free)
        if kernels.check_motion(qa, qb, *self._far(), self.config.min_motion, np.empty(4)):
            return True
        return self._bounded.accepts(np.stack([qa, qb]))

    def _clearances(self, Q: Numbers) -> tuple[np.ndarray, np.ndarray]:
        Q = configurations(self.robot, Q, finite=True)
        world, own = np.empty(len(Q)), np.empty(len(Q))

        def work(part: slice) -> None:
            kernels.clearance_batch(
                Q[part], self._rf, self._ri, *self._surfaces, world[part], own[part]
            )

        run_chunked(work, len(Q), _BATCH_CHUNK)
        return world, own

    safety_margin = margins.safety_margin
    min_clearance = motion.min_clearance
    max_safe_motion = motion.max_safe_motion
    path_entropy = entropy.path_entropy

    @property
    def max_risk(self) -> float | None:
        """Bound on the probability of collision of what is valid, or None."""
        return None if self._bounded is None else self._bounded.setting.config.max_risk

    def collision_probability(self, path: Numbers, held_out: bool = False) -> RiskEstimate:
        """Return the probability that a path (T, dof), or a configuration (dof,), touches anything.

        The share of worlds, drawn from the map's posterior, in which any sphere of any moving link
        touches an occupied voxel that it may not touch, or a certain obstacle, anywhere on the
        path: the same world for the whole path. Edges are straight in joint space and swept without
        gaps. Margin, self-collision and joint limits do not enter. RobotError as for
        `packing.waypoints`.

        With `held_out` other worlds are asked than those that `max_risk` is checked with: a path
        that a planner found with this checker was selected by those, so their verdict on it is too
        mild.
        """
        rows = waypoints(self.robot, path, single=True)
        risk = self._path_risk
        return (risk.held_out if held_out else risk).estimate(rows)

    def _ruled_world(self) -> Any:
        if not hasattr(self.world, "certain_field"):
            raise ConfigError(
                f"probabilities and allowed contacts need a vprism_plan.World; "
                f"{type(self.world).__name__} has no posterior and no fields per object"
            )
        return self.world

    @cached_property
    def _path_risk(self) -> PathRisk:
        """Made when it is asked for; if two threads ask at once, twice, of the same draws."""
        world = self._ruled_world()
        return PathRisk(make_setting(world, self.robot, self.config, self._rules, self._link_rules))

    def risk_setting(self, held_out: bool = False) -> Setting:
        """Return what probabilities are counted with; `held_out` as in `collision_probability`."""
        risk = self._path_risk
        return (risk.held_out if held_out else risk).setting
