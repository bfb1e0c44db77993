# SPDX-License-Identifier: BSD-3-Clause
"""A robot as flat arrays, and where its frames, links and spheres are for a configuration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from vprism_plan._read_only import ReadOnly
from vprism_plan._shapes import Configurations, Indices, Points, Pose, Spheres, Values, Vector
from vprism_plan.errors import RobotError
from vprism_plan.robots.sphere_files import LinkSpheres
from vprism_plan.robots.urdf import LIMIT_TOLERANCE, RobotModel

if TYPE_CHECKING:
    import torch

KIND_FIXED = 0
KIND_REVOLUTE = 1
KIND_PRISMATIC = 2


@dataclass(frozen=True, eq=False)
class KinematicArrays(ReadOnly):
    """A kinematic tree as C-contiguous float64/int64 arrays, read-only.

    Frame 0 is the robot's base; every other frame belongs to one moving joint,
    parents before children. Fixed joints, and joints locked at a value, are
    merged into the offsets, so a walk over the frames costs one product per
    moving joint. The pose of frame f in the world is

        T_f = T_parent(f) @ [R_off, t_off] @ motion(axis, value),
        value = q_mult * q[q_index] + q_offset       (mimic joints),

    with ``T_0 = [base_R, base_t]``. Metres and radians.
    """

    base_R: Float[np.ndarray, "3 3"]  # noqa: N815  rotation of the base in the world
    base_t: Float[np.ndarray, "3"]  # its position there
    parent: Int[np.ndarray, "frames"]  # parent frame, -1 for frame 0
    R_off: Float[np.ndarray, "frames 3 3"]  # joint frame in its parent frame at joint value 0
    t_off: Float[np.ndarray, "frames 3"]
    axis: Float[np.ndarray, "frames 3"]  # unit joint axis in the joint frame
    kind: Int[np.ndarray, "frames"]  # 0 fixed (only frame 0), 1 revolute or continuous, 2 prismatic
    q_index: Int[np.ndarray, "frames"]  # index into the configuration, -1 for frame 0
    # Factor on that value and what is added to it: 1 and 0 unless the joint mimics.
    q_mult: Float[np.ndarray, "frames"]
    q_offset: Float[np.ndarray, "frames"]
    # Spheres are sorted by link, and in it by falling radius.
    sphere_frame: Int[np.ndarray, "spheres"]  # frame each sphere moves with
    sphere_center: Float[np.ndarray, "spheres 3"]  # in that frame
    sphere_radius: Float[np.ndarray, "spheres"]
    sphere_link: Int[np.ndarray, "spheres"]  # index into the robot's ``link_names``
    link_start: Int[np.ndarray, "links_plus_one"]  # link l owns link_start[l]:link_start[l + 1]
    link_frame: Int[np.ndarray, "links"]  # frame each link moves with
    link_center: Float[np.ndarray, "links 3"]  # of a ball that holds all spheres of the link
    link_radius: Float[np.ndarray, "links"]
    link_fixed: Bool[np.ndarray, "links"]  # not checked against the world: no joint moves it
    # Metres of each link's radii that are padding. They count against the world; a pair's gap
    # is that of its spheres plus the padding of both links.
    link_padding: Float[np.ndarray, "links"]
    link_buffer: Float[np.ndarray, "links"]  # metres kept from other links, not in the radii
    pairs: Int[np.ndarray, "pairs 2"]  # of links, first < second, to test for self-collision
    lower: Float[np.ndarray, "dof"]  # joint limits; -pi and pi for continuous joints
    upper: Float[np.ndarray, "dof"]
    continuous: Bool[np.ndarray, "dof"]  # where the joint turns without limit


@dataclass(frozen=True)
class Attachment:
    """Where a link sits: constant pose ``T`` in the moving frame ``frame``, below ``parent``."""

    frame: int
    T: np.ndarray
    parent: str = ""


def build_arrays(
    model: RobotModel,
    active: Sequence[str],
    locked: Mapping[str, float],
    spheres: LinkSpheres,
    base_pose: Pose,
    buffer: Mapping[str, float],
) -> tuple[KinematicArrays, dict[str, Attachment]]:
    """Flatten a robot into arrays without pairs, and say where each URDF link sits.

    Actuated joints that are not active are locked. Links are numbered as in ``spheres``.
    """
    frames: list[tuple[int, np.ndarray, np.ndarray, int, int, float, float]] = [
        (-1, np.eye(4), np.array([0.0, 0.0, 1.0]), KIND_FIXED, -1, 0.0, 0.0)
    ]
    links = {model.root: Attachment(0, np.eye(4))}
    for joint in model.joints:
        parent = links[joint.parent]
        frame, T = parent.frame, parent.T @ joint.T_origin
        driver, factor, shift = model.resolve_mimic(joint.name)
        if joint.moves and driver in active:
            kind = KIND_PRISMATIC if joint.kind == "prismatic" else KIND_REVOLUTE
            index = list(active).index(driver)
            frames.append((frame, T, joint.axis, kind, index, factor, shift))
            frame, T = len(frames) - 1, np.eye(4)
        elif joint.moves:
            motion, way = np.eye(4), (factor * locked[driver] + shift) * joint.axis
            if joint.kind == "prismatic":
                motion[:3, 3] = way
            else:
                motion[:3, :3] = Rotation.from_rotvec(way).as_matrix()
            T = T @ motion
        links[joint.child] = Attachment(frame, T, joint.parent)
    chosen = [model.joint_map[name] for name in active]
    centers, radii, ball_centers, ball_radii = zip(
        *(in_frame(links[name], rows) for name, rows in spheres.items()), strict=True
    )
    counts = [len(rows) for rows in radii]
    link_frame = np.array([links[name].frame for name in spheres])
    parents, offsets, axes, kinds, drivers, factors, shifts = (
        np.array(column) for column in zip(*frames, strict=True)
    )
    arrays = KinematicArrays(
        base_R=base_pose[:3, :3].copy(),
        base_t=base_pose[:3, 3].copy(),
        parent=parents,
        R_off=offsets[:, :3, :3].copy(),
        t_off=offsets[:, :3, 3].copy(),
        axis=axes,
        kind=kinds,
        q_index=drivers,
        q_mult=factors,
        q_offset=shifts,
        sphere_frame=np.repeat(link_frame, counts),
        sphere_center=np.vstack(centers),
        sphere_radius=np.concatenate(radii),
        sphere_link=np.repeat(np.arange(len(counts)), counts),
        link_start=np.array([0, *np.cumsum(counts)]),
        link_frame=link_frame,
        link_center=np.array(ball_centers),
        link_radius=np.array(ball_radii),
        link_fixed=link_frame == 0,
        link_padding=np.zeros(len(link_frame)),
        link_buffer=np.array([buffer.get(name, 0.0) for name in spheres]),
        pairs=np.empty((0, 2), dtype=np.int64),
        lower=np.array([joint.lower for joint in chosen]),
        upper=np.array([joint.upper for joint in chosen]),
        continuous=np.array([joint.kind == "continuous" for joint in chosen]),
    )
    return arrays, links


def in_frame(sits: Attachment, rows: Spheres) -> tuple[Points, Values, Vector, float]:
    """A link's spheres in the frame that it moves with, radius falling, and a ball around them."""
    rows = rows[np.argsort(-rows[:, 3], kind="stable")]
    local = rows[:, :3] @ sits.T[:3, :3].T + sits.T[:3, 3]
    return local, rows[:, 3], *bounding_ball(local, rows[:, 3])


