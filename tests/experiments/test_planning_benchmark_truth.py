# SPDX-License-Identifier: BSD-3-Clause
"""The true scene's verdict on paths, against dense sampling and formulas; the problems."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.small_scenes import at, small_camera, small_scene

from experiments.planning_benchmark import PathTruth, Problem, Truth, find_problems
from experiments.planning_benchmark.grid_world import benchmark_robot
from experiments.planning_benchmark.problems import Criteria, hand_distance, tip_sphere
from experiments.planning_benchmark.truth import nearest_surface
from vprism_plan.planning import plan
from vprism_plan.simulation.scenes import Scene
from vprism_plan.simulation.solids import sphere
from vprism_plan.world.visibility import OCCLUDED, classify_points


@pytest.fixture(scope="module")
def robot():
    return benchmark_robot()


@pytest.fixture(scope="module")
def scene():
    small = small_scene()
    clutter = sphere(0.04, at(-0.09, 0.02, 0.04))
    return Scene((*small.solids, clutter), (*small.labels, 0), small.camera, name="small")


@pytest.fixture(scope="module")
def truth(scene, robot):
    return Truth(scene, robot)


def brute_force(truth, path, step=0.0005):
    """Smallest gap over a path, sampled densely in joint space, every sphere asked exactly."""
    moving = ~np.asarray(truth.robot.fixed_links)[truth.robot.sphere_links]
    pieces = int(np.ceil(np.abs(np.diff(path, axis=0)).sum() / step))
    t = np.linspace(0.0, len(path) - 1.0, pieces + 1)
    Q = np.stack([np.interp(t, np.arange(len(path)), column) for column in path.T], axis=1)
    best = np.inf
    for part in np.array_split(Q, max(1, len(Q) // 500)):
        centers = truth.robot.sphere_centers(torch.from_numpy(part)).numpy()[:, moving]
        gaps = truth.scene.signed_distance(centers.reshape(-1, 3), table=True)
        best = min(best, (gaps.reshape(len(part), -1) - truth.robot.sphere_radii[moving]).min())
    return float(best)


def test_the_field_never_says_more_than_the_truth(truth, scene):
    rng = np.random.default_rng(0)
    points = rng.uniform(truth.field.origin, truth.field.upper, (20_000, 3))
    near = rng.uniform((-0.2, -0.2, 0.0), (0.2, 0.2, 0.15), (20_000, 3))
    for some in (points, near):
        exact = scene.signed_distance(some)
        bound = truth.field.lower_bound(some)
        assert (bound <= exact + 1e-6).all()
        assert (bound >= exact - 0.025).all()
        close = exact < 0.02  # where the nodes around are exact
        assert (bound[close] >= exact[close] - 0.01).all()


def test_a_judgement_equals_dense_sampling(truth, robot):
    rng = np.random.default_rng(1)
    down = np.array([0.35, 0.55, 0.0, -2.0, 0.0, 2.5, 0.8])
    seen = set()
    for number in range(8):
        ends = down + rng.normal(0.0, 0.12 if number % 2 else 0.3, (2, 7))
        path = np.clip(ends, robot.lower, robot.upper)
        judged = truth.judge(path)
        dense = brute_force(truth, path)
        assert dense - 1e-9 <= judged.clearance + 1e-4
        assert judged.clearance <= dense + 0.001
        assert judged.collides == (judged.clearance < 0.0)
        assert judged.depth == max(0.0, -judged.clearance)
        assert PathTruth.from_dict(judged.to_dict()) == judged
        seen.add(judged.body.split(":")[0])
    assert len(seen) >= 2


@pytest.fixture(scope="module")
def lone_ball(scene, ball_robot):
    """A ball of 2 cm among nothing but the ball of the scene."""
    lone = Scene((scene.solids[0],), (2,), scene.camera, name="lone")
    return Truth(lone, ball_robot(0.02))


@settings(max_examples=25)
@given(
    start=st.tuples(*[st.floats(-0.25, 0.25)] * 2, st.floats(0.03, 0.2)),
    end=st.tuples(*[st.floats(-0.25, 0.25)] * 2, st.floats(0.03, 0.2)),
)
def test_a_ball_on_a_line_by_formula(lone_ball, start, end):
    """Distance of a segment from the ball of the scene and from the table is elementary."""
    radius = 0.02
    judged = lone_ball.judge(np.array([start, end]))
    a, b = np.array(start), np.array(end)
    middle, along = np.array([0.0, -0.05, 0.03]), b - a
    t = np.clip((middle - a) @ along / max(along @ along, 1e-12), 0.0, 1.0)
    to_ball = np.linalg.norm(a + t * along - middle) - 0.03 - radius
    to_table = min(a[2], b[2]) - radius
    want = min(to_ball, to_table)
    assert want - 1e-6 <= judged.clearance <= want + 0.001
    if abs(to_ball - to_table) > 0.002:
        assert judged.body == ("object:2" if to_ball < to_table else "table")


def test_places_and_names_of_what_is_hit(truth, scene, ball_robot):
    ball = Truth(scene, ball_robot(0.01))
    through = ball.judge(np.array([[0.2, -0.05, 0.03], [0.0, -0.05, 0.03]]))
    assert through.body == "object:2"
    assert through.depth == pytest.approx(0.04, abs=0.001)
    assert ball.judge(np.array([[-0.09, 0.02, 0.05]])).body == "clutter"
    low = ball.judge(np.array([[0.3, 0.3, 0.2], [0.3, 0.3, 0.005]]))
    assert (low.body, low.place) == ("table", 1.0)
    assert low.depth == pytest.approx(0.005, abs=1e-9)
    np.testing.assert_allclose(low.point, (0.3, 0.3, 0.0), atol=1e-9)
    name, point = nearest_surface(scene, np.array([0.0, -0.05, 0.09]))
    assert name == "object:2"
    np.testing.assert_allclose(point, (0.0, -0.05, 0.06), atol=1e-4)


def test_what_the_true_checker_accepts_is_free(truth, robot):
    checker = truth.checker()
    rng = np.random.default_rng(2)
    Q = rng.uniform(robot.lower, robot.upper, (400, 7))
    Q = Q[checker.is_valid_batch(Q)]
    accepted = [edge for edge in pairwise(Q) if checker.check_motion(*edge)]
    assert len(accepted) > 3
    for edge in accepted[:6]:
        assert truth.judge(np.stack(edge)).clearance > -0.001


def test_problems_are_what_they_claim(truth, robot):
    criteria = Criteria()
    problems = find_problems(truth, 2, seed=3, criteria=criteria)
    assert len(problems) == 2
    assert find_problems(truth, 2, seed=3, criteria=criteria) == problems
    assert any(any(p.hidden) for p in problems)
    spacious, wide = truth.checker(min(criteria.ends)), truth.checker(criteria.straight)
    tip = np.array([tip_sphere(robot)])
    for problem in problems:
        assert Problem.from_dict(problem.to_dict()) == problem
        start, goal = np.array(problem.start), np.array(problem.goal)
        assert not wide.check_motion(start, goal)
        for q, hidden, near in zip((start, goal), problem.hidden, problem.hand, strict=True):
            assert spacious.is_valid(q)
            place = truth.sphere_centers(q[None], tip)[0]
            assert truth.scene.signed_distance(place)[0] <= criteria.tip + 0.003
            assert (classify_points(truth.world.views, place)[0] == OCCLUDED) == hidden
            assert hand_distance(truth, q) == near <= criteria.hand
        found = plan(truth.checker(criteria.clearance), start, goal, seed=problem.seed)
        assert found.solved
        assert not truth.judge(found.path).collides


def test_a_scene_without_objects_offers_no_problems(robot, caplog):
    far = Scene((sphere(0.03, at(2.5, 0.0, 0.03)),), (1,), small_camera(), name="far")
    seen = small_scene().observation
    object.__setattr__(far, "observation", seen)
    assert find_problems(Truth(far, robot), 2) == []
    assert "0 problems of 2" in caplog.text
