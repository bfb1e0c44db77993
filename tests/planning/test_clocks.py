# SPDX-License-Identifier: BSD-3-Clause
"""Limits on time that passes, and on processor time."""

import time

import disk_world
import pytest

from vprism_plan.errors import PlanningError
from vprism_plan.planning import plan, search

COMMON = ["RRTConnect", "RRTstar", "InformedRRTstar", "BITstar", "KPIECE1", "AORRTC"]
START, GOAL = [-0.7, -0.5], [0.7, -0.5]


class Dawdler(disk_world.DiskChecker):
    """Waits in every check: wall time passes, processor time does not."""

    def check_motion_buffer(self, qa, qb):
        time.sleep(0.002)
        return super().check_motion_buffer(qa, qb)


def dawdler():
    wall = disk_world.closed_wall()
    return Dawdler(wall.centers, wall.radii, wall.robot)


def test_processor_time_stands_still_while_a_checker_waits():
    began, spent = time.perf_counter(), time.process_time()
    result = plan(dawdler(), START, GOAL, "RRTstar", time_limit=0.1, clock="process")
    assert result.report.clock == "process"
    assert 0.1 <= result.report.planning_time <= time.process_time() - spent
    # Most of the time it slept.
    assert time.perf_counter() - began > 1.5 * result.report.planning_time


def test_wall_time_passes_while_a_checker_waits():
    result = plan(dawdler(), START, GOAL, "RRTstar", time_limit=0.3)
    assert result.report.clock == "wall"
    assert 0.29 < result.report.planning_time < 2.0


@pytest.mark.parametrize("planner", COMMON)
def test_every_planner_stops_at_its_limit_of_processor_time(planner):
    checker = disk_world.closed_wall()
    result = plan(checker, START, GOAL, planner, time_limit=0.1, clock="process")
    assert not result.solved
    assert 0.09 < result.report.planning_time < 5.0


@pytest.mark.parametrize("planner", COMMON)
def test_both_clocks_give_the_same_path_if_the_search_ends_by_itself(planner):
    checker = disk_world.wall_with_gap()
    paths = [
        plan(checker, START, GOAL, planner, time_limit=20.0, stop="first", clock=clock).path
        for clock in ("wall", "process")
    ]
    assert paths[0].tolist() == paths[1].tolist()


class Fickle(disk_world.DiskChecker):
    """Refuses, once the search has begun, the goal that it accepted before."""

    def is_valid(self, q):
        return self.clearance(q) > 0.0

    def is_valid_buffer(self, q):
        return super().is_valid_buffer(q) and q[0] < GOAL[0] - 0.01


def test_a_planner_that_sleeps_until_its_goal_is_valid_is_woken_by_the_wall_clock(monkeypatch):
    """Processor time never passed: a benchmark by that clock hung for ever."""
    monkeypatch.setattr(search, "PATIENCE", 5.0)
    wall = disk_world.wall_with_gap()
    checker = Fickle(wall.centers, wall.radii, wall.robot)
    began = time.perf_counter()
    result = plan(checker, START, GOAL, time_limit=0.1, clock="process")
    assert not result.solved
    assert 0.5 <= time.perf_counter() - began < 5.0
    assert result.report.planning_time < 0.5


def test_an_unknown_clock_is_refused():
    with pytest.raises(PlanningError, match=r"'sundial'.*'wall'.*'process'"):
        plan(disk_world.wall_with_gap(), START, GOAL, clock="sundial")
