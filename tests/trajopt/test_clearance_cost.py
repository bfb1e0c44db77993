# SPDX-License-Identifier: BSD-3-Clause
"""The distance field as a smooth function, and the cost made of it."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.small_scenes import at

import vprism_plan as vp
from vprism_plan.trajopt import ClearanceCost
from vprism_plan.trajopt._field import SplineField, grown, union_field
from vprism_plan.trajopt.sphere_costs import hinge
from vprism_plan.world.distance import Lattice, NodeDistances, distance_to_lattice, finish
from vprism_plan.world.grid import Grid

H = 0.01


def strewn(seed, share=0.004, shape=(14, 12, 13)):
    """A field of single occupied nodes, and their positions."""
    marks = np.random.default_rng(seed).random(shape) < share
    marks[3, 4, 5] = True
    grid = Grid(H, np.array([-5, 2, -3]), shape)
    away, _ = distance_to_lattice(Lattice(marks.astype(np.uint8), grid.first, 1), grid)
    field = finish(NodeDistances(away, np.zeros(shape, np.int16)), grid, (), False)
    return field, grid.origin + H * np.argwhere(marks)


def values(field, points):
    columns = np.zeros(1, dtype=np.int64)
    return field(torch.from_numpy(points)[:, None], columns)[:, 0].numpy()


@settings(max_examples=25)
@given(st.integers(0, 40))
def test_the_spline_never_says_farther_than_it_promises(seed):
    """D^2 <= d^2 + 3 h^2 / 4 against brute force, inside the grid and outside."""
    field, obstacles = strewn(seed)
    rng = np.random.default_rng(seed + 1)
    points = rng.uniform(field.origin - 0.04, field.upper + 0.04, (400, 3))
    true = np.linalg.norm(points[:, None] - obstacles, axis=2).min(axis=1)
    smooth = values(union_field([field], np.empty((0, 4))), points)
    assert (smooth <= np.sqrt(true**2 + 0.75 * H**2) + 1e-6).all()
    inside = ((points >= field.origin) & (points <= field.upper)).all(axis=1)
    assert (smooth >= true - 2.7 * H)[inside].all()  # and is not useless
    radii = rng.uniform(0.0, 0.05, 400)
    assert (true[smooth > grown(radii, H)] > radii[smooth > grown(radii, H)] - 1e-6).all()


def test_half_spaces_are_exact_away_from_edges():
    field, _ = strewn(0)
    empty = finish(
        NodeDistances(np.full((14, 12, 13), np.inf, np.float32), np.zeros((14, 12, 13), np.int16)),
        Grid(H, np.array([-5, 2, -3]), (14, 12, 13)), (), False,
    )  # fmt: skip
    plane = np.array([[0.0, 0.0, 1.0, -0.021]])
    points = np.random.default_rng(0).uniform([-0.03, 0.04, 0.0], [0.06, 0.11, 0.07], (50, 3))
    assert values(union_field([empty], plane), points) == pytest.approx(points[:, 2] + 0.021)
    assert union_field([field], plane) is union_field([field], plane)  # kept
    assert union_field([field], 2 * plane) is not union_field([field], plane)


def test_everything_outside_may_be_an_obstacle():
    nodes = np.full((1, 6, 6, 6), 0.02, np.float32)
    field = SplineField(nodes, np.zeros(3), H, solid_outside=True)
    away = np.array([[0.025, 0.025, 0.08], [0.025, 0.025, 0.025]])
    assert values(field, away) == pytest.approx([0.02 - 0.03, 0.02])


def test_the_gradient_is_continuous():
    """Across every cell face and across the faces of the grid of an empty field's rim."""
    field, _ = strewn(3)
    spline = union_field([field], np.empty((0, 4)))
    start, end = field.origin + 0.013, field.upper - 0.011
    t = torch.linspace(0.0, 1.0, 20_001, dtype=torch.float64)[:, None]
    x = (torch.from_numpy(start) + t * torch.from_numpy(end - start)).requires_grad_()
    (grad,) = torch.autograd.grad(spline(x[:, None], np.zeros(1, np.int64)).sum(), x)
    steps = grad.diff(dim=0).norm(dim=1)
    assert steps.max() < 30.0 * steps.mean()  # a kink would be thousands of times the mean