def bounding_ball(centers: Points, radii: Values) -> tuple[Vector, float]:
    """Centre and radius (rounded up) of a small ball that holds balls (Badoiu and Clarkson)."""
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
    arrays: KinematicArrays, q: Configurations
) -> tuple[Float[np.ndarray, "n frames 3 3"], Float[np.ndarray, "n frames 3"]]:
    """World rotations and positions of all frames for configurations (radians or metres)."""
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
            turn = Rotation.from_rotvec(value[:, None] * arrays.axis[f])
            R[:, f] = R[:, f] @ turn.as_matrix()
    return R, t


def place(
    poses: tuple[Float[np.ndarray, "n frames 3 3"], Float[np.ndarray, "n frames 3"]],
    frame: Indices,
    points: Points,
) -> Float[np.ndarray, "n m 3"]:
    """World positions of points that move with frames, from :func:`frame_poses`."""
    R, t = poses
    return np.asarray((R[:, frame] @ points[:, :, None])[..., 0] + t[:, frame])


def only_links(arrays: KinematicArrays, links: Indices) -> KinematicArrays:
    """Spheres of these links only, in this order; all joints, and no pairs."""
    counts = np.diff(arrays.link_start)[links]
    starts = np.concatenate([[0], np.cumsum(counts)])
    rows = np.arange(starts[-1]) + np.repeat(arrays.link_start[links] - starts[:-1], counts)
    of_spheres = ("sphere_frame", "sphere_center", "sphere_radius")
    of_links = [field.name for field in fields(arrays) if field.name.startswith("link_")]
    of_links.remove("link_start")
    return replace(
        arrays,
        **{name: getattr(arrays, name)[rows] for name in of_spheres},
        **{name: getattr(arrays, name)[links] for name in of_links},
        sphere_link=np.repeat(np.arange(len(links)), counts),
        link_start=starts,
        pairs=np.empty((0, 2), dtype=np.int64),
    )


