# SPDX-License-Identifier: BSD-3-Clause
"""What `optimize` keeps: a bound on risk, the clearance of a path, and that path itself."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
from planning.disk_world import DiskChecker, wall_with_gap
from trajopt.disk_cost import BallCost, disk_cost

from vprism_plan.trajopt import SmoothnessCost, optimize

START, GOAL = np.array([-0.7, -0.5]), np.array([0.7, -0.5])
OVER = np.array([START, [-0.5, 0.9], [0.5, 0.9], GOAL])


def run(checker, **given):
    cost = given.pop("cost", None) or disk_cost(checker)
    given = {"waypoints": 16, "max_iterations": 80, "seeds": 6, **given}
    return optimize(checker, START, GOAL, cost=cost, **given)


def length(path):
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def densest(checker, path):
    """The smallest clearance of a path, by a great many samples: slow and obvious."""
    rows = [a + t * (b - a) for a, b in pairwise(path) for t in np.linspace(0.0, 1.0, 30)]
    return min(checker.clearance(q) for q in rows)


@dataclass(frozen=True)
class Estimate:
    probability: float
    upper: float

    def text(self):
        return f"P(collision) {self.probability:.3f}"


class NearIsRisky(DiskChecker):
    """The risk of a whole path grows as it comes near; no edge and no cost says so."""

    def __init__(self, inner, max_risk, levels=5):
        self.__dict__.update(inner.__dict__)
        self.inner, self.max_risk, self.levels, self.asked = inner, max_risk, levels, []

    def tightened(self, level, ends):
        if level > self.levels:
            return None
        stricter = NearIsRisky(self.inner, self.max_risk, self.levels)
        stricter.radii = self.inner.radii + 0.01 * level
        stricter.asked = self.asked
        return stricter

    def collision_probability(self, path, held_out=False):
        assert held_out, "the path must be judged by worlds that nothing has seen"
        self.asked.append(np.array(path))
        risk = float(np.exp(-60.0 * densest(self.inner, path)))
        return Estimate(risk, min(1.0, 1.2 * risk))


def guard(checker):
    return BallCost(checker, margin=0.1, weight=3e4)


def test_a_path_within_the_bound_comes_with_its_risk():
    checker = NearIsRisky(wall_with_gap(), max_risk=0.9)
    result = run(checker)
    assert result.solved
    assert result.report.risk.upper <= 0.9
    assert result.report.risk_levels == 0
    assert "P(collision)" in result.message
    assert np.array_equal(checker.asked[-1], result.path)


def test_a_path_too_risky_as_a_whole_is_pushed_away_until_it_is_not():
    loose = run(NearIsRisky(wall_with_gap(), max_risk=0.9))
    checker = NearIsRisky(wall_with_gap(), max_risk=0.03)
    result = run(checker, guard=guard(checker))
    assert result.solved
    assert result.report.risk.upper <= 0.03 < loose.report.risk.upper
    assert result.report.risk_levels >= 1
    assert len(checker.asked) == result.report.risk_levels + 1
    assert densest(checker.inner, result.path) > densest(checker.inner, loose.path)
    assert result.report.winner_name in result.message


@pytest.mark.parametrize("repairing", [True, False])
def test_a_bound_that_cannot_be_kept_gives_no_path(repairing):
    checker = NearIsRisky(wall_with_gap(), max_risk=1e-9)
    result = run(checker, guard=guard(checker) if repairing else None, initial=OVER, seeds=2)
    assert result.status == "too_risky"
    assert result.path is None
    assert not result.solved
    assert np.array_equal(result.best[0], START)
    assert "whole path is not" in result.message


def test_the_clearance_of_the_initial_path_is_kept_and_the_path_is_shorter():
    gap = wall_with_gap()
    before = densest(gap, OVER)
    free = run(gap, initial=OVER, seeds=1)
    assert densest(gap, free.path) < before - 0.02
    kept = run(gap, initial=OVER, seeds=1, keep_clearance=True, guard=BallCost(gap, 0.25, 3e4))
    assert kept.solved
    assert densest(gap, kept.path) >= before - 1e-3
    assert length(kept.path) < 0.98 * length(OVER)
    assert kept.report.kept_clearance == pytest.approx(before, abs=2e-3)
    assert kept.report.min_clearance == pytest.approx(densest(gap, kept.path), abs=2e-3)


def test_a_number_of_metres_can_be_kept():
    gap = wall_with_gap()
    result = run(gap, keep_clearance=0.08, guard=BallCost(gap, 0.12, 3e4))
    assert result.solved
    assert densest(gap, result.path) >= 0.08 - 1e-3


def test_where_nothing_passes_the_initial_path_comes_back_as_it_is():
    """A cost that cares for length alone draws everything through the wall."""
    gap = wall_with_gap()
    result = run(gap, cost=SmoothnessCost(), initial=OVER, seeds=2)
    assert result.solved
    assert np.array_equal(result.path, OVER)
    assert result.report.winner is None
    assert result.report.winner_name == ""
    assert "as it was given" in result.message
    assert np.isnan(result.report.cost)
    assert result.report.path_length == pytest.approx(length(OVER))


def test_an_initial_path_that_collides_is_no_solution_either():
    gap = wall_with_gap()
    through = np.stack([START, [0.0, 0.1], GOAL])
    result = run(gap, cost=SmoothnessCost(), initial=through, seeds=1)
    assert not result.solved
    assert result.path is None


def test_several_initial_paths_come_first_and_keep_the_best_clearance():
    gap = wall_with_gap()
    near = np.stack([START, [-0.3, 0.75], [0.3, 0.75], GOAL])
    result = run(gap, initial=[near, OVER], seeds=3)
    assert [seed.name for seed in result.report.seeds] == ["initial 0", "initial 1", "straight"]
    stacked = run(gap, initial=np.stack([near, OVER]), seeds=3)
    assert np.array_equal(stacked.begun, result.begun)
    kept = run(gap, initial=[near, OVER], seeds=2, keep_clearance=True)
    clearances = [densest(gap, path) for path in (near, OVER)]
    assert kept.report.kept_clearance == pytest.approx(max(clearances), abs=5e-3)
