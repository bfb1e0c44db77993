# SPDX-License-Identifier: BSD-3-Clause
"""One robot, five ways to compute where it is; all must agree."""

import pickle

import numpy as np
import pytest
import torch
import yourdfpy
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import kinematics_oracle as oracle
from scipy.spatial.transform import Rotation

from vprism_plan._kernels import checking
from vprism_plan.collision.packing import pack_robot
from vprism_plan.robots import Robot
from vprism_plan.robots.kinematics import frame_poses, place

PANDA_DH = [
    (0, 0.333, 0),
    (0, 0, -np.pi / 2),
    (0, 0.316, np.pi / 2),
    (0.0825, 0, np.pi / 2),
    (-0.0825, 0.384, -np.pi / 2),
    (0, 0, np.pi / 2),
    (0.088, 0, np.pi / 2),
    (0, 0.107, 0),
]
UR5E_DH = [
    (0, 0.1625, np.pi / 2),
    (-0.425, 0, 0),
    (-0.3922, 0, 0),
    (0, 0.1333, np.pi / 2),
    (0, 0.0997, -np.pi / 2),
    (0, 0.0996, 0),
]
seeds = st.integers(0, 2**32 - 1)


def place_spheres(arrays, q):
    return place(frame_poses(arrays, q), arrays.sphere_frame, arrays.sphere_center)


def kernel_centers(robot: Robot, q: np.ndarray) -> np.ndarray:
    packed = pack_robot(robot.arrays)
    centers = np.empty((3, len(robot.sphere_radii)))
    checking.place_spheres(q, *packed, centers)
    return centers.T


def values_of(robot: Robot, q: np.ndarray) -> dict[str, float]:
    return dict(zip(robot.joint_names, q.tolist(), strict=True)) | robot.locked


@pytest.mark.parametrize("name", ["panda", "ur5e", "planar3"])
@pytest.mark.parametrize("seed", range(20))
def test_all_implementations_agree_on_the_shipped_robots(robots, urdf_folder, name, seed):
    rng = np.random.default_rng(seed)
    base = oracle.random_pose(rng)
    robot = robots[name].with_base_pose(base)
    q = robot.random_configuration(rng)
    poses = robot.link_poses(q)
    path = urdf_folder / f"{name}.urdf"
    expected = oracle.link_poses(path, values_of(robot, q), base)
    assert poses.keys() == expected.keys()
    for link in poses:
        np.testing.assert_allclose(poses[link], expected[link], atol=1e-12)
    model = yourdfpy.URDF.load(str(path), load_meshes=False)
    model.update_cfg(values_of(robot, q))
    for link in poses:
        other = base @ model.get_transform(link, model.base_link)
        np.testing.assert_allclose(poses[link], other, atol=1e-9)
    plain = place_spheres(robot.arrays, q[None])[0]
    in_torch = robot.sphere_centers(torch.tensor(q)).numpy()
    np.testing.assert_allclose(in_torch, plain, atol=1e-12)
    np.testing.assert_allclose(kernel_centers(robot, q), in_torch, atol=1e-12)
    single = robot.sphere_centers(torch.tensor(q, dtype=torch.float32))
    assert single.dtype == torch.float32
    np.testing.assert_allclose(single.numpy(), plain, atol=5e-6)


