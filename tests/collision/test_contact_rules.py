# SPDX-License-Identifier: BSD-3-Clause
"""Which link may touch what: for that object alone, that link alone, and nothing behind it."""

import numpy as np
import pytest
from jaxtyping import TypeCheckError
from oracles.small_scenes import small_map

import vprism_plan as vp
from vprism_plan.collision import CheckerConfig, CollisionChecker
from vprism_plan.errors import ConfigError, RobotError, WorldError

# A hand that slides along x, y, z: a wrist above, two fingers below it.
_SLIDE = """<joint name="{n}" type="prismatic"><parent link="{p}"/><child link="{c}"/>
  <axis xyz="{a}"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint>"""
_FIXED = """<joint name="to_{c}" type="fixed"><parent link="wrist"/><child link="{c}"/></joint>"""
SPHERES = {
    "wrist": [{"center": [0.0, 0.0, 0.12], "radius": 0.03}],
    "left": [{"center": [0.0, 0.045, 0.0], "radius": 0.012}],
    "right": [{"center": [0.0, -0.045, 0.0], "radius": 0.012}],
}
SRDF = """<robot name="hand"><group name="fingers"><link name="left"/><link name="right"/></group>
  <disable_collisions link1="left" link2="right" reason="Never"/></robot>"""

BALL, BOX = [0.0, -0.05], [0.01, 0.055]  # objects 2 and 5 stand here
ON_BALL = [-0.035, -0.095, 0.03]  # the left finger on the ball's side that is seen, no other
ON_BOX = [-0.018, 0.1, 0.04]  # the right finger on the box
AWAY = [-0.3, 0.0, 0.2]


@pytest.fixture(scope="module")
def hand(tmp_path_factory):
    chain = [
        ("x", "base", "sx", "1 0 0"),
        ("y", "sx", "sy", "0 1 0"),
        ("z", "sy", "wrist", "0 0 1"),
    ]
    links = "".join(f'<link name="{n}"/>' for n in ("base", "sx", "sy", "wrist", "left", "right"))
    joints = "".join(_SLIDE.format(n=n, p=p, c=c, a=a) for n, p, c, a in chain)
    joints += _FIXED.format(c="left") + _FIXED.format(c="right")
    folder = tmp_path_factory.mktemp("hand")
    (folder / "hand.urdf").write_text(f'<robot name="hand">{links}{joints}</robot>')
    (folder / "hand.srdf").write_text(SRDF)
    return vp.Robot.from_urdf(folder / "hand.urdf", spheres=SPHERES)


@pytest.fixture(scope="module")
def world():
    return vp.World(small_map())


@pytest.fixture(scope="module")
def make(world, hand):
    def checker(allowed=None, **changes):
        return CollisionChecker(
            world,
            hand,
            CheckerConfig(**{"allowed_contacts": allowed or {}, "max_risk": None, **changes}),
        )

    return checker


def bodies(report):
    return {(c.link, c.body) for c in report.contacts}


def test_the_places_of_these_tests_are_what_they_say(make):
    plain = make()
    assert bodies(plain.explain(ON_BALL)) == {("left", "object:2")}
    assert bodies(plain.explain(ON_BOX)) == {("right", "object:5")}
    assert plain.is_valid(AWAY)


@pytest.mark.parametrize("name", ["left", "fingers"])
def test_what_may_be_touched_is_free_for_that_link_and_object_alone(make, name):
    ruled = make({name: {2}})
    assert ruled.is_valid(ON_BALL)
    assert not ruled.is_valid(ON_BOX)
    assert bodies(ruled.explain(ON_BOX)) == {("right", "object:5")}
    # The other finger on the same ball: free by group, refused by link.
    other = [ON_BALL[0], BALL[1] + 0.045, ON_BALL[2]]
    touching = {c for c in bodies(make().explain(other)) if c[0] == "right"}
    assert touching == {("right", "object:2")}
    refused = {c for c in bodies(ruled.explain(other)) if c == ("right", "object:2")}
    assert refused == (set() if name == "fingers" else touching)
    # The wrist on the ball is refused in both.
    pressed = [-0.02, BALL[1], -0.06]
    assert ("wrist", "object:2") in bodies(ruled.explain(pressed))


