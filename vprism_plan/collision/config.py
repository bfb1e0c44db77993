# SPDX-License-Identifier: BSD-3-Clause
"""What "free" means for one checker."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Int

from vprism_plan._arguments import is_number, is_whole
from vprism_plan.errors import ConfigError

# What each number must be, in words and as a test that nan fails.
_LENGTH = "finite and at least 0 metres", lambda v: 0.0 <= v < np.inf
_NUMBERS: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "margin": _LENGTH,
    "self_margin": _LENGTH,
    "min_motion": ("finite and at least 1e-5 metres", lambda v: 1e-5 <= v < np.inf),
    "max_risk": (
        "a probability strictly between 0 and 1, or None for no bound",
        lambda v: 0.0 < v < 1.0,
    ),
    "n_worlds": ("a positive multiple of 64", lambda v: v >= 64 and v % 64 == 0),
    "risk_seed": ("at least 0", lambda v: v >= 0),
    "confidence": ("strictly between 0 and 1", lambda v: 0.0 < v < 1.0),
}


@dataclass(frozen=True)
class CheckerConfig:
    """Settings of a `CollisionChecker`.

    Attributes:
        margin: Clearance, metres, that every sphere must keep from the world beyond
            touching it; 0 means that only contact is refused.
        self_margin: The same between the links of the robot, metres.
        min_motion: Edges are certified continuously until no sphere can move more than
            this, metres, between two checked configurations. A point of such a gap is
            at most half of it away from a configuration known to be free: that half
            is the tolerance of `check_motion`.
        max_risk: Bound on the probability of collision. With a bound, the objects of the
            map (and occluded space where the map has support) are judged by worlds drawn
            from its posterior instead of by the level set, at P(occupied) = 1/2 of each
            draw whatever `WorldConfig.level` is: a configuration or an edge is
            free if the upper confidence bound of its probability of coming within `margin`
            is at most `max_risk`. Everything else is refused as without a bound, and so is
            the level set if `max_risk` is below its level: draws are counted by voxels, and
            alone would let a path shave a surface that was seen. None: level set.
        allowed_contacts: Link or SRDF group -> ids of the objects it may touch; for
            example {"hand": {3}}. What a link may touch, it may also pass through.
        n_worlds: Worlds drawn for probabilities, a multiple of 64.
        risk_seed: Seed of the draws.
        confidence: Of the interval of a probability, two-sided.
    """

    margin: float = 0.0
    self_margin: float = 0.0
    min_motion: float = 0.002
    max_risk: float | None = None
    allowed_contacts: Mapping[str, Any] = field(default_factory=dict, hash=False)
    n_worlds: int = 256
    risk_seed: int = 0
    confidence: float = 0.95

    def __post_init__(self) -> None:
        """Refuse values that would make a verdict meaningless."""
        for name, (wanted, fits) in _NUMBERS.items():
            value = getattr(self, name)
            if name == "max_risk" and value is None:
                continue
            whole = name in {"n_worlds", "risk_seed"}
            if not (is_whole(value) if whole else is_number(value)):
                raise ConfigError(
                    f"{name} is {value!r}; it must be a {'whole ' if whole else ''}number"
                )
            if not fits(value):
                raise ConfigError(f"{name} is {value!r}; it must be {wanted}")
        object.__setattr__(self, "allowed_contacts", _checked_contacts(self.allowed_contacts))

    @property
    def tolerance(self) -> float:
        """How far, metres of motion, an accepted edge may be from a checked free point."""
        return 0.5 * self.min_motion


def _checked_contacts(contacts: Any) -> dict[str, frozenset[int]]:
    """Link or group to a set of object ids; ConfigError if it is not that."""
    if not isinstance(contacts, Mapping):
        raise ConfigError(
            f"allowed_contacts is a {type(contacts).__name__}; it must map a link or group to "
            'object ids, for example {"hand": {3}}'
        )
    checked = {}
    for name, ids in contacts.items():
        some = isinstance(ids, Collection) and not isinstance(ids, str)
        if not (some and all(is_whole(i) for i in ids)):
            raise ConfigError(
                f"allowed_contacts[{name!r}] is {ids!r}; it must be a set of object ids (whole "
                "numbers), for example {3}"
            )
        checked[str(name)] = frozenset(int(i) for i in ids)
    return checked


def contact_rules(
    robot: Any, allowed: Mapping[str, Collection[int]]
) -> tuple[list[frozenset[int]], Int[np.ndarray, " links"]]:
    """Turn allowed contacts into distinct rules.

    Args:
        robot: whose links and groups are named: has `link_names`, and `links_of(name)` as
            `vprism_plan.robots.Robot` does.
        allowed: link or SRDF group -> ids of the objects it may touch; what several
            entries say of one link adds up.

    Returns:
        The sets of objects that may be touched, the empty one first, and the index of the
        set that holds for each link.

    Raises:
        RobotError: no such link or group.
    """
    names = list(robot.link_names)
    per_link: list[set[int]] = [set() for _ in names]
    for name, ids in allowed.items():
        for link in robot.links_of(name):
            per_link[names.index(link)].update(int(i) for i in ids)
    rules = [frozenset[int]()]
    index = np.zeros(len(names), dtype=np.int64)
    for number, own in enumerate(map(frozenset, per_link)):
        if own not in rules:
            rules.append(own)
        index[number] = rules.index(own)
    return rules, index
