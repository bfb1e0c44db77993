# SPDX-License-Identifier: BSD-3-Clause
"""What "free" means for one checker."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vprism_plan.errors import ConfigError


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
        max_risk: Bound on the probability of collision; only None (no bound) is
            accepted by this version.
        allowed_contacts: Contacts to permit, link to object ids; only an empty mapping
            is accepted by this version.
    """

    margin: float = 0.0
    self_margin: float = 0.0
    min_motion: float = 0.002
    max_risk: float | None = None
    allowed_contacts: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse values that would make a verdict meaningless."""
        for name in ("margin", "self_margin"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0.0):
                raise ConfigError(f"{name} is {value!r}; it must be finite and at least 0 metres")
        if not (np.isfinite(self.min_motion) and self.min_motion >= 1e-5):
            raise ConfigError(
                f"min_motion is {self.min_motion!r}; it must be finite and at least 1e-5 metres"
            )
        if self.max_risk is not None:
            raise ConfigError(
                f"max_risk is {self.max_risk!r}; this version has no chance constraints, "
                "so leave it None and use margin (metres) to keep away from surfaces"
            )
        if self.allowed_contacts:
            raise ConfigError(
                f"allowed_contacts names {sorted(map(str, self.allowed_contacts))}; this version "
                "has no contact rules, so leave it empty"
            )

    @property
    def tolerance(self) -> float:
        """How far, metres of motion, an accepted edge may be from a checked free point."""
        return 0.5 * self.min_motion
