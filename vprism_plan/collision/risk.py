# SPDX-License-Identifier: BSD-3-Clause
"""The probability that a robot collides: verdicts by a bound on it, and estimates of it."""

import copy
from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import betaincinv

from vprism_plan._kernels import checking
from vprism_plan._kernels import risk as kernels
from vprism_plan.collision import draws
from vprism_plan.collision.config import CheckerConfig
from vprism_plan.collision.reports import Contact, RiskEstimate
from vprism_plan.errors import ConfigError

_HELD_OUT = 1_000_003  # added to the seed of the draws
_ONE = np.zeros(1, np.int64)
_MAX_SAMPLES = 64
_SLAB = 8  # planes of nodes classified at once


class PathRisk:
    """A robot among the posterior worlds of one map; see `make_setting` for the arguments.

    Attributes:
        allowed: how many worlds may collide with what is valid, under `config.max_risk`.
    """

    def __init__(
        self,
        world: Any,
        robot: Any,
        config: CheckerConfig,
        rules: Sequence[Collection[int]],
        link_rules: Int[np.ndarray, " l"],
    ) -> None:
        # Probabilities are of touching; verdicts keep the margin as well, and touch a voxel
        # at its corners.
        self.setting = draws.make_setting(world, robot, config, rules, link_rules)
        self._corners = draws.grown(self.setting, draws.CORNER)
        self._kept = draws.grown(draws.with_margin(self.setting, config.margin), draws.CORNER)
        worlds = self.setting.worlds
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

    def tightened(self, level: int) -> "PathRisk | None":
        """Return the same with a stricter bound on verdicts, None if there is none left.

        Halves the worlds that may collide, down to none, then grows the spheres by half, one
        and two voxels. What the stricter one accepts, this one accepts.
        """
        stricter = copy.copy(self)
        halvings = self.allowed.bit_length()  # after so many, none is left
        stricter.allowed = self.allowed >> min(level, halvings)
        if level > halvings:
            if level - halvings > len(draws.PADDINGS):
                return None
            stricter._kept = draws.grown(self._kept, draws.PADDINGS[level - halvings - 1])
        return stricter

    def held_out(self) -> "PathRisk":
        """Return the same with worlds that no verdict has seen."""
        if self._held_out is None:
            other = copy.copy(self)
            worlds = self.setting.worlds
            other.setting = replace(self.setting, worlds=worlds.redrawn(worlds.seed + _HELD_OUT))
            other._corners = draws.grown(other.setting, draws.CORNER)
            self._held_out = other
        return self._held_out

    # --- verdicts ----------------------------------------------------------------------
    def accepts(self, path: Float[np.ndarray, "t dof"]) -> bool:
        """Whether few enough worlds come within the margin anywhere on a path, certain
        obstacles aside."""
        return bool(draws.count_path(self._kept, path).touched.sum() <= self.allowed)

    def accepts_one(self, q: Float[np.ndarray, "dof"]) -> bool:
        """Return `accepts` of one configuration: the quick way."""
        return draws.count_at(self._kept, q)[1] <= self.allowed

    def accepts_each(self, Q: Float[np.ndarray, "n dof"]) -> Bool[np.ndarray, " n"]:
        """Return `accepts` of each configuration by itself."""
        return draws.count_each(self._kept, Q).counts <= self.allowed

    def exceeded_at(self, edge: Float[np.ndarray, "2 dof"]) -> float:
        """Return where along an edge, 0 to 1, more worlds have collided than are allowed."""
        sweep = draws.count_path(self._kept, edge)
        first = np.sort(sweep.first[sweep.first >= 0])
        return float(first[self.allowed]) / max(1, len(sweep.counts) - 1)

    def contacts(self, q: Float[np.ndarray, "dof"]) -> tuple[Contact, ...]:
        """Return which links touch which objects in how many worlds, the most frequent first."""
        sweep = draws.count_path(self._kept, q[None])
        return draws.risky_contacts(self._kept, sweep, float(self._upper[int(sweep.touched.sum())]))

    # --- estimates ---------------------------------------------------------------------
    def estimate(self, path: Float[np.ndarray, "t dof"], with_margin: bool = False) -> RiskEstimate:
        """Return the joint probability of collision along a path, or of coming within the
        margin; of a configuration, where the path has one row."""
        at = draws.grown(self._kept, -draws.CORNER) if with_margin else self.setting
        path = path.copy()
        n, inside = at.worlds.n_worlds, 0
        around = sweep = draws.count_path(self._kept if with_margin else self._corners, path)
        if around.touched.any():
            sweep = draws.recount(at, around)
            # A draw that occupies the centre of a voxel occupies that point, whatever voxels are.
            inside = int(draws.recount(draws.grown(at, -0.5), around, within=True).touched.sum())
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
            trace=lambda: draws.first_contacts(at, path, sweep, edge, float(stats[0])),
            volume=lambda: self._shares(at, sweep.centers),
        )

    def _shares(self, at: draws.Setting, centers: Float[np.ndarray, "n 3 s"]) -> dict[str, float]:
        if self._codes is None:
            self._codes = SpaceCodes(at.world)
        return self._codes.shares(centers, at.radii, at.sphere_tables)


