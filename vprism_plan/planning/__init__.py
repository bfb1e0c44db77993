# SPDX-License-Identifier: BSD-3-Clause
"""OMPL's view of the checker: two classes for any OMPL program, and `plan` in one call."""

from vprism_plan.planning.goals import PoseGoalConfig as PoseGoalConfig
from vprism_plan.planning.goals import ReachRegion as ReachRegion
from vprism_plan.planning.looking import NextView as NextView
from vprism_plan.planning.looking import ViewValue as ViewValue
from vprism_plan.planning.looking import camera_views as camera_views
from vprism_plan.planning.looking import next_view as next_view
from vprism_plan.planning.objectives import RiskObjective as RiskObjective
from vprism_plan.planning.objectives import VPrismMinimaxRiskObjective as VPrismMinimaxRiskObjective
from vprism_plan.planning.objectives import VPrismRiskObjective as VPrismRiskObjective
from vprism_plan.planning.ompl_adapter import VPrismMotionValidator as VPrismMotionValidator
from vprism_plan.planning.ompl_adapter import (
    VPrismStateValidityChecker as VPrismStateValidityChecker,
)
from vprism_plan.planning.ompl_adapter import last_valid as last_valid
from vprism_plan.planning.ompl_adapter import state_space as state_space
from vprism_plan.planning.ompl_adapter import to_array as to_array
from vprism_plan.planning.ompl_adapter import to_state as to_state
from vprism_plan.planning.plan import plan as plan
from vprism_plan.planning.planners import planners as planners
from vprism_plan.planning.protocols import CheckerLike as CheckerLike
from vprism_plan.planning.protocols import SecondOpinion as SecondOpinion
from vprism_plan.planning.result import PlanReport as PlanReport
from vprism_plan.planning.result import PlanResult as PlanResult
from vprism_plan.planning.result import RefusedGoal as RefusedGoal
from vprism_plan.planning.search import quiet_ompl as quiet_ompl
from vprism_plan.planning.trajectory import Trajectory as Trajectory
from vprism_plan.planning.trajectory import read_trajectory as read_trajectory
from vprism_plan.planning.trajectory import time_parameterize as time_parameterize
from vprism_plan.planning.trajectory import write_trajectory as write_trajectory
