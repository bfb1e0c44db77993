# SPDX-License-Identifier: BSD-3-Clause
"""What a view would show of a motion in one world: voxel by voxel, step by step."""

from itertools import product

import numpy as np


def dense_worlds(worlds, lower, upper):
    """First voxel of a box (m), and which of its voxels are occupied in which world."""
    first = np.floor(np.asarray(lower) / worlds.resolution).astype(int)
    last = np.ceil(np.asarray(upper) / worlds.resolution).astype(int)
    index = np.array(list(product(*(range(a, b + 1) for a, b in zip(first, last, strict=True)))))
    return first, (worlds.owners(index) > 0).reshape(*(last - first + 1), -1)


def free_way(point, eye, first, occupied, voxel, grid):
    """Whether nothing stands on the way from a voxel's neighbours to the eye or out of the grid."""
    away = np.asarray(eye) - point
    length = np.sqrt((away**2).sum())
    way = 1.25 * voxel
    while way < length:
        at = point + away * (way / length)
        node = [round((at[a] - grid.origin[a]) / grid.spacing) for a in range(3)]
        if not all(0 <= k < n for k, n in zip(node, grid.distance.shape, strict=True)):
            return True
        cell = [round(at[a] / voxel) - first[a] for a in range(3)]
        if (
            all(0 <= k < n for k, n in zip(cell, occupied.shape, strict=True))
            and (occupied[tuple(cell)])
        ):
            return False
        way += voxel
    return True


def in_image(point, pose, intrinsics, shape):
    """Whether a camera's image holds a point."""
    local = np.linalg.inv(pose) @ [*point, 1.0]
    u, v = (intrinsics @ local[:3])[:2] / local[2]
    within = -0.5 <= u <= shape[1] - 0.5 and -0.5 <= v <= shape[0] - 0.5
    return local[2] > 0.05 and within


def shown(balls, view, intrinsics, shape, first, occupied, voxel, grid):
    """Whether a view shows an occupied voxel within half a voxel of any ball (x, y, z, r)."""
    points = voxel * (np.argwhere(occupied) + first)
    for point in points:
        inside = np.linalg.norm(balls[:, :3] - point, axis=1) <= balls[:, 3] + 0.5 * voxel
        if not inside.any() or not in_image(point, view, intrinsics, shape):
            continue
        if free_way(point, view[:3, 3], first, occupied, voxel, grid):
            return True
    return False
