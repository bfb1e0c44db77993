"""Bounds over whole edges against dense sampling of the exact distance, on random robots."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.checker_oracle import BallWorld, self_clearance, sphere_positions, world_clearance
from oracles.random_robots import as_robot, random_arrays, random_q

from vprism_plan.collision import CheckerConfig, CollisionChecker
from vprism_plan.collision.motion import (
    edges_of,
    max_safe_motion,
    min_clearance,
    motion_bounds,
    sphere_jacobians,
)
from vprism_plan.errors import RobotError

SPACING = 0.03
seeds = st.integers(0, 2**32 - 1)


def random_case(seed, **config):
    rng = np.random.default_rng(seed)
    arrays = random_arrays(rng, dof=int(rng.integers(1, 6)))
    n = int(rng.integers(1, 7))
    normal = rng.normal(size=3)
    plane = [[*(normal / np.linalg.norm(normal)), rng.uniform(-1.2, -0.4)]]
    truth = BallWorld(rng.uniform(-0.9, 0.9, (n, 3)), rng.uniform(0.02, 0.3, n), np.array(plane))
    world = truth.baked(SPACING)
    return rng, arrays, truth, CollisionChecker(world, as_robot(arrays), CheckerConfig(**config))


def random_path(rng, arrays, n):
    """Waypoints a little to far apart."""
    path = [random_q(rng, arrays)]
    for _ in range(n - 1):
        step = rng.uniform(0.02, 0.5) * (random_q(rng, arrays) - path[-1])
        path.append(path[-1] + step)
    return np.array(path)


def dense(path, n):
    share = np.linspace(0.0, 1.0, n, endpoint=False)[:, None]
    parts = [a + share * (b - a) for a, b in pairwise(path)]
    return np.concatenate([*parts, path[-1:]])


@settings(max_examples=25, deadline=None)
@given(seeds)
def test_jacobians_equal_finite_differences(seed):
    rng = np.random.default_rng(seed)
    arrays = random_arrays(rng, dof=int(rng.integers(1, 6)))
    q = random_q(rng, arrays)
    spheres = np.arange(len(arrays.sphere_radius))
    centers, jacobian = sphere_jacobians(arrays, np.tile(q, (len(spheres), 1)), spheres)
    np.testing.assert_allclose(centers, sphere_positions(arrays, q), atol=1e-12)
    for j in range(len(q)):
        step = np.zeros(len(q))
        step[j] = 1e-6
        slope = (sphere_positions(arrays, q + step) - sphere_positions(arrays, q - step)) / 2e-6
        np.testing.assert_allclose(jacobian[:, :, j], slope, atol=1e-7)


@settings(max_examples=12, deadline=None)
@given(seeds)
def test_motion_bounds_hold_and_agree_with_the_edge_check(seed):
    rng, arrays, _, checker = random_case(seed)
    path = random_path(rng, arrays, 4)
    edges = edges_of(checker, path)
    own, between = motion_bounds(arrays, edges.delta)
    for e in range(3):
        stated = checker.check_motion_report(path[e], path[e + 1]).motion_bound
        assert max(own[e], between[e]) == pytest.approx(stated, rel=1e-9)
        way = sphere_positions(arrays, edges.at(np.full(65, e), np.linspace(0, 1, 65)))
        length = np.linalg.norm(np.diff(way, axis=0), axis=2).sum(axis=0)
        assert length.max() <= own[e] + 1e-9


@settings(max_examples=25, deadline=None)
@given(seeds, st.sampled_from([0.0003, 0.002]))
def test_no_point_of_the_path_is_nearer_than_its_smallest_clearance(seed, tolerance):
    rng, arrays, truth, checker = random_case(seed)
    path = random_path(rng, arrays, int(rng.integers(1, 4)))
    found = min_clearance(checker, path, tolerance)
    Q = dense(edges_of(checker, path).path, 400)
    exact = world_clearance(arrays, truth, Q[::8]).min()
    assert found.clearance <= exact + 1e-9
    computed = checker.clearance_batch(Q)
    assert found.clearance <= computed.min() + 1e-9
    # Within the tolerance of the smallest: nothing denser finds less.
    assert found.clearance >= computed.min() - found.tolerance - 1e-9 or (
        checker.clearance(found.q) < computed.min()
    )
    assert checker.clearance(found.q) == pytest.approx(found.clearance + found.tolerance, abs=1e-12)
    assert found.tolerance == (tolerance if len(path) > 1 else 0.0)
    edge = min(int(found.place), max(0, len(path) - 2))
    if len(path) > 1:
        there = edges_of(checker, path).at(np.array([edge]), np.array([found.place - edge]))[0]
        np.testing.assert_allclose(found.q, there, atol=1e-9)


def test_a_motionless_path_has_an_exact_clearance():
    rng, arrays, _, checker = random_case(3)
    q = random_q(rng, arrays)
    found = min_clearance(checker, [q, q, q])
    assert found.clearance == checker.clearance(q)
    assert found.tolerance == 0.0
    assert "within 0.00 mm" in found.text()


@settings(max_examples=25, deadline=None)
@given(seeds, st.floats(0.0, 0.02))
def test_motion_is_safe_before_and_refused_just_after(seed, margin):
    rng, arrays, truth, checker = random_case(seed, margin=margin)
    q = next((q for q in (random_q(rng, arrays) for _ in range(60)) if checker.is_valid(q)), None)
    if q is None:
        return
    dq = rng.uniform(0.05, 1.5) * (random_q(rng, arrays) - q)
    found = max_safe_motion(checker, q, dq)
    assert found.tolerance <= 0.0005
    along = np.linspace(0.0, found.fraction, 1000)
    Q = q + along[:, None] * dq
    assert checker.is_valid_batch(Q).all()
    assert (world_clearance(arrays, truth, Q[::40]) > margin - found.tolerance).all()
    assert (self_clearance(arrays, Q[::40]) > -found.tolerance).all()
    if found.whole:
        assert found.fraction == 1.0
        assert found.reason is None
        assert "all of it" in found.text()
        return
    assert not checker.is_valid(q + found.refused_at * dq)
    motion = found.distance / found.fraction if found.fraction else np.inf
    assert (found.refused_at - found.fraction) * motion <= found.tolerance + 1e-12
    assert not found.reason.valid
    assert found.reason.text() in found.text()
    assert found.to_dict()["reason"]["contacts"]


def test_motion_from_a_refused_configuration_is_not_safe_at_all():
    for seed in range(50):
        rng, arrays, _, checker = random_case(seed)
        q = random_q(rng, arrays)
        if not checker.is_valid(q):
            found = max_safe_motion(checker, q, np.ones(len(q)))
            assert (found.fraction, found.refused_at, found.distance) == (0.0, 0.0, 0.0)
            assert not found.whole
            return
    pytest.fail("no refused configuration")


def test_motion_ends_at_a_joint_limit_and_says_so(ball_robot):
    empty = BallWorld(np.array([[0.0, 0.0, -0.9]]), np.array([0.05]), np.zeros((0, 4)))
    checker = CollisionChecker(empty.baked(SPACING), ball_robot(0.02))
    found = max_safe_motion(checker, [0.0, 0.0, 0.5], [4.0, 1.0, 0.0])
    assert found.fraction == pytest.approx(0.75, abs=1e-3)
    assert found.fraction <= 0.75
    assert found.reason.contacts[0].kind == "joint_limit"
    assert found.configurations < 300
    assert max_safe_motion(checker, [0.0, 0.0, 0.5], [3.0, 0.0, 0.0]).whole
    assert max_safe_motion(checker, [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]).whole


def test_a_ball_that_falls_on_a_plane_stops_where_geometry_says(ball_robot):
    ground = BallWorld(
        np.array([[0.9, 0.9, 0.9]]), np.array([0.05]), np.array([[0.0, 0.0, 1.0, 0.0]])
    )
    checker = CollisionChecker(ground.baked(SPACING), ball_robot(0.05), CheckerConfig(margin=0.01))
    found = max_safe_motion(checker, [0.0, 0.0, 0.4], [0.0, 0.0, -0.8])
    assert found.fraction == pytest.approx((0.4 - 0.06) / 0.8, abs=1e-6)
    assert found.distance == pytest.approx(0.34, abs=1e-6)
    path = [[-0.3, 0.0, 0.3], [0.0, 0.0, 0.12], [0.3, 0.0, 0.3]]
    lowest = min_clearance(checker, path)
    assert lowest.clearance == pytest.approx(0.07 - lowest.tolerance, abs=1e-9)
    assert lowest.place == 1.0


def test_nonsense_is_refused_by_name(ball_robot):
    truth = BallWorld(np.array([[0.0, 0.0, 0.0]]), np.array([0.1]), np.zeros((0, 4)))
    checker = CollisionChecker(truth.baked(SPACING), ball_robot(0.05))
    for call in (min_clearance, lambda c, p: max_safe_motion(c, p, p)):
        with pytest.raises(RobotError, match="shape"):
            call(checker, np.zeros((2, 2)))
        with pytest.raises(RobotError, match=r"finite|inf"):
            call(checker, np.full((1, 3) if call is min_clearance else 3, np.inf))
    with pytest.raises(RobotError, match=r"joint x goes from 0.0000 to 4.0000 m"):
        min_clearance(checker, [[0.0, 0.0, 0.0], [4.0, 0.0, 0.0]])
    with pytest.raises(RobotError, match="tolerance"):
        min_clearance(checker, [[0.0, 0.0, 0.0]], tolerance=0.0)
    with pytest.raises(RobotError, match="tolerance"):
        max_safe_motion(checker, [0.0, 0.0, 0.0], [1.0, 0.0, 0.0], tolerance=np.nan)
    with pytest.raises(RobotError, match="shape"):
        min_clearance(checker, np.zeros((0, 3)))


@pytest.mark.slow
def test_with_a_bound_on_risk_motion_stops_where_the_verdict_does(demo_map, demo_world, ball_robot):
    seen, labels = demo_map.views[0].points()
    middle = seen[labels == 3].mean(axis=0)
    checker = CollisionChecker(demo_world, ball_robot(0.02), CheckerConfig(max_risk=0.05))
    start = middle + np.array([0.0, 0.0, 0.25])
    found = max_safe_motion(checker, start, middle - start, tolerance=0.002)
    assert 0.0 < found.fraction < 1.0
    along = np.linspace(0.0, found.fraction, 50)[:, None]
    assert checker.is_valid_batch(start + along * (middle - start)).all()
    assert not checker.is_valid(start + found.refused_at * (middle - start))
    assert found.reason.contacts
