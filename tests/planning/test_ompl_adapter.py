# SPDX-License-Identifier: BSD-3-Clause
"""The two classes inside somebody else's OMPL program."""

import threading
from itertools import pairwise

import disk_world
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ompl import base as ob
from ompl import geometric as og

from vprism_plan.errors import PlanningError
from vprism_plan.planning import (
    CheckerLike,
    VPrismMotionValidator,
    VPrismStateValidityChecker,
    last_valid,
    ompl_adapter,
    quiet_ompl,
    state_space,
    to_array,
    to_state,
)
from vprism_plan.planning.ompl_adapter import nearest_turns


def attach(checker, space=None):
    si = ob.SpaceInformation(space or state_space(checker.robot))
    si.setStateValidityChecker(VPrismStateValidityChecker(si, checker))
    si.setMotionValidator(VPrismMotionValidator(si, checker))
    with quiet_ompl():
        si.setup()
    return si


def one_disk(continuous=()):
    return disk_world.DiskChecker([(0.0, 0.0)], [0.3], disk_world.robot(2, continuous))


def test_the_fake_is_what_planning_asks_for():
    checker = one_disk()
    assert isinstance(checker, CheckerLike)


@settings(max_examples=100, deadline=None)
@given(q=st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4))
def test_ompl_hears_what_the_checker_says(q):
    checker = one_disk()
    si = attach(checker)
    a, b = np.array(q[:2]), np.array(q[2:])
    s1, s2 = to_state(si.getStateSpace(), a), to_state(si.getStateSpace(), b)
    assert si.isValid(s1) is checker.is_valid(a)
    assert si.checkMotion(s1, s2) is checker.check_motion(a, b)


def test_a_verdict_that_is_not_a_bool_still_arrives():
    class Numpyish(disk_world.DiskChecker):
        def is_valid_buffer(self, q):
            return np.bool_(super().is_valid_buffer(q))

        def check_motion_buffer(self, qa, qb):
            return np.bool_(super().check_motion_buffer(qa, qb))

    si = attach(Numpyish([(0.0, 0.0)], [0.3], disk_world.robot()))
    space = si.getStateSpace()
    left, inside = to_state(space, np.array([-0.9, 0.0])), to_state(space, np.zeros(2))
    assert si.isValid(left)
    assert not si.isValid(inside)
    assert not si.checkMotion(left, inside)


def test_clearance_is_metres_and_negative_inside():
    checker = one_disk()
    si = attach(checker)
    svc = VPrismStateValidityChecker(si, checker)
    assert svc.clearance(to_state(si.getStateSpace(), np.array([0.5, 0.0]))) == pytest.approx(0.2)
    assert svc.clearance(to_state(si.getStateSpace(), np.zeros(2))) == pytest.approx(-0.3)


def test_the_end_of_a_motion_is_checked_even_if_the_checkers_edges_forget_it():
    class ForgetsItsEnd(disk_world.DiskChecker):
        def check_motion_buffer(self, qa, qb):
            return True

    si = attach(ForgetsItsEnd([(0.0, 0.0)], [0.3], disk_world.robot()))
    space = si.getStateSpace()
    away, inside = to_state(space, np.array([-0.9, 0.0])), to_state(space, np.zeros(2))
    assert not si.checkMotion(away, inside)


@pytest.mark.parametrize("attachment", [VPrismStateValidityChecker, VPrismMotionValidator])
@pytest.mark.parametrize("dimension", [1, 3, 7])
def test_a_wrong_dimension_names_both_numbers(attachment, dimension):
    space = ob.RealVectorStateSpace(dimension)
    space.setBounds(-1, 1)
    with pytest.raises(PlanningError, match=f"{dimension} dimensions.*2 joints"):
        attachment(ob.SpaceInformation(space), one_disk())


def test_the_users_own_compound_space_serves():
    space = ob.CompoundStateSpace()
    for _ in range(2):
        part = ob.RealVectorStateSpace(1)
        part.setBounds(-1, 1)
        space.addSubspace(part, 1.0)
    si = attach(one_disk(), space)
    assert not si.isValid(to_state(space, np.array([0.1, 0.1])))
    assert si.isValid(to_state(space, np.array([0.1, 0.9])))


@pytest.mark.parametrize("planner", [og.RRT, og.RRTConnect, og.RRTstar, og.KPIECE1, og.BITstar])
def test_a_users_program_finds_only_valid_motions(planner):
    checker = disk_world.wall_with_gap()
    si = attach(checker)
    space = si.getStateSpace()
    problem = ob.ProblemDefinition(si)
    problem.setStartAndGoalStates(
        to_state(space, np.array([-0.7, -0.5])), to_state(space, np.array([0.7, -0.5]))
    )
    solver = planner(si)
    solver.setProblemDefinition(problem)
    with quiet_ompl():
        solver.solve(ob.timedPlannerTerminationCondition(0.3))
    assert problem.hasExactSolution()
    path = [to_array(space, state) for state in problem.getSolutionPath().getStates()]
    assert all(checker.check_motion(a, b) for a, b in pairwise(path))


