# SPDX-License-Identifier: BSD-3-Clause
"""`optimize` with a real arm among the bundled scene's objects, and its picture."""

from pathlib import Path

import numpy as np
import pytest

import vprism_plan as vp
from vprism_plan.collision.motion import edges_of
from vprism_plan.planning import PoseGoalConfig
from vprism_plan.trajopt import default_cost, optimize
from vprism_plan.viz import save_figure, trajopt_figure

START = [0.5, 0.67, 0.0, -1.6, 0.0, 2.27, 0.785]
GOAL = [-0.35, 0.3, 0.0, -1.85, 0.0, 2.15, 0.785]
TOUCHING = [0.48, 0.7, -0.11, -1.8, -0.23, 2.27, 0.88]
BASE = np.array([[0, -1, 0, 0.05], [1, 0, 0, -0.6], [0, 0, 1, 0], [0, 0, 0, 1.0]])


@pytest.fixture(scope="module")
def panda():
    urdf = Path(vp.__file__).parent / "data" / "urdf" / "panda.urdf"
    return vp.Robot.from_urdf(urdf, base_pose=BASE)


@pytest.fixture(scope="module")
def checker(demo_world, panda):
    return vp.CollisionChecker(demo_world, panda)


@pytest.fixture(scope="module")
def raw(checker):
    """RRTConnect's path as it comes from the planner."""
    return vp.plan(checker, START, GOAL, simplify=False).path


def free_everywhere(checker, path):
    """A second look: every configuration within half a millimetre of motion."""
    Q, _ = edges_of(checker, path).samples(0.0005)
    return checker.is_valid_batch(Q).all()


def length(path):
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def test_from_nothing_with_the_default_cost(checker):
    assert not checker.check_motion(START, GOAL)
    result = optimize(checker, START, GOAL, seeds=3)
    assert result.solved
    assert free_everywhere(checker, result.path)
    assert np.array_equal(result.path[[0, -1]], [START, GOAL])
    assert result.report.rounds == 1
    shortened = vp.plan(checker, START, GOAL)
    assert length(result.path) < 1.02 * shortened.report.path_length
    assert result.report.min_clearance > shortened.report.min_clearance
    names = {"smoothness", "clearance", "risk", "self-collision", "joint limits"}
    assert set(result.history.terms) == names


def test_a_planners_path_gets_shorter_at_no_lower_clearance(checker, raw):
    result = optimize(checker, START, GOAL, initial=raw, seeds=1, keep_clearance=True)
    assert result.solved
    assert result.report.winner_name == "initial 0"
    assert free_everywhere(checker, result.path)
    before, after = (checker.min_clearance(path).clearance for path in (raw, result.path))
    assert after >= before - 0.001
    assert length(result.path) < 0.75 * length(raw)


@pytest.mark.slow
def test_a_bound_on_risk_holds_for_the_whole_path(demo_world, panda):
    bounded = vp.CollisionChecker(demo_world, panda, vp.CheckerConfig(max_risk=0.1, n_worlds=64))
    result = optimize(bounded, START, GOAL, seeds=1, waypoints=16, max_iterations=60)
    assert result.solved
    assert result.report.risk.upper <= 0.1
    again = bounded.collision_probability(result.path, held_out=True)
    assert again.upper == result.report.risk.upper
    assert "risk" in result.history.terms


def test_a_goal_that_touches_what_it_may(demo_world, panda):
    plain = vp.CollisionChecker(demo_world, panda, vp.CheckerConfig(max_risk=None))
    assert optimize(plain, GOAL, TOUCHING).status == "invalid_goal"
    rules = vp.CheckerConfig(allowed_contacts={"hand": {1}}, max_risk=None)
    ruled = vp.CollisionChecker(demo_world, panda, rules)
    result = optimize(ruled, GOAL, TOUCHING, seeds=3)
    assert result.solved
    assert free_everywhere(ruled, result.path)


def test_a_margin_that_the_start_does_not_keep_is_refused(demo_world, panda):
    strict = vp.CollisionChecker(demo_world, panda, vp.CheckerConfig(margin=0.3))
    result = optimize(strict, START, GOAL)
    assert result.status == "invalid_start"
    assert "start is invalid" in result.message


def test_the_default_cost_pushes_only_within_its_margin(checker):
    """In the open it is the squared length, whatever the number of waypoints."""
    import torch

    cost = default_cost(checker)
    high = np.array(START) - [0.0, 0.9, 0.0, 0.0, 0.0, 0.0, 0.0]
    line = high + np.linspace(0.0, 1.0, 12)[:, None] * [0.4, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    assert float(cost(torch.from_numpy(line))) == pytest.approx(0.4**2)
    through = np.array(START) + np.linspace(0.0, 1.0, 12)[:, None] * np.subtract(GOAL, START)
    assert float(cost(torch.from_numpy(through))) > 10.0 * length(through) ** 2


def test_the_picture_shows_paths_and_history(checker, raw, tmp_path):
    result = optimize(checker, START, GOAL, initial=raw, seeds=2, max_iterations=10)
    figure = trajopt_figure(checker, result, given=raw, title="a test")
    above, side, terms, seeds = figure.axes[:4]
    assert "above" in above.get_title()
    assert "side" in side.get_title()
    assert {t.get_text() for t in seeds.get_legend().get_texts()} == {
        "initial 0 (returned)",
        "straight",
    } or result.report.winner != 0
    drawn = {line.get_label() for line in terms.lines}
    assert set(result.history.terms) <= drawn
    save_figure(figure, tmp_path / "trajopt.png")
    assert (tmp_path / "trajopt.png").stat().st_size > 20_000
    refused = optimize(checker, [9.0, *START[1:]], GOAL)
    with pytest.raises(ValueError, match="start is invalid"):
        trajopt_figure(checker, refused)


def test_a_pose_is_reached_by_the_nearest_configuration_that_has_a_path(checker, panda):
    pose = panda.link_poses(GOAL)["panda_hand"]
    how = PoseGoalConfig(link="panda_hand", max_goals=2)
    result = optimize(checker, START, pose, seeds=2, pose_goal=how)
    assert result.solved, result.message
    assert free_everywhere(checker, result.path)
    np.testing.assert_allclose(panda.link_poses(result.path[-1])["panda_hand"], pose, atol=2e-3)
    away = pose.copy()
    away[2, 3] = 3.0
    nothing = optimize(checker, START, away)
    assert nothing.status == "invalid_goal"
    assert "reaches the pose" in nothing.message
