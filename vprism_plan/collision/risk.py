# SPDX-License-Identifier: BSD-3-Clause
"""A robot among the worlds drawn from a map: which of them it touches, verdicts by a bound on
the probability that it collides, and estimates of that."""

import copy
import math
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.special import betaincinv

from vprism_plan._kernels import checking, risk
from vprism_plan.collision.config import CheckerConfig
from vprism_plan.collision.explain import nearest_source, unit_ball_points, volume_shares
from vprism_plan.collision.packing import (
    AT_MOST,
    Configuration,
    Rows,
    Waypoints,
    pack_robot,
    pack_world,
    wider,
)
from vprism_plan.collision.reports import Contact, FirstContact, RiskEstimate, as_point
from vprism_plan.errors import ConfigError, RobotError
from vprism_plan.world import PosteriorWorlds
from vprism_plan.world.grid import Chosen
from vprism_plan.world.posterior_worlds import MAX_REACH

_HELD_OUT = 1_000_003  # added to the seed of the draws
_MAX_SAMPLES, _POINTS = 64, 8  # of a path, and in each ball at these, for what nobody has seen
# Voxels by which spheres may grow when no world may collide any more (`PathRisk.tightened`).
PADDINGS = (0.5, 1.0, 2.0)
# Voxels by which a draw's surface may lie off where its voxels put it.
BLUR = 0.25
# Voxels between a sphere's surface and the farthest voxel it is compared with: the way to
# the far node of its centre's cell, the deepest that a voxel's centre lies in an object, at most
# five eighths for the way between samples, and room to spare.
_ROOM = 3.5 + BLUR
_FINER, _REFINEMENTS = 4, 3  # samples of an edge, each time; its spheres grow by a 16th
_UNDECIDED = 0.01  # share of worlds that only the way between samples touches