class SpaceCodes:
    """What is known of the space around each node of a world's grid.

    0: seen, or hidden where the map has support. 1: hidden without support. 2: never
    observed. 3 (not stored): outside the grid. Baked once, O(nodes), one byte per node.

    Args:
        world: a `vprism_plan.world.World`.
    """

    def __init__(self, world: Any) -> None:
        field = world.field
        self._origin = np.asarray(field.origin, dtype=np.float64)
        self._spacing = float(field.spacing)
        shape = field.distance.shape
        self._codes = np.empty(shape, np.uint8)
        for start in range(0, shape[0], _SLAB):
            stop = min(start + _SLAB, shape[0])
            index = np.moveaxis(np.indices((stop - start, *shape[1:])), 0, -1).reshape(-1, 3)
            corner = self._origin + self._spacing * np.array([start, 0, 0])
            points = corner + self._spacing * index
            codes = np.asarray(world.status(points)).astype(np.uint8)
            codes[codes == 3] = 0  # rounding at the faces
            hidden = np.flatnonzero(codes == 1)
            judged = np.asarray(world.map.support(points[hidden])) >= world.config.min_support
            codes[hidden[judged]] = 0
            self._codes[start:stop] = codes.reshape(stop - start, *shape[1:])

    def shares(
        self,
        centers: Float[np.ndarray, "n 3 s"],
        radii: Float[np.ndarray, " s"],
        rules: Int[np.ndarray, " s"],
    ) -> dict[str, float]:
        """Return the share of the swept volume that lies in each kind of space not judged.

        Seven points per ball (its centre and six at three fifths of the radius), balls
        weighted by volume, averaged over at most 64 samples spread along the path.
        Balls with rule -1 (not checked) do not count.
        """
        n = len(centers)
        chosen = _ONE if n == 1 else np.arange(m := min(n, _MAX_SAMPLES)) * (n - 1) // (m - 1)
        totals = np.zeros(4)
        kernels.volume_codes(
            centers, chosen, radii, rules, self._codes, self._origin, self._spacing, totals
        )
        seen, occluded, unobserved, outside = totals.tolist()
        whole = max(seen + occluded + unobserved + outside, 1e-300)
        return {
            "occluded": occluded / whole,
            "unobserved": unobserved / whole,
            "outside": outside / whole,
        }


def clopper_pearson(
    n: int, confidence: float
) -> tuple[Float[np.ndarray, " n1"], Float[np.ndarray, " n1"]]:
    """Bounds on a probability after k = 0..n hits in n trials: lower (n + 1,), upper (n + 1,).

    Clopper and Pearson, Biometrika 26 (1934): each tail holds (1 - confidence) / 2.
    """
    k = np.arange(n + 1, dtype=np.float64)
    tail = 0.5 * (1.0 - confidence)
    lower, upper = np.zeros(n + 1), np.ones(n + 1)
    lower[1:] = betaincinv(k[1:], n - k[1:] + 1.0, tail)
    upper[:-1] = betaincinv(k[:-1] + 1.0, n - k[:-1], 1.0 - tail)
    return lower, upper


def tolerated_hits(max_risk: float, upper: Float[np.ndarray, " n1"], n_worlds: int) -> int:
    """Return the most hits whose upper bound is still within `max_risk`.

    Raises:
        ConfigError: not even no hits at all would do, with so few worlds.
    """
    allowed = int(np.searchsorted(upper, max_risk, side="right")) - 1
    if allowed < 0:
        raise ConfigError(
            f"max_risk is {max_risk}, but {n_worlds} worlds without a collision only show a "
            f"risk of at most {upper[0]:.4f}; draw more (n_worlds), or accept more risk"
        )
    return min(allowed, n_worlds)
