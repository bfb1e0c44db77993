# SPDX-License-Identifier: BSD-3-Clause
"""A small world, and an arm in it, for tests of costs."""

import numpy as np
import pytest
import torch
from oracles.small_scenes import at, small_map

import vprism_plan as vp
from vprism_plan.world.config import Box

CRATE = Box("crate", size=(0.12, 0.1, 0.12), T_world=at(0.0, -0.3, 0.06))  # stands on the table


@pytest.fixture(scope="session")
def cost_map():
    return small_map()


@pytest.fixture(scope="session")
def cost_world(cost_map):
    bounds = ((-0.25, -0.45, -0.03), (0.3, 0.3, 0.4))
    return vp.World(cost_map, vp.WorldConfig(known=(CRATE,), bounds=bounds))


@pytest.fixture(scope="session")
def crate():
    return CRATE


@pytest.fixture(scope="session")
def arm(repository):
    return vp.Robot.from_urdf(repository / "urdf" / "panda.urdf", base_pose=at(-0.45, 0.0, 0.0))


@pytest.fixture(scope="session")
def arm_checker(cost_world, arm):
    config = vp.CheckerConfig(margin=0.005, self_margin=0.005, allowed_contacts={"hand": {2}})
    return vp.CollisionChecker(cost_world, arm, config)


@pytest.fixture(scope="session")
def colliding(arm_checker) -> torch.Tensor:
    """Trajectories (3, 3, 7) of the arm that pass through many things."""
    robot = arm_checker.robot
    Q = np.random.default_rng(0).uniform(robot.lower, robot.upper, (3000, robot.dof))
    worst = np.argsort(arm_checker.clearance_batch(Q) + arm_checker.self_clearance_batch(Q))
    reaching = np.array([0.0, 0.9, 0.0, -1.6, 0.0, 2.5, 0.8])
    middle = np.stack([reaching, *Q[worst[:2]]])
    noise = np.random.default_rng(1).normal(scale=0.1, size=(3, 3, robot.dof))
    return torch.from_numpy(middle[:, None] + noise)
