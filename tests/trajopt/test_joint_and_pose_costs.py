# SPDX-License-Identifier: BSD-3-Clause
"""Costs of joints, poses and links near each other against formulas and plain loops."""

import numpy as np
import pytest
import torch
from oracles.checker_oracle import sphere_positions

from vprism_plan.errors import RobotError
from vprism_plan.trajopt import JointLimitCost, PoseCost, SelfCollisionCost, SmoothnessCost
from vprism_plan.trajopt.sphere_costs import hinge, soft_contact


def curve(T, dof=3, dtype=torch.float64):
    """Cubic in time: u in [0, 1] to a + b u + c u^2 + d u^3 per joint."""
    u = torch.linspace(0.0, 1.0, T, dtype=dtype)[:, None]
    powers = torch.arange(1, dof + 1, dtype=dtype)
    return 0.3 + powers * u - 2.0 * u**2 + 0.5 * powers * u**3


@pytest.mark.parametrize(
    ("order", "derivative"),
    [
        ("velocity", lambda u, p: p - 4.0 * u + 1.5 * p * u**2),
        ("acceleration", lambda u, p: -4.0 + 3.0 * p * u),
        ("jerk", lambda u, p: 3.0 * p + 0.0 * u),
    ],
)
def test_smoothness_is_the_integral_whatever_the_number_of_waypoints(order, derivative):
    duration, u = 2.0, np.linspace(0.0, 1.0, 20_001)
    n = {"velocity": 1, "acceleration": 2, "jerk": 3}[order]
    squares = sum((derivative(u, p) / duration**n) ** 2 for p in (1.0, 2.0, 3.0))
    integral = duration * np.trapezoid(squares, u)
    factors = {"velocity": 0.0, order: 1.0}
    cost = SmoothnessCost(**factors, duration=duration)
    errors = [abs(float(cost(curve(T))) / integral - 1.0) for T in (60, 240)]
    assert errors[0] < 0.06
    assert errors[1] < 0.3 * errors[0]


def test_smoothness_of_the_trivial():
    cost = SmoothnessCost(acceleration=1.0, jerk=1.0)
    assert float(cost(torch.ones(5, 3))) == 0.0
    assert float(cost(torch.ones(1, 3))) == 0.0
    line = torch.linspace(0.0, 1.0, 9, dtype=torch.float64)[:, None]
    assert float(cost(line)) == pytest.approx(1.0)  # of unit speed for a second
    assert float(SmoothnessCost(joint_weights=[3.0])(line)) == pytest.approx(3.0)


def test_joints_go_as_the_waypoints_say(arm):
    class Wheel:
        name, dof, joint_names = "wheel", 2, ("a", "b")
        continuous = np.array([True, False])

    path = torch.tensor([[3.1, 0.0], [-3.1, 0.5]], dtype=torch.float64)
    assert float(SmoothnessCost(robot=Wheel())(path)) == pytest.approx(6.2**2 + 0.25)
    with pytest.raises(RobotError, match="a, b"):
        SmoothnessCost(robot=Wheel())(path[:, :1])


def test_joint_limits(arm):
    cost = JointLimitCost(arm, margin=0.1)
    middle = torch.from_numpy(0.5 * (arm.lower + arm.upper))
    q = middle.repeat(4, 1)
    assert float(cost(q)) == 0.0
    q[1, 0], q[2, 3] = arm.upper[0] - 0.04, arm.lower[3] - 0.2
    assert float(cost(q)) == pytest.approx((0.06**2 + 0.3**2) / 4.0)
    assert float(JointLimitCost(arm, margin=99.0)(middle[None])) == pytest.approx(0.0)


def test_pose(arm):
    q = arm.neutral
    poses = arm.link_poses(q)
    rng = np.random.default_rng(0)
    for link in ("panda_hand", "panda_link4"):
        cost = PoseCost(arm, link, poses[link], at=1, rotation_weight=0.5)
        path = torch.from_numpy(np.stack([q, q, q + 1.0]))
        assert float(cost(path)) == pytest.approx(0.0, abs=1e-12)
        other = rng.uniform(arm.lower, arm.upper)
        path[1] = torch.from_numpy(other)
        found = arm.link_poses(other)[link]
        away = found[:3, 3] - poses[link][:3, 3]
        cosine = 0.5 * (np.trace(found[:3, :3].T @ poses[link][:3, :3]) - 1.0)
        assert float(cost(path)) == pytest.approx(away @ away + 0.5 * 2.0 * (1.0 - cosine))


def test_self_collision_is_the_sum_over_sphere_pairs(arm_checker, colliding):
    robot, margin = arm_checker.robot, 0.03
    arrays, kept = robot.arrays, arm_checker.config.self_margin
    cost = SelfCollisionCost(arm_checker, margin=margin, subsamples=1)
    for path, found in zip(colliding, cost(colliding), strict=True):
        per_waypoint = []
        for q in path.numpy():
            centers = sphere_positions(arrays, q)
            total = 0.0
            for a, b in arrays.pairs:
                for s in range(arrays.link_start[a], arrays.link_start[a + 1]):
                    for t in range(arrays.link_start[b], arrays.link_start[b + 1]):
                        gap = np.linalg.norm(centers[s] - centers[t]) - kept
                        gap -= arrays.sphere_radius[s] + arrays.sphere_radius[t]
                        total += float(hinge(torch.tensor(gap), margin))
            per_waypoint.append(total)
        by_time = 0.25 * per_waypoint[0] + 0.5 * per_waypoint[1] + 0.25 * per_waypoint[2]
        assert float(found) == pytest.approx(by_time, abs=1e-9)


def test_padding_does_not_count_between_links(arm, colliding):
    padded = arm.with_padding(0.02)
    path = colliding[1:]
    plain = SelfCollisionCost(arm, subsamples=1)(path)
    assert torch.allclose(SelfCollisionCost(padded, subsamples=1)(path), plain, atol=1e-9)


def test_soft_contact_ends():
    depth = torch.tensor([-9.0, -8.0, 0.0, 30.0, 500.0], dtype=torch.float64, requires_grad=True)
    value = soft_contact(depth, 8.0)
    expected = [0.0, 0.0, np.log(2.0) * (1.0 - np.exp(-8.0)) ** 2, 30.0, 500.0]
    assert value.tolist() == pytest.approx(expected)
    (slope,) = torch.autograd.grad(value.sum(), depth)
    assert slope.tolist() == pytest.approx([0.0, 0.0, 0.5, 1.0, 1.0], abs=2e-3)
