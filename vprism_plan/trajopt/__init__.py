# SPDX-License-Identifier: BSD-3-Clause
"""PyTorch's view of a world: differentiable costs of trajectories."""

from vprism_plan.trajopt.clearance import ClearanceCost as ClearanceCost
from vprism_plan.trajopt.cost import SumCost as SumCost
from vprism_plan.trajopt.cost import TrajectoryCost as TrajectoryCost
from vprism_plan.trajopt.joint_costs import JointLimitCost as JointLimitCost
from vprism_plan.trajopt.joint_costs import SmoothnessCost as SmoothnessCost
