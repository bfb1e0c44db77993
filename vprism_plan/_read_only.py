# SPDX-License-Identifier: BSD-3-Clause
"""Arrays that are handed out are not to be changed by who gets them."""

from typing import Any

import numpy as np


class ReadOnly:
    """Makes every array among a dataclass's values, or one table deep in them, refuse changes.

    What goes to kernels must stay writeable: to numba, a read-only array is a type of its own,
    for which every kernel is compiled again.
    """

    def __post_init__(self) -> None:
        for value in self.__dict__.values():
            for array in value.values() if isinstance(value, dict) else (value,):
                if isinstance(array, np.ndarray):
                    array.setflags(write=False)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Pickling and deepcopy forget it."""
        self.__dict__.update(state)
        ReadOnly.__post_init__(self)
