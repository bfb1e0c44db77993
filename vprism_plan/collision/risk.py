# SPDX-License-Identifier: BSD-3-Clause
"""The probability that a path touches anything, with its interval and its causes."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.special import betaincinv

from vprism_plan.errors import ConfigError


@dataclass(frozen=True)
class FirstContact:
    """What a path touches first, in some of the worlds where it touches anything.

    Attributes:
        body: "object:3", "background", "occluded", "support surface", ...
        link: link that touches it.
        waypoint: index of the waypoint where, or after which, it does.
        share: share of the colliding worlds; the shares of all causes sum to 1.
    """

    body: str
    link: str
    waypoint: int
    share: float

    def text(self) -> str:
        """Return the cause as one phrase."""
        return (
            f"{self.link} touches {self.body} at or after waypoint {self.waypoint} in "
            f"{100 * self.share:.0f}% of them"
        )


@dataclass(frozen=True, eq=False)
class RiskEstimate:
    """The joint probability that a path collides, over worlds drawn from the posterior.

    Attributes:
        probability: share of the worlds in which any sphere touches anything anywhere on
            the path; the same world for the whole path. A voxel counts as the ball inside
            it. 1 if a certain obstacle is hit.
        lower: Clopper-Pearson bound of the worlds that occupy a voxel's centre inside a
            sphere, less what skipping certain voxels may add.
        upper: Clopper-Pearson bound of the worlds with a voxel whose corners a sphere reaches,
            and what skipping certain voxels may hide; above 0 even if no world collides.
            Verdicts with `max_risk` go by it.
        confidence: of the interval (lower, upper), two-sided; it holds the size of voxels.
        n_worlds: worlds drawn.
        seed: of the draws.
        per_waypoint: (T,) the same probability at each waypoint alone.
        certain: whether the path hits what is an obstacle in every world: support surface,
            background, unseen space by policy, known geometry.
        spacing: no sphere centre moves more than this between two samples, metres; what
            lies between samples is covered by growing the spheres.
        configurations: samples taken.
        trace, volume: find `first_contact` and `shares`, which cost more than the rest and
            are often not asked for.
    """

    probability: float
    lower: float
    upper: float
    confidence: float
    n_worlds: int
    seed: int
    per_waypoint: Float[np.ndarray, " t"]
    certain: bool
    spacing: float
    configurations: int
    trace: Callable[[], tuple[FirstContact, ...]] = field(repr=False)
    volume: Callable[[], dict[str, float]] = field(repr=False)

    @cached_property
    def first_contact(self) -> tuple[FirstContact, ...]:
        """What the worlds collide with first: causes, the most frequent first; empty if no
        world collides."""
        return self.trace()

    @cached_property
    def shares(self) -> dict[str, float]:
        """Share of the swept volume that the map cannot judge, by kind: "occluded" (hidden,
        without support), "unobserved", "outside" (the grid)."""
        return self.volume()

    @property
    def unsupported_share(self) -> float:
        """Share of the swept volume in space that the map cannot judge."""
        return sum(self.shares.values())

    def __getstate__(self) -> dict[str, Any]:
        """Find what is left to find before the estimate leaves the process."""
        found = {"first_contact": self.first_contact, "shares": self.shares}
        return {**self.__dict__, **found, "trace": tuple, "volume": dict}

    def text(self) -> str:
        """Return the estimate in one line."""
        line = (
            f"P(collision) {self.probability:.3f} "
            f"({100 * self.confidence:.0f}% interval {self.lower:.3f} to {self.upper:.3f}, "
            f"{self.n_worlds} worlds)"
        )
        if self.first_contact:
            line += f"; {self.first_contact[0].text()}"
        if self.unsupported_share > 0.005:
            line += f"; {100 * self.unsupported_share:.0f}% of the swept volume is not judged"
        return line

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-ready keys."""
        return {
            "probability": self.probability,
            "lower": self.lower,
            "upper": self.upper,
            "confidence": self.confidence,
            "n_worlds": self.n_worlds,
            "seed": self.seed,
            "per_waypoint": [float(p) for p in self.per_waypoint],
            "first_contact": [vars(cause) for cause in self.first_contact],
            "certain": self.certain,
            "unsupported_share": self.unsupported_share,
            "shares": dict(self.shares),
            "spacing": self.spacing,
            "configurations": self.configurations,
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
