# SPDX-License-Identifier: BSD-3-Clause
"""Occupancy, entropy and joint risk against what the map and its draws say."""

import numpy as np
import pytest
import torch
from oracles.risk_oracle import DrawnVoxels, ball_touches

import vprism_plan as vp
from vprism_plan.trajopt import EntropyCost, OccupancyCost, RiskCost
from vprism_plan.trajopt.posterior_costs import ball_quadrature

RADIUS = 0.03
SUPPORT = 0.5  # kernel mass from which readings count, of a map alone


@pytest.fixture(scope="module")
def ball(ball_robot):
    return ball_robot(RADIUS)


@pytest.fixture(scope="module")
def places():
    """Trajectories of one waypoint in and around the objects: (40, 1, 3)."""
    spots = np.random.default_rng(0).uniform([-0.06, -0.12, 0.0], [0.08, 0.12, 0.12], (40, 3))
    return torch.from_numpy(spots)[:, None]


def test_the_quadrature_averages_over_the_ball():
    nodes, weights = ball_quadrature()
    rng = np.random.default_rng(0)
    inside = rng.normal(size=(400_000, 3))
    inside *= (rng.random((400_000, 1)) ** (1 / 3)) / np.linalg.norm(inside, axis=1, keepdims=True)
    for i, j, k in ((0, 0, 0), (2, 0, 0), (4, 0, 0), (2, 2, 0), (1, 0, 0), (3, 1, 0), (1, 1, 1)):
        exact = np.prod(inside ** [i, j, k], axis=1).mean()
        assert weights @ np.prod(nodes ** [i, j, k], axis=1) == pytest.approx(exact, abs=2e-3)
    assert (weights > 0).all()


def around(places):
    nodes, weights = ball_quadrature()
    return (places[:, 0, None].numpy() + RADIUS * nodes).reshape(-1, 3), weights


def test_occupancy_and_entropy_are_averages_of_the_map(cost_map, ball, places):
    points, weights = around(places)
    p = cost_map.predict_proba(points)
    counts = -np.expm1(-cost_map.support(points) / SUPPORT)
    readings = {
        "hazard": -np.log(p[:, 0]),
        "probability": p[:, 1:].sum(axis=1),
        "entropy": -(p * np.log(p)).sum(axis=1),
    }
    for name, values in readings.items():
        if name == "entropy":
            cost = EntropyCost(cost_map, ball)
        else:
            cost = OccupancyCost(cost_map, ball, measure=name)
        expected = (counts * values).reshape(-1, len(weights)) @ weights
        assert cost(places).numpy() == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_baked_is_exact_with_finer_nodes(cost_map, ball, places):
    for kind in (OccupancyCost, EntropyCost):
        exact = kind(cost_map, ball)(places)
        errors = [
            (kind(cost_map, ball, exact=False, resolution=h)(places) - exact).abs().mean()
            for h in (0.01, 0.005)
        ]
        assert errors[1] < 0.6 * errors[0]
        assert errors[0] < 0.15 * exact.mean()


def test_what_is_certain_counts_with_a_world(cost_map, cost_world, ball, crate, places):
    alone, composed = OccupancyCost(cost_map, ball), OccupancyCost(cost_world, ball)
    assert (composed(places) >= alone(places) - 1e-12).all()
    x, y, z = crate.T_world[:3, 3]
    inside = torch.tensor([[[x, y, z]], [[x, y, -0.05]], [[0.25, 0.25, 0.35]]], dtype=torch.float64)
    assert alone(inside)[:2].max() < 0.05
    hazard = composed(inside)
    assert hazard[:2].min() > 10.0
    assert hazard[2] == 0.0
    certain = OccupancyCost(cost_world, ball, measure="probability")(inside)
    assert certain.tolist() == pytest.approx([1.0, 1.0, 0.0], abs=1e-4)


def test_the_hazard_keeps_its_slope_where_probability_is_one(cost_map, cost_world, ball):
    """Below the table and in the crate P is 1 to the last bit."""
    q = torch.tensor([[[0.01, -0.31, 0.07]], [[0.1, 0.0, -0.2]]], dtype=torch.float64)
    q.requires_grad_()
    for kind in (OccupancyCost, RiskCost):
        (grad,) = torch.autograd.grad(kind(cost_world, ball)(q).sum(), q)
        assert (grad.norm(dim=(1, 2)) > 10.0).all()


# --- joint risk -----------------------------------------------------------------------------------


def behind(x, n=24):
    """A way past the far sides of both objects, x metres from the camera's side."""
    y = np.linspace(-0.14, 0.14, n)
    return torch.from_numpy(np.column_stack([np.full(n, x), y, np.full(n, 0.05)]))


@pytest.fixture(scope="module")
def sharp(cost_map, ball):
    """So cold that a draw is touched or it is not."""
    return RiskCost(cost_map, ball, temperature=2e-5, subsamples=1)


