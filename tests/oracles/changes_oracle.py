# SPDX-License-Identifier: BSD-3-Clause
"""What one view says of what another shows, point by point and pixel by pixel."""

import numpy as np

from vprism_plan.perception.camera import depth_sigma

MARGIN, AROUND = 0.015, 3  # metres in front of a surface; pixels to each side


def pixel_of(view, point):
    """Row, column and depth (m) of a point in a view's image, or None outside of it."""
    x, y, z = (np.linalg.inv(view.pose) @ [*point, 1.0])[:3]
    if z <= 0.01:
        return None
    K = view.intrinsics
    column, row = round(K[0, 0] * x / z + K[0, 2]), round(K[1, 1] * y / z + K[1, 2])
    if not (0 <= row < view.shape[0] and 0 <= column < view.shape[1]):
        return None
    return row, column, z


def is_free(view, point):
    """Whether a view says that a point (m) is free: its ray is, at least as far as that."""
    at = pixel_of(view, point)
    return at is not None and bool(view.free_depth[at[:2]] > at[2])


def looked_through(view, point):
    """Whether all that a view shows around a point (m) lies clearly behind it."""
    at = pixel_of(view, point)
    if at is None:
        return False
    row, column, z = at
    for v in range(max(0, row - AROUND), min(view.shape[0], row + AROUND + 1)):
        for u in range(max(0, column - AROUND), min(view.shape[1], column + AROUND + 1)):
            if not view.depth[v, u] > z + MARGIN + 3.0 * depth_sigma(np.array([z]))[0]:
                return False
    return True


def share_looked_through(view, other, label, step=5):
    """Share of what another view shows of an object that a view looks through."""
    found = []
    points = other.point_image()
    for v in range(0, view.shape[0], step):
        for u in range(0, view.shape[1], step):
            if other.labels[v, u] == label and other.depth[v, u] > 0:
                found.append(looked_through(view, points[v, u]))
    return float(np.mean(found)) if found else 0.0


def is_behind(view, mask, point):
    """Whether a point (m) lies behind what some pixels of a view show."""
    at = pixel_of(view, point)
    return at is not None and bool(mask[at[:2]] and 0 < view.depth[at[:2]] <= at[2])
