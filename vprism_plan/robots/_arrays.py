# SPDX-License-Identifier: BSD-3-Clause
"""The flat description of a robot that compiled kernels read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from vprism_plan._read_only import make_read_only

KIND_FIXED = 0
KIND_REVOLUTE = 1
KIND_PRISMATIC = 2


@dataclass(frozen=True, eq=False)
class KinematicArrays:
    """A kinematic tree as C-contiguous float64/int64 arrays, read-only.

    Frame 0 is the robot's base; every other frame belongs to one moving joint,
    parents before children. Fixed joints, and joints locked at a value, are
    merged into the offsets, so a walk over the frames costs one product per
    moving joint. The pose of frame f in the world is

        T_f = T_parent(f) @ [R_off, t_off] @ motion(axis, value),
        value = q_mult * q[q_index] + q_offset       (mimic joints),

    with ``T_0 = [base_R, base_t]``. Metres and radians.

    Attributes:
        base_R: Rotation of the base in the world.
        base_t: Position of the base in the world, metres.
        parent: Parent frame, -1 for frame 0.
        R_off: Joint frame in its parent frame at joint value 0, rotation.
        t_off: The same, translation in metres.
        axis: Unit joint axis in the joint frame.
        kind: 0 fixed (only frame 0), 1 revolute or continuous, 2 prismatic.
        q_index: Index into the configuration, -1 for frame 0.
        q_mult: Factor on the configuration value (1 unless the joint mimics).
        q_offset: Offset added to it (0 unless the joint mimics).
        sphere_frame: Frame each sphere moves with.
        sphere_center: Centre in that frame, metres.
        sphere_radius: Radius, metres. Spheres are sorted by (link, radius
            falling), so the spheres of a link are contiguous.
        sphere_link: Index into the robot's ``link_names``.
        link_start: Link l owns the spheres ``link_start[l]:link_start[l + 1]``.
        link_frame: Frame each link moves with.
        link_center: Centre of a ball that holds all spheres of the link.
        link_radius: Radius of that ball.
        link_fixed: True where no joint moves the link.
        link_padding: Metres of each link's radii that are padding. They count against the
            world; a pair's gap is that of its spheres plus the padding of both links.
        pairs: Link pairs (first < second) to test for self-collision.
        lower: Lower joint limits; -pi for continuous joints.
        upper: Upper joint limits; +pi for continuous joints.
        continuous: True where the joint turns without limit.
    """

    base_R: Float[np.ndarray, "3 3"]  # noqa: N815
    base_t: Float[np.ndarray, "3"]
    parent: Int[np.ndarray, "frames"]
    R_off: Float[np.ndarray, "frames 3 3"]
    t_off: Float[np.ndarray, "frames 3"]
    axis: Float[np.ndarray, "frames 3"]
    kind: Int[np.ndarray, "frames"]
    q_index: Int[np.ndarray, "frames"]
    q_mult: Float[np.ndarray, "frames"]
    q_offset: Float[np.ndarray, "frames"]
    sphere_frame: Int[np.ndarray, "spheres"]
    sphere_center: Float[np.ndarray, "spheres 3"]
    sphere_radius: Float[np.ndarray, "spheres"]
    sphere_link: Int[np.ndarray, "spheres"]
    link_start: Int[np.ndarray, "links_plus_one"]
    link_frame: Int[np.ndarray, "links"]
    link_center: Float[np.ndarray, "links 3"]
    link_radius: Float[np.ndarray, "links"]
    link_fixed: Bool[np.ndarray, "links"]
    link_padding: Float[np.ndarray, "links"]
    pairs: Int[np.ndarray, "pairs 2"]
    lower: Float[np.ndarray, "dof"]
    upper: Float[np.ndarray, "dof"]
    continuous: Bool[np.ndarray, "dof"]

    def __post_init__(self) -> None:
        """Keep users of the robot's limits and radii from changing those of every checker."""
        make_read_only(self.__dict__)

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        make_read_only(state)
