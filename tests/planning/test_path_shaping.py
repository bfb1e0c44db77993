# SPDX-License-Identifier: BSD-3-Clause
"""Shortening, resampling and splitting keep every edge as it was checked."""

import time
from itertools import pairwise

import disk_world
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from vprism_plan.planning import plan
from vprism_plan.planning.path import MotionCheck, drop_waypoints, resample, shorten

ZIGZAG = np.array([[-0.9, -0.9], [-0.9, 0.9], [-0.8, 0.9], [0.0, 0.9], [0.9, 0.9], [0.9, -0.9]])


def length(path):
    return np.linalg.norm(np.diff(path, axis=0), axis=1).sum()


def later():
    return time.perf_counter() + 60.0


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), dof=st.integers(2, 3))
def test_shortening_only_shortens_and_keeps_to_checked_edges(seed, dof):
    checker = disk_world.wall_with_gap(dof)
    path = np.zeros((6, dof))
    path[:, :2] = ZIGZAG
    accepted = {(a.tobytes(), b.tobytes()) for a, b in pairwise(path)}

    def check(a, b):
        verdict = checker.check_motion(a, b)
        if verdict:
            accepted.add((a.tobytes(), b.tobytes()))
        return verdict

    short = shorten(path, check, seed, later())
    assert np.array_equal(short[[0, -1]], path[[0, -1]])
    assert length(short) <= length(path) + 1e-9
    assert all((a.tobytes(), b.tobytes()) in accepted for a, b in pairwise(short))
    assert np.array_equal(short, shorten(path, check, seed, later()))


def test_shortening_gets_near_the_shortest_way_round_the_wall():
    checker = disk_world.wall_with_gap()
    short = shorten(ZIGZAG, MotionCheck(checker), 0, later())
    # No way round can be shorter than over the top of the highest ball, (0, 0.7).
    least = 2 * np.hypot(0.9, 1.6)
    assert least < length(short) < 1.15 * least < length(ZIGZAG)


def test_a_free_world_leaves_one_straight_edge():
    assert len(drop_waypoints(ZIGZAG, lambda a, b: True, later())) == 2
    assert np.array_equal(drop_waypoints(ZIGZAG, lambda a, b: False, later()), ZIGZAG)


def test_a_deadline_that_has_passed_leaves_the_path_as_it_is():
    calls = []
    path = shorten(ZIGZAG, lambda a, b: calls.append(1) or True, 0, time.perf_counter() - 1.0)
    assert np.array_equal(path, ZIGZAG)
    assert not calls


def test_repeated_waypoints_and_still_paths_survive():
    still = np.zeros((3, 2))
    assert np.array_equal(shorten(still, lambda a, b: True, 0, later()), still[:2])
    doubled = np.repeat(ZIGZAG, 2, axis=0)
    checker = disk_world.wall_with_gap()
    assert length(shorten(doubled, MotionCheck(checker), 1, later())) < length(ZIGZAG)


def test_an_edge_whose_pieces_are_refused_stays_whole():
    whole = {(0.0, 1.0), (1.0, 2.0)}

    def check(a, b):
        return (a[0], b[0]) in whole or a[0] >= 1.0

    path = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
    assert resample(path, check, 0.5)[:, 0].tolist() == [0.0, 1.0, 1.5, 2.0]


def test_shortcuts_never_turn_a_continuous_joint_the_ambiguous_way():
    check = MotionCheck(disk_world.DiskChecker([], [], disk_world.robot(2, (0,))))
    assert check(np.array([0.0, 0.0]), np.array([3.1, 0.0]))
    assert not check(np.array([0.0, 0.0]), np.array([3.2, 0.0]))
    assert check.count == 2


def test_planned_turns_are_unambiguous():
    checker = disk_world.DiskChecker([], [], disk_world.robot(2, (0,)))
    result = plan(checker, [0.0, 0.0], [3.1, 0.5])
    assert result.solved
    assert np.abs(np.diff(result.path[:, 0])).max() < np.pi
