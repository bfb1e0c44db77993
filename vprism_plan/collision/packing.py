# SPDX-License-Identifier: BSD-3-Clause
"""Robots, worlds and joint values as the flat arrays that the checking kernels read.

Besides copying, this turns every joint frame so that its axis is z (a rotation about a coordinate
axis costs half of a general one), bounds how far each joint can carry each link, which is what the
continuous edge check advances by, and checks joint values as people write them, once, before
anything is computed from them.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from vprism_plan._arguments import number
from vprism_plan._kernels.checking import FARTHEST
from vprism_plan.errors import RobotError
from vprism_plan.robots.kinematics import KIND_PRISMATIC, KinematicArrays, Named, joint_values
from vprism_plan.robots.pairs import pair_room
from vprism_plan.robots.urdf import LIMIT_TOLERANCE
from vprism_plan.world.grid import Vector

# Arrays of joint values: of one configuration, of many, of a path.
Configuration = Float[np.ndarray, " _"]
Rows = Float[np.ndarray, "_ _"]
Waypoints = Float[np.ndarray, "_ _"]

_HEADER = 24
MARGIN = 6  # where the floats of a packed world hold the clearance to keep
AT_MOST = 200_000  # configurations that one query may ask about
# An array, a tensor, a list or a tuple; of one configuration also values by name.
Numbers = ArrayLike | Sequence[Any] | Named

# Kernel view of a robot, floats and integers: `vprism_plan._kernels.checking` has the layout.
PackedRobot = tuple[Float[np.ndarray, "f"], Int[np.ndarray, "i"]]
# Kernel view of a world: distances at nodes and in blocks (metres, float32), (rules, x, y, z)
# each, and the grid, plane and margin data.
PackedWorld = tuple[np.ndarray, np.ndarray, np.ndarray]


def _rotation_from_z(axis: Vector) -> Float[np.ndarray, "3 3"]:
    """Return a rotation whose third column is the unit vector `axis`."""
    helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
    x = np.cross(helper, axis)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(axis, x), axis])


def ancestors(parent: Int[np.ndarray, "f"]) -> list[list[int]]:
    """Return, for each frame, the chain from the base to the frame itself."""
    chains: list[list[int]] = []
    for frame, above in enumerate(parent):
        chains.append([*chains[above], frame] if above >= 0 else [frame])
    return chains


def _prismatic_travel(arrays: KinematicArrays, frame: int) -> float:
    """Return the largest displacement of a prismatic frame within its limits, metres."""
    if arrays.kind[frame] != KIND_PRISMATIC:
        return 0.0
    joint = int(arrays.q_index[frame])
    ends = np.array([arrays.lower[joint], arrays.upper[joint]])
    ends += (-LIMIT_TOLERANCE, LIMIT_TOLERANCE)
    return float(np.max(np.abs(arrays.q_mult[frame] * ends + arrays.q_offset[frame])))


def reach_table(arrays: KinematicArrays) -> Float[np.ndarray, "f l"]:
    """Bound how far each joint can move any sphere centre of each link, over all configurations
    within the limits, metres per unit of its own motion (1 for prismatic joints); -1 where it
    does not move the link. Offsets along the chain are added up: the triangle inequality."""
    table = np.full((len(arrays.parent), len(arrays.link_frame)), -1.0)
    chains = ancestors(arrays.parent)
    for link, own in enumerate(arrays.link_frame):
        chain = chains[int(own)]
        rows = slice(int(arrays.link_start[link]), int(arrays.link_start[link + 1]))
        centers = arrays.sphere_center[rows]
        # reach: from the origin of the frame below to the farthest sphere centre
        reach = float(np.max(np.linalg.norm(centers, axis=1)))
        for position in range(len(chain) - 1, 0, -1):
            frame = chain[position]
            axis = arrays.axis[frame]
            if position == len(chain) - 1:
                lever = float(np.max(np.linalg.norm(np.cross(centers, axis), axis=1)))
            else:
                below = chain[position + 1]
                across = float(np.linalg.norm(np.cross(arrays.t_off[below], axis)))
                lever = across + _prismatic_travel(arrays, below) + reach
                reach += float(np.linalg.norm(arrays.t_off[below]))
                reach += _prismatic_travel(arrays, below)
            table[frame, link] = 1.0 if arrays.kind[frame] == KIND_PRISMATIC else lever
    return table


def _frame_floats(arrays: KinematicArrays) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return (frames, 14) pose and motion data and each frame's rotation to a z axis."""
    n_frames = len(arrays.parent)
    frames = np.zeros((n_frames, 14))
    turned = [np.eye(3)]
    frames[0, :9] = arrays.base_R.reshape(-1)
    frames[0, 9:12] = arrays.base_t
    for f in range(1, n_frames):
        above = turned[int(arrays.parent[f])]
        turn = _rotation_from_z(arrays.axis[f])
        turned.append(turn)
        frames[f, :9] = (above.T @ arrays.R_off[f] @ turn).reshape(-1)
        frames[f, 9:12] = above.T @ arrays.t_off[f]
        frames[f, 12] = arrays.q_mult[f]
        frames[f, 13] = arrays.q_offset[f]
    return frames, turned