def reach_bound(arrays: KinematicArrays) -> float:
    """No sphere reaches farther from the base origin than this (metres; triangle inequality)."""
    reach = np.zeros(len(arrays.parent))
    for f in range(1, len(reach)):
        reach[f] = reach[arrays.parent[f]] + np.linalg.norm(arrays.t_off[f])
        if arrays.kind[f] == KIND_PRISMATIC:
            ends = np.array([arrays.lower[arrays.q_index[f]], arrays.upper[arrays.q_index[f]]])
            ends += (-LIMIT_TOLERANCE, LIMIT_TOLERANCE)
            reach[f] += np.abs(arrays.q_mult[f] * ends + arrays.q_offset[f]).max()
    outer = np.linalg.norm(arrays.sphere_center, axis=1) + arrays.sphere_radius
    return float((reach[arrays.sphere_frame] + outer).max())


class TorchKinematics:
    """Sphere centres in the base frame as a function of a torch configuration.

    The chain of pytorch-kinematics is built from our matrices, as its reader of URDFs rounds to
    float32 and ignores mimic joints. One is kept per dtype and device.
    """

    def __init__(self, arrays: KinematicArrays) -> None:
        self._arrays = arrays
        self._chains: dict[tuple[torch.dtype, torch.device], tuple[Any, ...]] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {"_arrays": self._arrays, "_chains": {}}

    def sphere_centers(self, q: torch.Tensor) -> torch.Tensor:
        """(B, dof) -> (B, S, 3) in the base frame, metres."""
        import torch

        key = (q.dtype, q.device)
        if key not in self._chains:
            self._chains[key] = _torch_chain(self._arrays, *key)
        chain, q_index, q_mult, q_offset, frame, center = self._chains[key]
        joints = q[:, q_index] * q_mult + q_offset
        # The chain's own backward is analytic and wrong when differentiated again;
        # the plain graph is right at every order.
        poses = chain.forward_kinematics_tensor(joints, analytical_grad=False)[frame]
        rotated = torch.einsum("sbij,sj->bsi", poses[..., :3, :3], center)
        return rotated + poses[..., :3, 3].transpose(0, 1)


