# SPDX-License-Identifier: BSD-3-Clause
"""Arrays that are handed out are not to be changed by who gets them."""

from typing import Any

import numpy as np


def make_read_only(values: dict[str, Any]) -> None:
    """Make every array among the values, or one table deep in them, refuse in-place changes.

    Pickling and deepcopy forget it: call this from `__setstate__`, too. What goes to kernels
    must stay writeable: to numba, a read-only array is a type of its own, for which every
    kernel is compiled again.
    """
    for value in values.values():
        inner = value.values() if isinstance(value, dict) else (value,)
        for array in inner:
            if isinstance(array, np.ndarray):
                array.setflags(write=False)