def pack_robot(
    arrays: KinematicArrays, self_margin: float = 0.0, rules: Int[np.ndarray, "l"] | None = None
) -> PackedRobot:
    """Pack a robot for the kernels: its pairs keep `self_margin` (metres) beyond touching, and
    `rules` say which of a packed world's fields each link is checked against (the first, if not
    given). Links that no joint moves are checked against none.

    Raises:
        RobotError: a prismatic joint has no finite limits, so its motion has no bound.
    """
    for frame in np.flatnonzero(arrays.kind == KIND_PRISMATIC):
        if not np.isfinite(_prismatic_travel(arrays, int(frame))):
            raise RobotError(
                f"prismatic joint number {int(arrays.q_index[frame])} has infinite limits; "
                "give it finite limits in the URDF, or lock it"
            )
    followers = np.flatnonzero((arrays.q_mult != np.round(arrays.q_mult)) & (arrays.kind == 1))
    for frame in followers:
        if arrays.continuous[arrays.q_index[frame]]:
            raise RobotError(
                f"a joint follows continuous joint number {int(arrays.q_index[frame])} with "
                f"multiplier {arrays.q_mult[frame]}, so a full turn does not come back to the "
                "same state; make the followed joint revolute, with limits"
            )
    frames, turned = _frame_floats(arrays)
    n_links = len(arrays.link_frame)
    spheres = _turned(turned, arrays.sphere_frame, arrays.sphere_center, arrays.sphere_radius)
    bounding = _turned(turned, arrays.link_frame, arrays.link_center, arrays.link_radius)
    limits = np.column_stack([arrays.lower - LIMIT_TOLERANCE, arrays.upper + LIMIT_TOLERANCE])
    gaps = np.array([self_margin, *pair_room(arrays, arrays.pairs)])
    float_parts = [frames, spheres.T, bounding, limits, reach_table(arrays), gaps]
    frame_ints = np.column_stack([arrays.parent, arrays.kind, np.maximum(arrays.q_index, 0)])
    starts, ends = arrays.link_start[:-1], arrays.link_start[1:]
    rules = np.zeros(n_links, dtype=np.int64) if rules is None else rules
    rules = np.where(arrays.link_fixed, -1, rules)
    link_ints = np.column_stack([arrays.link_frame, starts, ends, rules])
    int_parts = [frame_ints, link_ints, arrays.pairs, arrays.continuous.astype(np.int64)]
    header = np.zeros(_HEADER, dtype=np.int64)
    header[:5] = len(frames), len(spheres), n_links, len(arrays.pairs), len(arrays.lower)
    header[8:12] = _HEADER + np.cumsum([0, *[part.size for part in int_parts[:-1]]])
    header[16:22] = np.cumsum([0, *[part.size for part in float_parts[:-1]]])
    floats = np.concatenate([part.reshape(-1) for part in float_parts], dtype=np.float64)
    ints = np.concatenate([header, *[part.reshape(-1) for part in int_parts]], dtype=np.int64)
    return floats, ints


def _turned(
    turned: list[np.ndarray], frames: np.ndarray, centers: np.ndarray, radii: np.ndarray
) -> Float[np.ndarray, "n 4"]:
    """Balls (centre, radius) in frames whose axes were turned to z."""
    moved = [turned[int(f)].T @ center for f, center in zip(frames, centers, strict=True)]
    return np.column_stack([np.reshape(moved, (-1, 3)), radii])


def block_bounds(
    distance: Float[np.ndarray, "nx ny nz"], spacing: float
) -> Float[np.ndarray, "bx by bz"]:
    """Return a lower bound of the distance (metres) for everywhere in each block of 4 x 4 x 4
    cells: every point is within half a cell's diagonal of a node, and distance is 1-Lipschitz."""
    lowest = distance
    for axis, n in enumerate(distance.shape):
        blocks = (n - 1) // 4 + 1
        rows = np.minimum(4 * np.arange(blocks)[:, None] + np.arange(5), n - 1)
        lowest = np.take(lowest, rows, axis=axis).min(axis=axis + 1)
    # A little more than sqrt(3) / 2, so that rounding in float32 cannot lift a bound.
    bounds = (lowest - np.float32(0.8662 * spacing)).astype(np.float32)
    return np.ascontiguousarray(np.nextafter(bounds, np.float32(-np.inf)))


