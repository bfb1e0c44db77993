# SPDX-License-Identifier: BSD-3-Clause
"""What the shipped URDFs and SRDFs say, against published numbers and against solids."""

import itertools

import fcl
import numpy as np
import pytest

from vprism_plan.robots import Robot
from vprism_plan.robots.pairs import pairs_touching, random_configurations


class SolidOracle:
    """Contact between the solids of two links, by FCL on exact primitives."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        make = {"box": fcl.Box, "cylinder": fcl.Cylinder, "sphere": fcl.Sphere}
        self.objects = {
            link: [(fcl.CollisionObject(make[s.kind](*s.size)), s.T_link) for s in solids]
            for link, solids in robot.geometry.items()
        }

    def touching(self, q: np.ndarray, a: str, b: str) -> bool:
        poses = self.robot.link_poses(q)
        for link in (a, b):
            for shape, T_link in self.objects[link]:
                T = poses[link] @ T_link
                shape.setTransform(fcl.Transform(T[:3, :3], T[:3, 3]))
        return any(
            fcl.collide(x, y, fcl.CollisionRequest(), fcl.CollisionResult())
            for (x, _), (y, _) in itertools.product(self.objects[a], self.objects[b])
        )


def named_pairs(robot: Robot, mask: np.ndarray) -> list[tuple[str, str]]:
    return [(robot.link_names[a], robot.link_names[b]) for a, b in robot.collision_pairs[mask]]


def all_pairs(robot: Robot) -> np.ndarray:
    return np.array(list(itertools.combinations(range(len(robot.link_names)), 2)))


def touching_now(robot: Robot, q: np.ndarray) -> list[tuple[str, str]]:
    return named_pairs(robot, pairs_touching(robot.arrays, q[None], robot.collision_pairs)[0])


def test_panda_limits_are_the_published_ones(robots):
    panda = robots["panda"]
    assert panda.joint_names == tuple(f"panda_joint{i}" for i in range(1, 8))
    np.testing.assert_array_equal(
        panda.lower, [-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973]
    )
    np.testing.assert_array_equal(
        panda.upper, [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973]
    )
    np.testing.assert_array_equal(panda.velocity_limits, [2.175] * 4 + [2.61] * 3)
    assert panda.locked == {"panda_finger_joint1": 0.04}
    assert not panda.continuous.any()


def test_ur5e_limits_are_the_published_ones(robots):
    ur5e = robots["ur5e"]
    turn = 2 * np.pi
    np.testing.assert_allclose(ur5e.upper, [turn, turn, np.pi, turn, turn, turn])
    np.testing.assert_allclose(ur5e.lower, -ur5e.upper)
    np.testing.assert_allclose(ur5e.velocity_limits, np.pi)


def test_planar_arm_has_one_continuous_joint(robots):
    planar = robots["planar3"]
    np.testing.assert_array_equal(planar.continuous, [True, False, False])
    np.testing.assert_allclose([planar.lower[0], planar.upper[0]], [-np.pi, np.pi])
    assert planar.velocity_limits[0] == 2.0


def test_fingers_are_open_unless_told_otherwise(urdf_folder):
    path = urdf_folder / "panda.urdf"

    def finger_distance(robot: Robot) -> float:
        poses = robot.link_poses(robot.neutral)
        between = poses["panda_leftfinger"][:3, 3] - poses["panda_rightfinger"][:3, 3]
        return float(np.linalg.norm(between))

    assert finger_distance(Robot.from_urdf(path)) == pytest.approx(0.08)
    closed = Robot.from_urdf(path, locked={"panda_finger_joint1": 0.0})
    assert finger_distance(closed) == pytest.approx(0.0)
    whole = Robot.from_urdf(path, joints=[*closed.joint_names, "panda_finger_joint1"])
    assert whole.dof == 8
    # the mimicking finger follows in every implementation of the kinematics
    q = np.append(closed.neutral, 0.015)
    poses = whole.link_poses(q)
    between = poses["panda_leftfinger"][:3, 3] - poses["panda_rightfinger"][:3, 3]
    assert np.linalg.norm(between) == pytest.approx(0.03)


@pytest.mark.parametrize("name", ["panda", "ur5e", "planar3"])
def test_named_states_are_free_for_spheres_and_solids(robots, name):
    robot = robots[name]
    oracle = SolidOracle(robot)
    assert "ready" in robot.named_states
    for q in robot.named_states.values():
        assert (q >= robot.lower).all()
        assert (q <= robot.upper).all()
        assert touching_now(robot, q) == []
        for a, b in named_pairs(robot, np.ones(len(robot.collision_pairs), dtype=bool)):
            assert not oracle.touching(q, a, b)
    np.testing.assert_array_equal(robot.neutral, robot.named_states["ready"])


def test_panda_folded_into_itself_is_seen(robots):
    panda = robots["panda"]
    oracle = SolidOracle(panda)
    folds = {
        "hand into forearm": [0, -0.5, 0, -2.0, 0, 0.0, 0.8],
        "hand into base": [0, 1.2, 0, -3.0, 0, 1.2, 0.8],
    }
    for name, values in folds.items():
        q = np.array(values, dtype=float)
        every = named_pairs(panda, np.ones(len(panda.collision_pairs), dtype=bool))
        assert any(oracle.touching(q, a, b) for a, b in every), name
        assert touching_now(panda, q) != [], name


def test_panda_stretched_out_is_free(robots):
    panda = robots["panda"]
    q = np.array([0.0, 0.0, 0.0, -0.07, 0.0, 1.5, 0.0])
    assert touching_now(panda, q) == []


@pytest.mark.parametrize("name", ["panda", "ur5e", "planar3"])
def test_solids_never_touch_where_spheres_do_not(robots, name):
    """The spheres hold the solids, so no contact of tested links may be missed."""
    robot = robots[name]
    oracle = SolidOracle(robot)
    Q = random_configurations(robot.arrays, 60, np.random.default_rng(0))
    touching = pairs_touching(robot.arrays, Q, robot.collision_pairs)
    solid_contacts = 0
    for q, row in zip(Q, touching, strict=True):
        for (a, b), spheres_touch in zip(robot.collision_pairs, row, strict=True):
            if oracle.touching(q, robot.link_names[a], robot.link_names[b]):
                solid_contacts += 1
                assert spheres_touch, (robot.link_names[a], robot.link_names[b])
    assert solid_contacts > 0


@pytest.mark.parametrize("name", ["panda", "planar3"])  # the UR5e has no such pair
def test_pairs_disabled_as_never_never_touch(robots, urdf_folder, name):
    robot = Robot.from_urdf(
        urdf_folder / f"{name}.urdf",
        joints=[*robots[name].joint_names, *robots[name].locked],
    )
    never = [pair for pair, reason in robot.disabled_pairs.items() if reason == "Never"]
    assert never
    index = np.array([sorted(robot.link_names.index(link) for link in pair) for pair in never])
    for seed in range(4):
        Q = random_configurations(robot.arrays, 2500, np.random.default_rng(seed))
        touching = pairs_touching(robot.arrays, Q, index).any(axis=0)
        assert not touching.any(), [never[k] for k in np.flatnonzero(touching)]


@pytest.mark.parametrize(
    ("name", "a", "b", "moving", "counts"),
    [
        ("panda", "panda_link6", "panda_hand", ["panda_joint7"], [90]),
        ("ur5e", "base_link_inertia", "upper_arm_link", ["shoulder_lift_joint"], [360]),
        ("ur5e", "wrist_1_link", "wrist_3_link", ["wrist_2_joint"], [360]),
        ("ur5e", "forearm_link", "wrist_2_link", ["wrist_1_joint", "wrist_2_joint"], [48, 48]),
    ],
)
def test_solids_of_pairs_disabled_by_default_stay_apart(robots, name, a, b, moving, counts):
    """Their spheres overlap; over all angles of the joints between them the solids do not."""
    robot = robots[name]
    assert robot.disabled_pairs[frozenset((a, b))] == "Default"
    oracle = SolidOracle(robot)
    joints = [robot.joint_names.index(joint) for joint in moving]
    q = robot.neutral
    ranges = [
        np.linspace(robot.lower[j], robot.upper[j], n) for j, n in zip(joints, counts, strict=True)
    ]
    for values in itertools.product(*ranges):
        q[joints] = values
        assert not oracle.touching(q, a, b), values


@pytest.mark.parametrize("name", ["panda", "ur5e", "planar3"])
def test_every_pair_is_tested_rigid_adjacent_or_disabled(robots, name):
    robot = robots[name]
    tested = {tuple(pair) for pair in robot.collision_pairs.tolist()}
    frames = robot.arrays.link_frame
    for a, b in all_pairs(robot):
        names = frozenset((robot.link_names[a], robot.link_names[b]))
        rigid = frames[a] == frames[b]
        if (a, b) not in tested:
            assert rigid or names in robot.disabled_pairs, names
        else:
            assert names not in robot.disabled_pairs


def test_only_the_mounted_base_is_fixed(robots):
    for name, base in [
        ("panda", "panda_link0"),
        ("ur5e", "base_link_inertia"),
        ("planar3", "base"),
    ]:
        robot = robots[name]
        fixed = [n for n, f in zip(robot.link_names, robot.fixed_links, strict=True) if f]
        assert fixed == [base]


def test_links_below_a_locked_joint_are_fixed_too(urdf_folder):
    robot = Robot.from_urdf(urdf_folder / "planar3.urdf", joints=["joint3"])
    fixed = [n for n, f in zip(robot.link_names, robot.fixed_links, strict=True) if f]
    assert fixed == ["base", "link1", "link2"]


def test_the_panda_stays_small_enough_to_check_fast(robots):
    assert len(robots["panda"].sphere_radii) <= 80