@settings(max_examples=200, deadline=None)
@given(
    a=st.floats(-np.pi, np.pi, exclude_max=True),
    b=st.floats(-np.pi, np.pi, exclude_max=True),
    t=st.floats(0.0, 1.0),
)
def test_the_checked_motion_is_the_one_ompl_interpolates(a, b, t):
    space = ob.SO2StateSpace()
    start, end, between = (space.allocState() for _ in range(3))
    start.value, end.value = a, b
    space.interpolate(start, end, t, between)
    end = nearest_turns(np.array([b]), np.array([a]), np.array([True]))[0]
    gap = a + t * (end - a) - between.value
    assert abs(gap - 2 * np.pi * round(gap / (2 * np.pi))) < 1e-9


def test_a_wrapping_motion_passes_behind_pi_and_not_through_zero():
    si = attach(one_disk(continuous=(0,)))
    space = si.getStateSpace()
    assert si.checkMotion(
        to_state(space, np.array([3.0, 0.0])), to_state(space, np.array([-3.0, 0.0]))
    )
    blocked = disk_world.DiskChecker([(np.pi, 0.0)], [0.1], disk_world.robot(2, (0,)))
    si = attach(blocked)
    space = si.getStateSpace()
    assert not si.checkMotion(
        to_state(space, np.array([3.0, 0.0])), to_state(space, np.array([-3.0, 0.0]))
    )


def test_a_long_turn_in_a_space_without_circles_is_not_mistaken_for_the_short_one():
    # The user models a continuous joint by a real interval: from -3 to 3 goes through 0.
    space = ob.RealVectorStateSpace(2)
    space.setBounds(-np.pi, np.pi)
    si = attach(one_disk(continuous=(0,)), space)
    assert not si.checkMotion(
        to_state(space, np.array([-3.0, 0.0])), to_state(space, np.array([3.0, 0.0]))
    )


@pytest.mark.parametrize("method", ["is_valid_buffer", "check_motion_buffer"])
def test_exceptions_of_the_checker_come_out_unchanged(method):
    class BoomError(RuntimeError):
        pass

    def explode(*_):
        raise BoomError("sensor unplugged")

    checker = one_disk()
    setattr(checker, method, explode)
    si = attach(checker)
    state = to_state(si.getStateSpace(), np.array([0.9, 0.9]))
    with pytest.raises(BoomError, match="unplugged"):
        si.checkMotion(state, state)


def test_a_second_thread_gets_its_own_answer():
    checker = one_disk()
    si = attach(checker)
    svc = VPrismStateValidityChecker(si, checker)
    space = si.getStateSpace()
    answers = []
    thread = threading.Thread(
        target=lambda: answers.append(svc.isValid(to_state(space, np.zeros(2))))
    )
    thread.start()
    thread.join()
    assert answers == [False]
    assert svc.isValid(to_state(space, np.array([0.9, 0.9])))
    assert svc.checks == 2


def test_without_the_capsule_route_the_answers_are_the_same(monkeypatch):
    monkeypatch.setattr(ompl_adapter, "_CAPSULE_NAME", b"renamed_by_nanobind")
    checker = one_disk()
    si = attach(checker)
    space = si.getStateSpace()
    left, right = to_state(space, np.array([-0.9, 0.0])), to_state(space, np.array([0.9, 0.0]))
    assert si.isValid(left)
    assert not si.isValid(to_state(space, np.zeros(2)))
    assert not si.checkMotion(left, right)


def test_last_valid_stops_at_the_disk():
    checker = one_disk()
    start, end = np.array([-0.9, 0.0]), np.array([0.9, 0.0])
    q, fraction = last_valid(checker, start, end, tolerance=1e-4)
    assert checker.check_motion(start, q)
    assert fraction == pytest.approx(0.6 / 1.8, abs=2e-4)
    np.testing.assert_allclose(q, start + fraction * (end - start))
    q, fraction = last_valid(checker, start, np.array([-0.9, 0.5]))
    assert fraction == 1.0
    assert q.tolist() == [-0.9, 0.5]
    assert last_valid(checker, np.zeros(2), end) == (None, 0.0)


def test_the_classes_count_their_calls():
    checker = one_disk()
    si = attach(checker)
    svc = VPrismStateValidityChecker(si, checker)
    mv = VPrismMotionValidator(si, checker)
    state = to_state(si.getStateSpace(), np.array([0.9, 0.9]))
    for _ in range(3):
        svc.isValid(state)
    mv.checkMotion(state, state)
    assert (svc.checks, mv.checks) == (3, 1)
