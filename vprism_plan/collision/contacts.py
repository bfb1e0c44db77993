# SPDX-License-Identifier: BSD-3-Clause
"""Which link may touch which object."""

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from jaxtyping import Int


def contact_rules(
    robot: Any, allowed: Mapping[str, Collection[int]]
) -> tuple[list[frozenset[int]], Int[np.ndarray, " links"]]:
    """Turn allowed contacts into distinct rules.

    Args:
        robot: whose links and groups are named: has `link_names`, and `links_of(name)` as
            `vprism_plan.robots.Robot` does.
        allowed: link or SRDF group -> ids of the objects it may touch; what several
            entries say of one link adds up.

    Returns:
        The sets of objects that may be touched, the empty one first, and the index of the
        set that holds for each link.

    Raises:
        RobotError: no such link or group.
    """
    names = list(robot.link_names)
    per_link: list[set[int]] = [set() for _ in names]
    for name, ids in allowed.items():
        for link in robot.links_of(name):
            per_link[names.index(link)].update(int(i) for i in ids)
    rules = [frozenset[int]()]
    index = np.zeros(len(names), dtype=np.int64)
    for number, own in enumerate(map(frozenset, per_link)):
        if own not in rules:
            rules.append(own)
        index[number] = rules.index(own)
    return rules, index
