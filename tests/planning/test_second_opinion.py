# SPDX-License-Identifier: BSD-3-Clause
"""What another judge says of a verified path is reported, and changes nothing else."""

import logging
from dataclasses import dataclass, field
from types import SimpleNamespace

import disk_world
import numpy as np
import pytest

from vprism_plan.errors import PlanningError
from vprism_plan.planning import plan

START, GOAL = [-0.7, -0.5], [0.7, -0.5]


@dataclass
class Judge:
    """Says what it was told to say."""

    robot: object
    valid: bool = True
    asked: list = field(default_factory=list)

    def review(self, checker, path):
        self.asked.append((checker, path.copy()))
        return SimpleNamespace(valid=self.valid, text=lambda: "Judge disagrees:\nedge 0 at 0.500")


def test_nobody_asked_nothing_said():
    result = plan(disk_world.wall_with_gap(), START, GOAL)
    assert result.solved
    assert result.report.second_opinion is None
    assert result.report.second_opinion_time == 0.0


@pytest.mark.parametrize("goal", [GOAL, [-0.6, -0.4]])
def test_agreement_changes_nothing_but_the_report(goal):
    checker = disk_world.wall_with_gap()
    judge = Judge(checker.robot)
    alone, judged = plan(checker, START, goal), plan(checker, START, goal, second_opinion=judge)
    np.testing.assert_array_equal(alone.path, judged.path)
    assert judged.message == alone.message
    assert judged.report.second_opinion.valid
    (asked,) = judge.asked
    assert asked[0] is checker
    np.testing.assert_array_equal(asked[1], judged.path)


def test_disagreement_is_loud_and_the_path_is_kept(caplog):
    checker = disk_world.wall_with_gap()
    alone = plan(checker, START, GOAL)
    with caplog.at_level(logging.WARNING):
        result = plan(checker, START, GOAL, second_opinion=Judge(checker.robot, valid=False))
    assert result.solved
    np.testing.assert_array_equal(alone.path, result.path)
    assert not result.report.second_opinion.valid
    assert "Judge disagrees: edge 0 at 0.500" in result.message
    assert "Judge disagrees" in caplog.text


def test_without_a_path_nobody_is_asked():
    checker = disk_world.wall_with_gap()
    judge = Judge(checker.robot)
    blocked = checker.centers[0]
    result = plan(checker, START, blocked, second_opinion=judge)
    assert result.status == "invalid_goal"
    assert not judge.asked


def test_a_judge_of_another_robot_is_refused():
    checker = disk_world.wall_with_gap()
    other = SimpleNamespace(joint_names=("left", "right"))
    with pytest.raises(PlanningError, match=r"left.*joint_0"):
        plan(checker, START, GOAL, second_opinion=Judge(other))


def test_what_is_no_judge_is_refused():
    checker = disk_world.wall_with_gap()
    with pytest.raises(Exception, match="second_opinion"):
        plan(checker, START, GOAL, second_opinion=42)
