# SPDX-License-Identifier: BSD-3-Clause
"""Every planner of OMPL's wheel, and what each of them does to those who trust it."""

import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import disk_world
import numpy as np
import pytest
from ompl import geometric as og

from vprism_plan.errors import PlanningError
from vprism_plan.planning import plan, planners

HERE = Path(__file__).parent
START, GOAL = [-0.7, -0.5], [0.7, -0.5]
QUICK = {"time_limit": 20.0, "stop": "first"}
OTHERS = ["RRT", "SORRTstar", "FMT", "BFMT", "PRM", "PRMstar", "BKPIECE1", "LBKPIECE1"]
NOT_PLANNERS = {"Discretization", "DiscretizationCellData", "SimpleSetup"}
NOT_PLANNERS |= {"PathGeometric", "PathSimplifier"}


def test_the_table_lists_every_planner_of_the_wheel():
    there = {name for name in dir(og) if name[0].isupper()} - NOT_PLANNERS
    assert set(planners()) == there
    assert len(there) == 14


def test_the_table_says_what_its_classes_offer():
    for name, kind in planners().items():
        offers = dir(kind.make)
        assert kind.has_range == ("setRange" in offers), name
        assert kind.needs_projection == ("setProjectionEvaluator" in offers), name
        assert kind.reports_cost == ("bestCost" in offers), name
        if kind.goal_bias:
            assert {"setGoalBias", "setRange"} <= set(offers), name


@pytest.mark.parametrize("planner", OTHERS)
def test_the_other_planners_go_round_the_wall_and_round_the_corner(planner):
    wall = disk_world.wall_with_gap()
    result = plan(wall, START, GOAL, planner, **QUICK)
    assert result.solved, result.message
    assert all(wall.check_motion(a, b) for a, b in pairwise(result.path))
    turning = disk_world.DiskChecker([(0.0, 0.0)], [0.3], disk_world.robot(2, (0,)))
    result = plan(turning, [-0.9, 0.0], [0.9, 0.0], planner, **QUICK)
    assert result.solved, result.message


@pytest.mark.parametrize("planner", ["RRT", "SORRTstar", "BFMT", "BKPIECE1", "LBKPIECE1"])
def test_the_other_planners_reach_one_of_several_goals(planner):
    wall = disk_world.wall_with_gap()
    result = plan(wall, START, [[0.0, 0.0], GOAL, [0.7, 0.5]], planner, **QUICK)
    assert result.solved, result.message
    # The first one is inside the wall.
    assert [refused.q for refused in result.report.refused_goals] == [(0.0, 0.0)]
    assert result.path[-1].tolist() == [GOAL, [0.7, 0.5]][result.report.goal_index]


def in_a_process(body):
    script = f"import sys; sys.path.insert(0, {str(HERE)!r})\n" + body
    return subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=240, check=False
    )


PROLOGUE = """
import disk_world
from vprism_plan.errors import PlanningError
from vprism_plan.planning import plan
wall = disk_world.wall_with_gap()
start, goal = [-0.7, -0.5], [0.7, -0.5]
def refused(**arguments):
    try:
        plan(wall, start, **{"goal": goal, "time_limit": 1.0, **arguments})
    except PlanningError as error:
        print("refused:", error)
"""


def test_prm_does_not_deadlock_with_several_goals_or_a_python_condition():
    """The second thread of PRM waited for the interpreter's lock, whatever the time limit."""
    done = in_a_process(
        PROLOGUE
        + """
for name in ("PRM", "PRMstar"):
    refused(planner=name, goal=[goal, [0.7, 0.5]])
    refused(planner=name, clock="process")
    # A continuous joint needs no objective in Python.
    turning = disk_world.DiskChecker([(0.0, 0.0)], [0.3], disk_world.robot(2, (0,)))
    assert plan(turning, [-0.9, 0.0], [0.9, 0.0], name, time_limit=1.5).solved
"""
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("refused:") == 4
    assert done.stderr == ""


def test_prm_does_not_abort_the_process_when_a_checker_raises():
    """Thrown out of solve(), an exception met a C++ thread that nobody had joined."""
    done = in_a_process(
        PROLOGUE
        + """
class Breaks(disk_world.DiskChecker):
    asked = 0
    def is_valid_buffer(self, q):
        Breaks.asked += 1
        if Breaks.asked > 20:
            raise error("sensor unplugged")
        return super().is_valid_buffer(q)
    def check_motion(self, qa, qb):
        return False
for error in (RuntimeError, KeyboardInterrupt):
    for name in ("PRM", "PRMstar"):
        Breaks.asked = 0
        try:
            plan(Breaks(wall.centers, wall.radii, wall.robot), start, goal, name)
        except error as caught:
            print("raised", caught)
"""
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["raised sensor unplugged"] * 4
    assert done.stderr == ""


def test_aorrtc_is_new_for_every_query():
    """A second solve() of one AORRTC after clear() ends the process."""
    done = in_a_process(
        PROLOGUE
        + """
for seed in range(4):
    assert plan(wall, start, goal, "AORRTC", time_limit=0.2, seed=seed, clock="process").solved
"""
    )
    assert done.returncode == 0, done.stderr


def test_a_condition_that_held_once_does_not_end_the_rounds_that_follow():
    """OMPL's conditions stay true: the search went on in name only after its first path."""
    wall = disk_world.wall_with_gap()
    result = plan(wall, START, GOAL, "RRTstar", time_limit=1.0, clock="process")
    costs = [step.cost for step in result.report.history]
    assert 2 <= len(costs) <= 60
    assert costs[-1] < 0.97 * costs[0]


def test_goals_are_several_configurations():
    wall = disk_world.wall_with_gap()
    result = plan(wall, START, [[0.0, 0.0], [0.0, 0.1]])
    assert result.status == "invalid_goal"
    assert "all 2 configurations given as goals are invalid" in result.message
    assert "touches" in result.message
    assert len(result.report.refused_goals) == 2
    result = plan(wall, START, np.array([[-0.7, 0.9], GOAL]))
    assert result.solved
    assert result.report.direct
    assert result.report.goal_index == 0


def test_prm_with_a_pose_that_has_many_solutions_says_why_not():
    wall = disk_world.wall_with_gap()
    with pytest.raises(PlanningError, match="deadlocks with more than one goal"):
        plan(wall, START, [GOAL, [0.7, 0.5]], "PRM")
