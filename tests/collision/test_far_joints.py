# SPDX-License-Identifier: BSD-3-Clause
"""Joints turned very far: angles lose their digits there, and edges their bounds.

Found at 1e15 radians: an edge through a wall was certified free, since what is left of the
angle after whole turns was rounding noise; at 1e16 an edge was halved beyond its stack.
"""

import numpy as np
import pytest
from oracles.checker_oracle import BallWorld

from vprism_plan._kernels import checking as kernels
from vprism_plan.collision import CollisionChecker
from vprism_plan.collision.motion import edges_of
from vprism_plan.collision.packing import AT_MOST
from vprism_plan.errors import RobotError
from vprism_plan.robots import Robot

WALLS = BallWorld(
    np.array([[0.0, 0.6, 0.3], [0.0, -0.6, 0.3]]), np.array([0.15, 0.15]), np.zeros((0, 4))
)
BODY = (
    '<link name="{}"><collision><origin xyz="{} 0 0"/><geometry><sphere radius="0.03"/>'
    "</geometry></collision></link>"
)


def turning(tmp_path, kind="continuous", limit=""):
    """A hand 0.6 m from a vertical axis: two walls part angle 0 from angle pi."""
    parts = BODY.format("base", -0.5), BODY.format("hand", 0.6)
    turn = (
        f'<joint name="turn" type="{kind}"><parent link="base"/><child link="hand"/>'
        f'<origin xyz="0 0 0.3"/><axis xyz="0 0 1"/>{limit}</joint>'
    )
    path = tmp_path / "turning.urdf"
    path.write_text(f'<robot name="turning">{"".join(parts)}{turn}</robot>')
    return Robot.from_urdf(path)


@pytest.fixture(scope="module")
def checker(tmp_path_factory):
    return CollisionChecker(WALLS.baked(0.02), turning(tmp_path_factory.mktemp("urdf")))


@pytest.mark.parametrize("power", [0, 3, 5, 6, 9, 12, 15, 16, 17, 20, 30, 100, 300])
def test_no_edge_between_the_walls_is_accepted_however_far_it_starts(checker, power):
    rng = np.random.default_rng(power)
    for _ in range(40):
        a = rng.uniform(1.0, 9.0) * 10.0**power * rng.choice([-1.0, 1.0])
        b = rng.choice([0.0, np.pi]) + rng.uniform(-0.3, 0.3)
        apart = not checker.is_valid([a]) or np.cos(a) * np.cos(b) < 0
        assert not (apart and checker.check_motion([a], [b])), (a, b)
        assert not (apart and checker.check_motion([b], [a])), (a, b)
        if abs(a) > kernels.FARTHEST:
            assert not checker.is_valid([a])
            assert not checker.check_motion([a], [a])


def test_whole_turns_within_reach_change_no_verdict_but_have_to_be_made(checker):
    for turns in (1.0, -7.0, 1e4):
        far = 2.0 * np.pi * turns
        assert checker.check_motion([far + 0.2], [far - 0.2])
        assert not checker.check_motion([far], [far + np.pi])
        assert not checker.check_motion([far + 0.2], [-0.2])  # through both walls, every turn


def test_an_edge_that_outlasts_all_patience_is_refused_and_says_so(tmp_path):
    """A hundred thousand turns round a pillar, seven centimetres off it."""
    beside = BallWorld(np.array([[0.0, 0.0, 0.3]]), np.array([0.5]), np.zeros((0, 4)))
    checker = CollisionChecker(beside.baked(0.02), turning(tmp_path))
    assert checker.check_motion([0.0], [12.0])
    report = checker.check_motion_report([0.0], [6e5])
    assert not report.valid
    assert report.configurations <= kernels._MOST_CHECKS
    assert "not certified within" in report.text()
    with pytest.raises(RobotError, match="coarser tolerance or a shorter path"):
        checker.min_clearance([[0.0], [9e5]])


def test_a_joint_too_far_is_a_reason(checker):
    report = checker.explain([1e7])
    assert not report.valid
    assert [c.kind for c in report.contacts if c.link == "turn"] == ["joint_limit"]
    assert "count fewer turns" in report.text()


def test_paths_of_such_joints_are_refused(checker):
    for ask in (lambda path: edges_of(checker, path), checker.min_clearance):
        with pytest.raises(RobotError, match=r"waypoint 1 is \[1e\+16\]; .* at most 1e\+06"):
            ask([[0.0], [1e16]])


@pytest.mark.parametrize("limit", [1e5, 1e16, 1e30])
def test_limits_that_mean_none_are_refused_with_the_remedy(tmp_path, limit):
    text = f'<limit lower="-{limit:g}" upper="{limit:g}" effort="1" velocity="1"/>'
    with pytest.raises(RobotError, match=r"'turn' .*make it continuous, or state real limits"):
        turning(tmp_path, "revolute", text)


def test_an_edge_that_cannot_be_halved_any_more_is_refused(checker):
    """Past 2**52 steps the middle of an interval is one of its ends: it ran off its stack."""
    stats = np.empty(4)
    qa, qb = np.array([0.1]), np.array([0.3])
    tiny = 1e-40
    packed = checker._rf, checker._ri, *checker._world
    accepted = kernels.check_motion(qa, qb, *packed, tiny, stats)
    assert accepted == (stats[0] < 0.0)
    wide = np.array([0.9 * kernels.FARTHEST])
    kernels.check_motion(-wide, wide + 1.5, *packed, tiny, stats)
    assert stats[1] < 1e7


def test_a_motion_of_too_many_samples_is_refused_with_the_number(tmp_path):
    from oracles.small_scenes import small_config, small_scene

    from vprism_plan.mapping import fit_map
    from vprism_plan.world import World

    limit = '<limit lower="-9000" upper="9000" effort="1" velocity="1"/>'
    robot = turning(tmp_path, "revolute", limit)
    world = World(fit_map(small_scene().observation, small_config(), seed=0))
    path = np.tile([[-8000.0], [8000.0]], (8, 1))
    with pytest.raises(RobotError, match=rf"at most {AT_MOST:,}: ask for parts"):
        CollisionChecker(world, robot).collision_probability(path)