@pytest.mark.slow
@settings(max_examples=60)
@given(seed=seeds, n_links=st.integers(2, 9))
def test_random_robots_agree_with_the_textbook(tmp_path_factory, seed, n_links):
    """Any axis, branches, prismatic, mimic of mimic, any subset of joints in any order."""
    rng = np.random.default_rng(seed)
    text, spheres = oracle.random_urdf(rng, n_links)
    path = tmp_path_factory.mktemp("random") / "random.urdf"
    path.write_text(text)
    base = oracle.random_pose(rng)
    every = Robot.from_urdf(path, spheres=spheres).joint_names
    chosen = [str(j) for j in rng.permutation(every)[: int(rng.integers(1, len(every) + 1))]]
    locked = {j: float(rng.uniform(-1, 1)) for j in every if j not in chosen}
    robot = Robot.from_urdf(path, spheres=spheres, base_pose=base, joints=chosen, locked=locked)
    assert robot.joint_names == tuple(chosen)
    q = robot.random_configuration(rng)
    values = dict(zip(chosen, q.tolist(), strict=True)) | locked
    for link, T in oracle.link_poses(path, values, base).items():
        np.testing.assert_allclose(robot.link_poses(q)[link], T, atol=1e-10)
    expected = oracle.sphere_centers(path, spheres, values, base)
    rows = np.vstack([expected[link] for link in robot.link_names])
    np.testing.assert_allclose(robot.sphere_radii, rows[:, 3])
    in_torch = robot.sphere_centers(torch.tensor(q)).numpy()
    np.testing.assert_allclose(in_torch, rows[:, :3], atol=1e-10)
    # The checker refuses a follower of a joint that turns without limit.
    followed = robot.arrays.q_index[robot.arrays.q_mult != np.round(robot.arrays.q_mult)]
    if not robot.continuous[followed].any():
        np.testing.assert_allclose(kernel_centers(robot, q), rows[:, :3], atol=1e-10)


def test_panda_matches_its_published_dh_table(robots):
    rng = np.random.default_rng(0)
    for _ in range(20):
        q = robots["panda"].random_configuration(rng)
        expected = oracle.dh_pose(PANDA_DH, np.append(q, 0.0), modified=True)
        np.testing.assert_allclose(
            robots["panda"].link_poses(q)["panda_link8"], expected, atol=1e-12
        )


def test_ur5e_matches_its_published_dh_table(robots):
    # The makers' base frame is turned half a turn about z against base_link.
    half_turn = oracle.transform(Rotation.from_euler("z", np.pi).as_matrix(), [0, 0, 0])
    rng = np.random.default_rng(0)
    for _ in range(20):
        q = robots["ur5e"].random_configuration(rng)
        expected = half_turn @ oracle.dh_pose(UR5E_DH, q, modified=False)
        np.testing.assert_allclose(robots["ur5e"].link_poses(q)["tool0"], expected, atol=1e-9)


def test_planar_arm_matches_school_trigonometry(robots):
    q = np.array([0.3, -0.7, 1.1])
    angles = np.cumsum(q)
    lengths = np.array([0.3, 0.25, 0.2])
    tip = robots["planar3"].link_poses(q)["tip"][:3, 3]
    expected = [lengths @ np.cos(angles), lengths @ np.sin(angles), 0.15]
    np.testing.assert_allclose(tip, expected, atol=1e-12)


@settings(max_examples=15)
@given(seed=seeds)
def test_moving_the_base_moves_every_sphere_with_it(robots, seed):
    rng = np.random.default_rng(seed)
    T = oracle.random_pose(rng)
    for robot in robots.values():
        q = torch.tensor(robot.random_configuration(rng))
        here = robot.sphere_centers(q).numpy()
        there = robot.with_base_pose(T @ robot.base_pose).sphere_centers(q).numpy()
        np.testing.assert_allclose(there, here @ T[:3, :3].T + T[:3, 3], atol=1e-12)


@settings(max_examples=15)
@given(seed=seeds, shape=st.lists(st.integers(0, 3), max_size=3))
def test_batch_equals_loop(robots, seed, shape):
    robot = robots["panda"]
    rng = np.random.default_rng(seed)
    Q = torch.tensor(rng.uniform(robot.lower, robot.upper, size=(*shape, robot.dof)))
    centers = robot.sphere_centers(Q)
    assert centers.shape == (*shape, len(robot.sphere_radii), 3)
    for index in np.ndindex(*shape):
        np.testing.assert_allclose(centers[index], robot.sphere_centers(Q[index]), atol=1e-14)