def test_the_potential():
    gap = torch.tensor([0.03, 0.02, 0.01, 0.0, -0.05], dtype=torch.float64)
    expected = [0.0, 0.0, 0.0025, 0.01, 0.06]
    assert hinge(gap, 0.02).tolist() == pytest.approx(expected)


# --- a ball that flies ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def ball(ball_robot):
    return ball_robot(0.03)


def inside_crate(crate, n, rng, depth):
    """Points at least so deep inside the crate."""
    half = 0.5 * np.asarray(crate.size) - depth
    return crate.T_world[:3, 3] + rng.uniform(-half, half, (n, 3))


def test_deep_inside_there_is_a_way_out(cost_world, ball, crate):
    """No plateau: from anywhere inside the crate (which stands on the table), under the table,
    and inside the map's objects, walking down the gradient ends where nothing is touched."""
    world = vp.World(cost_world.map, replace(cost_world.config, occluded="occupied"))
    cost = ClearanceCost(world, ball, subsamples=1)
    rng = np.random.default_rng(0)
    starts = np.concatenate([
        inside_crate(crate, 60, rng, 0.005),
        rng.uniform([-0.1, -0.4, -0.3], [0.1, 0.2, -0.01], (20, 3)),
        rng.uniform([-0.01, 0.03, 0.01], [0.03, 0.08, 0.07], (20, 3)),  # the map's box
        rng.uniform([0.02, -0.1, 0.01], [0.2, 0.1, 0.06], (20, 3)),  # its shadow
    ])  # fmt: skip
    q = torch.from_numpy(starts)[:, None].clone().requires_grad_()
    before = cost(q)
    (grad,) = torch.autograd.grad(before.sum(), q)
    steep = grad.norm(dim=(1, 2))
    assert before.min() > 0.0
    assert (steep > 0.0).all()  # small only where two ways out are equally long
    assert (steep > 0.4).float().mean() > 0.97
    for _ in range(250):
        (grad,) = torch.autograd.grad(cost(q).sum(), q)
        q = (q.detach() - 0.004 * grad).requires_grad_()
    checker = vp.CollisionChecker(world, ball)
    assert checker.clearance_batch(q.detach()[:, 0].numpy()).min() > -0.002


def test_depth_costs_as_much_as_it_is(cost_world, ball, crate):
    """Below the crate's top the cost grows by one metre per metre, all the way to its middle."""
    cost = ClearanceCost(cost_world, ball, subsamples=1)
    center = crate.T_world[:3, 3]
    heights = np.linspace(0.075, 0.115, 9)
    q = torch.from_numpy(np.array([[center[0], center[1], z] for z in heights]))[:, None]
    slopes = np.diff(cost(q).numpy()) / np.diff(heights)
    assert np.abs(slopes + 1.0).max() < 0.35  # nodes are a centimetre apart
    assert slopes.mean() == pytest.approx(-1.0, abs=0.1)


