# SPDX-License-Identifier: BSD-3-Clause
"""Nothing of a query outlives it: no memory, no binding noise at exit."""

import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent

PROLOGUE = """
import gc, os, sys
sys.path.insert(0, {here!r})
import disk_world
import psutil
from ompl import base as ob, geometric as og
from vprism_plan.planning import *
memory = psutil.Process().memory_info
checker = disk_world.DiskChecker([(0.0, 0.0)], [0.3], disk_world.robot())
start, goal = [-0.9, 0.0], [0.9, 0.0]
"""

OWN_PROGRAM = """
import numpy as np
def cycle():
    space = state_space(checker.robot)
    si = ob.SpaceInformation(space)
    si.setStateValidityChecker(VPrismStateValidityChecker(si, checker))
    si.setMotionValidator(VPrismMotionValidator(si, checker))
    si.setup()
    problem = ob.ProblemDefinition(si)
    problem.setStartAndGoalStates(
        to_state(space, np.array(start)), to_state(space, np.array(goal))
    )
    planner = og.RRTConnect(si)
    planner.setProblemDefinition(problem)
    planner.solve(5.0)
    assert problem.hasExactSolution()
"""

ONE_CALL = """
def cycle():
    assert plan(checker, start, goal, simplify=False).solved
"""

WITH_RISK = """
import numpy as np
def upper_half(Q):
    return np.clip(Q[:, 1], 0.0, None)
def cycle():
    space = state_space(checker.robot)
    si = ob.SpaceInformation(space)
    si.setStateValidityChecker(VPrismStateValidityChecker(si, checker))
    si.setMotionValidator(VPrismMotionValidator(si, checker))
    si.setup()
    problem = ob.ProblemDefinition(si)
    problem.setStartAndGoalStates(
        to_state(space, np.array(start)), to_state(space, np.array(goal))
    )
    kinds = VPrismRiskObjective, VPrismMinimaxRiskObjective
    objective = kinds[cycle.count % 2](si, checker, kind=upper_half, spacing=0.5)
    problem.setOptimizationObjective(objective)
    planner = og.RRTstar(si)
    planner.setProblemDefinition(problem)
    planner.setup()
    left = iter(range(40))
    planner.solve(ob.PlannerTerminationCondition(lambda: next(left, None) is None))
    cycle.count += 1
cycle.count = 0
"""

LED = """
def upper_half(Q):
    return np.clip(Q[:, 1], 0.0, None)
import numpy as np
def cycle():
    found = plan(
        checker, start, goal, "RRTstar", objective=RiskObjective(upper_half, spacing=0.5),
        simplify=False, stop="converged", convergence=(0.5, 3),
    )
    assert found.solved
"""

EPILOGUE = """
gc.disable()
with quiet_ompl():
    for _ in range({warm}):
        cycle()
    before = memory().rss
    for _ in range({cycles}):
        cycle()
print((memory().rss - before) / 1e6)
"""

EVERY_PLANNER = """
turning = disk_world.DiskChecker([(0.0, 0.0)], [0.3], disk_world.robot(2, (0,)))
for name, kind in planners().items():
    for stop in ("first", "limit") if kind.starts_thread else ("first", "converged", "limit"):
        for world in (checker, turning):
            plan(world, [-0.9, 0.0], [0.9, 0.0], name, time_limit=0.05, stop=stop)
class Breaks(disk_world.DiskChecker):
    def check_motion_buffer(self, qa, qb):
        raise RuntimeError("sensor unplugged")
broken = Breaks([(0.0, 0.0)], [0.3], disk_world.robot())
for name in planners():
    try:
        plan(broken, [-0.9, 0.0], [0.9, 0.0], name, time_limit=1.0)
    except RuntimeError:
        print("raised")
"""


def run(*parts, cycles=500):
    script = "".join(parts).replace("{here!r}", repr(str(HERE)))
    script = script.replace("{warm}", str(cycles // 10)).replace("{cycles}", str(cycles))
    return subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=300, check=False
    )


@pytest.mark.parametrize("body", [OWN_PROGRAM, ONE_CALL], ids=["own_program", "plan"])
def test_500_cycles_grow_less_than_5_megabytes_and_leave_quietly(body):
    done = run(PROLOGUE, body, EPILOGUE)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert float(done.stdout) < 5.0


@pytest.mark.slow
@pytest.mark.parametrize("body", [WITH_RISK, LED], ids=["own_program", "plan"])
def test_objectives_keep_nothing_alive(body):
    done = run(PROLOGUE, body, EPILOGUE, cycles=60)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert float(done.stdout) < 3.0


def test_every_planner_and_every_exception_leave_quietly():
    done = run(PROLOGUE, EVERY_PLANNER)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert done.stdout.split() == ["raised"] * 14
