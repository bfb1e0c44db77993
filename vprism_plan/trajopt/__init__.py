# SPDX-License-Identifier: BSD-3-Clause
"""PyTorch's view of a world: differentiable costs of trajectories."""

from vprism_plan.trajopt.cost import SumCost as SumCost
from vprism_plan.trajopt.cost import TrajectoryCost as TrajectoryCost
from vprism_plan.trajopt.joint_costs import JointLimitCost as JointLimitCost
from vprism_plan.trajopt.joint_costs import PoseCost as PoseCost
from vprism_plan.trajopt.joint_costs import SmoothnessCost as SmoothnessCost
from vprism_plan.trajopt.optimizer import OptimizeReport as OptimizeReport
from vprism_plan.trajopt.optimizer import OptimizeResult as OptimizeResult
from vprism_plan.trajopt.optimizer import SeedReport as SeedReport
from vprism_plan.trajopt.optimizer import default_cost as default_cost
from vprism_plan.trajopt.optimizer import optimize as optimize
from vprism_plan.trajopt.posterior_costs import EntropyCost as EntropyCost
from vprism_plan.trajopt.posterior_costs import OccupancyCost as OccupancyCost
from vprism_plan.trajopt.risk_cost import RiskCost as RiskCost
from vprism_plan.trajopt.sphere_costs import ClearanceCost as ClearanceCost
from vprism_plan.trajopt.sphere_costs import SelfCollisionCost as SelfCollisionCost
