# SPDX-License-Identifier: BSD-3-Clause
"""World and robot in, verdicts with reasons out."""

from vprism_plan.collision.checker import CollisionChecker as CollisionChecker
from vprism_plan.collision.config import CheckerConfig as CheckerConfig
from vprism_plan.collision.mesh.checker import MeshChecker as MeshChecker
from vprism_plan.collision.mesh.comparison import Comparison as Comparison
from vprism_plan.collision.mesh.comparison import PathOpinion as PathOpinion
from vprism_plan.collision.mesh.comparison import compare as compare
from vprism_plan.collision.reports import Contact as Contact
from vprism_plan.collision.reports import FirstContact as FirstContact
from vprism_plan.collision.reports import MotionReport as MotionReport
from vprism_plan.collision.reports import RiskEstimate as RiskEstimate
from vprism_plan.collision.reports import StateReport as StateReport
