# SPDX-License-Identifier: BSD-3-Clause
"""Pose goals: our damped least squares against pytorch-kinematics' `PseudoInverseIK`.

    python -m experiments.benchmarks.inverse_kinematics [--poses 30]

Both get the same reachable poses, restarts and limits. "exact" is the largest error of a
solution, by yourdfpy's kinematics in float64; "distinct" counts solutions that differ by more
than 0.05 rad in some joint.
"""

import argparse
import time

import numpy as np
import torch

import vprism_plan as vp
from vprism_plan._resources import urdf_path
from vprism_plan.planning.goals import PoseGoalConfig, solve_pose

RESTARTS = 64
LINKS = {"panda": "panda_hand", "ur5e": "tool0"}


def distinct(rows: np.ndarray) -> int:
    kept: list[np.ndarray] = []
    for q in rows:
        if all(np.abs(q - other).max() > 0.05 for other in kept):
            kept.append(q)
    return len(kept)


def error(robot: vp.Robot, link: str, q: np.ndarray, pose: np.ndarray) -> tuple[float, float]:
    """Metres and radians between a link and a pose."""
    reached = robot.link_poses(q)[link]
    turn = pose[:3, :3].T @ reached[:3, :3]
    angle = np.arccos(np.clip(0.5 * (np.trace(turn) - 1.0), -1.0, 1.0))
    return float(np.linalg.norm(reached[:3, 3] - pose[:3, 3])), float(angle)


def ours(robot: vp.Robot, link: str, pose: np.ndarray, seed: int) -> np.ndarray:
    config = PoseGoalConfig(link=link, attempts=RESTARTS)
    reference = robot.random_configuration(np.random.default_rng(seed))
    return solve_pose(robot, pose, reference, seed, config)


def theirs(robot: vp.Robot, link: str, name: str):
    import pytorch_kinematics as pk

    text = urdf_path(name).read_bytes()
    chain = pk.build_serial_chain_from_urdf(text, link).to(dtype=torch.float64)
    limits = torch.tensor(np.array(chain.get_joint_limits()), dtype=torch.float64).T
    names = chain.get_joint_parameter_names()
    column = [robot.joint_names.index(n) for n in names]

    def solve(pose: np.ndarray, seed: int) -> np.ndarray:
        torch.manual_seed(seed)
        ik = pk.PseudoInverseIK(
            chain, max_iterations=100, num_retries=RESTARTS, joint_limits=limits,
            early_stopping_any_converged=False, early_stopping_no_improvement=None,
            pos_tolerance=1e-4, rot_tolerance=1e-3, lr=1.0, debug=False,
        )  # fmt: skip
        goal = pk.Transform3d(matrix=torch.tensor(pose[None], dtype=torch.float64))
        answer = ik.solve(goal)
        rows = answer.solutions[0][answer.converged[0]].numpy()
        full = np.zeros((len(rows), robot.dof))
        full[:, column] = rows
        return full

    return solve


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--poses", type=int, default=30)
    options = parser.parse_args()
    torch.set_num_threads(1)
    print("robot | solver | poses solved | distinct | ms per pose | worst mm | worst mrad | beyond")
    for name, link in LINKS.items():
        robot = vp.Robot.from_urdf(urdf_path(name))
        rng = np.random.default_rng(0)
        poses = [
            robot.link_poses(robot.random_configuration(rng))[link] for _ in range(options.poses)
        ]
        solvers = {
            "ours": lambda pose, seed, robot=robot, link=link: ours(robot, link, pose, seed),
            "pytorch-kinematics": theirs(robot, link, name),
        }
        for label, solve in solvers.items():
            solve(poses[0], 0)
            began = time.process_time()
            found = [solve(pose, k) for k, pose in enumerate(poses)]
            spent = 1e3 * (time.process_time() - began) / len(poses)
            errors = [
                error(robot, link, q, p) for p, rows in zip(poses, found, strict=True) for q in rows
            ]
            beyond = max(
                float(np.max(np.maximum(rows - robot.upper, robot.lower - rows), initial=0.0))
                for rows in found
            )
            worst = np.max(errors, axis=0) if errors else (np.nan, np.nan)
            print(
                f"{name} | {label} | {sum(len(r) > 0 for r in found)} / {len(poses)} | "
                f"{np.mean([distinct(r) for r in found]):.1f} | {spent:.1f} | "
                f"{1e3 * worst[0]:.4f} | {1e3 * worst[1]:.3f} | {beyond:.1e}"
            )


if __name__ == "__main__":
    main()