def test_rules_only_ever_allow_more_and_only_their_own(make):
    rng = np.random.default_rng(0)
    Q = rng.uniform([-0.1, -0.15, 0.02], [0.1, 0.15, 0.15], (600, 3))
    plain, both = make(), make({"fingers": {2, 5}})
    split = make({"left": [2, 5], "right": (5, 2)})
    a, b = plain.is_valid_batch(Q), both.is_valid_batch(Q)
    assert not (a & ~b).any()
    assert (b & ~a).any()
    np.testing.assert_array_equal(b, split.is_valid_batch(Q))
    np.testing.assert_array_equal(b, [both.is_valid(q) for q in Q])
    for q in Q[b & ~a][:30]:
        # Everything that was refused was a finger on an object, or the hidden space inside it.
        for contact in plain.explain(q).contacts:
            assert contact.link in {"left", "right"}
            assert contact.body in {"object:2", "object:5", "occluded"}
        assert both.explain(q).allowed
    for q in Q[~b][:60]:
        assert not any(
            c.link in {"left", "right"} and c.kind == "object" for c in both.explain(q).contacts
        )


def test_an_allowed_contact_is_told(make):
    report = make({"fingers": {2}}).explain(ON_BALL)
    assert report.valid
    assert not report.contacts
    (contact,) = report.allowed
    assert (contact.link, contact.body, contact.detail) == ("left", "object:2", "allowed")
    assert contact.depth >= 0.0
    assert "left touches object:2" in report.text()
    assert report.to_dict()["allowed"][0]["contact_body_2"] == "object:2"
    assert not make({"fingers": {2}}).explain(AWAY).allowed
    assert not make().explain(AWAY).allowed


def test_clearance_does_not_count_what_may_be_touched(make):
    """It is measured to the rest: with both objects allowed, fingers near them are far off."""
    both = make({"fingers": {2, 5}, "wrist": {2, 5}})
    plain = make()
    assert plain.clearance(ON_BALL) < 0.0
    assert both.clearance(ON_BALL) > 0.0
    assert both.clearance(ON_BALL) <= 0.03  # the table, under the finger's middle
    rng = np.random.default_rng(1)
    Q = rng.uniform([-0.1, -0.15, 0.02], [0.1, 0.15, 0.15], (200, 3))
    assert (both.clearance_batch(Q) >= plain.clearance_batch(Q)).all()


def test_hidden_space_behind_an_allowed_object_is_still_refused(make, world):
    """Inside the object the shadow goes with it; behind it the hand may not feel around."""
    ruled = make({"fingers": {2, 5}})
    points = np.column_stack([np.linspace(0.0, 0.15, 61), np.full(61, BALL[1]), np.full(61, 0.03)])
    gap = world.object_field(2).lower_bound(points)
    behind = points[(world.status(points) == 1) & (gap > 0.03)]
    assert len(behind) > 3
    for finger in behind - [0.0, 0.045, 0.0]:
        report = ruled.explain(finger)
        assert ("left", "occluded") in bodies(report)
    inside = np.array([0.0, BALL[1] - 0.045, 0.03])
    assert "left" not in {link for link, _ in bodies(ruled.explain(inside))}


def test_edges_obey_the_same_rules(make):
    """Down onto the ball and away again: free by rule, refused without, and the other way round
    for what the rule does not name."""
    above = [ON_BALL[0], ON_BALL[1], 0.2]
    ruled = make({"fingers": {2}})
    assert ruled.check_motion(above, ON_BALL)
    assert not make().check_motion(above, ON_BALL)
    report = make().check_motion_report(above, ON_BALL)
    assert bodies(report.state) == {("left", "object:2")}
    above_box = [ON_BOX[0], ON_BOX[1], 0.2]
    assert not ruled.check_motion(above_box, ON_BOX)


def test_the_worlds_obey_the_same_rules(make, world):
    numbers = {"n_worlds": 128, "risk_seed": 3}
    plain, ruled = make(**numbers), make({"fingers": {2}}, **numbers)
    by_link = make({"right": {2}}, **numbers)
    assert plain.collision_probability(ON_BALL).probability > 0.9
    assert ruled.collision_probability(ON_BALL).probability < 0.05
    same = plain.collision_probability(ON_BALL).probability
    assert by_link.collision_probability(ON_BALL).probability == same
    same = plain.collision_probability(ON_BOX).probability
    assert ruled.collision_probability(ON_BOX).probability == same
    assert ruled.collision_probability(ON_BOX).first_contact[0].body == "object:5"
    # Sphere by sphere against the worlds themselves.
    worlds = world.posterior_worlds(128, 3, reach=0.05)
    rng = np.random.default_rng(2)
    Q = rng.uniform([-0.08, -0.13, 0.03], [0.05, 0.13, 0.12], (40, 3))
    for q in Q:
        estimate = ruled.collision_probability(q)
        if estimate.certain:
            continue
        wrist = worlds.touched((q + np.array([0.0, 0.0, 0.12]))[None], 0.03)[0]
        fingers = q + np.array([[0.0, 0.045, 0.0], [0.0, -0.045, 0.0]])
        hit = wrist | worlds.touched(fingers, 0.012, without=[2]).any(axis=0)
        assert estimate.probability == hit.mean()


