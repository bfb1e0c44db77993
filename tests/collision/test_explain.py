"""Reasons: never empty when a configuration is refused, and confirmed by the truth."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.checker_oracle import BallWorld, self_clearance, sphere_positions
from oracles.random_robots import as_robot, random_arrays, random_q

from vprism_plan.collision import CheckerConfig, CollisionChecker
from vprism_plan.collision.explain import unit_ball_points

SPACING = 0.03


def make(seed, planes=()):
    rng = np.random.default_rng(seed)
    arrays = random_arrays(rng, dof=4)
    truth = BallWorld(
        rng.uniform(-0.6, 0.6, (5, 3)), rng.uniform(0.05, 0.2, 5), np.array(planes).reshape(-1, 4)
    )
    return rng, arrays, truth, CollisionChecker(truth.baked(SPACING), as_robot(arrays))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_every_refusal_has_a_reason_that_the_truth_confirms(seed):
    rng, arrays, truth, checker = make(seed, [[0.0, 0.0, 1.0, -0.5]])
    for _ in range(15):
        q = random_q(rng, arrays)
        report = checker.explain(q)
        assert report.valid == checker.is_valid(q)
        assert report.valid == (not report.contacts)
        centers = sphere_positions(arrays, q)
        for contact in report.contacts:
            if contact.kind == "self":
                assert self_clearance(arrays, q) <= 1e-12
                continue
            radius = arrays.sphere_radius[contact.sphere]
            assert checker.robot.link_names[arrays.sphere_link[contact.sphere]] == contact.link
            if contact.kind == "support":
                gap = centers[contact.sphere] @ truth.planes[0, :3] - truth.planes[0, 3] - radius
                assert contact.depth == pytest.approx(-gap, abs=1e-9)
                continue
            ball = int(contact.body.split(":")[1]) - 1
            gap = np.linalg.norm(centers[contact.sphere] - truth.centers[ball]) - truth.radii[ball]
            assert gap - radius <= 0.75 * SPACING  # the field's own conservatism, no more


def test_a_joint_outside_its_limits_is_named():
    rng, arrays, _, checker = make(1)
    q = random_q(rng, arrays)
    bounded = int(np.flatnonzero(~arrays.continuous)[0])
    q[bounded] = arrays.upper[bounded] + 0.25
    contacts = [c for c in checker.explain(q).contacts if c.kind == "joint_limit"]
    assert contacts[0].link == f"joint{bounded}"
    assert contacts[0].depth == pytest.approx(0.25)
    assert "outside its limits" in contacts[0].text()


def test_reports_are_json_with_the_keys_of_moveit():
    for seed in range(40):
        rng, arrays, _, checker = make(seed)
        report = checker.explain(random_q(rng, arrays))
        data = json.loads(json.dumps(report.to_dict()))
        assert set(data) >= {"valid", "contacts", "cost_sources", "clearance", "shares"}
        for contact in data["contacts"]:
            assert {"position", "normal", "depth", "contact_body_1", "contact_body_2"} <= set(
                contact
            )
        assert report.text()


def test_sampling_points_fill_the_unit_ball():
    points = unit_ball_points()
    radii = np.linalg.norm(points, axis=1)
    assert radii.max() == pytest.approx(1.0)
    assert np.all(radii <= 1.0 + 1e-12)
    assert np.linalg.norm(points.mean(axis=0)) < 0.1


def test_what_is_only_too_near_is_from_it_and_what_overlaps_is_into_it():
    """ "2 mm into the support surface" was said of a ball 8 mm above it, with 10 mm asked for."""
    rng, arrays, truth, _ = make(3, [[0.0, 0.0, 1.0, -0.5]])
    rule = CheckerConfig(margin=0.05)
    checker = CollisionChecker(truth.baked(SPACING), as_robot(arrays), rule)
    said = set()
    for _ in range(400):
        q = random_q(rng, arrays)
        centers = sphere_positions(arrays, q)
        for contact in checker.explain(q).contacts:
            if contact.kind != "support":
                continue
            assert contact.required == pytest.approx(0.05)
            gap = centers[contact.sphere, 2] + 0.5 - arrays.sphere_radius[contact.sphere]
            assert contact.required - contact.depth == pytest.approx(gap, abs=1e-9)
            word = "from" if gap > 0.0 else "into"
            assert f"{1000 * abs(gap):.1f} mm {word} the support surface" in contact.text()
            assert ("50.0 mm asked for" in contact.text()) == (gap > 0.0)
            said.add(word)
    assert said == {"from", "into"}