def pack_world(world: Any, fields: Sequence[Any], margin: float) -> PackedWorld:
    """Pack a world's half-spaces and policies for the kernels, and fields on the same nodes with
    the same field beyond, one per contact rule; `margin` (metres) is the clearance to keep."""
    field = fields[0]
    planes = np.asarray(world.planes, dtype=np.float64).reshape(-1, 4)
    outside = 1.0 if world.config.unobserved == "occupied" else 0.0
    beyond = getattr(field, "beyond", None)
    far = np.empty(0)
    if beyond is not None:
        grid = [*beyond.origin, beyond.spacing, *beyond.distance.shape]
        far = np.concatenate([grid, beyond.distance.reshape(-1)], dtype=np.float64)
    head = [*np.asarray(field.origin, dtype=np.float64), float(field.spacing), outside]
    head += [float(len(planes)), float(margin), *planes.reshape(-1)]
    floats = np.concatenate([head, far], dtype=np.float64)
    distance = np.ascontiguousarray([f.distance for f in fields], dtype=np.float32)
    blocks = np.ascontiguousarray([block_bounds(d, float(field.spacing)) for d in distance])
    return distance, blocks, floats


def wider(world: PackedWorld, extra: float) -> PackedWorld:
    """Return a packed world from which `extra` metres more are to be kept."""
    distance, blocks, floats = world
    floats = floats.copy()
    floats[MARGIN] += extra
    return distance, blocks, floats


def configuration(robot: Any, q: Numbers) -> Configuration:
    """Return a configuration, itself if the kernels can read it; whether it is finite is for a
    verdict to say."""
    if type(q) is np.ndarray and q.dtype == np.float64 and q.shape == (robot.dof,):
        return q if q.flags.carray else q.copy()
    array = joint_values(q, robot, "a configuration")
    if array.shape != (robot.dof,):
        raise _wrong_shape(robot, array, "a configuration", f"({robot.dof},)")
    return array


def configurations(robot: Any, Q: Numbers, finite: bool = False) -> Rows:
    """Return configurations; RobotError if the shape is wrong, or one that must be is not
    finite."""
    array = joint_values(Q, robot, "configurations")
    if array.ndim != 2 or array.shape[1] != robot.dof:
        raise _wrong_shape(robot, array, "configurations", f"(n, {robot.dof})")
    if finite and not np.isfinite(array).all():
        row = int(np.flatnonzero(~np.isfinite(array).all(axis=1))[0])
        raise RobotError(
            f"configuration {row} is {array[row].tolist()}: joint values that are not finite; "
            "give finite ones"
        )
    return array


def waypoints(robot: Any, path: Numbers, single: bool = False) -> Waypoints:
    """Return the waypoints (T, dof), T >= 1, of a path whose motion can be bounded; with `single`,
    take one configuration (dof,) for a path, too.

    Raises:
        RobotError: the shape is wrong, a value is not finite or far beyond any use (angles lose
            their last digits there), or a sliding joint leaves its limits.
    """
    array = joint_values(path, robot, "a path")
    rows = array[None] if single and array.ndim == 1 else array
    if rows.ndim != 2 or rows.shape[1] != robot.dof or len(rows) == 0:
        shapes = f"(T, {robot.dof}), T >= 1" + (f", or ({robot.dof},)" if single else "")
        raise _wrong_shape(robot, array, "a path", shapes)
    near = (np.abs(rows) <= FARTHEST).all(axis=1)
    if not near.all():
        row = int(np.flatnonzero(~near)[0])
        raise RobotError(
            f"waypoint {row} is {rows[row].tolist()}; give finite joint values of at most "
            f"{FARTHEST:g}"
        )
    for j in np.unique(robot.arrays.q_index[robot.arrays.kind == KIND_PRISMATIC]):
        low, high = rows[:, j].min(), rows[:, j].max()
        least, most = robot.lower[j] - LIMIT_TOLERANCE, robot.upper[j] + LIMIT_TOLERANCE
        if not least <= low <= high <= most:
            excess = max(robot.lower[j] - low, high - robot.upper[j])
            raise RobotError(
                f"prismatic joint {robot.joint_names[j]} goes from {low:.4f} to {high:.4f} m, "
                f"outside its limits [{robot.lower[j]:.4f}, {robot.upper[j]:.4f}] m by "
                f"{excess:.3g}; its motion is bounded only within them"
            )
    return rows


def _wrong_shape(robot: Any, array: np.ndarray, what: str, shapes: str) -> RobotError:
    return RobotError(
        f"{what} has shape {array.shape}; {robot.name} needs {shapes}: "
        f"{', '.join(robot.joint_names)}"
    )


def checked_tolerance(tolerance: float) -> float:
    """Return a tolerance, metres of motion; RobotError if it is below a micrometre."""
    return number("tolerance", tolerance, 1e-6, unit="metres of motion", error=RobotError)
