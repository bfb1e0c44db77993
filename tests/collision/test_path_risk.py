# SPDX-License-Identifier: BSD-3-Clause
"""The joint probability of a path, against slow twins that ask every draw at every voxel."""

import json
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.checker_oracle import sphere_positions
from oracles.random_robots import as_robot, random_arrays, random_q
from oracles.risk_oracle import DrawnVoxels, ball_touches, dense_touches, inside_ball
from oracles.small_scenes import at, small_map
from oracles.worlds_oracle import draw_owners
from scipy.stats import binomtest

import vprism_plan as vp
from vprism_plan._kernels import checking as kernels
from vprism_plan.collision import CheckerConfig, CollisionChecker
from vprism_plan.collision.packing import pack_robot
from vprism_plan.collision.risk import BLUR, clopper_pearson, count_path, grown, tolerated_hits
from vprism_plan.errors import ConfigError, RobotError
from vprism_plan.world import Box

S = 64
H = 0.01
RADIUS = 0.02
BLURRED = BLUR * H

seeds = st.integers(0, 2**32 - 1)


@pytest.fixture(scope="module")
def small():
    return small_map()


@pytest.fixture(scope="module")
def drawn(small):
    return DrawnVoxels(small, S, 7, H)


@pytest.fixture(scope="module")
def free_world(small):
    """Only the draws, and the table, are obstacles."""
    return all_drawn(vp.World(small, vp.WorldConfig(occluded="free")), S)


@pytest.fixture(scope="module")
def strict_world(small):
    """Hidden space without support, and a known box, are obstacles in every world."""
    known = (Box("crate", (0.04, 0.3, 0.1), at(-0.15, 0.0, 0.05)),)
    return all_drawn(vp.World(small, vp.WorldConfig(known=known)), 128)


def all_drawn(world, n_worlds):
    """The world, no voxel of whose draws is taken for certain: then they are the oracle's."""
    drawn = vp.PosteriorWorlds(world.map, n_worlds, 7, H, reach=0.25, tolerance=0.0)
    world._draws[n_worlds, 7, H] = drawn
    return world


def config(**changes):
    return CheckerConfig(**{"n_worlds": S, "risk_seed": 7, **changes})


@pytest.fixture(scope="module")
def ball(free_world, ball_robot):
    return CollisionChecker(free_world, ball_robot(RADIUS), config())


@pytest.fixture(scope="module")
def doubtful(free_world):
    """Places for a ball: half of them where worlds disagree, half anywhere above the table."""
    rng = np.random.default_rng(11)
    places = rng.uniform([-0.1, -0.13, 0.025], [0.2, 0.13, 0.12], (6000, 3))
    share = free_world.posterior_worlds(S, 7, reach=0.1).touched(places, RADIUS).mean(axis=1)
    unsure = places[(share > 0.05) & (share < 0.95)]
    assert len(unsure) > 50
    return np.concatenate([unsure, places[: len(unsure)]])


