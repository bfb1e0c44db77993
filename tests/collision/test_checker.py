"""The checking kernels against textbook twins, on random robots in random worlds."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.checker_oracle import (
    BallWorld,
    frame_poses,
    self_clearance,
    sphere_positions,
    world_clearance,
)
from oracles.random_robots import as_robot, random_arrays, random_q

from vprism_plan._kernels import checking as kernels
from vprism_plan.collision import CheckerConfig, CollisionChecker
from vprism_plan.collision.packing import pack_robot, reach_table
from vprism_plan.errors import ConfigError, RobotError

SPACING = 0.03
# Worst case of max_i(d_i - |x - x_i|) over a cell: half a face diagonal.
INFLATION = 0.75 * SPACING

seeds = st.integers(0, 2**32 - 1)


def random_world(rng, unobserved="free", n=None):
    n = int(rng.integers(1, 9)) if n is None else n
    planes = []
    for _ in range(int(rng.integers(0, 3))):
        normal = rng.normal(size=3)
        planes.append([*(normal / np.linalg.norm(normal)), rng.uniform(-1.2, -0.4)])
    centers = rng.uniform(-0.9, 0.9, (n, 3))
    # A field knows obstacles inside its grid only, so none may stick out of it.
    radii = np.minimum(rng.uniform(0.02, 0.3, n), 0.97 - np.abs(centers).max(axis=1))
    truth = BallWorld(centers, radii, np.array(planes).reshape(-1, 4))
    return truth, truth.baked(SPACING, unobserved=unobserved)


def random_case(seed, **config):
    rng = np.random.default_rng(seed)
    arrays = random_arrays(rng, dof=int(rng.integers(1, 6)))
    truth, world = random_world(rng)
    return rng, arrays, truth, CollisionChecker(world, as_robot(arrays), CheckerConfig(**config))


@settings(max_examples=60, deadline=None)
@given(seeds)
def test_compiled_kinematics_equal_products_of_matrices(seed):
    rng = np.random.default_rng(seed)
    arrays = random_arrays(rng, dof=int(rng.integers(1, 7)))
    packed = pack_robot(arrays)
    q = random_q(rng, arrays)
    centers = np.empty((3, len(arrays.sphere_radius)))
    kernels.place_spheres(q, *packed, centers)
    np.testing.assert_allclose(centers.T, sphere_positions(arrays, q), atol=1e-12)


@settings(max_examples=60, deadline=None)
@given(seeds)
def test_clearance_never_exceeds_the_truth_and_is_close_below_it(seed):
    rng, arrays, truth, checker = random_case(seed)
    Q = np.array([random_q(rng, arrays) for _ in range(20)])
    exact = world_clearance(arrays, truth, Q)
    ours = np.array([checker.clearance(q) for q in Q])
    assert (ours <= exact + 1e-9).all()
    inside_grid = np.abs(sphere_positions(arrays, Q)).max(axis=(1, 2)) < 0.9
    close = inside_grid & (exact > -0.01)
    assert (ours[close] >= exact[close] - INFLATION).all()


@settings(max_examples=60, deadline=None)
@given(seeds, st.floats(0.0, 0.05), st.floats(0.0, 0.02))
def test_verdict_is_that_of_the_clearances(seed, margin, self_margin):
    rng, arrays, _, checker = random_case(seed, margin=margin, self_margin=self_margin)
    Q = np.array([random_q(rng, arrays) for _ in range(30)])
    world, own = checker.clearance_batch(Q), checker.self_clearance_batch(Q)
    singles = [checker.is_valid(q) for q in Q]
    assert all(isinstance(single, bool) for single in singles)  # OMPL accepts nothing else
    np.testing.assert_array_equal(checker.is_valid_batch(Q), singles)
    np.testing.assert_array_equal(world, [checker.clearance(q) for q in Q])
    decided = (np.abs(world - margin) > 1e-9) & (np.abs(own - self_margin) > 1e-9)
    expected = (world > margin) & (own > self_margin)
    np.testing.assert_array_equal(np.array(singles)[decided], expected[decided])


@settings(max_examples=40, deadline=None)
@given(seeds)
def test_self_clearance_is_exact(seed):
    rng, arrays, _, checker = random_case(seed)
    for _ in range(5):
        q = random_q(rng, arrays)
        exact = self_clearance(arrays, q)
        ours = checker.self_clearance_batch(q[None])[0]
        assert ours == pytest.approx(exact, abs=1e-12) if np.isfinite(exact) else np.isinf(ours)


@settings(max_examples=40, deadline=None)
@given(seeds)
def test_free_configurations_are_free_in_truth(seed):
    rng, arrays, truth, checker = random_case(seed)
    Q = np.array([random_q(rng, arrays) for _ in range(30)])
    free = Q[[checker.is_valid(q) for q in Q]]
    assert (world_clearance(arrays, truth, free) > 0).all()
    assert (self_clearance(arrays, free) > 0).all()


@settings(max_examples=40, deadline=None)
@given(seeds, st.floats(0.001, 0.05))
def test_clearance_does_not_depend_on_margin_and_validity_falls_with_it(seed, more):
    rng, arrays, _, checker = random_case(seed)
    padded = CollisionChecker(checker.world, checker.robot, CheckerConfig(margin=more))
    Q = np.array([random_q(rng, arrays) for _ in range(30)])
    np.testing.assert_array_equal(checker.clearance_batch(Q), padded.clearance_batch(Q))
    assert not np.any(padded.is_valid_batch(Q) & ~checker.is_valid_batch(Q))


@settings(max_examples=40, deadline=None)
@given(seeds)
def test_reach_table_bounds_the_motion_of_every_sphere(seed):
    rng = np.random.default_rng(seed)
    arrays = random_arrays(rng, dof=int(rng.integers(1, 6)))
    table = reach_table(arrays)
    step = 1e-6
    for _ in range(20):
        q = random_q(rng, arrays)
        before = sphere_positions(arrays, q)
        for j in range(len(q)):
            moved = q.copy()
            moved[j] += step
            speed = np.linalg.norm(sphere_positions(arrays, moved) - before, axis=1) / step
            frames = np.flatnonzero(arrays.q_index == j)
            bound = sum(
                abs(arrays.q_mult[f]) * np.maximum(table[f], 0.0)[arrays.sphere_link]
                for f in frames
            )
            assert np.all(speed <= bound + 1e-6)


def dense_edge(arrays, qa, qb, step):
    """Configurations along an edge, so that no sphere moves more than `step` between two."""
    coarse = qa + np.linspace(0, 1, 33)[:, None] * (qb - qa)
    moves = np.diff(sphere_positions(arrays, coarse), axis=0)
    longest = np.linalg.norm(moves, axis=2).max() if moves.size else 0.0
    n = 33 * max(1, int(np.ceil(1.5 * longest / step)))
    return qa + np.linspace(0, 1, n)[:, None] * (qb - qa)


@settings(max_examples=80, deadline=None)
@given(seeds)
def test_accepted_edges_hide_no_collision(seed):
    rng, arrays, truth, checker = random_case(seed)
    for _ in range(8):
        qa = random_q(rng, arrays)
        qb = qa + rng.uniform(0.05, 1.0) * (random_q(rng, arrays) - qa)
        report = checker.check_motion_report(qa, qb)
        assert report.valid == checker.check_motion(qa, qb)
        if not report.valid:
            assert not checker.is_valid(qa + report.collision_fraction * (qb - qa))
            assert not report.state.valid
            continue
        assert report.tolerance <= checker.config.tolerance
        gaps = world_clearance(arrays, truth, dense_edge(arrays, qa, qb, 0.004))
        assert gaps.min() > -report.tolerance - 1e-9


@settings(max_examples=40, deadline=None)
@given(seeds)
def test_edges_through_self_collision_are_refused(seed):
    rng, arrays, _, checker = random_case(seed)
    qa, qb = random_q(rng, arrays), random_q(rng, arrays)
    if checker.check_motion(qa, qb):
        gaps = self_clearance(arrays, dense_edge(arrays, qa, qb, 0.02))
        assert gaps.min() > -checker.config.tolerance - 1e-9


def test_edges_are_refused_at_the_same_place_in_both_directions():
    for seed in range(60):
        rng, arrays, _, checker = random_case(seed)
        qa, qb = random_q(rng, arrays), random_q(rng, arrays)
        assert checker.check_motion(qa, qb) == checker.check_motion(qb, qa)


@settings(max_examples=40, deadline=None)
@given(seeds)
def test_whole_world_moved_with_the_robot_changes_nothing_but_rounding(seed):
    """Distances at nodes are exact, so only the position within a cell may matter."""
    rng, arrays, truth, checker = random_case(seed)
    shift = rng.uniform(-0.3, 0.3, 3)
    planes = truth.planes.copy()
    if len(planes):
        planes[:, 3] += planes[:, :3] @ shift
    world = BallWorld(truth.centers + shift, truth.radii, planes).baked(
        SPACING, lower=tuple(-1.0 + shift), upper=tuple(1.0 + shift)
    )
    moved = arrays.__class__(**{**arrays.__dict__, "base_t": arrays.base_t + shift})
    there = CollisionChecker(world, as_robot(moved))
    for _ in range(10):
        q = random_q(rng, arrays)
        assert there.clearance(q) == pytest.approx(checker.clearance(q), abs=1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_not_finite_is_never_free_and_says_so(bad):
    rng, arrays, _, checker = random_case(7)
    q = random_q(rng, arrays)
    q[0] = bad
    assert not checker.is_valid(q)
    assert not checker.is_valid_batch(q[None])[0]
    assert not checker.check_motion(q, random_q(rng, arrays))
    assert not checker.check_motion(random_q(rng, arrays), q)
    report = checker.explain(q)
    assert not report.valid
    assert report.contacts[0].kind == "not_finite"
    assert "joint0" in report.text()
    with pytest.raises(RobotError, match="finite"):
        checker.clearance(q)


def test_wrong_shapes_name_the_joints():
    _, arrays, _, checker = random_case(3)
    dof = len(arrays.lower)
    for call in (checker.is_valid, checker.clearance, checker.explain):
        with pytest.raises(RobotError, match="joint0"):
            call(np.zeros(dof + 1))
    with pytest.raises(RobotError, match=r"\(n, "):
        checker.is_valid_batch(np.zeros(dof))
    with pytest.raises(RobotError, match="shape"):
        checker.check_motion(np.zeros(dof), np.zeros(dof + 2))


@pytest.mark.parametrize(
    "config",
    [{"margin": -0.01}, {"margin": np.nan}, {"self_margin": np.inf}, {"min_motion": 0.0}],
)
def test_meaningless_settings_are_refused(config):
    with pytest.raises(ConfigError, match=next(iter(config))):
        CheckerConfig(**config)


def test_outside_the_grid_follows_the_policy():
    rng = np.random.default_rng(11)
    arrays = random_arrays(rng, dof=2)
    far = arrays.__class__(**{**arrays.__dict__, "base_t": np.array([5.0, 0.0, 0.0])})
    truth = BallWorld(np.array([[0.0, 0.0, 0.0]]), np.array([0.3]), np.zeros((0, 4)))
    q = np.zeros(2)
    free = CollisionChecker(truth.baked(SPACING), as_robot(far))
    exact = world_clearance(far, truth, q)
    assert exact - 0.7 < free.clearance(q) <= exact
    wall = CollisionChecker(truth.baked(SPACING, unobserved="occupied"), as_robot(far))
    assert wall.clearance(q) < -3.0
    assert not wall.is_valid(q)
    assert wall.explain(q).contacts[0].kind == "unobserved"


def test_links_that_do_not_move_are_not_checked_against_the_world():
    arrays = random_arrays(np.random.default_rng(5), dof=2)
    poses = frame_poses(arrays, np.zeros(2))
    base = poses[0, :3, 3]
    truth = BallWorld(base[None], np.array([0.02]), np.zeros((0, 4)))
    checker = CollisionChecker(truth.baked(SPACING), as_robot(arrays))
    centers = sphere_positions(arrays, np.zeros(2))
    moving = ~arrays.link_fixed[arrays.sphere_link]
    assert truth.distance(centers[~moving]).min() < 0.15
    expected = (truth.distance(centers[moving]) - arrays.sphere_radius[moving]).min()
    assert checker.clearance(np.zeros(2)) <= expected
    assert checker.clearance(np.zeros(2)) > expected - INFLATION
