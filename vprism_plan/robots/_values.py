# SPDX-License-Identifier: BSD-3-Clause
"""Joint values as people write them, turned into arrays for kernels."""

from typing import Any

import numpy as np
from jaxtyping import Float

from vprism_plan.errors import RobotError


def joint_values(values: Any, robot: Any, what: str) -> Float[np.ndarray, "..."]:
    """Return joint values as a fresh float64 array, C-contiguous and writeable.

    A copy even of what is such an array: numba would compile its kernels once more for a
    read-only one. Neither the shape nor that values are finite is looked at.

    Args:
        values: an array, a tensor, a list or a tuple of real numbers.
        robot: whose joints the message names.
        what: for the message, with its article.

    Raises:
        RobotError: they are not real numbers, ragged, too large for a float, masked, or a
            tensor that requires a gradient.
    """
    if type(values) is np.ndarray and values.dtype == np.float64:
        return values.copy(order="C")
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
