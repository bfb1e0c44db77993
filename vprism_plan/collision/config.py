# SPDX-License-Identifier: BSD-3-Clause
"""What "free" means for one checker."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Int

from vprism_plan._arguments import is_whole, number, whole
from vprism_plan.errors import ConfigError


@dataclass(frozen=True)
class CheckerConfig:
    """Settings of a `CollisionChecker`; lengths in metres.

    Attributes:
        margin: clearance that every sphere must keep from the world beyond touching it.
        self_margin: the same between the links of the robot.
        min_motion: edges are certified continuously until no sphere can move more than this between
            two checked configurations. A point of such a gap is at most half of it away from a
            configuration known to be free: the tolerance of `check_motion`.
        max_risk: bound on the probability of collision. A collision that is c times as bad as a
            reached goal is good is worth risking up to 1 / (1 + c): 0.1 (default) is c = 9. With a
            bound, the map's objects, what of hidden space is the map's to judge, and objects that
            nobody saw (`WorldConfig.hidden_objects`) are judged by worlds drawn from the posterior
            (`PosteriorWorlds`), whatever `WorldConfig.level` is: a configuration or an edge is free
            if the upper confidence bound of its probability of coming within `margin` is at most
            `max_risk`. Everything else is refused as without a bound, and so is the level set if
            `max_risk` is below its level: draws are counted by voxels, and alone would let a path
            shave a surface that was seen. None: the level set alone. A world without a posterior is
            certain: its surfaces decide.
        allowed_contacts: link or SRDF group -> ids of the objects it may touch; for example
            {"hand": {3}}. What a link may touch, it may also pass through.
        n_worlds: worlds drawn for probabilities, a multiple of 64.
        risk_seed: seed of the draws.
        confidence: of the interval of a probability, two-sided.
    """

    margin: float = 0.0
    self_margin: float = 0.0
    min_motion: float = 0.002
    max_risk: float | None = 0.1
    allowed_contacts: Mapping[str, Any] = field(default_factory=dict, hash=False)
    n_worlds: int = 256
    risk_seed: int = 0
    confidence: float = 0.95

    def __post_init__(self) -> None:
        """Refuse values that would make a verdict meaningless."""
        number("margin", self.margin, 0.0, unit="metres")
        number("self_margin", self.self_margin, 0.0, unit="metres")
        number("min_motion", self.min_motion, 1e-5, unit="metres")
        if self.max_risk is not None:
            unit = "(a probability; None for no bound)"
            number("max_risk", self.max_risk, 0.0, 1.0, unit, above=True, below=True)
        if whole("n_worlds", self.n_worlds, 64) % 64:
            raise ConfigError(f"n_worlds is {self.n_worlds}; it must be a multiple of 64")
        whole("risk_seed", self.risk_seed)
        number("confidence", self.confidence, 0.0, 1.0, above=True, below=True)
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
    """Turn allowed contacts (see `CheckerConfig`; what several entries say of one link adds up)
    into distinct rules.

    Returns:
        The sets of objects that may be touched, the empty one first, and the index of the set that
        holds for each link.

    Raises:
        RobotError: no such link or group.
    """
    names = list(robot.link_names)
    own = [frozenset[int]()] * len(names)
    for name, ids in allowed.items():
        for link in robot.links_of(name):
            own[names.index(link)] |= frozenset(map(int, ids))
    rules = list(dict.fromkeys([frozenset[int](), *own]))
    return rules, np.array([rules.index(ids) for ids in own], dtype=np.int64)
