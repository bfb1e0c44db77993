# SPDX-License-Identifier: BSD-3-Clause
"""What `plan` answers with every default: how sure, how far away, and how risky its no is."""

from itertools import pairwise

import numpy as np
import pytest
from oracles.small_scenes import at, small_map

import vprism_plan as vp
from vprism_plan.planning import attempts, plan
from vprism_plan.planning.attempts import Query
from vprism_plan.planning.search import SearchOutcome
from vprism_plan.world import Box

NOTHING = SearchOutcome("timeout", None, None, 0.0, 0, 0)
RADIUS = 0.02
START = [0.02, -0.2, 0.15]
ACROSS = [0.02, 0.2, 0.15]


@pytest.fixture(scope="module")
def world():
    known = (Box("crate", (0.04, 0.1, 0.1), at(-0.25, 0.0, 0.05)),)
    return vp.World(small_map(), vp.WorldConfig(known=known))


@pytest.fixture(scope="module")
def checker(world, ball_robot):
    return vp.CollisionChecker(world, ball_robot(RADIUS))


@pytest.fixture(scope="module")
def doubtful(checker):
    """Places that the default refuses although nothing was seen there, the surest last."""
    rng = np.random.default_rng(3)
    places = rng.uniform([-0.05, -0.1, 0.025], [0.15, 0.1, 0.12], (4000, 3))
    refused = places[~checker.is_valid_batch(places)]
    risky = refused[checker.relaxed(0.9).is_valid_batch(refused)]
    assert len(risky) > 20
    return risky[np.argsort([checker.collision_probability(q).probability for q in risky])]


def test_every_solved_plan_says_how_sure_it_is(checker):
    result = plan(checker, START, ACROSS)
    assert result.solved, result.message
    assert result.risk is result.report.risk
    assert result.risk.upper <= checker.config.max_risk == 0.1
    again = checker.collision_probability(result.path, held_out=True)
    assert (again.probability, again.upper) == (result.risk.probability, result.risk.upper)
    assert "P(collision)" in result.message


def test_with_room_to_spare_the_path_keeps_away(checker):
    low, across = [0.02, -0.2, 0.03], [0.02, 0.2, 0.03]
    result = plan(checker, low, across)
    assert result.report.middle is not None  # the table is near
    wide, first, last = result.report.middle
    assert (wide, first, last) == (0.02, 1, len(result.path) - 2)
    assert (
        f"kept 20 mm beyond the checker's margin between waypoints 1 and {last}; 5 mm at both"
        in (result.message)
    )
    assert checker.min_clearance(result.path[first : last + 1]).clearance > 0.0195
    assert checker.min_clearance(result.path).clearance > 0.0045
    result = plan(checker, [*low[:2], 0.05], [*across[:2], 0.05])
    assert "kept 20 mm beyond the checker's margin" in result.message
    assert result.report.middle is None
    assert checker.min_clearance(result.path).clearance > 0.0195
    plain = plan(checker, [*low[:2], 0.05], [*across[:2], 0.05], margins=None)
    assert checker.min_clearance(plain.path).clearance < 0.015


