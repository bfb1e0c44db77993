# SPDX-License-Identifier: BSD-3-Clause
"""Tell objects that touch apart: things on a table are hills with valleys between them."""

import numpy as np
from jaxtyping import Float, Int

from vprism_plan.perception._image_graph import components

_STEP = 0.005
# A summit must rise this much over the pass to its neighbour: in metres, and as a share of
# its height above the table. Rims, knobs and handles do not.
_PROMINENCE = 0.022
_RELATIVE_PROMINENCE = 0.25


def split_at_valleys(
    height: Float[np.ndarray, " n"],
    area: Float[np.ndarray, " n"],
    start: Int[np.ndarray, " m"],
    end: Int[np.ndarray, " m"],
    min_area: float,
) -> Int[np.ndarray, " n"]:
    """Number the hills of a graph of pixels, 0 = in a valley (belongs to the nearest hill).

    The graph is flooded from below in steps of 5 mm. Where what is still above water
    falls apart into two pieces or more, each prominent and of at least `min_area`, they are
    different objects; a piece that is neither is part of the same hill.

    Args:
        height: metres above the table.
        area: square metres that each pixel stands for.
        start: first pixel of each edge.
        end: second pixel of each edge.
        min_area: smallest visible area of a hill, square metres.
    """
    hills = np.zeros(len(height), dtype=np.int64)
    piece = components(len(height), start, end)
    found = 0
    divisible = np.bincount(piece, weights=area) >= 2.0 * min_area
    for nodes in _groups(piece):
        if divisible[piece[nodes[0]]]:
            found = _flood(hills, found, nodes, height, area, start, end, min_area)
        else:
            found += 1
            hills[nodes] = found
    return hills


def _groups(piece: Int[np.ndarray, " n"]) -> list[np.ndarray]:
    """Return the members of every piece, largest first."""
    order = np.argsort(piece, kind="stable")
    cuts = np.flatnonzero(np.diff(piece[order])) + 1
    return sorted(np.split(order, cuts), key=len, reverse=True) if len(piece) else []


def _flood(
    hills: np.ndarray,
    found: int,
    nodes: np.ndarray,
    height: np.ndarray,
    area: np.ndarray,
    start: np.ndarray,
    end: np.ndarray,
    min_area: float,
) -> int:
    """Mark the hills of one connected piece in `hills`; return how many there are by now."""
    inside = np.zeros(len(height), dtype=bool)
    inside[nodes] = True
    within = inside[start] & inside[end]
    stack = [(nodes, start[within], end[within])]
    while stack:
        members, first, second = stack.pop()
        parts = _fall_apart(members, height, area, first, second, min_area)
        if len(parts) < 2:
            found += 1
            hills[members] = found
            continue
        for part in parts:
            inside[:] = False
            inside[part] = True
            within = inside[first] & inside[second]
            stack.append((part, first[within], second[within]))
    return found


def _fall_apart(
    members: np.ndarray,
    height: np.ndarray,
    area: np.ndarray,
    start: np.ndarray,
    end: np.ndarray,
    min_area: float,
) -> list[np.ndarray]:
    """Raise the water until two or more prominent pieces are left; [] if that never happens."""
    heights = height[members]
    number = np.empty(len(height), dtype=np.int64)
    for level in np.arange(heights.min() + _STEP, heights.max() - _PROMINENCE, _STEP):
        dry = members[heights >= level]
        number[dry] = np.arange(len(dry))
        above = (height[start] >= level) & (height[end] >= level)
        start, end = start[above], end[above]
        piece = components(len(dry), number[start], number[end])
        size = np.bincount(piece, weights=area[dry])
        if (size >= min_area).sum() < 2:
            continue
        prominent = []
        for part in np.flatnonzero(size >= min_area):
            nodes = dry[piece == part]
            summit = float(np.percentile(height[nodes], 95.0))
            if summit - level >= max(_PROMINENCE, _RELATIVE_PROMINENCE * summit):
                prominent.append(nodes)
        if len(prominent) > 1:
            return prominent
    return []
