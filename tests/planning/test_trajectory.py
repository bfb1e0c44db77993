# SPDX-License-Identifier: BSD-3-Clause
"""Timing keeps the limits and never leaves the path; files come back as they were."""

import json
import sys
from itertools import pairwise
from types import SimpleNamespace

import disk_world
import numpy as np
import pytest
import yaml
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from oracles.small_scenes import at

import vprism_plan as vp
from vprism_plan.errors import MissingDependencyError, PlanningError
from vprism_plan.planning import (
    Trajectory,
    read_trajectory,
    time_parameterize,
    write_trajectory,
)
from vprism_plan.world import Box, HalfSpace, Sphere

ROBOT = disk_world.robot(2)


def distance_to_polyline(q, path):
    best = np.inf
    for a, b in pairwise(path):
        d = b - a
        t = np.clip((q - a) @ d / max(d @ d, 1e-300), 0.0, 1.0)
        best = min(best, np.linalg.norm(q - a - t * d))
    return best


coordinates = st.lists(
    st.lists(st.floats(-3.0, 3.0).map(lambda x: round(x, 3)), min_size=2, max_size=2),
    min_size=2,
    max_size=6,
)


@settings(max_examples=80, deadline=None)
@given(points=coordinates, scale=st.floats(0.05, 1.0))
def test_limits_hold_and_the_path_is_not_left(points, scale):
    path = np.array(points)
    assume(np.any(np.diff(path, axis=0) != 0.0))
    velocity, acceleration = np.array([1.0, 2.0]), np.array([0.7, 5.0])
    trajectory = time_parameterize(ROBOT, path, velocity, acceleration, scale=scale)
    fine = np.linspace(0.0, trajectory.duration, 3001)
    q, v = trajectory.sample(fine)
    assert np.all(np.abs(v) <= scale * velocity * (1 + 1e-9) + 1e-12)
    rate = np.abs(np.diff(v, axis=0)) / np.diff(fine)[:, None]
    assert np.all(rate <= scale * acceleration * (1 + 1e-6) + 1e-9)
    assert np.array_equal(q[0], path[0])
    assert np.array_equal(trajectory.positions[-1], path[-1])
    assert np.all(trajectory.velocities[[0, -1]] == 0.0)
    assert max(distance_to_polyline(p, path) for p in q[::30]) < 1e-8
    # The positions are the integral of the velocities: nothing jumps.
    walked = q[0] + np.cumsum((v[1:] + v[:-1]) / 2 * np.diff(fine)[:, None], axis=0)
    assert np.abs(walked - q[1:]).max() < 1e-3
    for waypoint in path:
        assert np.min(np.linalg.norm(trajectory.positions - waypoint, axis=1)) < 1e-9


def test_a_long_line_cruises_at_the_limit_and_takes_the_time_it_must():
    trajectory = time_parameterize(
        ROBOT, np.array([[0.0, 0.0], [3.0, 0.0]]), [1.0, 1.0], [2.0, 2.0]
    )
    assert trajectory.duration == pytest.approx(3.0 / 1.0 + 1.0 / 2.0)
    assert trajectory.sample(np.array([1.0]))[1][0].tolist() == pytest.approx([1.0, 0.0])


def test_a_short_line_never_reaches_full_speed():
    trajectory = time_parameterize(
        ROBOT, np.array([[0.0, 0.0], [0.1, 0.0]]), [1.0, 1.0], [2.0, 2.0]
    )
    assert trajectory.duration == pytest.approx(2 * np.sqrt(0.1 / 2.0))
    assert np.max(trajectory.velocities) == pytest.approx(2.0 * np.sqrt(0.1 / 2.0))


def test_waypoints_on_a_line_do_not_slow_the_motion_and_corners_do():
    line = np.array([[0.0, 0.0], [1.0, 1.0], [1.5, 1.5], [3.0, 3.0]])
    whole = time_parameterize(ROBOT, line[[0, -1]])
    assert time_parameterize(ROBOT, line).duration == pytest.approx(whole.duration)
    corner = time_parameterize(ROBOT, np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]))
    at = np.argmin(np.linalg.norm(corner.positions - [1.0, 0.0], axis=1))
    assert np.all(corner.velocities[at] == 0.0)
    back = time_parameterize(ROBOT, np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]]))
    assert np.all(back.velocities[np.argmax(back.positions[:, 0])] == 0.0)


@pytest.mark.parametrize("path", [[[0.1, 0.2]], [[0.1, 0.2]] * 3])
def test_a_path_that_goes_nowhere_takes_no_time(path):
    trajectory = time_parameterize(ROBOT, np.array(path))
    assert trajectory.duration == 0.0
    assert trajectory.positions.tolist() == [[0.1, 0.2]]
    assert trajectory.sample(np.array([0.0, 1.0]))[0].tolist() == [[0.1, 0.2]] * 2


