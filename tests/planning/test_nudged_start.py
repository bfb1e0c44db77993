# SPDX-License-Identifier: BSD-3-Clause
"""A start that is refused by a hair has a way out, said so; nothing refused is called free."""

import numpy as np
import pytest
from disk_world import DiskChecker, PointRobot
from hypothesis import given
from hypothesis import strategies as st

from vprism_plan.errors import PlanningError
from vprism_plan.planning import plan

ROBOT = PointRobot(np.full(2, -2.0), np.full(2, 2.0), np.zeros(2, dtype=bool))
GOAL = np.array([1.5, 1.5])


@given(depth=st.floats(1e-6, 0.02), turn=st.floats(0.0, 2.0 * np.pi), nudge=st.floats(1e-4, 0.02))
def test_a_start_is_moved_by_no_more_than_is_stated(depth, turn, nudge):
    """Into the disk by `depth`: only what is free within the stated room is taken."""
    checker = DiskChecker([[0.0, 0.0]], [0.5], ROBOT)
    start = (0.5 - depth) * np.array([np.cos(turn), np.sin(turn)])
    result = plan(checker, start, GOAL, nudge=nudge)
    if not result.solved:
        # From anywhere on the rim, some corner of the box leads straight out.
        assert result.status == "invalid_start"
        assert depth > 0.3 * nudge
        return
    moved = float(np.abs(result.path[0] - start).max())
    assert 0.0 < moved <= nudge
    assert depth <= np.sqrt(2.0) * nudge
    assert all(checker.is_valid(q) for q in result.path)
    assert result.report.certified
    (said,) = result.warnings
    assert said in result.message
    assert "the start is refused (" in said
    stated = float(said.split("up to ")[1].split(" mrad")[0])
    assert 1000.0 * moved <= stated <= 1000.0 * moved + 0.0101


def test_a_free_start_is_kept_and_a_deep_one_refused():
    checker = DiskChecker([[0.0, 0.0]], [0.5], ROBOT)
    free = plan(checker, [-1.0, 0.0], GOAL)
    np.testing.assert_array_equal(free.path[0], [-1.0, 0.0])
    assert free.warnings == ()
    for start, nudge in (([0.3, 0.0], 0.005), ([0.499, 0.0], 0.0)):
        refused = plan(checker, start, GOAL, nudge=nudge)
        assert refused.status == "invalid_start"
        assert refused.path is None
        assert refused.warnings == ()


def test_an_encoder_beyond_a_limit_by_a_milliradian_is_put_back():
    checker = DiskChecker([[0.0, 0.0]], [0.5], ROBOT)
    result = plan(checker, [2.001, 0.0], GOAL)
    assert result.solved
    assert (result.path <= ROBOT.upper).all()
    assert result.warnings
    assert plan(checker, [2.1, 0.0], GOAL).status == "invalid_start"


def test_goals_are_not_moved():
    checker = DiskChecker([[0.0, 0.0]], [0.5], ROBOT)
    assert plan(checker, GOAL, [0.4999, 0.0]).status == "invalid_goal"


@pytest.mark.parametrize("nudge", [-1e-3, 0.5, np.nan])
def test_odd_values_are_refused(nudge):
    with pytest.raises(PlanningError, match="nudge"):
        plan(DiskChecker([[0.0, 0.0]], [0.5], ROBOT), GOAL, GOAL, nudge=nudge)
