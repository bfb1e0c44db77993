# SPDX-License-Identifier: BSD-3-Clause
"""`optimize` hands out verified paths only, and says why where there is none."""

from itertools import pairwise

import numpy as np
import pytest
from planning.disk_world import wall_with_gap
from trajopt.disk_cost import disk_cost

from vprism_plan.trajopt import optimize

START, GOAL = np.array([-0.8, -0.4]), np.array([0.8, -0.3])
SMALL = {"waypoints": 24, "max_iterations": 150}


def run(checker, start=START, goal=GOAL, **settings):
    cost = settings.pop("cost", None) or disk_cost(checker)
    return optimize(checker, start, goal, **{"cost": cost, **SMALL, **settings})


def every_edge_is_free(checker, path):
    return all(checker.check_motion(a, b) for a, b in pairwise(path))


def length(path):
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


@pytest.fixture
def gap():
    return wall_with_gap()


@pytest.mark.parametrize("method", ["lbfgs", "adam"])
def test_a_path_round_the_wall_is_found_and_free(gap, method):
    assert not gap.check_motion(START, GOAL)
    result = run(gap, method=method)
    assert result.solved
    assert result.status == "exact"
    assert every_edge_is_free(gap, result.path)
    assert result.report.winner_name in result.message
    # Over the wall's end and straight from there to both ends is the shortest way.
    corner = np.array([0.0, 0.55 + 0.15])
    shortest = np.linalg.norm(corner - START) + np.linalg.norm(GOAL - corner)
    assert shortest < length(result.path) < 1.1 * shortest
    assert result.report.path_length == pytest.approx(length(result.path))


@pytest.mark.parametrize("method", ["lbfgs", "adam"])
def test_start_and_goal_are_returned_bit_for_bit(gap, method):
    rng = np.random.default_rng(3)
    for _ in range(4):
        start = np.array([rng.uniform(-0.9, -0.4), rng.uniform(-0.9, 0.9)])
        goal = np.array([rng.uniform(0.4, 0.9), rng.uniform(-0.9, 0.9)])
        result = run(gap, start, goal, seeds=4, method=method, max_iterations=40)
        for rows in (result.begun, result.ended):
            assert np.array_equal(rows[:, 0], np.tile(start, (4, 1)))
            assert np.array_equal(rows[:, -1], np.tile(goal, (4, 1)))
        if result.solved:
            assert np.array_equal(result.path[0], start)
            assert np.array_equal(result.path[-1], goal)
