# SPDX-License-Identifier: BSD-3-Clause
"""From a tree of links to the flat arrays, and plain numpy kinematics on them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from vprism_plan.robots._arrays import KIND_FIXED, KIND_PRISMATIC, KIND_REVOLUTE, KinematicArrays
from vprism_plan.robots._model import Joint, RobotModel
from vprism_plan.robots._sphere_files import LinkSpheres


@dataclass(frozen=True)
class Attachment:
    """Where a link sits: constant pose ``T`` in the moving frame ``frame``."""

    frame: int
    T: np.ndarray


def joint_motion(joint: Joint, value: float) -> Float[np.ndarray, "4 4"]:
    """Pose of a joint's child frame in its joint frame at a value (rad or m)."""
    T = np.eye(4)
    if joint.kind == "prismatic":
        T[:3, 3] = value * joint.axis
    else:
        T[:3, :3] = rotation(joint.axis, np.float64(value))
    return T


def rotation(
    axis: Float[np.ndarray, "3"], angle: Float[np.ndarray, "*batch"] | np.float64
) -> Float[np.ndarray, "*batch 3 3"]:
    """Rotation matrices about a unit axis (Rodrigues)."""
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    s, c = np.sin(angle)[..., None, None], np.cos(angle)[..., None, None]
    return np.eye(3) + s * K + (1.0 - c) * (K @ K)


def build_arrays(
    model: RobotModel,
    active: Sequence[str],
    locked: Mapping[str, float],
    spheres: LinkSpheres,
    pairs: Int[np.ndarray, "pairs 2"],
    base_pose: Float[np.ndarray, "4 4"],
) -> tuple[KinematicArrays, dict[str, Attachment]]:
    """Flatten a robot.

    Args:
        model: The tree.
        active: Joints of the configuration, in its order.
        locked: Value of every other actuated joint.
        spheres: Spheres per link; its keys, in order, are the collision links.
        pairs: Link pairs for self-collision, indices into those links.
        base_pose: Pose of the robot's root link in the world.

    Returns:
        The arrays, and where each URDF link sits.
    """
    frames: list[tuple[int, np.ndarray, np.ndarray, int, int, float, float]] = [
        (-1, np.eye(4), np.array([0.0, 0.0, 1.0]), KIND_FIXED, -1, 0.0, 0.0)
    ]
    links = {model.root: Attachment(0, np.eye(4))}
    for joint in model.joints:
        parent = links[joint.parent]
        T = parent.T @ joint.T_origin
        if not joint.moves:
            links[joint.child] = Attachment(parent.frame, T)
            continue
        driver, factor, shift = model.resolve_mimic(joint.name)
        if driver in active:
            kind = KIND_PRISMATIC if joint.kind == "prismatic" else KIND_REVOLUTE
            index = list(active).index(driver)
            frames.append((parent.frame, T, joint.axis, kind, index, factor, shift))
            links[joint.child] = Attachment(len(frames) - 1, np.eye(4))
        else:
            moved = T @ joint_motion(joint, factor * locked[driver] + shift)
            links[joint.child] = Attachment(parent.frame, moved)
    chosen = [model.joint_map[name] for name in active]
    offsets = np.array([frame[1] for frame in frames])
    arrays = KinematicArrays(
        base_R=_floats(base_pose[:3, :3]),
        base_t=_floats(base_pose[:3, 3]),
        parent=_ints([frame[0] for frame in frames]),
        R_off=_floats(offsets[:, :3, :3]),
        t_off=_floats(offsets[:, :3, 3]),
        axis=_floats([frame[2] for frame in frames]),
        kind=_ints([frame[3] for frame in frames]),
        q_index=_ints([frame[4] for frame in frames]),
        q_mult=_floats([frame[5] for frame in frames]),
        q_offset=_floats([frame[6] for frame in frames]),
        **_sphere_arrays(spheres, links),
        pairs=np.ascontiguousarray(pairs, dtype=np.int64).reshape(-1, 2),
        lower=_floats([joint.lower for joint in chosen]),
        upper=_floats([joint.upper for joint in chosen]),
        continuous=np.array([joint.kind == "continuous" for joint in chosen], dtype=bool),
    )
    return arrays, links


def _floats(values: object) -> np.ndarray:
    return np.array(values, dtype=np.float64, order="C")


def _ints(values: object) -> np.ndarray:
    return np.array(values, dtype=np.int64, order="C")