def test_defaults_come_from_the_robot():
    trajectory = time_parameterize(ROBOT, np.array([[0.0, 0.0], [9.0, 0.0]]))
    assert np.max(np.abs(trajectory.velocities)) == pytest.approx(ROBOT.velocity_limits[0])
    assert trajectory.times[1] == pytest.approx(0.5)


@pytest.mark.parametrize(("arguments", "message"), [
    ({"velocity_limits": [1.0, np.inf]}, "velocity limit of joint 'joint_1' is inf"),
    ({"velocity_limits": [0.0, 1.0]}, "velocity limit of joint 'joint_0' is 0"),
    ({"acceleration_limits": [1.0, np.nan]}, "acceleration limit of joint 'joint_1' is nan"),
    ({"velocity_limits": [1.0]}, "shape"),
    ({"scale": 0.0}, "scale is 0"),
    ({"scale": 1.5}, "scale is 1.5"),
])  # fmt: skip
def test_unusable_limits_are_named(arguments, message):
    with pytest.raises(PlanningError, match=message):
        time_parameterize(ROBOT, np.array([[0.0, 0.0], [1.0, 1.0]]), **arguments)


@pytest.mark.parametrize("path", [np.zeros((2, 3)), np.zeros((0, 2)), np.array([[0.0, np.nan]])])
def test_unusable_paths_are_refused(path):
    with pytest.raises(PlanningError, match="path"):
        time_parameterize(ROBOT, path)


