# SPDX-License-Identifier: BSD-3-Clause
"""What another judge says of a verified path is reported, and changes nothing else."""

import json
import logging
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from types import SimpleNamespace

import disk_world
import numpy as np
import pytest
from oracles.world_oracles import KernelMap

from vprism_plan.collision import CheckerConfig, CollisionChecker, MeshChecker
from vprism_plan.errors import PlanningError
from vprism_plan.planning import plan
from vprism_plan.robots import Robot
from vprism_plan.world import World, WorldConfig

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


# --- with meshes ------------------------------------------------------------------------

CUBE = """<robot name="cube"><link name="world"/><link name="x"/><link name="cube"><collision>
  <geometry><box size="0.06 0.06 0.06"/></geometry></collision></link>
  <joint name="x" type="prismatic"><parent link="world"/><child link="x"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" velocity="1" effort="1"/></joint>
  <joint name="y" type="prismatic"><parent link="x"/><child link="cube"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>"""


@pytest.fixture(scope="module")
def around_a_blob(tmp_path_factory):
    """A function that makes a checker of a cube, in a sphere of a given radius, near a blob."""
    path = tmp_path_factory.mktemp("cube") / "cube.urdf"
    path.write_text(CUBE)
    blob = KernelMap(np.zeros((1, 3)), np.array([[-6.0, 6.0]]), np.array([3.0, 0.0]))
    world = World(blob, WorldConfig(bounds=((-0.3,) * 3, (0.3,) * 3)))

    def make(radius):
        spheres = {"cube": [{"center": [0.0, 0.0, 0.0], "radius": radius}]}
        robot = Robot.from_urdf(path, spheres=spheres)
        return CollisionChecker(world, robot, CheckerConfig(max_risk=None))

    return make


@pytest.mark.parametrize("y", [0.0, 0.05])
def test_meshes_agree_with_paths_of_enclosing_spheres(around_a_blob, y):
    checker = around_a_blob(0.053)
    judge = MeshChecker.like(checker)
    result = plan(checker, [-0.2, y], [0.2, y], second_opinion=judge)
    assert result.solved, result.message
    opinion = result.report.second_opinion
    assert opinion.valid
    assert opinion.configurations > 50
    assert "disagrees" not in result.message


def test_meshes_name_the_link_that_sticks_out_of_its_spheres(around_a_blob):
    """The checker only knows a small ball; its cube scrapes the object on the way."""
    checker = around_a_blob(0.01)
    start, goal = [-0.2, 0.05], [0.2, 0.05]
    result = plan(checker, start, goal, second_opinion=MeshChecker.like(checker), margins=None)
    assert result.solved
    assert result.path is not None
    (found,) = result.report.second_opinion.findings
    assert found.edge == 0
    assert found.contacts[0].link == "cube"
    assert found.contacts[0].body == "object:1"
    assert {cause.kind for cause in found.causes} == {"solids outside spheres"}
    for word in ("MeshChecker disagrees", "edge 0", "cube", "object:1", "solids outside spheres"):
        assert word in result.message
    json.dumps(asdict(result.report))  # as the command line writes it
    json.dumps(result.report.second_opinion.to_dict())


@pytest.mark.parametrize("margin", [0.0, 0.02])
def test_meshes_plan_by_themselves(around_a_blob, margin):
    """`plan` takes a `MeshChecker` in the place of a `CollisionChecker`."""
    spheres = around_a_blob(0.053)
    rule = CheckerConfig(margin=margin)
    meshes = MeshChecker(spheres.world, spheres.robot, rule, step=0.01)
    start, goal = [-0.2, 0.01], [0.2, 0.01]
    result = plan(meshes, start, goal, time_limit=20.0)
    assert result.solved, result.message
    np.testing.assert_allclose(result.path[[0, -1]], [start, goal])
    assert len(result.path) > 2
    for qa, qb in pairwise(result.path):
        for share in np.linspace(0.0, 1.0, 30):
            assert meshes.clearance(qa + share * (qb - qa)) >= margin - 0.005
    blocked = plan(meshes, start, [0.0, 0.0])
    assert blocked.status == "invalid_goal"
    assert "object:1" in blocked.message
