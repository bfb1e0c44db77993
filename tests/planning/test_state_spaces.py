# SPDX-License-Identifier: BSD-3-Clause
"""State spaces and the way of a state into numpy."""

import threading

import disk_world
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ompl import base as ob

from vprism_plan.errors import PlanningError
from vprism_plan.planning import ompl_adapter, state_space, to_array, to_state


def names(space):
    if isinstance(space, ob.CompoundStateSpace):
        return [(type(part).__name__, part.getDimension()) for part in space.getSubspaces()]
    return [(type(space).__name__, space.getDimension())]


def test_limited_joints_make_one_real_vector_space_with_their_bounds():
    robot = disk_world.robot(3)
    robot.lower[:] = [-1.0, -2.0, -3.0]
    robot.upper[:] = [0.5, 1.5, 2.5]
    space = state_space(robot)
    bounds = space.getBounds()
    assert names(space) == [("RealVectorStateSpace", 3)]
    assert list(bounds.low) == [-1.0, -2.0, -3.0]
    assert list(bounds.high) == [0.5, 1.5, 2.5]


@pytest.mark.parametrize(
    ("continuous", "expected"),
    [
        ((0,), [("SO2StateSpace", 1), ("RealVectorStateSpace", 3)]),
        ((1, 2), [("RealVectorStateSpace", 1), *[("SO2StateSpace", 1)] * 2,
                  ("RealVectorStateSpace", 1)]),
        ((0, 1, 2, 3), [("SO2StateSpace", 1)] * 4),
    ],
)  # fmt: skip
def test_continuous_joints_become_circles_in_joint_order(continuous, expected):
    assert names(state_space(disk_world.robot(4, continuous))) == expected


@pytest.mark.parametrize(("low", "high"), [(0.0, 0.0), (1.0, -1.0), (-np.inf, 1.0), (np.nan, 1.0)])
def test_a_limited_joint_without_a_range_is_named(low, high):
    robot = disk_world.robot(2)
    robot.lower[1], robot.upper[1] = low, high
    with pytest.raises(PlanningError, match="joint_1"):
        state_space(robot)


@settings(max_examples=60, deadline=None)
@given(
    continuous=st.sets(st.integers(0, 4)),
    q=st.lists(st.floats(-3.1, 3.1), min_size=5, max_size=5),
)
def test_flat_order_is_joint_order_by_both_routes(continuous, q):
    space = state_space(disk_world.robot(5, sorted(continuous)))
    state = to_state(space, np.array(q))
    reader = ompl_adapter.StateReader(space, 5)
    assert reader.fast
    assert to_array(space, state).tolist() == q
    assert reader.read(state).tolist() == q
    reader.fast = False
    assert reader.read(state).tolist() == q
    a, b = reader.read_pair(state, to_state(space, np.zeros(5)))
    assert a.tolist() == q
    assert b.tolist() == [0.0] * 5


def test_angles_of_circles_are_wrapped_and_others_are_not():
    space = state_space(disk_world.robot(2, (1,)))
    q = to_array(space, to_state(space, np.array([7.0, 7.0])))
    np.testing.assert_allclose(q, [7.0, 7.0 - 2 * np.pi])
    assert to_array(space, to_state(space, np.array([0.0, np.pi])))[1] == -np.pi


@pytest.mark.parametrize("q", [[0.0], [0.0, np.nan], [np.inf, 0.0], [0.0, 0.0, 0.0]])
def test_what_is_not_a_configuration_is_refused(q):
    with pytest.raises(PlanningError, match="2 finite numbers"):
        to_state(state_space(disk_world.robot(2)), np.array(q))


def test_without_the_capsule_route_the_slow_one_serves(monkeypatch):
    monkeypatch.setattr(ompl_adapter, "_CAPSULE_NAME", b"renamed_by_nanobind")
    space = state_space(disk_world.robot(4, (2,)))
    reader = ompl_adapter.StateReader(space, 4)
    assert not reader.fast
    state = to_state(space, np.array([0.1, 0.2, 0.3, 0.4]))
    assert reader.read(state).tolist() == [0.1, 0.2, 0.3, 0.4]


def test_a_serialisation_that_answers_nonsense_is_not_used(monkeypatch):
    monkeypatch.setattr(ompl_adapter, "to_array", lambda space, state: np.full(2, 9.0))
    assert not ompl_adapter.StateReader(state_space(disk_world.robot(2)), 2).fast


def test_threads_do_not_share_buffers():
    space = state_space(disk_world.robot(2))
    reader = ompl_adapter.StateReader(space, 2)
    mine = reader.read(to_state(space, np.array([0.1, 0.2])))
    theirs = []
    thread = threading.Thread(
        target=lambda: theirs.append(reader.read(to_state(space, np.array([0.3, 0.4]))))
    )
    thread.start()
    thread.join()
    assert mine.tolist() == [0.1, 0.2]
    assert theirs[0].tolist() == [0.3, 0.4]


def spaces_that_are_not_straight():
    compound = ob.CompoundStateSpace()
    compound.addSubspace(ob.RealVectorStateSpace(1), 1.0)
    compound.addSubspace(ob.SO3StateSpace(), 1.0)
    return [("SO3", compound), ("Dubins", ob.DubinsStateSpace()), ("Time", ob.TimeStateSpace())]


@pytest.mark.parametrize("which", range(3))
def test_spaces_without_straight_motions_are_refused_by_name(which):
    name, space = spaces_that_are_not_straight()[which]
    with pytest.raises(PlanningError, match=name):
        ompl_adapter.wrapping_coordinates(space)