def ball_path(rng, doubtful, n=4):
    """Waypoints of a ball: from where worlds disagree, a few centimetres at a time."""
    start = doubtful[rng.integers(len(doubtful) // 2)]
    path = start + np.vstack([np.zeros(3), rng.normal(scale=0.015, size=(n - 1, 3))]).cumsum(axis=0)
    path[:, 2] = np.maximum(path[:, 2], RADIUS + 0.005)
    return path


def lifted(arrays):
    """A random robot whose base stands above the objects."""
    shift = np.array([0.0, 0.0, 0.35])
    return arrays.__class__(**{**arrays.__dict__, "base_t": arrays.base_t + shift})


def random_case(seed, world, **changes):
    rng = np.random.default_rng(seed)
    arrays = lifted(random_arrays(rng, dof=int(rng.integers(1, 5)), reach=0.5))
    checker = CollisionChecker(world, as_robot(arrays), config(**changes))
    # Near the objects, and short: the oracles take milliseconds per sphere and sample.
    around = [random_q(rng, arrays) for _ in range(40)]
    low = sphere_positions(arrays, np.array(around))[..., 2].min(axis=1)
    path = [around[int(np.argmin(np.abs(low - 0.05)))]]
    for _ in range(2):
        path.append(path[-1] + rng.uniform(0.005, 0.03) * (random_q(rng, arrays) - path[-1]))
    return rng, arrays, checker, np.array(path)


def setting(checker):
    """The draws and the robot among them, without the margin."""
    return checker.risk_setting()


def swept(checker, path):
    return count_path(setting(checker), path)


def steps_of(checker, path):
    """Samples of each edge: as many as gaps need, or four times that, again and again."""
    packed = pack_robot(checker.robot.arrays)
    steps = np.empty(len(path) - 1, np.int64)
    kernels.count_steps(path, *packed, setting(checker).spacing, steps)
    found = np.diff(swept(checker, path).waypoints)
    assert np.isin(found / steps, [1, 4, 16, 64]).all()
    return found


def oracle_counts(checker, drawn, path, allowed=None):
    """Draws touched at each sample (n, S): own kinematics, own slack, the draws' definition."""
    arrays = checker.robot.arrays
    steps = steps_of(checker, path) if len(path) > 1 else []
    rows = [path[0]]
    for (qa, qb), n in zip(pairwise(path), steps, strict=True):
        rows += [qa + t / n * (qb - qa) for t in range(1, n + 1)]
    centers = sphere_positions(arrays, np.array(rows))
    # The kernel's slack is proven to cover the gaps by a test of its own.
    sweep = swept(checker, path)
    assert len(rows) == len(sweep.centers)
    np.testing.assert_allclose(centers, sweep.centers.transpose(0, 2, 1), atol=1e-12)
    moving = np.flatnonzero(~np.asarray(arrays.link_fixed)[arrays.sphere_link])
    radii = arrays.sphere_radius
    touched = np.zeros((len(rows), drawn.n_worlds), bool)
    for i in range(len(rows)):
        for s in moving:
            classes = () if allowed is None else allowed[s]
            radius = radii[s] + sweep.slack[i, s]
            touched[i] |= ball_touches(drawn, sweep.centers[i, :, s], radius, H, classes)
    return touched, steps


# --- the number -----------------------------------------------------------------------------
def assert_is_the_oracles(checker, drawn, path):
    touched, steps = oracle_counts(checker, drawn, path)
    sweep = swept(checker, path)
    np.testing.assert_array_equal(sweep.touched, touched.any(axis=0))
    np.testing.assert_array_equal(sweep.counts, touched.sum(axis=1))
    first = np.where(touched.any(axis=0), touched.argmax(axis=0), -1)
    np.testing.assert_array_equal(sweep.first, first)
    estimate = checker.collision_probability(path)
    waypoints = np.concatenate(([0], np.cumsum(steps))).astype(int)
    if not estimate.certain:
        assert estimate.probability == touched.any(axis=0).mean()
        np.testing.assert_array_equal(estimate.per_waypoint, touched[waypoints].mean(axis=1))
    assert estimate.configurations == len(touched)
    return estimate


def test_a_ball_s_path_has_the_risk_of_its_draws(ball, drawn, doubtful):
    rng = np.random.default_rng(0)
    found = []
    for _ in range(6):
        found.append(assert_is_the_oracles(ball, drawn, ball_path(rng, doubtful)).probability)
        q = ball_path(rng, doubtful, 1)[0]
        alone = assert_is_the_oracles(ball, drawn, q[None])
        assert ball.collision_probability(q).probability == alone.probability
    assert any(0.0 < p < 1.0 for p in found)


@settings(max_examples=5)
@given(seeds)
def test_a_random_robot_s_path_has_the_risk_of_its_draws(free_world, drawn, seed):
    _, _, checker, path = random_case(seed, free_world)
    assert_is_the_oracles(checker, drawn, path)


@pytest.mark.parametrize("seed", range(1))
def test_a_panda_s_path_has_the_risk_of_its_draws(free_world, drawn, repository, seed):
    base = at(-0.45, 0.0, 0.0)
    robot = vp.Robot.from_urdf(repository / "urdf" / "panda.urdf", base_pose=base)
    checker = CollisionChecker(free_world, robot, config())
    rng = np.random.default_rng(seed)
    ready = np.array([0.0, 0.35, 0.0, -2.3, 0.0, 2.7, 0.78])
    path = ready + np.cumsum(rng.normal(scale=0.03, size=(2, 7)), axis=0)
    assert_is_the_oracles(checker, drawn, path)


def test_the_same_question_has_the_same_answer_and_seeds_differ(
    free_world, ball_robot, ball, doubtful
):
    path = doubtful[:1]
    again = CollisionChecker(free_world, ball_robot(RADIUS), config())
    other = CollisionChecker(free_world, ball_robot(RADIUS), config(risk_seed=8))
    first = ball.collision_probability(path)
    assert first.probability == again.collision_probability(path).probability
    assert first.seed == 7
    assert (swept(ball, path).touched != swept(other, path).touched).any()
    held_out = ball.collision_probability(path, held_out=True)
    assert held_out.seed != 7


# --- never too low --------------------------------------------------------------------------
@settings(max_examples=5)
@given(seeds)
def test_dense_sampling_finds_no_collision_in_a_world_called_free(ball, drawn, doubtful, seed):
    path = ball_path(np.random.default_rng(seed), doubtful, 2)
    truly = dense_touches(drawn, ball.robot.arrays, path, H)
    assert not (truly & ~swept(ball, path).touched.astype(bool)).any()


@settings(max_examples=4)
@given(seeds)
def test_nor_for_random_robots(free_world, drawn, seed):
    _, arrays, checker, path = random_case(seed, free_world)
    truly = dense_touches(drawn, arrays, path[:2], H, step=0.001)
    assert not (truly & ~swept(checker, path[:2]).touched.astype(bool)).any()


@settings(max_examples=40)
@given(seeds, st.floats(0.005, 0.2))
def test_slack_covers_the_way_between_samples(seed, spacing):
    """What a sphere holds between two samples, it holds at one of the two, grown by its slack."""
    rng = np.random.default_rng(seed)
    arrays = random_arrays(rng, dof=int(rng.integers(1, 6)))
    packed = pack_robot(arrays)
    path = np.array([random_q(rng, arrays) for _ in range(3)])
    steps = np.empty(2, np.int64)
    n = kernels.count_steps(path, *packed, spacing, steps) + 1
    centers = np.empty((n, 3, len(arrays.sphere_radius)))
    slack = np.empty((n, len(arrays.sphere_radius)))
    kernels.place_path(path, steps, *packed, centers, slack)
    assert slack.max() <= 0.625 * spacing + 1e-12  # what the reach of the worlds counts on
    centers = centers.transpose(0, 2, 1)
    radius = np.asarray(arrays.sphere_radius)
    at_sample = 0
    for (qa, qb), count in zip(pairwise(path), steps, strict=True):
        for i in rng.choice(count, min(count, 4), replace=False):
            a, b = at_sample + i, at_sample + i + 1
            assert np.linalg.norm(centers[b] - centers[a], axis=1).max() <= spacing + 1e-9
            for t in np.linspace(i, i + 1, 23) / count:
                here = sphere_positions(arrays, qa + t * (qb - qa))
                outward = rng.normal(size=(25, *here.shape))
                outward[0] = centers[b] - centers[a]  # the way the sphere goes, and across it
                outward[1:12] -= outward[0] * (
                    (outward[1:12] * outward[0]).sum(axis=2, keepdims=True)
                    / np.maximum((outward[0] ** 2).sum(axis=1, keepdims=True), 1e-300)
                )
                outward /= np.maximum(np.linalg.norm(outward, axis=2, keepdims=True), 1e-300)
                rim = here + radius[:, None] * outward
                near = np.linalg.norm(rim - centers[a], axis=2) <= radius + slack[a] + 1e-12
                near |= np.linalg.norm(rim - centers[b], axis=2) <= radius + slack[b] + 1e-12
                assert near.all()
        at_sample += count


def test_a_joint_that_turns_without_carrying_anything_adds_no_slack():
    """A wrist spinning about a sphere's own centre once made the sphere grow past `reach`."""
    rng = np.random.default_rng(2)
    arrays = random_arrays(rng, dof=3)
    kind = np.where(arrays.kind == 2, 1, arrays.kind)
    still = arrays.__class__(
        **{
            **arrays.__dict__,
            "kind": kind,
            "t_off": np.zeros_like(arrays.t_off),
            "sphere_center": 1e-3 * arrays.sphere_center,
            "link_center": 1e-3 * arrays.link_center,
        }
    )
    packed = pack_robot(still)
    path = np.array([np.full(3, -9.0), np.full(3, 9.0)])
    steps = np.empty(1, np.int64)
    n = kernels.count_steps(path, *packed, H, steps) + 1
    centers = np.empty((n, 3, len(still.sphere_radius)))
    slack = np.empty((n, len(still.sphere_radius)))
    kernels.place_path(path, steps, *packed, centers, slack)
    assert slack.max() <= 0.625 * H + 1e-12


def test_joint_risk_is_between_the_largest_and_the_sum(ball, doubtful):
    rng = np.random.default_rng(1)
    for _ in range(30):
        path = ball_path(rng, doubtful)
        estimate = ball.collision_probability(path)
        sweep = swept(ball, path)
        assert estimate.per_waypoint.max() <= estimate.probability
        if not estimate.certain:
            assert sweep.counts.max() / S <= estimate.probability
            assert estimate.probability <= min(1.0, sweep.counts.sum() / S)
        # A waypoint of a path is covered with the way to its neighbours: never less than alone.
        alone = [ball.collision_probability(q).probability for q in path]
        assert (np.array(alone) <= estimate.per_waypoint).all()


def test_risk_grows_with_the_radius_and_with_the_path(free_world, ball_robot, ball, doubtful):
    wide = CollisionChecker(free_world, ball_robot(RADIUS + 0.012), config())
    rng = np.random.default_rng(2)
    grew = 0
    for _ in range(20):
        path = ball_path(rng, doubtful)
        narrow = ball.collision_probability(path).probability
        assert narrow <= wide.collision_probability(path).probability
        grew += narrow < wide.collision_probability(path).probability
        parts = [ball.collision_probability(path[:n]).probability for n in (2, 3, 4)]
        assert parts == sorted(parts)
    assert grew > 0


def test_the_margin_counts_in_verdicts_and_not_in_the_probability(
    strict_world, ball_robot, ball, doubtful
):
    """Verdicts with a margin are those of a ball that is larger by it."""
    robot, numbers = ball_robot(RADIUS), {"n_worlds": 128, "max_risk": 0.3}
    with_margin = CollisionChecker(strict_world, robot, config(margin=0.01, **numbers))
    without = CollisionChecker(strict_world, robot, config(**numbers))
    larger = CollisionChecker(strict_world, ball_robot(RADIUS + 0.01), config(**numbers))
    Q = np.random.default_rng(5).choice(doubtful, 60)
    for q in Q:
        same = without.collision_probability(q)
        assert with_margin.collision_probability(q).probability == same.probability
        assert with_margin.is_valid(q) == larger.is_valid(q)
    for edge in Q.reshape(30, 2, 3):
        assert with_margin.check_motion(*edge) == larger.check_motion(*edge)
        report = with_margin.check_motion_report(*edge)
        if report.risk is not None:
            theirs = larger.collision_probability(edge)
            assert report.risk.probability == theirs.probability
    assert not (with_margin.is_valid_batch(Q) & ~without.is_valid_batch(Q)).any()
    assert (without.is_valid_batch(Q) & ~with_margin.is_valid_batch(Q)).any()


def test_direction_and_waypoints_on_the_way_change_little(ball, doubtful):
    """Samples move by less than a step, so voxels at the very rim come and go: 0.03 in the mean.
    With samples a whole voxel apart it was half as much again, and more for single paths."""
    rng = np.random.default_rng(3)
    reversed_, split = [], []
    for _ in range(40):
        path = ball_path(rng, doubtful, 3)
        risk = ball.collision_probability(path).probability
        reversed_.append(ball.collision_probability(path[::-1]).probability - risk)
        fractions = np.sort(rng.uniform(0, 1, 3))
        more = [path[0], *(path[0] + t * (path[1] - path[0]) for t in fractions), *path[1:]]
        split.append(ball.collision_probability(np.array(more)).probability - risk)
    assert np.abs(reversed_).max() <= 1.5 / S
    assert np.abs(split).mean() <= 0.03
    assert np.mean(np.abs(split) > 0.02) <= 0.15


# --- certain obstacles -----------------------------------------------------------------------
def test_certain_obstacles_are_certain_and_named(strict_world, ball_robot):
    checker = CollisionChecker(strict_world, ball_robot(RADIUS), config())
    high = [0.0, 0.0, 0.3]
    for inside, body in (
        ([0.3, 0.3, 0.0], "support surface"),
        ([-0.15, 0.1, 0.06], "known:crate"),
        ([0.12, -0.05, -0.05], "support surface"),
    ):
        for path in (inside, [high, inside], [high, inside, high]):
            estimate = checker.collision_probability(path)
            assert estimate.certain
            assert (estimate.probability, estimate.lower, estimate.upper) == (1.0, 1.0, 1.0)
            named = [c for c in estimate.first_contact if c.body == body]
            assert named
            assert named[0].link == "ball"
            assert sum(c.share for c in estimate.first_contact) == pytest.approx(1.0)
            rows = np.atleast_2d(path)
            at_waypoint = [not np.allclose(q, high) for q in rows]
            assert (estimate.per_waypoint[at_waypoint] == 1.0).all()
            assert (estimate.per_waypoint[np.logical_not(at_waypoint)] < 1.0).all()


def test_an_obstacle_between_two_free_waypoints_is_certain_too(strict_world, ball_robot):
    checker = CollisionChecker(strict_world, ball_robot(RADIUS), config())
    through = checker.collision_probability([[-0.3, 0.0, 0.06], [-0.1, 0.0, 0.15]])
    around = checker.collision_probability([[-0.3, 0.0, 0.3], [-0.1, 0.0, 0.3]])
    assert through.certain
    assert through.per_waypoint.max() < 1.0
    assert through.first_contact[0].body == "known:crate"
    assert not around.certain
    assert around.probability == 0.0
    assert around.first_contact == ()
    assert around.upper > 0.0


def test_background_is_certain_and_named(ball_robot):
    """A thing without a label is an obstacle in every world."""
    from oracles.small_scenes import small_config, small_scene

    from vprism_plan.simulation.scenes import Scene
    from vprism_plan.simulation.solids import sphere

    scene = small_scene()
    clutter = sphere(0.03, at(-0.05, 0.2, 0.03))
    cluttered = Scene((*scene.solids, clutter), (*scene.labels, 0), scene.camera)
    world = vp.World(vp.fit_map(cluttered.observation, small_config(), seed=0))
    checker = CollisionChecker(world, ball_robot(0.01), config())
    estimate = checker.collision_probability([-0.06, 0.2, 0.06])
    assert estimate.certain
    assert estimate.first_contact[0].body == "background"


def test_hidden_space_counts_as_its_policy_says(small, ball_robot, strict_world, free_world):
    """Behind the box and beyond the kernels: an obstacle, or what the draws say."""
    x = np.linspace(0.0, 0.5, 51)
    points = np.column_stack([x, np.full(51, 0.055), np.full(51, 0.025)])
    beyond = (strict_world.status(points) == 1) & (small.support(points) < 0.1)
    assert beyond.any(), "the scene has no hidden point without support"
    strict, free = (
        CollisionChecker(w, ball_robot(0.005), config()) for w in (strict_world, free_world)
    )
    for q in points[beyond]:
        estimate = strict.collision_probability(q)
        assert estimate.certain
        assert estimate.first_contact[0].body == "occluded"
        assert estimate.unsupported_share > 0.0
        assert not free.collision_probability(q).certain


def test_joint_limits_and_self_collision_do_not_enter(free_world):
    for seed in range(8):
        _, arrays, checker, path = random_case(seed, free_world)
        slides = np.isin(np.arange(len(arrays.lower)), arrays.q_index[arrays.kind == 2])
        tight = arrays.__class__(
            **{
                **arrays.__dict__,
                "lower": np.where(slides, arrays.lower, -1e-4),
                "upper": np.where(slides, arrays.upper, 1e-4),
            }
        )
        narrow = CollisionChecker(free_world, as_robot(tight), config())
        wide = checker.collision_probability(path)
        assert narrow.collision_probability(path).probability == wide.probability
        assert narrow.collision_probability(path[0]).certain == (
            checker.collision_probability(path[0]).certain
        )


# --- intervals ------------------------------------------------------------------------------
@pytest.mark.parametrize("n", [64, 256])
@pytest.mark.parametrize("confidence", [0.5, 0.95, 0.999])
def test_intervals_are_those_of_clopper_and_pearson(n, confidence):
    lower, upper = clopper_pearson(n, confidence)
    for k in [0, 1, 2, n // 3, n - 1, n]:
        exact = binomtest(k, n).proportion_ci(confidence, method="exact")
        assert lower[k] == pytest.approx(exact.low, abs=1e-12)
        assert upper[k] == pytest.approx(exact.high, abs=1e-12)
    assert lower[0] == 0.0
    assert upper[0] > 0.0
    assert upper[n] == 1.0


def test_tolerated_hits_are_the_most_that_keep_the_bound():
    for n in (64, 256):
        upper = clopper_pearson(n, 0.95)[1]
        for bound in (0.06, 0.1, 0.3, 0.9, 0.999):
            allowed = tolerated_hits(bound, upper, n)
            assert upper[allowed] <= bound
            assert allowed == n or upper[allowed + 1] > bound
    with pytest.raises(ConfigError, match="draw more"):
        tolerated_hits(0.01, clopper_pearson(64, 0.95)[1], 64)


def test_no_hit_is_not_no_risk(ball):
    skipping = CollisionChecker(ball.world, ball.robot, config(risk_seed=8))
    estimate = skipping.collision_probability([0.0, 0.0, 0.4])
    assert estimate.probability == 0.0
    exact = binomtest(0, S).proportion_ci(0.95, method="exact").high
    assert exact <= estimate.upper <= exact + 1e-3
    assert f"{estimate.upper:.3f}" in estimate.text()
    assert estimate.lower == 0.0


def test_bounds_hold_the_size_of_voxels_and_the_skipped_ones_errors(ball, drawn, doubtful):
    worlds = setting(ball).worlds
    lower, upper = clopper_pearson(S, 0.95)
    for q in np.random.default_rng(4).choice(doubtful, 40):
        estimate = ball.collision_probability(q)
        if estimate.certain:
            continue
        corners = ball_touches(drawn, q, RADIUS + BLURRED, H).sum()
        centres = ball_touches(drawn, q, RADIUS - BLURRED, H).sum()
        assert estimate.upper == pytest.approx(min(1.0, upper[corners] + worlds.error_free))
        assert estimate.lower == pytest.approx(max(0.0, lower[centres] - worlds.error_occupied))


@pytest.mark.slow
def test_intervals_hold_what_finer_voxels_find(small, ball, doubtful):
    """Of 48 paths at contact three had a risk above their upper bound by voxels of 2 mm: 0.69
    where 0.434 was stated."""
    step = 0.002
    rng = np.random.default_rng(13)
    judged, share, missed, doubted = 0, 0, 0, 0
    while judged < 12:
        path = ball_path(rng, doubtful, 2)
        path[:, 2] += 0.007  # the table is known, its voxels' corners lie above it
        estimate = ball.collision_probability(path)
        if estimate.certain:
            continue
        judged += 1
        places = path[0] + np.linspace(0.0, 1.0, 9)[:, None] * (path[1] - path[0])
        around = np.unique(
            np.concatenate([inside_ball(place, RADIUS, step) for place in places]), axis=0
        )
        finer = np.zeros(S, bool)
        for part in np.array_split(around, len(around) // 5000 + 1):
            finer |= (draw_owners(small, step * part, S, 7) > 0).any(axis=0)
        bounds = [count_path(grown(setting(ball), v), path).touched > 0 for v in (-BLUR, BLUR)]
        assert estimate.lower <= finer.mean() <= estimate.upper
        missed += (finer & ~bounds[1]).sum()
        share += bounds[1].sum() - bounds[0].sum()
        doubted += 0.0 < finer.mean() < 1.0
    assert missed == 0
    assert share < 0.5 * 12 * S
    assert doubted > 3


def test_with_allowed_contacts_the_upper_bound_holds_what_a_wrong_owner_may_hide(
    free_world, ball_robot
):
    """A voxel given to an object that may be touched without drawing hides its other owners."""
    checker = CollisionChecker(
        free_world, ball_robot(RADIUS), config(allowed_contacts={"ball": {2}})
    )
    worlds = setting(checker).worlds
    estimate = checker.collision_probability([0.0, 0.0, 0.4])
    expected = clopper_pearson(S, 0.95)[1][0] + worlds.error_free + worlds.error_occupied
    assert estimate.upper == pytest.approx(expected, abs=1e-12)


# --- causes ---------------------------------------------------------------------------------
def test_causes_are_ranked_and_confirmed(free_world, drawn, small):
    """In as many worlds as stated, the link really is the first to touch the object there."""
    explained = 0
    for seed in range(12):
        _, arrays, checker, path = random_case(seed, free_world)
        estimate = checker.collision_probability(path)
        shares = [c.share for c in estimate.first_contact]
        if estimate.probability == 0.0:
            assert not shares
            continue
        assert sum(shares) == pytest.approx(1.0)
        assert shares == sorted(shares, reverse=True)
        if estimate.certain:
            continue
        touched, steps = oracle_counts(checker, drawn, path)
        edges = np.concatenate(([0], np.cumsum(steps)))
        first = np.where(touched.any(axis=0), touched.argmax(axis=0), -1)
        waypoint = np.searchsorted(edges, first, side="right") - 1
        sweep = swept(checker, path)
        for cause in estimate.first_contact:
            link = checker.robot.link_names.index(cause.link)
            wanted = small.object_ids.index(int(cause.body.split(":")[1])) + 1
            others = [k for k in range(1, small.n_classes) if k != wanted]
            possible = 0
            for s in np.flatnonzero((first >= 0) & (waypoint == cause.waypoint)):
                i = first[s]
                possible += any(
                    ball_touches(
                        drawn,
                        sweep.centers[i, :, ball],
                        arrays.sphere_radius[ball] + sweep.slack[i, ball],
                        H,
                        others,
                    )[s]
                    for ball in np.flatnonzero(arrays.sphere_link == link)
                )
            assert cause.share * touched.any(axis=0).sum() <= possible + 1e-9
        explained += 1
    assert explained > 0


def test_the_object_in_front_is_what_a_ball_touches_first(ball):
    estimate = ball.collision_probability([[-0.2, -0.05, 0.05], [0.0, -0.05, 0.05]])
    assert estimate.probability == 1.0
    assert not estimate.certain
    assert estimate.first_contact[0].body == "object:2"
    assert estimate.first_contact[0].link == "ball"
    assert {c.waypoint for c in estimate.first_contact} == {0}
    back = ball.collision_probability([[0.0, 0.055, 0.12], [0.01, 0.055, 0.06]])
    assert back.first_contact[0].body == "object:5"


def test_the_estimate_speaks_and_is_json(ball):
    estimate = ball.collision_probability([[-0.2, -0.05, 0.05], [0.0, -0.05, 0.05]])
    data = json.loads(json.dumps(estimate.to_dict()))
    assert data["probability"] == 1.0
    assert len(data["per_waypoint"]) == 2
    assert data["first_contact"][0]["body"] == "object:2"
    assert "object:2" in estimate.text()
    assert f"{S} worlds" in estimate.text()


# --- what cannot be judged --------------------------------------------------------------------
def test_unsupported_share_is_that_of_the_swept_volume(strict_world, small, ball_robot):
    """Against random points in the balls, each asked exactly."""
    rng = np.random.default_rng(5)
    radius = 0.04
    checker = CollisionChecker(strict_world, ball_robot(radius), config())
    errors = []
    for _ in range(15):
        q = rng.uniform([0.05, -0.1, 0.0], [0.3, 0.1, 0.06])
        points = rng.normal(size=(3000, 3))
        points *= (radius * np.cbrt(rng.random(3000)) / np.linalg.norm(points, axis=1))[:, None]
        points += q
        status = strict_world.status(points)
        judged = small.support(points) >= strict_world.config.min_support
        estimate = checker.collision_probability(q)
        expected = {
            "occluded": np.mean((status == 1) & ~judged),
            "unobserved": np.mean(status == 2),
            "outside": np.mean(status == 3),
        }
        # Seven points per ball, on nodes a centimetre apart.
        errors += [abs(estimate.shares[name] - share) for name, share in expected.items()]
        total = sum(estimate.shares.values())
        assert estimate.unsupported_share == pytest.approx(total)
        assert 0.0 <= total <= 1.0 + 1e-9
    assert max(errors) < 0.4
    assert np.mean(errors) < 0.06
    far = checker.collision_probability([2.5, 0.0, 1.0])
    assert far.shares["outside"] == pytest.approx(1.0)
    seen = checker.collision_probability([-0.1, 0.0, 0.2])
    assert seen.unsupported_share == pytest.approx(0.0)


# --- verdicts with a bound ----------------------------------------------------------------------
@pytest.fixture(scope="module")
def bounded(strict_world, ball_robot):
    return {
        bound: CollisionChecker(
            strict_world, ball_robot(RADIUS), config(n_worlds=128, max_risk=bound)
        )
        for bound in (0.05, 0.2, 0.6)
    }


def on_level_set(checker, places, room=0.0):
    """Where a ball touches what verdicts go by beside the draws: the level set, or, if the bound
    is above the level, what was seen."""
    below = checker.config.max_risk < checker.world.config.level
    world = checker.world
    field = world.field if below else world.certain_field(seen=True)
    return field.lower_bound(np.ascontiguousarray(places)) <= RADIUS + room


def test_validity_is_few_enough_worlds_nothing_certain_and_off_the_level_set(
    bounded, small, doubtful
):
    drawn = DrawnVoxels(small, 128, 7, H)
    Q = np.random.default_rng(6).choice(doubtful, 100)
    valid = {}
    for bound, checker in bounded.items():
        singles = np.array([checker.is_valid(q) for q in Q])
        assert all(isinstance(checker.is_valid(q), bool) for q in Q[:20])
        np.testing.assert_array_equal(checker.is_valid_batch(Q), singles)
        np.testing.assert_array_equal([checker.is_valid_buffer(q) for q in Q], singles)
        hits = np.array([ball_touches(drawn, q, RADIUS + BLURRED, H).sum() for q in Q])
        estimates = [checker.collision_probability(q) for q in Q]
        certain = np.array([e.certain for e in estimates])
        off = ~on_level_set(checker, Q)
        expected = ~certain & (hits <= checker._path_risk.allowed) & off
        np.testing.assert_array_equal(singles, expected)
        np.testing.assert_array_equal(singles, off & [e.upper <= bound for e in estimates])
        valid[bound] = singles
    assert not (valid[0.05] & ~valid[0.2]).any()
    assert not (valid[0.2] & ~valid[0.6]).any()
    assert valid[0.05].sum() < valid[0.6].sum() < len(Q)


def test_edges_are_free_if_their_joint_risk_is_within_the_bound(bounded, doubtful):
    rng = np.random.default_rng(7)
    seen = set()
    for _ in range(60):
        qa, qb = rng.choice(doubtful, 2)
        for bound, checker in bounded.items():
            estimate = checker.collision_probability([qa, qb])
            free = checker.check_motion(qa, qb)
            if free != (estimate.upper <= bound):
                between = qa + np.linspace(0.0, 1.0, 200)[:, None] * (qb - qa)
                assert not free
                assert on_level_set(checker, between, room=0.002).any()
            if free:
                assert checker.is_valid(qa)
                assert checker.is_valid(qb)
            report = checker.check_motion_report(qa, qb)
            assert report.valid == free
            assert json.dumps(report.risk.to_dict() if report.risk else {})
            seen.add((free, report.risk is not None))
            if report.risk is None:
                continue
            assert not free
            assert report.state is None
            assert report.risk.upper > bound
            assert 0.0 <= report.collision_fraction <= 1.0
            assert "too risky" in report.text()
            assert all(cause.body in report.text() for cause in report.risk.first_contact[:1])
            # At the stated fraction more worlds have collided than may.
            there = qa + report.collision_fraction * (qb - qa)
            part = checker.collision_probability([qa, there + 1e-9 * (qb - qa)])
            assert part.upper > bound or report.collision_fraction == 0.0
    assert seen == {(True, False), (False, True), (False, False)}


@pytest.mark.slow
def is_proven(checker, qa, qb):
    checker.check_motion(qa, qb)  # bakes
    stats = np.empty(4)
    return kernels.check_motion(qa, qb, *checker._far(), checker.config.min_motion, stats)


def grown_by_what_is_kept(checker):
    arrays = checker.robot.arrays
    return arrays.__class__(**{**arrays.__dict__, "sphere_radius": checker._bounded._kept.radii})


def test_what_keeps_clear_of_every_draw_touches_none(free_world, drawn, ball_robot):
    checker = CollisionChecker(free_world, ball_robot(RADIUS), config(max_risk=0.3, margin=0.003))
    rng = np.random.default_rng(5)
    ends = rng.uniform([-0.15, -0.15, 0.025], [0.25, 0.15, 0.22], (24, 2, 3))
    strictest = checker._bounded.allowed.bit_length() + 3
    for judge in (checker, checker.tightened(strictest)):
        arrays = grown_by_what_is_kept(judge)
        proven = [edge for edge in ends if is_proven(judge, *edge)]
        assert 0.1 * len(ends) < len(proven) < 0.9 * len(ends)
        for edge in proven:
            assert judge._bounded.accepts(edge)
            assert not dense_touches(drawn, arrays, edge, H, step=0.002).any()
            steps = np.linspace(0.0, 1.0, 50)[:, None]
            Q = edge[0] + steps * (edge[1] - edge[0])
            assert judge._bounded.accepts_each(Q).all()


@settings(max_examples=8, deadline=None)
@given(seed=seeds)
def test_nor_does_a_random_robot(free_world, drawn, seed):
    rng, arrays, checker, path = random_case(seed, free_world, max_risk=0.3)
    aside = [random_q(rng, arrays) for _ in range(3)]
    for edge in (*pairwise(path), *((q, q + 0.02 * (path[0] - q)) for q in aside)):
        if is_proven(checker, *edge):
            kept = grown_by_what_is_kept(checker)
            assert not dense_touches(drawn, kept, edge, H, step=0.002).any()


def test_nothing_is_proven_where_nobody_has_drawn(small, ball_robot):
    """What is not baked yet counts as touched; asking about it bakes it."""
    world = vp.World(small, vp.WorldConfig(occluded="free"))
    checker = CollisionChecker(world, ball_robot(RADIUS), config(max_risk=0.3))
    edges = np.random.default_rng(5).uniform([-0.15, -0.15, 0.025], [0.25, 0.15, 0.22], (40, 2, 3))
    more, stats = checker.config.min_motion, np.empty(4)
    before = [kernels.check_motion(*edge, *checker._far(), more, stats) for edge in edges]
    after = [is_proven(checker, *edge) for edge in edges]
    assert sum(before) < sum(after)
    assert all(b for a, b in zip(before, after, strict=True) if a)


def test_a_tightened_checker_refuses_more_and_says_why(bounded, doubtful):
    """Its reports once counted with the looser bound, and failed where that was not reached."""
    rng = np.random.default_rng(8)
    checker = bounded[0.6]
    edges = [rng.choice(doubtful, 2) for _ in range(40)]
    before = [checker.check_motion(*edge) for edge in edges]
    level, refused = 1, 0
    while (stricter := checker.tightened(level)) is not None:
        now = [stricter.check_motion(*edge) for edge in edges]
        assert not any(n and not b for n, b in zip(now, before, strict=True))
        for edge, free in zip(edges, now, strict=True):
            report = stricter.check_motion_report(*edge)
            assert report.valid == free
            if report.risk is not None:
                refused += 1
                assert 0.0 <= report.collision_fraction <= 1.0
            for q in edge:
                state = stricter.explain(q)
                assert state.valid == (not state.contacts)
        before = now
        level += 1
    assert level > 3
    assert refused > 0
    with pytest.raises(ConfigError, match="max_risk"):
        CollisionChecker(checker.world, checker.robot, config(max_risk=None)).tightened(1)


def test_worlds_that_the_ends_lose_are_not_counted_at_every_edge(bounded, doubtful):
    rng = np.random.default_rng(17)
    checker, verdicts = bounded[0.6], []
    places = doubtful[~on_level_set(checker, doubtful)]
    worlds = checker.world.posterior_worlds(128, 7, reach=0.25)
    hit = worlds.touched(places, RADIUS + BLURRED)
    for _ in range(12):
        a, b, *others = rng.permutation(len(places))[:20]
        lost = hit[a] | hit[b]
        for level in (1, 3, 7):
            stricter = checker.tightened(level, places[[a, b]])
            left = max(0, checker._bounded.allowed - lost.sum()) >> level
            expected = [(hit[q] & ~lost).sum() <= left for q in (a, b, *others)]
            assert expected[:2] == [True, True]
            np.testing.assert_array_equal(
                stricter.is_valid_batch(places[[a, b, *others]]), expected
            )
            assert [stricter.is_valid(places[q]) for q in (a, b, *others)] == expected
            verdicts += expected[2:]
            for q in others[:4]:
                edge = places[[a, q]]
                if stricter.check_motion(*edge):
                    swept = count_path(checker._bounded._kept, edge).touched > 0
                    assert (swept & ~lost).sum() <= left
    assert 0.1 < np.mean(verdicts) < 0.9


def test_a_refusal_for_risk_names_links_objects_and_shares(bounded, doubtful):
    rng = np.random.default_rng(9)
    risky = 0
    for checker in bounded.values():
        for q in rng.choice(doubtful, 60):
            report = checker.explain(q)
            assert report.valid == checker.is_valid(q)
            assert report.valid == (not report.contacts)
            causes = [c for c in report.contacts if c.kind == "risk"]
            total = sum(c.probability for c in causes)
            if not causes:
                continue
            risky += 1
            sweep = count_path(checker._bounded._kept, q[None])
            assert total == pytest.approx(sweep.touched.mean())
            assert {c.link for c in causes} == {"ball"}
            assert {c.body for c in causes} <= {"object:2", "object:5"}
            assert all(c.depth > 0.0 for c in causes)
            assert "probability" in report.text()
            assert json.dumps(report.to_dict())
    assert risky > 10


# --- wrong input ----------------------------------------------------------------------------
def test_wrong_paths_are_refused_by_name(ball):
    ask = ball.collision_probability
    for shape in ((2, 2), (0, 3), (4,), (1, 2, 3), ()):
        with pytest.raises(RobotError, match="shape"):
            ask(np.zeros(shape))
    for bad in (np.nan, np.inf):
        path = np.full((3, 3), 0.3)
        path[1, 2] = bad
        with pytest.raises(RobotError, match="waypoint 1"):
            ask(path)
    with pytest.raises(RobotError, match="prismatic joint"):
        ask([[0.0, 0.0, 0.3], [0.0, 0.0, 4.0]])


def test_too_few_worlds_for_the_bound_are_refused(free_world, ball_robot):
    robot = ball_robot(RADIUS)
    with pytest.raises(ConfigError, match="n_worlds"):
        CollisionChecker(free_world, robot, config(max_risk=0.01))
    assert CollisionChecker(free_world, robot, config(max_risk=0.01, n_worlds=512)).max_risk == 0.01


def test_worlds_without_a_posterior_are_refused(small):
    from oracles.checker_oracle import BallWorld

    arrays = random_arrays(np.random.default_rng(0), dof=2)
    world = BallWorld(np.zeros((1, 3)), np.array([0.1]), np.zeros((0, 4))).baked()
    checker = CollisionChecker(world, as_robot(arrays))
    with pytest.raises(ConfigError, match="posterior"):
        checker.collision_probability(np.zeros(2))
    # Where nothing is uncertain, a bound on risk asks for no more than the surfaces.
    assert checker.config.max_risk == 0.1
    assert checker.max_risk is None
    Q = np.random.default_rng(1).uniform(-3.0, 3.0, (300, 2))
    plain = CollisionChecker(world, as_robot(arrays), CheckerConfig(max_risk=None))
    np.testing.assert_array_equal(checker.is_valid_batch(Q), plain.is_valid_batch(Q))
    # A world of one's own around a real map once was an error with every default.
    world.map = small
    assert CollisionChecker(world, as_robot(arrays)).max_risk is None


def test_a_bound_on_risk_does_not_let_a_ball_shave_the_level_set(free_world, ball_robot, doubtful):
    """Voxels count as inscribed balls: the draws alone passed paths 2 mm inside seen surfaces."""
    robot = ball_robot(RADIUS)
    plain = CollisionChecker(free_world, robot, config(max_risk=None))
    bounded = CollisionChecker(free_world, robot, config(max_risk=0.3))
    loose = CollisionChecker(free_world, robot, config(max_risk=0.6))
    rng = np.random.default_rng(5)
    low, high = doubtful.min(axis=0) - 0.03, doubtful.max(axis=0) + 0.03
    places = rng.uniform(low, high, (4000, 3))
    refused = ~plain.is_valid_batch(places)
    assert refused.sum() > 100
    assert not bounded.is_valid_batch(places[refused]).any()
    # Above the level the draws decide alone: half of them may object.
    assert loose.is_valid_batch(places[refused]).any()
    for q in places[refused][:20]:
        assert not bounded.explain(q).valid
    for a, b in places[:300].reshape(-1, 2, 3):
        if bounded.check_motion(a, b):
            assert plain.check_motion(a, b)


def test_a_wider_margin_keeps_a_tightened_bound(bounded, doubtful):
    """The bound lives beside the settings, and a checker made anew from them forgot it."""
    tight = bounded[0.6].tightened(2)
    wider = tight.with_extra_margin(0.005)
    Q = np.random.default_rng(12).choice(doubtful, 150)
    assert not (wider.is_valid_batch(Q) & ~tight.is_valid_batch(Q)).any()
    plain = bounded[0.6].with_extra_margin(0.005)
    assert not (wider.is_valid_batch(Q) & ~plain.is_valid_batch(Q)).any()
    # Above the level what was seen refuses most of what a tighter bound would.
    assert wider._bounded.allowed == tight._bounded.allowed < plain._bounded.allowed


def test_balls_too_large_for_fine_voxels_are_asked_about_in_coarser_ones(small, ball_robot):
    """The default bound on risk made every robot with a sphere of 28 cm an error."""
    radius = 0.3
    world = vp.World(small, vp.WorldConfig(occluded="free"))
    world._draws[S, 7, 2 * H] = vp.PosteriorWorlds(small, S, 7, 2 * H, reach=0.5, tolerance=0.0)
    checker = CollisionChecker(world, ball_robot(radius), config())
    assert setting(checker).worlds.resolution == 2 * H
    drawn = DrawnVoxels(small, S, 7, 2 * H)
    some, rng = 0, np.random.default_rng(8)
    for way in rng.normal(size=(60, 3)):
        q = [0.05, 0.0, 0.05] + way / np.linalg.norm(way) * rng.uniform(0.3, 0.42)
        touched = swept(checker, q[None]).touched.astype(bool)
        np.testing.assert_array_equal(touched, ball_touches(drawn, q, radius, 2 * H))
        some += 0 < touched.sum() < S
    assert some > 0