def test_nothing_to_pay_means_free(cost_world, ball, arm):
    rng = np.random.default_rng(4)
    for robot, n in ((ball, 4000), (arm, 1500)):
        low, high = np.maximum(robot.lower, -2.9), np.minimum(robot.upper, 2.9)
        if robot is ball:
            low, high = np.array([-0.4, -0.6, -0.1]), np.array([0.5, 0.5, 0.6])
        Q = rng.uniform(low, high, (n, robot.dof))
        cost = ClearanceCost(cost_world, robot, margin=0.02)(torch.from_numpy(Q)[:, None])
        checker = vp.CollisionChecker(cost_world, robot)
        clearance = checker.clearance_batch(Q)
        # What was seen outside the grid is for the checker alone.
        grid, moving = cost_world.grid, ~robot.fixed_links[robot.sphere_links]
        for q in Q[(cost.numpy() == 0.0) & (clearance <= 0.0)]:
            centers, plane, _, field = checker.sphere_clearances(q)
            wrong = moving & (np.minimum(plane, field) <= 0.0)
            assert ((centers < grid.origin) | (centers > grid.upper)).any(axis=1)[wrong].all()
        assert (cost.numpy()[clearance < 0.0] > 0.0).mean() > 0.95
        assert 0.02 < (cost == 0.0).double().mean() < 0.98


def test_more_margin_costs_more(arm_checker, colliding):
    spread = colliding + 0.3 * torch.randn(
        (3, 3, 7), generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    costs = [ClearanceCost(arm_checker, margin=m)(spread) for m in (0.005, 0.01, 0.03, 0.1)]
    for less, more in pairwise(costs):
        assert (more >= less).all()


def test_between_waypoints_it_looks_too(cost_world, ball, crate):
    x, y, _ = crate.T_world[:3, 3]
    path = torch.tensor([[x - 0.2, y, 0.06], [x + 0.2, y, 0.06]], dtype=torch.float64)
    assert ClearanceCost(cost_world, ball, subsamples=1)(path) == 0.0
    fine = ClearanceCost(cost_world, ball, subsamples=64)(path)
    assert fine > 0.005
    assert ClearanceCost(cost_world, ball)(path) == pytest.approx(float(fine), rel=0.25)
    more = torch.stack([path[0] + t * (path[1] - path[0]) for t in torch.linspace(0, 1, 30)])
    assert ClearanceCost(cost_world, ball)(more) == pytest.approx(float(fine), rel=0.05)


def test_by_length_a_detour_in_time_costs_nothing(cost_world, ball, crate):
    x, y, _ = crate.T_world[:3, 3]
    t = torch.linspace(0.0, 1.0, 60, dtype=torch.float64)
    for timing in (t, t**3, 1.0 - (1.0 - t) ** 2):
        path = torch.stack([torch.full_like(t, x), y - 0.2 + 0.4 * timing, 0 * t + 0.05], dim=1)
        cost = ClearanceCost(cost_world, ball, arc_length=True, spacing=0.002)(path)
        by_time = ClearanceCost(cost_world, ball, spacing=0.002)(path)
        if timing is t:
            expected, slow = float(cost), float(by_time)
        assert float(cost) == pytest.approx(expected, rel=0.01)
    assert expected == pytest.approx(0.4 * slow, rel=0.01)  # metres times the average
    assert float(ClearanceCost(cost_world, ball, arc_length=True)(path[30:31].expand(4, 3))) == 0.0


def test_what_may_be_touched_is_no_obstacle(cost_world, ball):
    """Object 5 is the box of the map; a rule for the ball takes it out, shadows aside."""
    inside = torch.tensor([[0.005, 0.055, 0.07]], dtype=torch.float64)
    allowed = vp.CheckerConfig(allowed_contacts={"ball": {5}})
    checkers = [vp.CollisionChecker(cost_world, ball, c) for c in (None, allowed)]
    strict, lenient = (float(ClearanceCost(c)(inside)) for c in checkers)
    assert lenient < strict
    margin = vp.CollisionChecker(cost_world, ball, vp.CheckerConfig(margin=0.01))
    assert float(ClearanceCost(margin)(inside)) == pytest.approx(strict + 0.01, abs=0.001)


def test_the_mounted_base_does_not_count(cost_world, arm):
    """Its spheres reach into the table for ever."""
    up = torch.tensor(arm.neutral)[None]
    lifted = arm.with_base_pose(at(-0.45, 0.0, 0.6))
    for robot in (arm, lifted):
        assert float(ClearanceCost(cost_world, robot)(up)) < 0.02