def test_a_bounded_checker_obeys_the_same_rules(make):
    numbers = {"n_worlds": 128, "max_risk": 0.2}
    plain, ruled = make(**numbers), make({"fingers": {2}}, **numbers)
    assert ruled.is_valid(ON_BALL)
    assert not plain.is_valid(ON_BALL)
    causes = plain.explain(ON_BALL).contacts
    assert ("left", "object:2") in {(c.link, c.body) for c in causes}
    assert not ruled.is_valid(ON_BOX)
    assert ruled.explain(ON_BALL).allowed[0].body == "object:2"
    Q = np.random.default_rng(3).uniform([-0.1, -0.15, 0.02], [0.1, 0.15, 0.15], (150, 3))
    np.testing.assert_array_equal(ruled.is_valid_batch(Q), [ruled.is_valid(q) for q in Q])
    assert not (plain.is_valid_batch(Q) & ~ruled.is_valid_batch(Q)).any()


def test_wrong_rules_are_refused_by_name(make):
    with pytest.raises(RobotError, match="thumb"):
        make({"thumb": {2}})
    with pytest.raises(RobotError, match="sx"):
        make({"sx": {2}})
    with pytest.raises(WorldError, match="no object 3"):
        make({"left": {3}})
    for wrong in ({"left": 2}, {"left": "2"}, {"left": {2.5}}, {"left": None}, {"left": {True}}):
        with pytest.raises(ConfigError, match="left"):
            CheckerConfig(allowed_contacts=wrong)
    for wrong in ([("left", {2})], "left", None):
        with pytest.raises((ConfigError, TypeCheckError), match="allowed_contacts"):
            CheckerConfig(allowed_contacts=wrong)


def test_settings_stay_comparable_and_hashable():
    """A frozen configuration serves as a key; the mapping it holds must not spoil that."""
    assert hash(CheckerConfig()) == hash(CheckerConfig())
    one, two = (CheckerConfig(allowed_contacts={"left": ids}) for ids in ([2, 5], {5, 2}))
    assert one == two
    assert hash(one) == hash(two)


def test_a_plan_may_end_on_its_target_and_says_so(make):
    """With the rule the path ends touching; without it the goal is refused and names the target."""
    ruled = make({"fingers": {2}})
    result = vp.plan(ruled, AWAY, ON_BALL, seed=0, time_limit=5.0)
    assert result.solved, result.message
    np.testing.assert_allclose(result.path[-1], ON_BALL, atol=1e-12)
    goal = ruled.explain(result.path[-1])
    assert goal.valid
    assert {(c.link, c.body) for c in goal.allowed} == {("left", "object:2")}
    told = {(c.link, c.body) for c in result.report.allowed_contacts}
    assert told == {("left", "object:2")}
    assert "object:2" in result.message
    for q in result.path:
        assert ruled.is_valid(q)
    refused = vp.plan(make(), AWAY, ON_BALL, seed=0, time_limit=5.0)
    assert not refused.solved
    assert refused.path is None
    assert "object:2" in refused.message
    assert "left" in refused.message
    elsewhere = vp.plan(ruled, AWAY, ON_BOX, seed=0, time_limit=5.0)
    assert not elsewhere.solved
    assert "object:5" in elsewhere.message


def test_a_plan_with_a_bound_on_risk_may_end_on_its_target(make):
    ruled = make({"fingers": {2}}, n_worlds=128, max_risk=0.2)
    result = vp.plan(ruled, AWAY, ON_BALL, seed=0, time_limit=5.0)
    assert result.solved, result.message
    assert result.report.risk.upper <= 0.2
    assert result.report.allowed_contacts[0].body == "object:2"
    refused = vp.plan(make(n_worlds=128, max_risk=0.2), AWAY, ON_BALL, seed=0, time_limit=5.0)
    assert not refused.solved
    assert "object:2" in refused.message
