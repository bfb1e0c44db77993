"""Rays through voxels, one voxel and one ray at a time."""

import numpy as np


def length_inside(a: np.ndarray, b: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> float:
    """Length of the segment from a to b within a box, cut to size plane by plane."""
    near, far = 0.0, 1.0
    for axis in range(3):
        d = b[axis] - a[axis]
        if d == 0.0:
            if not lower[axis] <= a[axis] <= upper[axis]:
                return 0.0
            continue
        t = sorted(((lower[axis] - a[axis]) / d, (upper[axis] - a[axis]) / d))
        near, far = max(near, t[0]), min(far, t[1])
    return max(far - near, 0.0) * float(np.linalg.norm(b - a))


def passed_lengths(
    points: np.ndarray, origin: np.ndarray, lower: np.ndarray, edge: float, shape: tuple
) -> np.ndarray:
    """The longest piece of any segment from the origin to a point in each voxel."""
    longest = np.zeros(shape)
    for index in np.ndindex(*shape):
        corner = lower + edge * np.array(index)
        for point in points:
            piece = length_inside(origin, point, corner, corner + edge)
            longest[index] = max(longest[index], piece)
    return longest


def nearest_classes(classes: np.ndarray, observed: np.ndarray) -> list[set]:
    """For every voxel, the classes of all observed voxels at the smallest distance."""
    where = np.argwhere(observed)
    found = []
    for index in np.ndindex(*classes.shape):
        square = ((where - np.array(index)) ** 2).sum(axis=1)
        nearest = where[square == square.min()]
        found.append({int(classes[tuple(row)]) for row in nearest})
    return found