def test_a_file_holds_the_ros_message_and_comes_back(tmp_path):
    path = np.array([[0.0, 0.0], [1.0, -0.5], [0.3, 0.3]])
    trajectory = time_parameterize(ROBOT, path)
    file = tmp_path / "trajectory.json"
    write_trajectory(file, ROBOT, trajectory, frame_id="base_link")
    message = json.loads(file.read_text())
    assert set(message) == {"header", "joint_names", "points"}
    assert message["header"] == {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": "base_link"}
    assert message["joint_names"] == ["joint_0", "joint_1"]
    for point in message["points"]:
        assert set(point) == {
            "positions", "velocities", "accelerations", "effort", "time_from_start",
        }  # fmt: skip
        assert isinstance(point["time_from_start"]["sec"], int)
        assert 0 <= point["time_from_start"]["nanosec"] < 10**9
    names, back = read_trajectory(file)
    assert names == ("joint_0", "joint_1")
    assert np.array_equal(back.positions, trajectory.positions)
    assert np.array_equal(back.velocities, trajectory.velocities)
    np.testing.assert_allclose(back.times, trajectory.times, atol=1e-9)


def test_a_nanosecond_carries_into_the_second(tmp_path):
    almost = Trajectory(np.array([0.0, 1.9999999999]), np.zeros((2, 2)), np.zeros((2, 2)))
    write_trajectory(tmp_path / "t.json", ROBOT, almost)
    points = json.loads((tmp_path / "t.json").read_text())["points"]
    assert points[1]["time_from_start"] == {"sec": 2, "nanosec": 0}


def test_a_trajectory_that_cannot_be_written_leaves_the_old_file(tmp_path):
    file = tmp_path / "t.json"
    file.write_text("old")
    broken = Trajectory(np.array([0.0]), np.full((1, 2), np.nan), np.zeros((1, 2)))
    with pytest.raises(ValueError, match="JSON"):
        write_trajectory(file, ROBOT, broken)
    with pytest.raises(PlanningError, match="nanosecond"):
        write_trajectory(file, ROBOT, Trajectory(np.zeros(2), np.zeros((2, 2)), np.zeros((2, 2))))
    with pytest.raises(PlanningError, match="joints"):
        write_trajectory(file, disk_world.robot(3), broken)
    assert file.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["t.json"]


@pytest.mark.parametrize("text", ["", "[]", '{"joint_names": []}', '{"joint_names": 3}'])
def test_a_file_that_is_no_trajectory_is_named(tmp_path, text):
    file = tmp_path / "bad.json"
    file.write_text(text)
    with pytest.raises(PlanningError, match=r"bad\.json"):
        read_trajectory(file)
    with pytest.raises(PlanningError, match=r"missing\.json"):
        read_trajectory(tmp_path / "missing.json")


def test_files_for_ros_hold_the_same_message(tmp_path):
    trajectory = time_parameterize(ROBOT, np.array([[0.0, 0.0], [0.7, 0.2], [0.1, 1.0]]))
    pytest.importorskip("rosbags")
    for suffix in (".json", ".yaml", ".cdr"):
        write_trajectory(tmp_path / f"t{suffix}", ROBOT, trajectory, frame_id="base_link")
    message = json.loads((tmp_path / "t.json").read_text())
    assert yaml.safe_load((tmp_path / "t.yaml").read_text()) == message
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    name = "trajectory_msgs/msg/JointTrajectory"
    read = store.deserialize_cdr((tmp_path / "t.cdr").read_bytes(), name)
    assert read.header.frame_id == "base_link"
    assert list(read.joint_names) == message["joint_names"]
    assert len(read.points) == len(message["points"])
    for point, expected in zip(read.points, message["points"], strict=True):
        time = expected["time_from_start"]
        assert (point.time_from_start.sec, point.time_from_start.nanosec) == tuple(time.values())
        for field in ("positions", "velocities", "accelerations", "effort"):
            assert getattr(point, field).tolist() == expected[field]
    # The bytes are what a bag of that message holds.
    assert bytes(store.serialize_cdr(read, name)) == (tmp_path / "t.cdr").read_bytes()


def test_without_rosbags_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    trajectory = time_parameterize(ROBOT, np.zeros((1, 2)))
    with pytest.raises(MissingDependencyError, match=r"vprism_plan\[export\]"):
        write_trajectory(tmp_path / "t.cdr", ROBOT, trajectory)
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def among_balls(ball_robot):
    """A checker of a ball of 5 cm among balls and a floor, and the distance to these."""
    rng = np.random.default_rng(0)
    balls = [Sphere(f"b{i}", rng.uniform(0.05, 0.15), rng.uniform(-0.6, 0.6, 3)) for i in range(12)]
    robot = ball_robot(0.05)
    world = vp.World(known=[*balls, HalfSpace("floor", (0.0, 0.0, 1.0), -0.7)])

    def gap(points):
        solids = [ball.signed_distance(points) for ball in balls]
        return np.minimum(np.min(solids, axis=0), points[:, 2] + 0.7) - 0.05

    return vp.CollisionChecker(world, robot), gap


def free_path(checker, rng, corners):
    """Random corners joined by free edges."""
    path = []
    while len(path) < corners:
        q = rng.uniform(-0.7, 0.7, 3)
        if checker.is_valid(q) and (not path or checker.check_motion(path[-1], q)):
            path.append(q)
    return np.array(path)


@pytest.mark.parametrize("seed", range(12))
def test_rounded_corners_touch_nothing_and_keep_the_limits(among_balls, seed):
    checker, gap = among_balls
    rng = np.random.default_rng(seed)
    path = free_path(checker, rng, 7)
    limits = {"velocity_limits": [1.0, 2.0, 0.5], "acceleration_limits": rng.uniform(0.5, 8.0, 3)}
    stops = time_parameterize(checker.robot, path, **limits)
    motion = time_parameterize(checker.robot, path, **limits, checker=checker)
    assert motion.duration <= stops.duration * (1 + 1e-9)
    fine = np.linspace(0.0, motion.duration, 20_001)
    q, v = motion.sample(fine)
    assert gap(q).min() > 0.0
    assert np.all(np.abs(v) <= np.array(limits["velocity_limits"]) * (1 + 1e-9))
    rate = np.abs(np.diff(v, axis=0)) / np.diff(fine)[:, None]
    assert np.all(rate <= limits["acceleration_limits"] * (1 + 1e-5) + 1e-9)
    walked = q[0] + np.cumsum((v[1:] + v[:-1]) / 2 * np.diff(fine)[:, None], axis=0)
    assert np.abs(walked - q[1:]).max() < 1e-5
    assert np.array_equal(q[0], path[0])
    np.testing.assert_allclose(q[-1], path[-1], atol=1e-12)
    assert np.all(motion.velocities[[0, -1]] == 0.0)


def test_with_room_corners_cost_little_and_without_room_they_are_stops(ball_robot):
    robot = ball_robot(0.05)
    path = np.array([[0.0, 0, 0], [0.5, 0, 0], [1.0, 0.1, 0], [1.5, 0, 0.1], [2.0, 0, 0]])
    open_space = vp.CollisionChecker(vp.World(known=[]), robot)
    stops = time_parameterize(robot, path)
    rounded = time_parameterize(robot, path, checker=open_space)
    straight = time_parameterize(robot, path[[0, -1]])
    assert rounded.duration < 1.2 * straight.duration < 0.9 * stops.duration
    # A box 2 cm beside the ball, on the inner side of a corner.
    corner = np.array([[0.0, 0, 0], [0.5, 0, 0], [0.5, 0.5, 0]])
    inside = Box("inside", (0.35, 0.35, 0.2), at(0.255, 0.245, 0.0))
    room = vp.WorldConfig(0.004, bounds=((0.0, 0.0, -0.1), (0.5, 0.5, 0.1)))
    touching = vp.CollisionChecker(vp.World(config=room, known=[inside]), robot)
    assert touching.check_motion(corner[0], corner[1])
    assert touching.check_motion(corner[1], corner[2])
    assert not touching.check_blend([0.25, 0.0, 0.0], corner[1], [0.5, 0.25, 0.0])
    motion = time_parameterize(robot, corner, checker=touching)
    free = time_parameterize(robot, corner, checker=open_space)
    assert free.duration < motion.duration <= time_parameterize(robot, corner).duration
    q, _ = motion.sample(np.linspace(0.0, motion.duration, 5000))
    assert (inside.signed_distance(q) > 0.05).all()


class Picky:
    """Refuses every rounded corner, or the risk of every motion."""

    def __init__(self, checker, **answers):
        self._checker, self._answers = checker, answers

    def __getattr__(self, name):
        answer = self._answers.get(name)
        return getattr(self._checker, name) if answer is None else lambda *_, **__: answer


def test_who_cannot_judge_a_rounded_corner_is_named(among_balls):
    checker, _ = among_balls
    meshes = vp.MeshChecker(checker.world, checker.robot)
    with pytest.raises(PlanningError, match="checker is a MeshChecker"):
        time_parameterize(checker.robot, np.zeros((2, 3)), checker=meshes)


def test_what_is_refused_is_not_rounded(ball_robot):
    checker = vp.CollisionChecker(vp.World(known=[]), ball_robot(0.05))
    path = np.array([[0.0, 0, 0], [0.5, 0, 0], [0.5, 0.5, 0], [0.0, 0.5, 0.2]])
    stops = time_parameterize(checker.robot, path)
    never = time_parameterize(checker.robot, path, checker=Picky(checker, check_blend=False))
    np.testing.assert_allclose(never.duration, stops.duration)
    assert {tuple(q) for q in path} <= {tuple(q) for q in never.positions}
    risk = SimpleNamespace(upper=0.2)
    risky = time_parameterize(
        checker.robot, path, checker=Picky(checker, collision_probability=risk)
    )
    assert np.array_equal(risky.positions, stops.positions)


def test_a_rounded_motion_is_judged_by_worlds_that_no_corner_has_seen(ball_robot):
    checker, asked = vp.CollisionChecker(vp.World(known=[]), ball_robot(0.05)), []
    judge = checker.collision_probability

    def judged(path, held_out=False):
        asked.append(held_out)
        return judge(path, held_out)

    checker.collision_probability = judged
    path = np.array([[0.0, 0, 0], [0.5, 0, 0], [0.5, 0.5, 0]])
    time_parameterize(checker.robot, path, checker=checker)
    assert asked == [True]


def test_corners_are_rounded_in_a_world_without_a_posterior(ball_robot):
    """It has no probabilities to bound: asking for one raised ConfigError."""
    baked = vp.World(known=[Sphere("ball", 0.05, (0.0, 0.4, 0.0))])
    world = SimpleNamespace(
        field=baked.field, planes=baked.planes, plane_names=baked.plane_names,
        sources=baked.sources, config=baked.config, map=baked.map, status=baked.status,
    )  # fmt: skip
    checker = vp.CollisionChecker(world, ball_robot(0.02))
    assert checker.max_risk is None
    assert checker.config.max_risk is not None
    path = np.array([[0.0, 0, 0], [0.3, 0, 0], [0.3, -0.3, 0]])
    rounded = time_parameterize(checker.robot, path, checker=checker)
    assert rounded.duration < time_parameterize(checker.robot, path).duration


def test_an_arm_keeps_its_links_apart_in_rounded_corners(repository):
    robot = vp.Robot.from_urdf(repository / "urdf" / "panda.urdf")
    floor = HalfSpace("floor", (0.0, 0.0, 1.0), -0.05)
    pole = Box("pole", (0.1, 0.1, 1.0), at(0.45, 0.2, 0.45))
    checker = vp.CollisionChecker(
        vp.World(known=[floor, pole]), robot, vp.CheckerConfig(self_margin=0.005)
    )
    rng, shorter = np.random.default_rng(3), 0
    for _ in range(4):
        path: list[np.ndarray] = []
        while len(path) < 5:
            q = rng.uniform(robot.lower, robot.upper)
            if checker.is_valid(q) and (not path or checker.check_motion(path[-1], q)):
                path.append(q)
        motion = time_parameterize(robot, np.array(path), checker=checker)
        q, _ = motion.sample(np.linspace(0.0, motion.duration, 5000))
        assert checker.is_valid_batch(q).all()
        shorter += motion.duration < 0.95 * time_parameterize(robot, np.array(path)).duration
    assert shorter >= 2