class Certain:
    """What is an obstacle in every world, under each contact rule; baked when it is asked for:
    that takes longer than drawing worlds, and who only counts draws never asks."""

    def __init__(self, world: Any, rules: Sequence[Collection[int]]) -> None:
        self._world, self.rules = world, tuple(rules)

    @cached_property
    def fields(self) -> list[Any]:
        """Distance to it, one field per contact rule."""
        return [self._world.certain_field(ids) for ids in self.rules]

    @cached_property
    def packed(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The same for the kernels: distances, block bounds, floats."""
        return pack_world(self._world, self.fields, 0.0)


@dataclass(frozen=True, eq=False)
class Setting:
    """A robot among the worlds of one map.

    Attributes:
        floats, ints: the robot for the kernels, without joint limits and link pairs.
    """

    world: Any
    robot: Any
    config: CheckerConfig
    worlds: PosteriorWorlds
    radii: Float[np.ndarray, " s"]  # metres
    tables: Int[np.ndarray, " g"]  # the table of `worlds` that holds for each contact rule
    sphere_tables: Int[np.ndarray, " s"]  # the table that holds for each sphere; -1 is not checked
    certain: Certain  # what is an obstacle in every world
    floats: Float[np.ndarray, " f"]
    ints: Int[np.ndarray, " i"]
    spacing: float  # no sphere centre moves more than this between two samples, metres
    margin: float = 0.0  # metres to keep from what is certain; in `radii` already

    @cached_property
    def packed(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The same for the kernels, with the margin: distances, block bounds, floats."""
        return wider(self.certain.packed, self.margin)


def grown(setting: Setting, voxels: float) -> Setting:
    """Return the same for spheres larger by some voxels (smaller, if negative) in the draws."""
    return replace(setting, radii=setting.radii + voxels * setting.worlds.resolution)


def make_setting(
    world: Any,
    robot: Any,
    config: CheckerConfig,
    rules: Sequence[Collection[int]],
    link_rules: Int[np.ndarray, " l"],
) -> Setting:
    """Put a setting together from `config.contact_rules`."""
    arrays = robot.arrays
    moving = ~np.asarray(arrays.link_fixed)[arrays.sphere_link]
    radii = arrays.sphere_radius.copy()  # kernels get it
    resolution = float(world.field.spacing)
    room = _ROOM if config.max_risk is None else _ROOM + PADDINGS[-1]
    largest = float(np.max(radii[moving], initial=0.0)) + config.margin
    # Larger balls than the kernels' squares of distances can hold need coarser voxels.
    resolution *= max(1, math.ceil(largest / ((MAX_REACH - room) * resolution)))
    worlds = world.posterior_worlds(
        config.n_worlds, config.risk_seed, largest + room * resolution, resolution
    )
    tables = np.array([worlds.rule(ids) for ids in rules], dtype=np.int64)
    per_link = np.where(arrays.link_fixed, -1, tables[link_rules])
    alone = replace(arrays, pairs=np.empty((0, 2), np.int64))
    floats, ints = pack_robot(alone, rules=link_rules)
    limits = floats[ints[19] :][: 2 * ints[4]]
    limits[0::2], limits[1::2] = -np.inf, np.inf  # whatever the joint values, spheres collide
    spacing = min(resolution, 0.5 * float(world.map.kernel_length))
    return Setting(
        world, robot, config, worlds, radii, tables, per_link[arrays.sphere_link].astype(np.int64),
        Certain(world, rules), floats, ints, spacing,
    )  # fmt: skip


@dataclass(frozen=True)
class Sweep:
    """Samples of a path and what they touch."""

    centers: Float[np.ndarray, "n 3 s"]  # sphere centres, metres
    # metres by which the spheres grow to cover the way to the next sample
    slack: Float[np.ndarray, "n s"]
    waypoints: Int[np.ndarray, " t"]  # samples that are waypoints
    touched: np.ndarray  # worlds that touch anything
    counts: Int[np.ndarray, " n"]  # worlds that touch at each sample
    first: Int[np.ndarray, " w"]  # sample of the first touch, -1 if none


def count_path(at: Setting, path: Waypoints, enough: int = 0) -> Sweep:
    """Sample a path without gaps and count the worlds that it touches.

    Spheres grow by what covers the way to the next sample, which counts worlds whose surfaces
    they pass. While that makes a difference, edges that touch anything are sampled finer; not
    where no more than `enough` worlds are touched.
    """
    if len(path) == 1:
        centers, hits = count_at(at, path[0])
        if hits:
            return count_each(at, path)
        n, none = at.worlds.n_worlds, np.zeros(1, np.int64)  # most places: no world is touched
        slack, touched = np.zeros((1, len(at.radii))), np.zeros(n, np.uint8)
        return Sweep(centers[None], slack, none, touched, none, np.full(n, -1))
    steps = np.empty(len(path) - 1, np.int64)
    checking.count_steps(path, at.floats, at.ints, at.spacing, steps)
    sweep = _swept(at, path, steps)
    for _ in range(_REFINEMENTS):
        passed = sweep.touched.sum()
        if passed <= enough or passed - recount(at, sweep, within=True).touched.sum() <= (
            _UNDECIDED * at.worlds.n_worlds
        ):
            break
        touching = np.add.reduceat(sweep.counts, sweep.waypoints[:-1])
        touching += sweep.counts[sweep.waypoints[1:]]
        steps = np.where(touching > 0, _FINER * steps, steps)
        if steps.sum() >= AT_MOST:
            break
        sweep = _swept(at, path, steps)
    return sweep


def _swept(at: Setting, path: Waypoints, steps: Int[np.ndarray, " e"]) -> Sweep:
    n = int(steps.sum()) + 1
    if n > AT_MOST:
        raise RobotError(
            f"a path of {len(path)} waypoints needs {n:,} configurations to miss nothing on the "
            f"way; at most {AT_MOST:,}: ask for parts of it"
        )
    centers = np.empty((n, 3, len(at.radii)))
    slack = np.empty((n, len(at.radii)))
    checking.place_path(path, steps, at.floats, at.ints, centers, slack)
    waypoints = np.concatenate(([0], np.cumsum(steps)))
    return Sweep(centers, slack, waypoints, *_touch(at, centers, slack))


def count_each(at: Setting, Q: Rows) -> Sweep:
    """Count the worlds that each configuration touches; nothing between them."""
    centers = np.empty((len(Q), 3, len(at.radii)))
    checking.place_spheres_batch(Q, at.floats, at.ints, centers)
    slack = np.zeros((len(Q), len(at.radii)))
    return Sweep(centers, slack, np.arange(len(Q)), *_touch(at, centers, slack))


def recount(at: Setting, sweep: Sweep, within: bool = False) -> Sweep:
    """Count again at a sweep's samples, for spheres of other radii; with `within`, the samples
    alone, not the way between them."""
    slack = np.zeros_like(sweep.slack) if within else sweep.slack
    return Sweep(sweep.centers, slack, sweep.waypoints, *_touch(at, sweep.centers, slack))


def count_at(at: Setting, q: Configuration) -> tuple[Float[np.ndarray, "3 s"], int]:
    """Sphere centres at a configuration, and how many worlds they touch: the quick way."""
    worlds = at.worlds
    centers = np.empty((3, len(at.radii)))
    checking.place_spheres(q, at.floats, at.ints, centers)
    touched = np.zeros(worlds.n_worlds, np.uint8)
    hits = risk.touch_one(centers, at.radii, at.sphere_tables, *worlds.baked(), touched)
    if hits < 0:  # the first to ask here: bake, then count
        hits = int(_touch(at, centers[None], np.zeros((1, len(at.radii))))[1][0])
    return centers, hits


def _touch(
    at: Setting, centers: Float[np.ndarray, "n 3 s"], slack: Float[np.ndarray, "n s"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Touched worlds, count at each sample, first sample of each world; bakes what it needs."""
    worlds = at.worlds
    while True:
        touched = np.zeros(worlds.n_worlds, np.uint8)
        counts = np.empty(len(centers), np.int64)
        first = np.full(worlds.n_worlds, -1, np.int64)
        wanted = worlds.new_marks()
        missing = risk.touch(
            centers, slack, at.radii, at.sphere_tables, *worlds.baked(),
            touched, counts, first, wanted,
        )  # fmt: skip
        if not missing:
            return touched, counts, first
        worlds.bake_marked(wanted)


def first_contacts(
    at: Setting, path: Waypoints, sweep: Sweep, edge: int, fraction: float
) -> tuple[FirstContact, ...]:
    """Rank what the worlds collide with first; certain obstacles stop all that are left."""
    if edge < 0 and not sweep.touched.any():
        return ()
    first = sweep.first.copy()
    total = int(sweep.touched.sum()) if edge < 0 else len(first)
    found: Counter[tuple[str, str, int]] = Counter()
    if edge >= 0:
        start = int(sweep.waypoints[edge])
        stop = int(sweep.waypoints[min(edge + 1, len(sweep.waypoints) - 1)])
        late = (first < 0) | (first > start + fraction * (stop - start))
        found[*_certain_cause(at, path, edge, fraction), edge] = int(late.sum())
        first[late] = -1
    for (sphere, body, sample), count in _touching(at, sweep, first).items():
        waypoint = int(np.searchsorted(sweep.waypoints, sample, side="right")) - 1
        found[body, _link_of(at, sphere), waypoint] += count
    ranked = sorted(found.items(), key=lambda item: (-item[1], item[0]))
    return tuple(FirstContact(*cause, count / total) for cause, count in ranked if count > 0)


def _link_of(at: Setting, sphere: int) -> str:
    return at.robot.link_names[int(at.robot.sphere_links[sphere])]


def _touching(
    at: Setting, sweep: Sweep, first: Int[np.ndarray, " w"]
) -> Counter[tuple[int, str, int]]:
    """Count (sphere, body, sample) of the first touch over the worlds."""
    sphere, owner = np.empty((2, len(first)), np.int64)
    worlds = at.worlds
    rows, owners, _ = worlds.owner_tables
    tables = worlds.tables
    risk.causes(
        sweep.centers, sweep.slack, at.radii, at.sphere_tables, tables.distance_row, tables.rows,
        worlds.first, worlds.resolution, first, rows, owners, worlds.halo, sphere, owner,
    )  # fmt: skip
    # The class after the map's is that of objects that nobody saw.
    names = [*(f"object:{i}" for i in at.world.map.object_ids), "occluded"]
    return Counter(
        (int(sphere[w]), names[owner[w] - 1], int(first[w])) for w in np.flatnonzero(sphere >= 0)
    )


def _certain_cause(at: Setting, path: Waypoints, edge: int, fraction: float) -> tuple[str, str]:
    """Name the body and the link of the deepest certain contact at a point of an edge."""
    qa, qb = path[edge], path[min(edge + 1, len(path) - 1)]
    q = qa + fraction * (qb - qa)
    n = len(at.radii)
    centers, plane, field = np.empty((3, n)), np.empty(n), np.empty(n)
    which = np.empty(n, np.int64)
    checking.sphere_clearances(q, at.floats, at.ints, *at.packed, centers, plane, which, field)
    gap = np.where(at.sphere_tables >= 0, np.minimum(plane, field), np.inf)
    s = int(np.argmin(gap))
    if plane[s] <= field[s]:
        return at.world.plane_names[which[s]], _link_of(at, s)
    rule = int(np.flatnonzero(at.tables == at.sphere_tables[s])[0])
    body, _ = nearest_source(at.world, at.certain.fields[rule], centers[:, s])
    return body, _link_of(at, s)


class PathRisk:
    """Verdicts on and estimates of a robot among the posterior worlds of one map; `allowed` is
    how many may collide with what is valid, under `config.max_risk`."""

    def __init__(self, setting: Setting) -> None:
        # Probabilities are of touching; verdicts keep the margin as well, and know no surface
        # better than `BLUR`.
        self.setting, config, rules = setting, setting.config, setting.certain.rules
        self._blurred = grown(setting, BLUR)
        kept = replace(setting, radii=setting.radii + config.margin, margin=config.margin)
        self._kept = grown(kept, BLUR)
        worlds = setting.worlds
        lower, upper = clopper_pearson(config.n_worlds, config.confidence)
        self._lower = np.maximum(lower - worlds.error_occupied, 0.0)
        # Where something may be touched, a voxel said to be its own may hide another object.
        hidden = worlds.error_free + (worlds.error_occupied if any(rules) else 0.0)
        self._upper = np.minimum(upper + hidden, 1.0)
        self._lost = np.zeros(config.n_worlds, np.bool_)  # worlds that no verdict counts
        self.allowed = 0
        if config.max_risk is not None:
            self.allowed = tolerated_hits(config.max_risk, self._upper, config.n_worlds)
            worlds.sample()

    def bounded_by(self, config: CheckerConfig) -> "PathRisk":
        """Return the same with the bound of another config."""
        other = copy.copy(self)
        other.setting = replace(self.setting, config=config)
        other._kept = replace(self._kept, config=config)
        other.allowed = tolerated_hits(float(config.max_risk or 0.0), self._upper, config.n_worlds)
        return other

    def tightened(self, level: int, ends: Rows | None = None) -> "PathRisk | None":
        """Return the same with a stricter bound on verdicts, None if there is none left: halves
        the worlds that may collide, down to none, then grows the spheres by `PADDINGS`. Worlds that
        collide at `ends` are lost to every path between them: they count once, not at each edge."""
        stricter = copy.copy(self)
        halvings = self.allowed.bit_length()  # after so many, none is left
        if level > halvings:
            if level - halvings > len(PADDINGS):
                return None
            stricter._kept = grown(self._kept, PADDINGS[level - halvings - 1])
        if ends is not None:
            stricter._lost = count_each(stricter._kept, ends).touched > 0
        left = max(0, self.allowed - int(stricter._lost.sum()))
        stricter.allowed = left >> min(level, halvings)
        return stricter

    @cached_property
    def held_out(self) -> "PathRisk":
        """The same with worlds that no verdict has seen."""
        other = copy.copy(self)
        worlds = self.setting.worlds
        other.setting = replace(self.setting, worlds=worlds.redrawn(worlds.seed + _HELD_OUT))
        other._blurred = grown(other.setting, BLUR)
        return other

    def accepts(self, path: Waypoints) -> bool:
        """Whether few enough worlds come within the margin anywhere on a path, certain
        obstacles and worlds that are lost aside."""
        return self._accepted(count_path(self._kept, path, self.allowed))

    def accepts_one(self, q: Configuration) -> bool:
        """Return `accepts` of one configuration: the quick way."""
        if count_at(self._kept, q)[1] <= self.allowed:
            return True
        return bool(self._lost.any()) and self._accepted(count_each(self._kept, q[None]))

    def accepts_each(self, Q: Rows) -> Chosen:
        """Return `accepts` of each configuration by itself."""
        found = count_each(self._kept, Q).counts <= self.allowed
        if self._lost.any():
            found[~found] = [self._accepted(count_each(self._kept, q[None])) for q in Q[~found]]
        return found

    def _accepted(self, sweep: Sweep) -> bool:
        return int((sweep.touched[~self._lost] > 0).sum()) <= self.allowed

    def exceeded_at(self, edge: Float[np.ndarray, "2 dof"]) -> float:
        """Return where along an edge, 0 to 1, more worlds have collided than are allowed."""
        sweep = count_path(self._kept, edge, self.allowed)
        first = np.sort(sweep.first[(sweep.first >= 0) & ~self._lost])
        return float(first[self.allowed]) / max(1, len(sweep.counts) - 1)

    def contacts(self, q: Configuration) -> tuple[Contact, ...]:
        """Return which links touch which objects in how many worlds, the most frequent first.
        Each world counts for its deepest contact alone: the shares add up to the probability of
        collision."""
        at, sweep = self._kept, count_path(self._kept, q[None])
        bound, upper = at.config.max_risk, float(self._upper[int(sweep.touched.sum())])
        return tuple(
            Contact(
                kind="risk",
                link=_link_of(at, sphere),
                body=body,
                depth=upper - float(bound or 0.0),
                sphere=sphere,
                position=as_point(sweep.centers[0, :, sphere]),
                probability=count / at.worlds.n_worlds,
                detail=f"upper bound of all {upper:.3f}, max_risk {bound}",
            )
            for (sphere, body, _), count in _touching(at, sweep, sweep.first).most_common()
        )

    def estimate(self, path: Waypoints, with_margin: bool = False) -> RiskEstimate:
        """Return the joint probability of collision along a path, or of coming within the
        margin; of a configuration, where the path has one row."""
        at = grown(self._kept, -BLUR) if with_margin else self.setting
        path = path.copy()
        n, inside = at.worlds.n_worlds, 0
        blurred = self._kept if with_margin else self._blurred
        around = sweep = count_path(blurred, path, n)
        if around.touched.any():
            sweep = count_path(at, path)
            around = recount(blurred, sweep)
            inside = int(recount(grown(at, -BLUR), sweep, within=True).touched.sum())
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
            volume=lambda: self._unjudged(sweep.centers),
        )

    def _unjudged(self, centers: Float[np.ndarray, "n 3 s"]) -> dict[str, float]:
        """Share of the swept volume in each kind of space that the map cannot judge, over at most
        64 samples spread along the path."""
        n, at = len(centers), self.setting
        some = np.unique(np.linspace(0, n - 1, min(n, _MAX_SAMPLES)).astype(np.int64))
        ball = unit_ball_points(_POINTS, surface=False)
        shares = volume_shares(
            at.world, at.robot, centers[some].transpose(0, 2, 1), ball, judged=True
        )
        return {kind: float(own.mean()) for kind, own in shares.items()}


def clopper_pearson(
    n: int, confidence: float
) -> tuple[Float[np.ndarray, " n1"], Float[np.ndarray, " n1"]]:
    """Bounds on a probability after k = 0..n hits in n trials: lower (n + 1,), upper (n + 1,).
    Clopper and Pearson, Biometrika 26 (1934): each tail holds (1 - confidence) / 2."""
    k = np.arange(n + 1, dtype=np.float64)
    tail = 0.5 * (1.0 - confidence)
    lower, upper = np.zeros(n + 1), np.ones(n + 1)
    lower[1:] = betaincinv(k[1:], n - k[1:] + 1.0, tail)
    upper[:-1] = betaincinv(k[:-1] + 1.0, n - k[:-1], 1.0 - tail)
    return lower, upper


def tolerated_hits(max_risk: float, upper: Float[np.ndarray, " n1"], n_worlds: int) -> int:
    """Return the most hits whose upper bound is still within `max_risk`; ConfigError if not even
    none would do, with so few worlds."""
    allowed = int(np.searchsorted(upper, max_risk, side="right")) - 1
    if allowed < 0:
        raise ConfigError(
            f"max_risk is {max_risk}, but {n_worlds} worlds without a collision only show a "
            f"risk of at most {upper[0]:.4f}; draw more (n_worlds), or accept more risk"
        )
    return min(allowed, n_worlds)