def test_when_cold_it_is_the_share_of_draws_that_are_touched(cost_map, ball, sharp):
    """Between the share for the ball and for one larger by what the spline may err."""
    voxels = DrawnVoxels(cost_map, 64, 0, 0.01)
    shares = []
    for x in (0.03, 0.055, 0.08, 0.095):
        path = behind(x)
        low, high = (
            np.any(
                [ball_touches(voxels, c, r, 0.01, inscribed=True) for c in path.numpy()], axis=0
            ).mean()
            for r in (RADIUS - 1e-4, RADIUS + 0.006)
        )
        p = float(sharp.probability(path))
        assert low - 1e-6 <= p <= high + 1e-6
        shares.append(p)
    assert shares == sorted(shares, reverse=True)
    assert shares[0] > 0.9
    assert shares[-1] < 0.5


def test_it_is_joint_not_a_sum(cost_map, ball, sharp):
    """Twice the same way is not twice the risk: the same draws are hit again."""
    path = behind(0.08)
    there_and_back = torch.cat([path, path.flip(0)])
    once, twice = (float(sharp.probability(q)) for q in (path, there_and_back))
    assert twice == pytest.approx(once, abs=0.01)


def test_like_the_checkers_probability(cost_world, ball_robot):
    """Between those of a smaller and a larger ball: both err to contact by part of a voxel."""
    config = vp.CheckerConfig(n_worlds=64, risk_seed=0)
    smaller, own, larger = (
        vp.CollisionChecker(cost_world, ball_robot(RADIUS + by), config)
        for by in (-0.008, 0, 0.008)
    )
    cold = RiskCost(own, temperature=2e-5, spacing=0.004)
    warm = RiskCost(own, spacing=0.004)
    seen = []
    for lift in (0.09, 0.11, 0.13, 0.16):
        path = behind(-0.03) + torch.tensor([0.0, 0.0, lift - 0.05], dtype=torch.float64)
        low, high = (c.collision_probability(path.numpy()).probability for c in (smaller, larger))
        seen.append(float(cold.probability(path)))
        assert low - 0.02 <= seen[-1] <= high + 0.02
        assert float(warm.probability(path)) >= seen[-1] - 0.02
    assert seen[0] > 0.5 > seen[-1]
    down = behind(-0.03) - torch.tensor([0.0, 0.0, 0.1], dtype=torch.float64)
    assert own.collision_probability(down.numpy()).certain
    assert float(cold.probability(down)) == pytest.approx(1.0)


def test_gradients_when_every_draw_is_hit(cost_map, ball):
    """The probability is 1 and flat; its cost still leads out, to where no draw is touched."""
    cost = RiskCost(cost_map, ball, subsamples=1)
    q = torch.tensor([[[0.01, 0.055, 0.04]], [[0.0, -0.05, 0.03]]], dtype=torch.float64)
    q.requires_grad_()
    assert (cost.probability(q) > 0.999).all()
    assert (torch.autograd.grad(cost(q).sum(), q)[0].norm(dim=(1, 2)) > 20.0).all()
    for _ in range(150):
        (grad,) = torch.autograd.grad(cost(q).sum(), q)
        q = (
            q.detach() - 0.002 * grad / (1e-9 + grad.norm(dim=(1, 2), keepdim=True))
        ).requires_grad_()
    assert cost.probability(q).max() < 0.2


def test_draws_are_fixed_by_the_seed(cost_map, ball, sharp):
    path = behind(0.055)
    again = RiskCost(cost_map, ball, temperature=2e-5, subsamples=1)
    other = RiskCost(cost_map, ball, temperature=2e-5, subsamples=1, seed=1)
    assert torch.equal(again(path), sharp(path))
    assert not torch.equal(other(path), sharp(path))


def test_objects_that_may_be_touched_are_no_risk(cost_world, ball):
    path = behind(0.03, 12)[6:]  # past the box, object 5
    config = vp.CheckerConfig(allowed_contacts={"ball": {5}})
    allowed = RiskCost(vp.CollisionChecker(cost_world, ball, config), temperature=1e-3)
    strict = RiskCost(cost_world, ball, temperature=1e-3)
    hazards = (
        OccupancyCost(vp.CollisionChecker(cost_world, ball, config)),
        OccupancyCost(cost_world, ball),
    )
    assert float(allowed(path)) < 0.5 * float(strict(path))
    assert float(hazards[0](path)) < float(hazards[1](path))


def test_a_map_of_nothing_is_no_risk(cost_map, ball):
    far = torch.full((4, 3), 2.0, dtype=torch.float64, requires_grad=True)
    for cost in (RiskCost(cost_map, ball), OccupancyCost(cost_map, ball)):
        assert float(cost(far).detach()) == 0.0
        assert torch.autograd.grad(cost(far), far)[0].abs().max() == 0.0