@pytest.mark.parametrize("name", ["panda", "ur5e", "planar3"])
def test_first_and_second_derivatives_are_right(robots, name):
    robot = robots[name]
    rng = np.random.default_rng(1)
    q = torch.tensor(rng.uniform(robot.lower, robot.upper, size=(2, robot.dof)), requires_grad=True)

    def some(x: torch.Tensor) -> torch.Tensor:
        return robot.sphere_centers(x)[..., ::17, :]

    assert torch.autograd.gradcheck(some, (q,))
    assert torch.autograd.gradgradcheck(some, (q,))


def test_derivatives_of_prismatic_and_mimic_joints_are_right(gripper):
    q = torch.tensor([[0.3, 0.02]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(gripper.sphere_centers, (q,))
    assert torch.autograd.gradgradcheck(gripper.sphere_centers, (q,))


@settings(max_examples=10)
@given(seed=seeds)
def test_jacobian_matches_finite_differences(robots, seed):
    robot = robots["ur5e"]
    q = robot.random_configuration(np.random.default_rng(seed))
    jacobian = torch.autograd.functional.jacobian(robot.sphere_centers, torch.tensor(q)).numpy()
    step = 1e-6
    for j in range(robot.dof):
        ends = np.stack([q, q])
        ends[0, j] += step
        ends[1, j] -= step
        plus, minus = place_spheres(robot.arrays, ends)
        np.testing.assert_allclose(jacobian[..., j], (plus - minus) / (2 * step), atol=1e-8)


@settings(max_examples=15)
@given(seed=seeds)
def test_no_sphere_leaves_the_reach(robots, seed):
    rng = np.random.default_rng(seed)
    for robot in robots.values():
        moved = robot.with_base_pose(oracle.random_pose(rng))
        q = moved.random_configuration(rng)
        centers = moved.sphere_centers(torch.tensor(q)).numpy()
        far = np.linalg.norm(centers - moved.base_pose[:3, 3], axis=1) + moved.sphere_radii
        assert far.max() <= moved.reach
        assert moved.reach == robot.reach


def test_reach_counts_prismatic_and_mimicked_travel(gripper):
    # right: 0.1 to the joint, |-2 * 0.05001 + 0.01| of travel with the limit's tolerance, a sphere
    # out to 0.03
    assert gripper.reach == pytest.approx(0.1 + 0.09002 + 0.03)


def test_link_balls_hold_their_spheres(robots):
    for robot in robots.values():
        a = robot.arrays
        for link in range(len(robot.link_names)):
            rows = slice(a.link_start[link], a.link_start[link + 1])
            assert (a.sphere_link[rows] == link).all()
            assert (np.diff(a.sphere_radius[rows]) <= 0).all()
            assert (a.sphere_frame[rows] == a.link_frame[link]).all()
            reach = np.linalg.norm(a.sphere_center[rows] - a.link_center[link], axis=1)
            assert (reach + a.sphere_radius[rows] <= a.link_radius[link]).all()
        assert a.link_start[-1] == len(robot.sphere_radii)


def test_arrays_are_what_the_kernels_expect(robots):
    for robot in robots.values():
        for name, value in vars(robot.arrays).items():
            assert value.flags.c_contiguous, name
            assert value.dtype in (np.float64, np.int64, np.bool_), name
        np.testing.assert_allclose(np.linalg.norm(robot.arrays.axis, axis=1), 1.0)
        assert (robot.arrays.parent[1:] < np.arange(1, len(robot.arrays.parent))).all()


def test_a_robot_survives_pickling(robots):
    copy = pickle.loads(pickle.dumps(robots["panda"]))
    q = torch.tensor(copy.neutral)
    torch.testing.assert_close(copy.sphere_centers(q), robots["panda"].sphere_centers(q))


def test_functional_transforms_agree(robots):
    robot = robots["planar3"]

    def cost(q: torch.Tensor) -> torch.Tensor:
        return (robot.sphere_centers(q) ** 3).sum()

    q = torch.tensor([0.2, 0.5, -0.4], dtype=torch.float64)
    expected = torch.autograd.functional.hessian(cost, q)
    torch.testing.assert_close(torch.func.hessian(cost)(q), expected)