def _torch_chain(
    arrays: KinematicArrays, dtype: torch.dtype, device: torch.device
) -> tuple[Any, ...]:
    """A chain; index, factor and offset of its joints; frames and centres of the spheres."""
    import torch
    from pytorch_kinematics.chain import Chain
    from pytorch_kinematics.frame import Frame, Joint
    from pytorch_kinematics.frame import Link as ChainLink
    from pytorch_kinematics.transforms import Transform3d

    if dtype not in (torch.float32, torch.float64):
        raise RobotError(f"q has dtype {dtype}; valid: torch.float32, torch.float64")

    def tensor(values: np.ndarray) -> torch.Tensor:
        kind = dtype if values.dtype.kind == "f" else torch.int64
        return torch.tensor(values, device=device).to(kind)

    nodes: list[Frame] = []
    for f in range(len(arrays.parent)):
        node = Frame(f"f{f}", link=ChainLink(f"f{f}"))
        if f > 0:
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = arrays.R_off[f], arrays.t_off[f]
            node.joint = Joint(
                f"j{f}",
                offset=Transform3d(matrix=tensor(matrix)),
                joint_type="prismatic" if arrays.kind[f] == KIND_PRISMATIC else "revolute",
                axis=tensor(arrays.axis[f]),
                dtype=dtype,
                device=device,
            )
            nodes[arrays.parent[f]].add_child(node)
        nodes.append(node)
    chain = Chain(nodes[0], dtype=dtype, device=device)
    order = [int(name[1:]) for name in chain.get_joint_parameter_names()]
    of_joints = (
        tensor(values[order]) for values in (arrays.q_index, arrays.q_mult, arrays.q_offset)
    )
    frame = torch.tensor([chain.frame_to_idx[f"f{f}"] for f in arrays.sphere_frame], device=device)
    return chain, *of_joints, frame, tensor(arrays.sphere_center)


def within_limits(robot: Any, q: Float[np.ndarray, "... dof"]) -> Float[np.ndarray, "... dof"]:
    """Return q with values beyond a limit put on it."""
    free = np.asarray(robot.continuous, dtype=bool)
    return np.where(free, q, np.clip(q, robot.lower, robot.upper))


def outside_limits(robot: Any, q: Float[np.ndarray, "... dof"]) -> Bool[np.ndarray, "... dof"]:
    """Return which values are beyond the limits of their joints by more than the tolerance."""
    low = q < np.asarray(robot.lower) - LIMIT_TOLERANCE
    high = q > np.asarray(robot.upper) + LIMIT_TOLERANCE
    return np.asarray((low | high) & ~np.asarray(robot.continuous, dtype=bool))


@runtime_checkable
class JointState(Protocol):
    """Joint values by name, such as a ROS message of that type."""

    name: Any
    position: Any


Named = Mapping[str, Any] | JointState


def joint_values(values: Any, robot: Any, what: str) -> Float[np.ndarray, "..."]:
    """Return joint values as a fresh float64 array, C-contiguous and writeable.

    A copy in any case: numba would compile its kernels once more for a read-only array.

    Raises:
        RobotError: they are not real numbers, ragged, too large for a float, masked, or a
            tensor that requires a gradient. Shape and finiteness are not looked at.
    """
    if type(values) is np.ndarray and values.dtype == np.float64:
        return values.copy(order="C")
    if isinstance(values, JointState):
        values = dict(zip(values.name, values.position, strict=True))
    if isinstance(values, Mapping):
        missing = [name for name in robot.joint_names if name not in values]
        if missing:
            named = f"the joints {missing}; it names {sorted(map(str, values))}"
            raise RobotError(f"{what} has no value for {named}")
        values = [values[name] for name in robot.joint_names]
    try:
        array = np.asarray(values)
        if array.dtype.kind == "c":
            raise TypeError("complex numbers")
        if isinstance(values, np.ma.MaskedArray) and np.ma.is_masked(values):
            raise TypeError("some values are masked")
        return np.array(array, dtype=np.float64, order="C")
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise RobotError(
            f"{what} cannot be read from {type(values).__name__}: {error}; give "
            f"real numbers for the {robot.dof} joints {list(robot.joint_names)}"
        ) from error