def test_keeping_away_in_the_middle_never_makes_a_path_riskier(checker, monkeypatch):
    rng = np.random.default_rng(7)
    ends = rng.uniform([-0.15, -0.2, 0.022], [0.15, 0.2, 0.14], (400, 3))
    ends = ends[checker.is_valid_batch(ends)]
    widened = 0
    for seed, pair in enumerate(ends[: len(ends) // 2 * 2].reshape(-1, 2, 3)[:40]):
        result = plan(checker, *pair, seed=seed)
        with monkeypatch.context() as patched:
            patched.setattr(Query, "widened", lambda *_: None)
            without = plan(checker, *pair, seed=seed)
        assert result.solved or not without.solved
        if result.report.middle is None:
            continue
        widened += 1
        assert all(checker.check_motion(a, b) for a, b in pairwise(result.path))
        again = checker.collision_probability(result.path, held_out=True)
        assert again.probability == result.risk.probability
        assert again.upper <= checker.config.max_risk
        if without.solved and without.report.risk_levels == result.report.risk_levels:
            assert result.risk.probability <= without.risk.probability
    assert widened >= 5


def test_shares_of_a_path_are_those_of_its_waypoints(checker):
    rng = np.random.default_rng(8)
    Q = rng.uniform([-0.3, -0.3, 0.0], [0.4, 0.3, 0.3], (300, 3))
    told = [checker.explain(q).shares for q in Q]
    for kind, shares in checker.unseen_shares(Q).items():
        off = shares - [own[kind] for own in told]
        assert np.abs(off).max() < 0.2  # one ball; a robot has dozens
        assert np.abs(off).mean() < 0.02
    result = plan(checker, START, ACROSS)
    most = {k: v.max() for k, v in checker.unseen_shares(result.path).items()}
    assert result.report.shares == most


def test_a_wider_margin_draws_no_worlds_anew(checker):
    """The wider checker once had draws of its own: seconds for every query."""
    wider = checker.with_extra_margin(0.02)
    assert wider._bounded is checker._bounded
    assert wider.config.margin == 0.02
    rng = np.random.default_rng(4)
    Q = rng.uniform([-0.1, -0.15, 0.025], [0.2, 0.15, 0.2], (3000, 3))
    near = checker.clearance_batch(Q) <= 0.02
    assert near.any()
    np.testing.assert_array_equal(wider.is_valid_batch(Q), checker.is_valid_batch(Q) & ~near)


def test_an_end_that_only_may_touch_is_too_risky_and_says_how_risky(checker, doubtful):
    told = 0
    for q in doubtful[:: len(doubtful) // 5]:
        result = plan(checker, START, q, time_limit=2.0)
        assert result.status == "too_risky"
        assert result.path is None
        if result.approximate_path is None:
            assert_says_how_risky(result.message, checker, q)
            continue
        np.testing.assert_array_equal(result.approximate_path[-1], q)
        assert ("riskier motions" in result.message) == (result.risk.upper > 0.1)
        assert f"P(collision) {result.risk.probability:.3f}" in result.message
        assert not result.explanation.valid
        told += "another view of it, another goal, or allowed_contacts {'ball': {" in result.message
    assert told >= 2


def assert_says_how_risky(message, checker, q):
    risk = checker.collision_probability(q, held_out=True)
    assert f"goal is too risky, {risk.text()}, and no motion to it was found" in message


@pytest.mark.parametrize("several", [False, True])
def test_without_a_motion_the_goal_s_own_probability_is_told(
    checker, doubtful, several, monkeypatch
):
    goals = doubtful[[0, len(doubtful) // 2]] if several else doubtful[0]
    monkeypatch.setattr(attempts, "search", lambda *_: NOTHING)
    monkeypatch.setattr(type(checker), "check_motion", lambda *_: False)
    result = plan(checker, START, goals)
    assert result.status == "too_risky"
    assert result.approximate_path is None
    risks = [checker.collision_probability(q, held_out=True) for q in np.atleast_2d(goals)]
    best = np.atleast_2d(goals)[int(np.argmin([risk.upper for risk in risks]))]
    assert_says_how_risky(result.message, checker, best)


def test_an_end_in_what_was_seen_or_is_known_is_in_collision(checker, world):
    points, labels = world.map.views[0].points()
    q = points[labels > 0][500]
    result = plan(checker, START, q)
    assert result.status == "invalid_goal"
    assert result.approximate_path is None
    assert plan(checker, START, [-0.25, 0.0, 0.05]).status == "invalid_goal"
    assert plan(checker, [-0.25, 0.0, 0.05], START).status == "invalid_start"


def test_a_relaxed_bound_never_passes_what_was_seen_nor_less_than_the_stricter(checker, world):
    rng = np.random.default_rng(5)
    Q = rng.uniform([-0.3, -0.15, 0.0], [0.2, 0.15, 0.15], (5000, 3))
    loose = [checker.relaxed(bound).is_valid_batch(Q) for bound in (0.2, 0.5, 0.95)]
    assert not (loose[0] & ~loose[1]).any()
    assert not (loose[1] & ~loose[2]).any()
    assert loose[0].sum() < loose[2].sum() < len(Q)
    seen, labels = world.map.views[0].points()
    seen = seen[labels > 0]
    away = np.linalg.norm(Q[loose[2]][:, None] - seen[::5], axis=2).min(axis=1)
    assert away.min() > RADIUS
    crate = world.config.known[0].signed_distance(Q[loose[2]])
    assert crate.min() > RADIUS
    assert checker.max_risk == 0.1  # the one that was asked is as it was


def test_planners_that_use_up_their_time_get_all_of_it(checker):
    result = plan(checker, START, ACROSS, planner="RRTstar", time_limit=0.3)
    assert result.solved
    assert "kept" not in result.message


def test_a_relaxed_checker_keeps_the_margin_of_the_one_that_was_asked(checker):
    """What was seen is packed once, with a margin: a wider checker once had that of the first."""
    checker.relaxed(0.5)
    wide = checker.with_extra_margin(0.02).relaxed(0.95)
    rng = np.random.default_rng(7)
    Q = rng.uniform([-0.35, -0.15, 0.021], [-0.15, 0.15, 0.15], (3000, 3))
    crate = checker.world.config.known[0].signed_distance(Q) - RADIUS
    assert (crate < 0.02).any()
    assert not wide.is_valid_batch(Q[crate < 0.02]).any()


def test_both_ends_have_their_say(checker, doubtful):
    """A risky start and a goal in collision: nobody calls that too risky."""
    result = plan(checker, doubtful[0], [-0.25, 0.0, 0.05], time_limit=1.0)
    assert result.status in ("invalid_start", "invalid_goal")
