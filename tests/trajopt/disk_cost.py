# SPDX-License-Identifier: BSD-3-Clause
"""The balls of the disk world as a cost, so that optimising takes milliseconds."""

import torch

from vprism_plan.trajopt import JointLimitCost, SmoothnessCost, TrajectoryCost

_PARTS = 4  # of every edge


class BallCost(TrajectoryCost):
    """Squared lack of a margin, summed over balls, averaged over samples of the edges."""

    def __init__(self, checker, margin=0.04, weight=1.0):
        super().__init__(weight, "balls")
        self.centers = torch.as_tensor(checker.centers)
        self.radii = torch.as_tensor(checker.radii)
        self.margin = margin

    def evaluate(self, q):
        shares = torch.arange(_PARTS, dtype=q.dtype) / _PARTS
        rows = q[..., :-1, None, :] + shares[:, None] * q.diff(dim=-2)[..., None, :]
        away = (rows[..., None, :] - self.centers).square().sum(dim=-1)
        gap = (away + 1e-12).sqrt() - self.radii
        return (self.margin - gap).clamp(min=0.0).square().sum(dim=-1).mean(dim=(-1, -2))


def disk_cost(checker, weight=30000.0):
    return (
        SmoothnessCost(robot=checker.robot)
        + BallCost(checker, weight=weight)
        + JointLimitCost(checker.robot, margin=0.02, weight=3000.0)
    )
