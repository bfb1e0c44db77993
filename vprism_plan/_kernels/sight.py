# SPDX-License-Identifier: BSD-3-Clause
"""Compiled lines of sight through many drawn worlds at once, 64 worlds in a word of bits."""

import numpy as np

from vprism_plan._kernels.jit import njit


@njit(cache=True, nogil=True)
def lines_of_sight(
    eyes, points, in_view, solid, corner, spacing, row, bits, first, voxel, gap, sees
):  # fmt: skip
    """Fill sees (views, points, words): bit s is set where nothing stands between in world s.

    Each ray is followed from its point, `gap` metres on, towards the eye (3,), a voxel at a time,
    to where it leaves the grid of `solid`, whose nodes (`spacing` apart from `corner` on) are
    obstacles in all worlds. Voxel i of `row` is centred on voxel * (first + i); a row of `bits`
    (r, words) says in which worlds it is occupied, none below 0. `in_view` (views, points).
    """
    n_words = bits.shape[1]
    step, at = np.empty(3), np.empty(3)
    for v in range(len(eyes)):
        for p in range(len(points)):
            sees[v, p] = 0
            if not in_view[v, p]:
                continue
            length = 0.0
            for a in range(3):
                step[a] = eyes[v, a] - points[p, a]
                length += step[a] ** 2
            length = np.sqrt(length)
            for w in range(n_words):
                sees[v, p, w] = ~np.uint64(0)
            way, left = gap, True
            while way < length and left:
                inside, node, cell = True, True, True
                for a in range(3):
                    at[a] = points[p, a] + step[a] * (way / length)
                    k = round((at[a] - corner[a]) / spacing)
                    node &= 0 <= k < solid.shape[a]
                    inside &= node
                    i = round(at[a] / voxel) - first[a]
                    cell &= 0 <= i < row.shape[a]
                if not inside:
                    break
                if solid[
                    round((at[0] - corner[0]) / spacing),
                    round((at[1] - corner[1]) / spacing),
                    round((at[2] - corner[2]) / spacing),
                ]:
                    sees[v, p] = 0
                    break
                if cell:
                    r = row[
                        round(at[0] / voxel) - first[0],
                        round(at[1] / voxel) - first[1],
                        round(at[2] / voxel) - first[2],
                    ]
                    if r >= 0:
                        left = False
                        for w in range(n_words):
                            sees[v, p, w] &= ~bits[r, w]
                            left |= sees[v, p, w] != 0
                way += voxel
