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

EPILOGUE = """
gc.disable()
with quiet_ompl():
    for _ in range(50):
        cycle()
    before = memory().rss
    for _ in range(500):
        cycle()
print((memory().rss - before) / 1e6)
"""

EVERY_PLANNER = """
turning = disk_world.DiskChecker([(0.0, 0.0)], [0.3], disk_world.robot(2, (0,)))
for name in ("RRTConnect", "RRTstar", "InformedRRTstar", "BITstar", "KPIECE1", "AORRTC"):
    for stop in ("first", "converged", "limit"):
        for world in (checker, turning):
            plan(world, [-0.9, 0.0], [0.9, 0.0], name, time_limit=0.1, stop=stop)
class Breaks(disk_world.DiskChecker):
    def check_motion_buffer(self, qa, qb):
        raise RuntimeError("sensor unplugged")
broken = Breaks([(0.0, 0.0)], [0.3], disk_world.robot())
for name in ("RRTConnect", "RRTstar", "InformedRRTstar", "BITstar", "KPIECE1", "AORRTC"):
    try:
        plan(broken, [-0.9, 0.0], [0.9, 0.0], name, time_limit=1.0)
    except RuntimeError:
        print("raised")
"""


def run(*parts):
    script = "".join(parts).replace("{here!r}", repr(str(HERE)))
    return subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=300, check=False
    )


@pytest.mark.parametrize("body", [OWN_PROGRAM, ONE_CALL], ids=["own_program", "plan"])
def test_500_cycles_grow_less_than_5_megabytes_and_leave_quietly(body):
    done = run(PROLOGUE, body, EPILOGUE)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert float(done.stdout) < 5.0


def test_every_planner_and_every_exception_leave_quietly():
    done = run(PROLOGUE, EVERY_PLANNER)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert done.stdout.split() == ["raised"] * 6
