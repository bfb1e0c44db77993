# SPDX-License-Identifier: BSD-3-Clause
"""Which joints a configuration has, where the others are locked, where the base stands."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from vprism_plan.errors import RobotError
from vprism_plan.robots._model import RobotModel
from vprism_plan.robots._srdf import SemanticModel

ARM_GROUP = "arm"


def choose_joints(
    model: RobotModel,
    semantics: SemanticModel,
    joints: Sequence[str] | None,
    group: str | None = None,
) -> tuple[str, ...]:
    """The joints of a configuration: given, of the group, of the group "arm", or else all."""
    valid = model.actuated
    if group is not None:
        if joints is not None:
            raise RobotError(f"both joints and the group {group!r} are given; give one of them")
        joints = [name for name in semantics.groups.get(group, ()) if name in valid]
        if not joints:
            raise RobotError(
                f"the SRDF of '{model.name}' has no group {group!r} with joints that move; "
                f"groups: {sorted(semantics.groups)}"
            )
    if joints is None:
        arm = [name for name in semantics.groups.get(ARM_GROUP, ()) if name in valid]
        chosen = tuple(arm) or valid
    elif isinstance(joints, str):
        raise RobotError(f"joints is the string {joints!r}; give a sequence of joint names")
    else:
        chosen = tuple(joints)
    unknown = [name for name in chosen if name not in valid]
    if unknown:
        raise RobotError(f"unknown or non-actuated joints {unknown}; valid: {list(valid)}")
    if len(set(chosen)) != len(chosen):
        raise RobotError(f"joints {list(chosen)} names a joint twice")
    if not chosen:
        raise RobotError(f"no joint of '{model.name}' moves; a robot needs at least one")
    return chosen


def lock_values(
    model: RobotModel,
    semantics: SemanticModel,
    active: Sequence[str],
    given: Mapping[str, float],
) -> dict[str, float]:
    """The value of every actuated joint that is not in the configuration."""
    rest = [name for name in model.actuated if name not in active]
    unknown = sorted(set(given) - set(rest))
    if unknown:
        raise RobotError(f"locked names {unknown}; joints that can be locked here: {rest}")
    values = {}
    for name in rest:
        joint = model.joint_map[name]
        stated = semantics.state_value(name)
        if name in given:
            value = float(given[name])
        elif stated is not None:
            value = stated
        else:
            value = min(max(0.0, joint.lower), joint.upper)
        within = joint.kind == "continuous" or joint.lower <= value <= joint.upper
        if not (math.isfinite(value) and within):
            raise RobotError(
                f"joint '{name}' is locked at {value}; its limits are "
                f"[{joint.lower:.6g}, {joint.upper:.6g}]"
            )
        values[name] = value
    return values


def rigid_pose(pose: ArrayLike, what: str = "base_pose") -> Float[np.ndarray, "4 4"]:
    """A copy of a pose, refused unless it is a proper rigid motion."""
    try:
        T = np.array(pose, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise RobotError(f"{what} is not a (4, 4) array: {error}") from error
    if T.shape != (4, 4):
        raise RobotError(f"{what} has shape {T.shape}; expected (4, 4)")
    if not np.isfinite(T).all():
        raise RobotError(f"{what} holds NaN or infinite values; give a rigid 4x4 pose")
    R = T[:3, :3]
    drift = float(np.abs(R @ R.T - np.eye(3)).max())
    if drift > 1e-6 or np.linalg.det(R) < 0 or not np.array_equal(T[3], [0, 0, 0, 1]):
        raise RobotError(
            f"{what} is not rigid: its rotation is off orthonormal by {drift:.3g}, with "
            f"determinant {np.linalg.det(R):.6g} (expected 1) and last row {T[3].tolist()} "
            "(expected [0, 0, 0, 1])"
        )
    return T
