# SPDX-License-Identifier: BSD-3-Clause
"""Configurations that bring a link to places and orientations: damped least squares, batched."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from vprism_plan.errors import PlanningError
from vprism_plan.robots.kinematics import KIND_PRISMATIC, frame_poses, within_limits

_DAMPING = 1e-2
_LARGEST_STEP = 0.5
# Names that mean "the point that is to reach a pose", in order of preference.
_TIP_NAMES = (
    "tcp", "tool0", "tool", "ee_link", "ee", "tip", "end_effector", "end_effector_link", "hand",
    "gripper_base", "flange",
)  # fmt: skip


@dataclass(frozen=True)
class Targets:
    """Where a link shall be, one target per row.

    Positions are of the link's origin in the world, metres; without rotations, of the link in
    the world, any will do. About `free_axis`, a unit vector in the link, it may turn freely.
    """

    positions: Float[np.ndarray, "n 3"]
    rotations: Float[np.ndarray, "n 3 3"] | None = None
    free_axis: Float[np.ndarray, " 3"] | None = None


@dataclass(frozen=True)
class Tip:
    """A link that follows a frame at the constant pose `offset` (4, 4); `chain` moves it."""

    frame: int
    offset: np.ndarray
    chain: tuple[int, ...]

    def behind(self, R: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rotations and positions (metres) of the link, by those of all frames, in the world."""
        turned = R[:, self.frame]
        return turned @ self.offset[:3, :3], turned @ self.offset[:3, 3] + t[:, self.frame]


def find_tip(robot: Any, link: str | None) -> Tip:
    """Find a link, or the end effector: the robot's `tool`, a link with a name of one, or what
    hangs on the last joint if the robot is one chain; PlanningError without one."""
    if not (hasattr(robot, "arrays") and hasattr(robot, "links")):
        who = type(robot).__name__
        raise PlanningError(f"a {who} has no kinematics; give the goal as joint values")
    links, parent = robot.links, robot.arrays.parent
    name = link or robot.tool
    if name is None:
        moving = [n for n in reversed(links) if links[n].frame > 0]  # not a locked arm's
        endings = [(n, e) for e in _TIP_NAMES for n in moving]
        name = next((n for n, e in endings if n == e or n.endswith("_" + e)), None)
    last = set(range(len(parent))) - set(parent.tolist())
    if name is None and len(last) == 1:
        within = {n: at for n, at in links.items() if at.frame in last and n not in robot.attached}
        leaves = within.keys() - {at.parent for at in within.values()}
        name = leaves.pop() if len(leaves) == 1 else None
    known = ", ".join(links)
    if name is None:
        raise PlanningError(f"no link looks like the end effector; name one (`link`): {known}")
    if name not in links:
        raise PlanningError(f"{robot.name} has no link {name!r}; its links are {known}")
    frame = links[name].frame
    chain = [frame] if frame > 0 else []
    while chain and parent[chain[-1]] > 0:
        chain.append(int(parent[chain[-1]]))
    return Tip(frame, links[name].T, tuple(chain))


def descend(
    robot: Any, tip: Tip, targets: Targets, q: Float[np.ndarray, "n dof"], iterations: int
) -> tuple[Float[np.ndarray, "n dof"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Move each start q towards its target, within the joint limits.

    Damped least squares on the pose error (Buss 2004, "Introduction to inverse
    kinematics", section 6), in float64 on the arrays that the collision kernels use. Returns
    configurations, and what is left of the error: metres, radians (0 where any orientation
    will do).
    """
    for _ in range(iterations):
        error, J = _error_and_jacobian(robot.arrays, tip, targets, q)
        damped = J @ J.transpose(0, 2, 1) + _DAMPING**2 * np.eye(error.shape[1])
        step = np.einsum("nji,nj->ni", J, np.linalg.solve(damped, error[..., None])[..., 0])
        largest = np.max(np.abs(step), axis=1, keepdims=True)
        q = q + step * np.minimum(1.0, _LARGEST_STEP / np.maximum(largest, 1e-300))
        q = within_limits(robot, q)
    error, _ = _error_and_jacobian(robot.arrays, tip, targets, q)
    return q, np.linalg.norm(error[:, :3], axis=1), np.linalg.norm(error[:, 3:], axis=1)


def _error_and_jacobian(
    arrays: Any, tip: Tip, targets: Targets, q: Float[np.ndarray, "n dof"]
) -> tuple[Float[np.ndarray, "n e"], Float[np.ndarray, "n e dof"]]:
    """Error (metres, rotation vector in the world) and the geometric Jacobian; three rows each
    if any orientation will do, six otherwise."""
    R, t = frame_poses(arrays, q)
    R_tip, t_tip = tip.behind(R, t)
    J = np.zeros((len(q), 6, q.shape[1]))
    for f in tip.chain:
        axis = R[:, f] @ arrays.axis[f]
        column = arrays.q_index[f]
        if arrays.kind[f] == KIND_PRISMATIC:
            J[:, :3, column] += arrays.q_mult[f] * axis
        else:
            J[:, :3, column] += arrays.q_mult[f] * np.cross(axis, t_tip - t[:, f])
            J[:, 3:, column] += arrays.q_mult[f] * axis
    away = targets.positions - t_tip
    if targets.rotations is None:
        return away, J[:, :3]
    if targets.free_axis is None:
        turn = Rotation.from_matrix(targets.rotations @ R_tip.transpose(0, 2, 1)).as_rotvec()
        return np.concatenate([away, turn], axis=1), J
    now, wanted = R_tip @ targets.free_axis, targets.rotations @ targets.free_axis
    turn = _turn_between(now, wanted)
    # What turns about the axis itself does not count, in the error or in the Jacobian.
    J[:, 3:] -= now[:, :, None] * np.einsum("ni,nij->nj", now, J[:, 3:])[:, None]
    return np.concatenate([away, turn], axis=1), J


def _turn_between(a: np.ndarray, b: np.ndarray) -> Float[np.ndarray, "n 3"]:
    """The shortest rotation vectors that turn unit vectors a to b."""
    across = np.cross(a, b)
    sine = np.linalg.norm(across, axis=1)
    angle = np.arctan2(sine, np.einsum("ni,ni->n", a, b))
    # Opposite directions: any perpendicular axis will do.
    other = np.cross(a, np.eye(3)[np.argmin(np.abs(a), axis=1)])
    other /= np.linalg.norm(other, axis=1, keepdims=True)
    axis = np.where(sine[:, None] > 1e-12, across / np.maximum(sine, 1e-300)[:, None], other)
    return axis * angle[:, None]
