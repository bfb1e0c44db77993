# SPDX-License-Identifier: BSD-3-Clause
"""World and robot in, verdicts with reasons out."""

from vprism_plan.collision.checker import CollisionChecker
from vprism_plan.collision.config import CheckerConfig
from vprism_plan.collision.mesh.checker import MeshChecker
from vprism_plan.collision.mesh.comparison import Comparison, PathOpinion, compare
from vprism_plan.collision.reports import (
    Contact,
    FirstContact,
    MotionReport,
    RiskEstimate,
    StateReport,
)

__all__ = [
    "CheckerConfig",
    "CollisionChecker",
    "Comparison",
    "Contact",
    "FirstContact",
    "MeshChecker",
    "MotionReport",
    "PathOpinion",
    "RiskEstimate",
    "StateReport",
    "compare",
]
