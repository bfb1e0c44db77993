# SPDX-License-Identifier: BSD-3-Clause
"""What an argument must be: each kind is checked here, and nowhere else.

Every check returns the value as what it is used as, or raises the caller's kind of
`VPrismError` that names the argument, its value and what would be valid.
"""

from collections.abc import Iterable
from math import inf
from typing import Any

import numpy as np
from jaxtyping import Float

from vprism_plan.errors import ConfigError, VPrismError

_ORTHONORMAL = 1e-6  # by how much R R^T may differ from the identity, element by element


def is_whole(value: Any) -> bool:
    """Whether it is an integer, also one of numpy's; True and False are not."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def is_number(value: Any) -> bool:
    """Whether it is a real number, also one of numpy's or in an array or tensor of no axes."""
    if is_whole(value) or isinstance(value, float | np.floating):
        return True
    kind = str(getattr(value, "dtype", ""))
    return getattr(value, "ndim", -1) == 0 and ("float" in kind or "int" in kind)


def number(
    name: str,
    value: Any,
    low: float = -inf,
    high: float = inf,
    unit: str = "",
    *,
    above: bool = False,
    below: bool = False,
    finite: bool = True,
    error: type[VPrismError] = ConfigError,
) -> float:
    """Return a number from `low` to `high`, or strictly above or below them."""
    if is_number(value):
        given = float(value)
        inside = (low < given if above else low <= given) and (
            given < high if below else given <= high
        )
        if inside and not (finite and abs(given) == inf):
            return given
    ends = [f"{'above' if above else 'at least'} {low:g}"] if low > -inf else []
    ends += [f"{'below' if below else 'at most'} {high:g}"] if high < inf else []
    wanted = f"a {'finite ' * finite}number {' and '.join(ends)} {unit}".strip()
    raise error(f"{name} is {value!r}; it must be {wanted}")


def whole(
    name: str,
    value: Any,
    low: int = 0,
    high: float = inf,
    *,
    error: type[VPrismError] = ConfigError,
) -> int:
    """Return a whole number from `low` to `high`."""
    if is_whole(value) and low <= value <= high:
        return int(value)
    most = f" and at most {high}" if high < inf else ""
    raise error(f"{name} is {value!r}; it must be a whole number, at least {low}{most}")


def choice(
    name: str, value: Any, valid: Iterable[Any], *, error: type[VPrismError] = ConfigError
) -> Any:
    """Return one of the valid values."""
    options = tuple(valid)
    if value not in options:
        raise error(f"{name} is {value!r}; it must be one of {', '.join(map(repr, options))}")
    return value


def rigid_pose(
    name: str,
    value: Any,
    *,
    tolerance: float = _ORTHONORMAL,
    error: type[VPrismError] = ConfigError,
) -> Float[np.ndarray, "4 4"]:
    """Return a fresh (4, 4) float64 proper rigid transform; errors say how far it is from one.

    The last row, which needs no rounding, is held to a millionth of the tolerance.
    """
    try:
        pose = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as cause:
        raise error(f"{name} is no (4, 4) array of numbers: {cause}") from cause
    if pose.shape != (4, 4):
        raise error(f"{name} has shape {pose.shape}; it must be a rigid transform (4, 4)")
    if not np.isfinite(pose).all():
        raise error(f"{name} holds NaN or infinite values; it must be a rigid transform (4, 4)")
    rotation = pose[:3, :3]
    drift = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    slip = float(np.abs(pose[3] - [0, 0, 0, 1]).max())
    if drift > tolerance or np.linalg.det(rotation) < 0.0 or slip > 1e-6 * tolerance:
        raise error(
            f"{name} is not rigid: its rotation is off orthonormal by {drift:.3g} (at most "
            f"{tolerance:g}), with determinant {np.linalg.det(rotation):.6g} (expected 1) and "
            f"last row {pose[3].tolist()} (expected [0, 0, 0, 1]); remove scale, shear, mirrors"
        )
    return pose
