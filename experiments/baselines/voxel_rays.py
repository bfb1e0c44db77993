# SPDX-License-Identifier: BSD-3-Clause
"""Compiled kernel of the voxel baseline: which voxels rays pass through."""

import math

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def mark_passed(  # noqa: PLR0912
    points: np.ndarray, origin: np.ndarray, lower: np.ndarray, edge: float, passed: np.ndarray
) -> None:
    """Mark every voxel that a segment from `origin` to a point enters.

    Voxel (i, j, k) spans `edge` from lower + edge * (i, j, k). The walk crosses one face
    at a time, the nearest first (Amanatides and Woo, "A fast voxel traversal algorithm
    for ray tracing", Eurographics 1987).
    """
    shape = passed.shape
    direction = np.empty(3)
    entry = np.empty(3)
    crossing = np.empty(3)
    stride = np.empty(3)
    cell = np.empty(3, np.int64)
    step = np.empty(3, np.int64)
    for r in range(len(points)):
        # The part of the segment, t in [near, far], that lies in the grid.
        near, far = 0.0, 1.0
        for a in range(3):
            entry[a] = (origin[a] - lower[a]) / edge
            direction[a] = (points[r, a] - origin[a]) / edge
            if direction[a] == 0.0:
                if entry[a] < 0.0 or entry[a] >= shape[a]:
                    far = -1.0
                continue
            t0 = -entry[a] / direction[a]
            t1 = (shape[a] - entry[a]) / direction[a]
            near = max(near, min(t0, t1))
            far = min(far, max(t0, t1))
        if near >= far:
            continue
        for a in range(3):
            at = entry[a] + near * direction[a]
            cell[a] = min(max(math.floor(at), 0), shape[a] - 1)
            if direction[a] > 0.0:
                step[a] = 1
                crossing[a] = (cell[a] + 1 - entry[a]) / direction[a]
                stride[a] = 1.0 / direction[a]
            elif direction[a] < 0.0:
                step[a] = -1
                crossing[a] = (cell[a] - entry[a]) / direction[a]
                stride[a] = -1.0 / direction[a]
            else:
                step[a] = 0
                crossing[a] = np.inf
                stride[a] = np.inf
        while True:
            passed[cell[0], cell[1], cell[2]] = True
            a = 0
            if crossing[1] < crossing[0]:
                a = 1
            if crossing[2] < crossing[a]:
                a = 2
            if crossing[a] >= far:
                break
            cell[a] += step[a]
            if cell[a] < 0 or cell[a] >= shape[a]:
                break
            crossing[a] += stride[a]
