# SPDX-License-Identifier: BSD-3-Clause
"""What counts as a number where one is asked for."""

from typing import Any

import numpy as np


def is_whole(value: Any) -> bool:
    """Whether it is an integer, also one of numpy's; True and False are not."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def is_number(value: Any) -> bool:
    """Whether it is a real number, also one of numpy's or in an array or tensor of no axes."""
    if is_whole(value) or isinstance(value, float | np.floating):
        return True
    kind = str(getattr(value, "dtype", ""))
    return getattr(value, "ndim", -1) == 0 and ("float" in kind or "int" in kind)