def _sphere_arrays(spheres: LinkSpheres, links: Mapping[str, Attachment]) -> dict[str, np.ndarray]:
    frames, centers, radii, owner, start = [], [], [], [], [0]
    bounds = []
    for index, (name, unsorted) in enumerate(spheres.items()):
        sits = links[name]
        rows = unsorted[np.argsort(-unsorted[:, 3], kind="stable")]
        local = rows[:, :3] @ sits.T[:3, :3].T + sits.T[:3, 3]
        frames += [sits.frame] * len(rows)
        centers.append(local)
        radii.append(rows[:, 3])
        owner += [index] * len(rows)
        start.append(start[-1] + len(rows))
        bounds.append(bounding_ball(local, rows[:, 3]))
    link_frame = _ints([links[name].frame for name in spheres])
    return {
        "sphere_frame": _ints(frames),
        "sphere_center": _floats(np.vstack(centers)),
        "sphere_radius": _floats(np.concatenate(radii)),
        "sphere_link": _ints(owner),
        "link_start": _ints(start),
        "link_frame": link_frame,
        "link_center": _floats([ball[0] for ball in bounds]),
        "link_radius": _floats([ball[1] for ball in bounds]),
        "link_fixed": link_frame == 0,
        "link_padding": np.zeros(len(link_frame)),
    }


def bounding_ball(
    centers: Float[np.ndarray, "n 3"], radii: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "3"], float]:
    """A small ball that holds a set of balls (Badoiu and Clarkson's iteration).

    Returns:
        Centre, and a radius rounded up so that every ball is held.
    """
    center = centers.mean(axis=0)
    best, radius = center, np.inf
    for step in range(1, 200):
        reach = np.linalg.norm(centers - center, axis=1) + radii
        far = int(np.argmax(reach))
        if reach[far] < radius:
            best, radius = center, float(reach[far])
        direction = centers[far] - center
        length = float(np.linalg.norm(direction))
        if length == 0.0:
            break
        center = center + direction / length * (reach[far] / (step + 1.0))
    return best, radius * (1.0 + 1e-12)


def frame_poses(
    arrays: KinematicArrays, q: Float[np.ndarray, "n dof"]
) -> tuple[Float[np.ndarray, "n frames 3 3"], Float[np.ndarray, "n frames 3"]]:
    """World poses of all frames for a batch of configurations.

    Args:
        arrays: The robot.
        q: (n, dof) radians or metres.

    Returns:
        Rotations (n, frames, 3, 3) and positions (n, frames, 3) in the world.
    """
    n, count = len(q), len(arrays.parent)
    R, t = np.empty((n, count, 3, 3)), np.empty((n, count, 3))
    R[:, 0], t[:, 0] = arrays.base_R, arrays.base_t
    for f in range(1, count):
        p = arrays.parent[f]
        value = arrays.q_mult[f] * q[:, arrays.q_index[f]] + arrays.q_offset[f]
        R[:, f] = R[:, p] @ arrays.R_off[f]
        t[:, f] = t[:, p] + R[:, p] @ arrays.t_off[f]
        if arrays.kind[f] == KIND_PRISMATIC:
            t[:, f] += value[:, None] * (R[:, f] @ arrays.axis[f])
        else:
            R[:, f] = R[:, f] @ rotation(arrays.axis[f], value)
    return R, t


def place_spheres(
    arrays: KinematicArrays, q: Float[np.ndarray, "n dof"]
) -> Float[np.ndarray, "n spheres 3"]:
    """World centres of all spheres for a batch of configurations, metres."""
    R, t = frame_poses(arrays, q)
    frame = arrays.sphere_frame
    return np.einsum("nsij,sj->nsi", R[:, frame], arrays.sphere_center) + t[:, frame]


def reach_bound(arrays: KinematicArrays) -> float:
    """No sphere reaches farther from the base origin than this, metres.

    The sum of offsets along each branch, plus the travel of its prismatic joints,
    plus how far the spheres stand off their frame: the triangle inequality.
    """
    reach = np.zeros(len(arrays.parent))
    for f in range(1, len(reach)):
        reach[f] = reach[arrays.parent[f]] + np.linalg.norm(arrays.t_off[f])
        if arrays.kind[f] == KIND_PRISMATIC:
            ends = np.array([arrays.lower[arrays.q_index[f]], arrays.upper[arrays.q_index[f]]])
            reach[f] += np.abs(arrays.q_mult[f] * ends + arrays.q_offset[f]).max()
    outer = np.linalg.norm(arrays.sphere_center, axis=1) + arrays.sphere_radius
    return float((reach[arrays.sphere_frame] + outer).max())
