# SPDX-License-Identifier: BSD-3-Clause
"""Pose goals: configurations that bring a link to a pose, and that a checker accepts."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from vprism_plan.errors import PlanningError
from vprism_plan.planning._protocol import CheckerLike
from vprism_plan.robots._arrays import KIND_PRISMATIC
from vprism_plan.robots._frames import frame_poses

_DAMPING = 1e-2
_LARGEST_STEP = 0.5


@dataclass(frozen=True)
class PoseGoalConfig:
    """How a pose becomes configurations.

    Attributes:
        link: the link that is to reach the pose; the end of the robot's longest chain
            if None.
        attempts: number of random configurations the solver starts from.
        iterations: steps per attempt.
        position_tolerance: metres between the link and the pose that still count as
            reached.
        rotation_tolerance: radians likewise.
        max_goals: how many valid configurations are handed to the planner at most.
    """

    link: str | None = None
    attempts: int = 64
    iterations: int = 100
    position_tolerance: float = 1e-4
    rotation_tolerance: float = 1e-3
    max_goals: int = 8

    def __post_init__(self) -> None:
        for name in ("attempts", "iterations", "max_goals"):
            if getattr(self, name) < 1:
                raise PlanningError(f"{name} is {getattr(self, name)!r}; it must be at least 1")
        for name in ("position_tolerance", "rotation_tolerance"):
            if not getattr(self, name) > 0.0:
                raise PlanningError(f"{name} is {getattr(self, name)!r}; it must be more than 0")


@dataclass(frozen=True)
class PoseSolutions:
    """Configurations found for a pose.

    Attributes:
        valid: accepted by the checker (g, dof), nearest to the reference first.
        example: one that reaches the pose, accepted or not (dof,); None if none does.
        reached: how many distinct configurations reach the pose.
        attempts: how many were tried.
    """

    valid: np.ndarray
    example: np.ndarray | None
    reached: int
    attempts: int


# Names that mean "the point that is to reach a pose", in order of preference.
_TIP_NAMES = ("tcp", "tool0", "tool", "ee_link", "ee", "tip", "end_effector", "hand")


def configurations_at_pose(
    checker: CheckerLike,
    pose: Float[np.ndarray, "4 4"],
    reference: Float[np.ndarray, " dof"],
    seed: int,
    config: PoseGoalConfig,
) -> PoseSolutions:
    """Find configurations that bring a link of the checker's robot to a pose.

    Damped least squares on the pose error (Buss 2004, "Introduction to inverse
    kinematics", section 6), batched over random starts within the joint limits, in
    float64 on the same arrays as the collision kernels. (The solver of
    pytorch-kinematics reads its offsets in float32 and leaves mimic joints out.)

    Args:
        checker: accepts or refuses configurations; its robot has `arrays`, `link_poses`.
        pose: wanted pose of the link in the world, metres.
        reference: first start of the solver; solutions are sorted by their distance
            to it.
        seed: of the random starts.
        config: which link, tolerances, number of attempts.

    Raises:
        PlanningError: the pose is not a rigid transform, or the link is unknown.
    """
    _require_rigid(pose)
    robot = checker.robot
    if not (hasattr(robot, "arrays") and hasattr(robot, "link_poses")):
        raise PlanningError(
            f"a {type(robot).__name__} has no kinematics to solve a pose with; "
            "give the goal as joint values"
        )
    rng = np.random.default_rng(seed)
    low, high = np.asarray(robot.lower), np.asarray(robot.upper)
    q = rng.uniform(low, high, (config.attempts, robot.dof))
    q[0] = reference
    tip = _find_tip(robot, config.link, rng)
    solved = _solve(robot, tip, pose, q, config)
    order = np.argsort(np.linalg.norm(solved - reference, axis=1), kind="stable")
    distinct: list[np.ndarray] = []
    for candidate in solved[order]:
        if all(np.max(np.abs(candidate - other)) > 0.05 for other in distinct):
            distinct.append(candidate)
    valid = [q for q in distinct if checker.is_valid(q)][: config.max_goals]
    return PoseSolutions(
        valid=np.array(valid).reshape(-1, robot.dof),
        example=distinct[0] if distinct else None,
        reached=len(distinct),
        attempts=config.attempts,
    )


def _require_rigid(pose: Float[np.ndarray, "4 4"]) -> None:
    R = pose[:3, :3]
    rigid = (
        np.isfinite(pose).all()
        and np.allclose(R @ R.T, np.eye(3), atol=1e-6)
        and np.linalg.det(R) > 0.0
        and np.allclose(pose[3], [0.0, 0.0, 0.0, 1.0])
    )
    if not rigid:
        raise PlanningError(
            f"goal pose {pose.tolist()} is not a rigid transform; it needs an orthonormal rotation "
            "with determinant 1, a translation in metres and the last row 0 0 0 1"
        )


@dataclass(frozen=True)
class _Tip:
    """A link that follows frame `frame` at the constant pose `offset`."""

    frame: int
    offset: np.ndarray
    chain: tuple[int, ...]


def _find_tip(robot: Any, link: str | None, rng: np.random.Generator) -> _Tip:
    """Find the frame a link is attached to: the deepest one it does not move against."""
    parent = robot.arrays.parent
    two = rng.uniform(robot.lower, robot.upper, (2, robot.dof))
    links = [robot.link_poses(q) for q in two]
    R, t = frame_poses(robot.arrays, two)
    name = _default_link(tuple(links[0])) if link is None else link
    if name not in links[0]:
        raise PlanningError(
            f"{robot.name} has no link {name!r}; its links are {', '.join(links[0])}"
        )
    for frame in reversed(range(len(parent))):
        offsets = [_rigid_inverse(R[i, frame], t[i, frame]) @ links[i][name] for i in (0, 1)]
        if np.allclose(offsets[0], offsets[1], atol=1e-9):
            chain = []
            walk = frame
            while walk > 0:
                chain.append(walk)
                walk = int(parent[walk])
            return _Tip(frame, offsets[0], tuple(chain))
    raise PlanningError(f"link {name!r} of {robot.name} is attached to no frame of the robot")


def _default_link(names: tuple[str, ...]) -> str:
    for ending in _TIP_NAMES:
        for name in reversed(names):
            if name == ending or name.endswith("_" + ending):
                return name
    raise PlanningError(
        "no link is recognisable as the end effector; name one in "
        f"PoseGoalConfig(link=...): {', '.join(names)}"
    )


def _rigid_inverse(
    R: Float[np.ndarray, "3 3"], t: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    T = np.eye(4)
    T[:3, :3] = R.T
    T[:3, 3] = -R.T @ t
    return T


def _solve(
    robot: Any,
    tip: _Tip,
    pose: Float[np.ndarray, "4 4"],
    q: Float[np.ndarray, "n dof"],
    config: PoseGoalConfig,
) -> Float[np.ndarray, "m dof"]:
    """Return those of the starts q that reach the pose, moved there."""
    free = np.asarray(robot.continuous, dtype=bool)
    for _ in range(config.iterations):
        error, J = _error_and_jacobian(robot.arrays, tip, pose, q)
        damped = J @ J.transpose(0, 2, 1) + _DAMPING**2 * np.eye(6)
        step = np.einsum("nji,nj->ni", J, np.linalg.solve(damped, error[..., None])[..., 0])
        largest = np.max(np.abs(step), axis=1, keepdims=True)
        q = q + step * np.minimum(1.0, _LARGEST_STEP / np.maximum(largest, 1e-300))
        q = np.where(
            free, np.mod(q + np.pi, 2 * np.pi) - np.pi, np.clip(q, robot.lower, robot.upper)
        )
    error, _ = _error_and_jacobian(robot.arrays, tip, pose, q)
    reached = _reached(error, config)
    return q[reached]


def _reached(error: Float[np.ndarray, "n 6"], config: PoseGoalConfig) -> Bool[np.ndarray, " n"]:
    near = np.linalg.norm(error[:, :3], axis=1) <= config.position_tolerance
    return near & (np.linalg.norm(error[:, 3:], axis=1) <= config.rotation_tolerance)


def _error_and_jacobian(
    arrays: Any, tip: _Tip, pose: Float[np.ndarray, "4 4"], q: Float[np.ndarray, "n dof"]
) -> tuple[Float[np.ndarray, "n 6"], Float[np.ndarray, "n 6 dof"]]:
    """Pose error (metres, rotation vector in the world) and the geometric Jacobian."""
    R, t = frame_poses(arrays, q)
    R_tip = R[:, tip.frame] @ tip.offset[:3, :3]
    t_tip = R[:, tip.frame] @ tip.offset[:3, 3] + t[:, tip.frame]
    turn = Rotation.from_matrix(pose[:3, :3] @ R_tip.transpose(0, 2, 1)).as_rotvec()
    error = np.concatenate([pose[:3, 3] - t_tip, turn], axis=1)
    J = np.zeros((len(q), 6, q.shape[1]))
    for f in tip.chain:
        axis = R[:, f] @ arrays.axis[f]
        column = arrays.q_index[f]
        if arrays.kind[f] == KIND_PRISMATIC:
            J[:, :3, column] += arrays.q_mult[f] * axis
        else:
            J[:, :3, column] += arrays.q_mult[f] * np.cross(axis, t_tip - t[:, f])
            J[:, 3:, column] += arrays.q_mult[f] * axis
    return error, J
