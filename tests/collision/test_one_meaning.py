# SPDX-License-Identifier: BSD-3-Clause
"""An edge is what its two rows say: every function of a path means the same motion by it.

Found: a continuous joint that differed by more than half a turn was checked the short way
round and timed the long way, through a ball that only the long way meets.
"""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from oracles.small_scenes import at, small_map

import vprism_plan as vp
from vprism_plan.collision.margins import margin_profile
from vprism_plan.planning import VPrismMotionValidator, state_space
from vprism_plan.planning.objectives import RiskObjective
from vprism_plan.planning.ompl_adapter import last_valid, to_state
from vprism_plan.planning.path import verified
from vprism_plan.planning.result import PlanReport
from vprism_plan.planning.trajectory import time_parameterize
from vprism_plan.trajopt import ClearanceCost, RiskCost

A, B = np.array([0.9]), np.array([2.0 * np.pi - 0.9])  # the long way round, past angle pi
OBJECTS = (0.01, 0.02)  # about where they stand
SWING = """<robot name="swing"><link name="base"/><link name="hand"><collision>
  <origin xyz="0.3 0 0.05"/><geometry><sphere radius="0.02"/></geometry></collision></link>
  <joint name="turn" type="continuous"><parent link="base"/><child link="hand"/>
  <axis xyz="0 0 1"/><limit effort="1" velocity="1"/></joint></robot>"""


def edge(qa, qb):
    return np.stack([np.asarray(qa, float), np.asarray(qb, float)])


def timed(it, path):
    trajectory = time_parameterize(it.robot, path, velocity_limits=[1.0])
    samples, _ = trajectory.sample(np.linspace(0.0, trajectory.duration, 400))
    return it.checker.is_valid_batch(samples).all()


def step(path):
    return path[1] - path[0]


def smallest(profile):
    return min(float(values.min()) for values in profile.values())


def costs_little(kind, most, **options):
    return lambda it, path: float(kind(it.checker, **options)(torch.from_numpy(path))) < most


# Each says whether a path (2, 1) is free.
JUDGES = {
    "check_motion": lambda it, path: it.checker.check_motion(*path),
    "backwards": lambda it, path: it.checker.check_motion(*path[::-1]),
    "check_motion_report": lambda it, path: it.checker.check_motion_report(*path).valid,
    "min_clearance": lambda it, path: it.checker.min_clearance(path).clearance > 0.0,
    "safety_margin": lambda it, path: it.checker.safety_margin(path).clearance > 0.0,
    "profile": lambda it, path: smallest(margin_profile(it.checker, path)[1]) > 0.0,
    "max_safe_motion": lambda it, path: it.checker.max_safe_motion(path[0], step(path)).whole,
    "probability": lambda it, path: it.checker.collision_probability(path).upper < 0.1,
    "bounded": lambda it, path: it.bounded.check_motion(*path),
    "bounded report": lambda it, path: it.bounded.check_motion_report(*path).valid,
    "entropy": lambda it, path: it.checker.path_entropy(path).swept_total < 1e-7,
    "last_valid": lambda it, path: last_valid(it.checker, *path)[1] == 1.0,
    "verified": lambda it, path: verified(it.checker, path, 0.05, it.report).solved,
    "timed": timed,
    "objective": lambda it, path: it.joint.path(path) < 0.1,
    "worst state": lambda it, path: it.worst.path(path) < 0.1,
    "clearance cost": costs_little(ClearanceCost, 1e-4),
    "its torch twin": costs_little(ClearanceCost, 1e-4, backend="torch"),
    "risk cost": costs_little(RiskCost, 0.5),
    "mesh check_motion": lambda it, path: it.meshes.check_motion(*path),
    "mesh check_path": lambda it, path: it.meshes.check_path(path).valid,
    "mesh review": lambda it, path: it.meshes.review(it.checker, path).valid,
}


@pytest.fixture(scope="module")
def world():
    return vp.World(small_map(), vp.WorldConfig(occluded="free"))


@pytest.fixture(scope="module")
def places(world, tmp_path_factory):
    """The robot beside objects that lie at angle pi, and at angle 0."""
    path = tmp_path_factory.mktemp("swing") / "swing.urdf"
    path.write_text(SWING)
    made = {}
    for angle, side in ((np.pi, 1.0), (0.0, -1.0)):
        x, y = OBJECTS
        robot = vp.Robot.from_urdf(path, base_pose=at(x + side * 0.3, y, 0.0))
        config = vp.CheckerConfig(n_worlds=64)
        checker = vp.CollisionChecker(world, robot, config)
        joint = RiskObjective(kind="joint", length_weight=0.0)
        made[angle] = SimpleNamespace(
            robot=robot,
            checker=checker,
            bounded=vp.CollisionChecker(world, robot, replace(config, max_risk=0.3)),
            meshes=vp.MeshChecker.like(checker, resolution=0.01),
            joint=joint.cost(checker),
            worst=RiskObjective(kind="survival", worst=True).cost(checker),
            report=PlanReport(planner="none", seed=0, time_limit=1.0),
        )
    return made


@pytest.mark.parametrize("judge", JUDGES)
def test_every_function_of_a_path_means_the_motion_that_its_rows_say(places, judge):
    says = JUDGES[judge]
    long, short = edge(A, B), edge(A, B - 2.0 * np.pi)
    behind, ahead = places[np.pi], places[0.0]
    assert not says(behind, long)
    assert says(behind, short)
    assert says(ahead, long)
    assert not says(ahead, short)
    # More than a turn meets both.
    assert not says(behind, edge(A, B + 2.0 * np.pi))
    assert not says(ahead, edge(A, B + 2.0 * np.pi))


def test_volume_in_unseen_space_is_that_of_the_motion(places):
    """The way towards the camera leaves its view, at the bottom."""
    unseen = [
        places[0.0].checker.collision_probability(path).volume()["unobserved"]
        for path in (edge(A, B), edge(A, B - 2.0 * np.pi))
    ]
    assert unseen[0] > 0.1 > unseen[1]


@pytest.mark.parametrize("angle", [np.pi, 0.0])
def test_planners_go_round_the_circle_and_say_in_their_rows_which_way(places, angle):
    """OMPL interpolates the short way: what is checked there is written out as it goes."""
    place = places[angle]
    space = state_space(place.robot)
    validator = VPrismMotionValidator(_information(space), place.checker)
    ends = to_state(space, A), to_state(space, B)
    assert validator.checkMotion(*ends) == (angle == np.pi)
    result = vp.plan(place.checker, A, B, seed=1, time_limit=20.0)
    assert result.solved
    steps = np.diff(result.path[:, 0])
    assert np.abs(steps).max() < np.pi
    assert result.path[-1] == pytest.approx(B - 2.0 * np.pi if angle == np.pi else B)
    assert all(place.meshes.check_motion(*rows) for rows in pairwise(result.path))
    assert timed(place, result.path)
    assert place.checker.collision_probability(result.path).upper < 0.1


def _information(space):
    from ompl import base as ob

    return ob.SpaceInformation(space)
