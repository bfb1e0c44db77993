# SPDX-License-Identifier: BSD-3-Clause
"""`plan` with a checker that bounds risk: the whole path counts, not its edges."""

import time
from dataclasses import dataclass

import disk_world
import numpy as np
import pytest

from vprism_plan.planning import plan

START, GOAL = [-0.7, -0.5], [0.7, -0.5]


@dataclass(frozen=True)
class Estimate:
    probability: float
    upper: float
    first_contact: tuple[()] = ()

    def text(self):
        return f"P(collision) {self.probability:.3f}"


class RiskyDisks(disk_world.DiskChecker):
    """Balls, and a joint risk that each level of tightening divides by `gain`."""

    def __init__(self, inner, max_risk, first_risk, gain=2.0, levels=4):
        self.__dict__.update(inner.__dict__)
        self.max_risk, self.first_risk = max_risk, first_risk
        self.gain, self.levels, self.level = gain, levels, 0
        self.asked = []

    def tightened(self, level, ends):
        if level > self.levels:
            return None
        stricter = RiskyDisks(self, self.max_risk, self.first_risk, self.gain, self.levels)
        stricter.level = level
        # What is stricter refuses more: the balls grow.
        stricter.radii = self.radii + 0.01 * level
        return stricter

    def collision_probability(self, path, held_out=False):
        assert held_out, "the path must be judged by worlds that the search has not seen"
        nearest = min(self.clearance(q) for q in path)
        self.asked.append(nearest)
        risk = self.first_risk / self.gain ** (len(self.asked) - 1)
        return Estimate(risk, risk + 0.01)


def risky(**numbers):
    return RiskyDisks(disk_world.wall_with_gap(), **numbers)


def test_a_path_within_the_bound_is_returned_with_its_risk():
    result = plan(risky(max_risk=0.1, first_risk=0.05), START, GOAL)
    assert result.solved
    assert result.report.risk.upper == pytest.approx(0.06)
    assert result.report.risk_levels == 0
    assert "P(collision) 0.050" in result.message


def test_a_path_that_is_too_risky_as_a_whole_is_sought_again_under_a_tighter_bound():
    checker = risky(max_risk=0.1, first_risk=0.3)
    result = plan(checker, START, GOAL)
    assert result.solved
    assert result.report.risk_levels == 2  # 0.3, 0.15, 0.075
    assert result.report.risk.upper <= checker.max_risk
    assert len(checker.asked) == 3


def test_if_no_bound_is_tight_enough_the_least_risky_path_is_shown_and_not_returned():
    checker = risky(max_risk=0.1, first_risk=0.9, gain=1.2, levels=3)
    result = plan(checker, START, GOAL)
    assert (result.status, result.path, result.solved) == ("too_risky", None, False)
    assert result.approximate_path is not None
    assert np.allclose(result.approximate_path[[0, -1]], [START, GOAL])
    assert result.report.risk_levels == 3
    assert result.report.risk.probability == pytest.approx(0.9 / 1.2**3)
    assert "whole path is not" in result.message


def test_the_report_counts_every_tightening_also_those_that_made_it_worse():
    """It once gave the level of the least risky path: 0 if tightening never helped."""
    checker = risky(max_risk=0.1, first_risk=0.3, gain=0.9, levels=2)
    result = plan(checker, START, GOAL)
    assert result.status == "too_risky"
    assert result.report.risk.probability == pytest.approx(0.3)
    assert result.report.risk_levels == 2
    assert "tightened 2 times" in result.message


def test_a_refusal_of_the_tighter_search_keeps_the_path_that_was_found():
    checker = RiskyDisks(disk_world.wall_with_gap(), 0.1, 0.9, 1.0, 1)
    closed = disk_world.closed_wall()
    tightened = checker.tightened

    def close(level, ends):
        stricter = tightened(level, ends)
        stricter.centers, stricter.radii = closed.centers, closed.radii
        return stricter

    checker.tightened = close
    result = plan(checker, START, GOAL, time_limit=1.0)
    assert result.status == "too_risky"
    assert result.approximate_path is not None


@pytest.mark.parametrize("end", [START, GOAL])
@pytest.mark.parametrize("clock", ["wall", "process"])
def test_an_end_that_the_tighter_bound_refuses_is_not_waited_for(end, clock):
    """OMPL sleeps until a goal is valid: the whole time limit, or for ever by processor time."""
    checker = RiskyDisks(disk_world.wall_with_gap(), 0.1, 0.9, 1.0, 1)
    tightened = checker.tightened
    asked = []

    def cover(level, ends):
        stricter = tightened(level, ends)
        stricter.centers = np.concatenate([stricter.centers, [end]])
        stricter.radii = np.append(stricter.radii, 0.05)
        stricter.check_motion_buffer = lambda *ends: asked.append(ends) or False
        return stricter

    checker.tightened = cover
    result = plan(checker, START, GOAL, time_limit=30.0, clock=clock)
    assert result.status == "too_risky"
    assert result.approximate_path is not None
    assert not asked, "no planner is started between ends that are refused"


def test_the_time_limit_ends_the_tightening():
    checker = risky(max_risk=1e-6, first_risk=0.9, gain=1.0, levels=10**6)
    result = plan(checker, START, GOAL, time_limit=1.0)
    assert result.status == "too_risky"
    assert 0 < len(checker.asked) < 10**4


def test_the_straight_way_is_judged_as_a_whole_too():
    free = disk_world.DiskChecker(np.zeros((0, 2)), np.zeros(0), disk_world.robot())
    checker = RiskyDisks(free, 0.1, 0.9, 1.0, 0)
    result = plan(checker, START, GOAL)
    assert result.status == "too_risky"
    assert result.report.direct


def test_without_a_bound_nobody_is_asked():
    checker = risky(max_risk=0.1, first_risk=0.9)
    checker.max_risk = None
    result = plan(checker, START, GOAL)
    assert result.solved
    assert checker.asked == []
    assert result.report.risk is None


def test_what_even_a_looser_bound_calls_too_risky_is_still_shown():
    """Found edge by edge, too risky as a whole: the answer was "timeout", and no path at all."""
    closed = disk_world.closed_wall()
    checker = RiskyDisks(closed, 0.1, 0.99, gain=1.0, levels=0)
    checker.relaxed = lambda bound: RiskyDisks(
        disk_world.wall_with_gap(), bound, 0.99, gain=1.0, levels=0
    )
    result = plan(checker, START, GOAL, time_limit=2.0)
    assert result.status == "too_risky"
    assert result.approximate_path is not None
    assert result.risk.probability == 0.99
    assert "riskier motions" in result.message


def test_drawing_worlds_under_a_wide_margin_leaves_the_last_one_its_time():
    class SlowAtFirst(RiskyDisks):
        """The first estimate takes longer than the whole plan may."""

        def with_extra_margin(self, extra):
            wider = SlowAtFirst(self, self.max_risk, 1.0)
            wider.radii, wider.asked = self.radii + extra, self.asked
            return wider

        def tightened(self, level, ends):
            return None

        def collision_probability(self, path, held_out=False):
            if not self.asked:
                time.sleep(0.6)
            self.asked.append(0.0)
            return Estimate(1.0, 1.0) if len(self.asked) == 1 else Estimate(0.0, 0.01)

    checker = SlowAtFirst(disk_world.wall_with_gap(), 0.1, 1.0)
    # A straight way, so that no search runs in the tenth of a second of the wide margin.
    result = plan(checker, START, [-0.7, 0.5], margins=(0.01, 0.0), time_limit=0.5)
    assert result.solved, result.message
    assert result.report.direct
    assert result.report.time_limit > 0.3
