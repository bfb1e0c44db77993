# SPDX-License-Identifier: BSD-3-Clause
"""A plane, the plane through points, and which part of one was seen."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import ConvexHull

from vprism_plan._read_only import ReadOnly
from vprism_plan._shapes import Chosen, Points, Pose, Values, Vector
from vprism_plan.errors import ObservationError, PlaneNotFoundError

_CELL, _REGION_CELL = 0.04, 0.02  # metres, of an extent and of a table top
_BRIDGE = 5  # cells: gaps in the visible table (objects and their shadows) do not split it
_MAX_CELLS, _MIN_PATCH = 1000, 0.2


@dataclass(frozen=True, eq=False)
class Plane(ReadOnly):
    """The plane {x : normal . x = offset}; the normal points to the side of the camera.

    Attributes:
        normal: (3,) unit vector, read-only; one of another length is scaled, with its offset.
        offset: metres along the normal.

    Raises:
        ObservationError: the normal is no finite, non-zero 3-vector, or the offset not finite.
    """

    normal: Any
    offset: float

    def __post_init__(self) -> None:
        normal = np.array(self.normal, dtype=np.float64)
        offset = float(self.offset)
        if normal.shape != (3,) or not np.isfinite(normal).all() or not np.isfinite(offset):
            found = f"plane normal {normal.tolist()} and offset {offset}"
            raise ObservationError(f"{found} must be a finite 3-vector and finite metres")
        length = float(np.linalg.norm(normal))
        if length < 1e-9:
            raise ObservationError("plane normal is zero; it must point away from the surface")
        object.__setattr__(self, "normal", normal / length)
        object.__setattr__(self, "offset", offset / length)
        super().__post_init__()

    def signed_distance(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch"]:
        """Height of points above the plane, metres; negative on the far side."""
        return np.asarray(np.asarray(points, dtype=np.float64) @ self.normal - self.offset)

    def project(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Foot of the perpendicular from every point to the plane."""
        points = np.asarray(points, dtype=np.float64)
        return points - self.signed_distance(points)[..., None] * self.normal

    def transformed(self, transform: Pose) -> "Plane":
        """Return the same plane seen from another frame: `T_a_b` maps a plane in b to a."""
        normal = transform[:3, :3] @ self.normal
        return Plane(normal, self.offset + float(normal @ transform[:3, 3]))

    def axes(self) -> Float[np.ndarray, "2 3"]:
        """Return two orthonormal directions in the plane; with the normal they are right-handed."""
        helper = np.eye(3)[int(np.argmin(np.abs(self.normal)))]
        first = np.cross(helper, self.normal)
        first /= np.linalg.norm(first)
        return np.stack([first, np.cross(self.normal, first)])


# ----------------------------------------------------------------------------- through points
def facing(normal: Vector, offset: float) -> Plane:
    """Return the plane with its normal on the side of the origin (the camera)."""
    return Plane(normal, offset) if offset <= 0 else Plane(-normal, -offset)


def least_squares_plane(points: Points, weights: Values) -> Plane:
    """Plane of least weighted squared distance; normal towards the origin."""
    total = weights.sum()
    mean = weights @ points / total
    centred = points - mean
    covariance = (centred * weights[:, None]).T @ centred / total
    normal = np.linalg.eigh(covariance)[1][:, 0]
    return facing(normal, float(normal @ mean))


def refine(plane: Plane, points: Points, band: Values) -> Plane:
    """Refit to the points in the band, by 1 / band^2, until the set no longer changes."""
    inliers = np.abs(plane.signed_distance(points)) < band
    for _ in range(20):
        if inliers.sum() < 3:
            return plane
        plane = least_squares_plane(points[inliers], 1.0 / band[inliers] ** 2)
        updated = np.abs(plane.signed_distance(points)) < band
        if np.array_equal(updated, inliers):
            break
        inliers = updated
    return plane


# ----------------------------------------------------------------------------- what was seen
def in_grid(grid: Bool[np.ndarray, "r c"], cells: Int[np.ndarray, "n 2"]) -> Chosen:
    """Which cells lie in a grid and are marked there."""
    inside = np.asarray(((cells >= 0) & (cells < grid.shape)).all(axis=1))
    inside[inside] = grid[tuple(cells[inside].T)]
    return inside


def over_extent(plane: Plane, on_plane: Points, others: Points, grown: bool = True) -> Chosen:
    """Which of `others` have their foot on the plane's visible extent.

    That is a grid of 4 cm cells that hold a point of the plane. `grown`, it is closed over gaps
    of 12 cm and one cell wider: the foot and the shadow of an object are not visible.
    """
    if not len(on_plane):
        return np.zeros(len(others), dtype=bool)
    axes = plane.axes()
    cells = np.floor(on_plane @ axes.T / _CELL).astype(np.int64)
    lower = cells.min(axis=0) - 4
    # Far strays of a distant floor could span a huge grid: cells are kept within 10 m.
    upper = np.minimum(cells.max(axis=0) + 5, lower + int(10.0 / _CELL))
    grid = np.zeros(upper - lower, dtype=bool)
    grid[tuple((cells[((cells >= lower) & (cells < upper)).all(axis=1)] - lower).T)] = True
    if grown:
        grid = ndimage.binary_dilation(ndimage.binary_closing(grid, iterations=3))
    return in_grid(grid, np.floor(others @ axes.T / _CELL).astype(np.int64) - lower)


@dataclass(frozen=True, eq=False)
class TableRegion:
    """The convex hull of the visible table top, in the plane's own axes."""

    axes: Float[np.ndarray, "2 3"]
    halfplanes: Float[np.ndarray, "f 3"]  # (a, b, c): a x + b y + c <= 0 inside, (a, b) unit

    def contains(self, points: Points, margin: float = 0.0) -> Chosen:
        """Whether the foot of a point lies on the table top, or within `margin` metres of it."""
        flat = points @ self.axes.T
        inside = np.ones(len(flat), dtype=bool)
        for a, b, c in self.halfplanes:
            inside &= flat @ np.array([a, b]) + c <= margin
        return inside


def table_region(plane: Plane, on_plane: Points) -> TableRegion:
    """Return the region covered by points on the plane, strays of other surfaces left out.

    A chair seat or a second desk may lie in the same plane: of the patches more than 10 cm
    apart, those with less than a fifth of the largest one's points are left out. So are strips
    thinner than 6 cm, where a chair's back beside the table passes through the plane.

    Raises:
        PlaneNotFoundError: the points cover no patch of 6 cm x 6 cm.
    """
    axes = plane.axes()
    flat = on_plane @ axes.T
    centre = np.median(flat, axis=0)
    cells = np.floor((flat - centre) / _REGION_CELL).astype(np.int64) + _MAX_CELLS // 2
    cells = cells[((cells >= 0) & (cells < _MAX_CELLS)).all(axis=1)]
    lower = cells.min(axis=0) - _BRIDGE
    grid = np.zeros(cells.max(axis=0) - lower + _BRIDGE + 1, dtype=bool)
    grid[tuple((cells - lower).T)] = True
    grid &= ndimage.binary_opening(ndimage.binary_closing(grid), np.ones((3, 3), dtype=bool))
    if not grid.any():
        raise PlaneNotFoundError(
            "the points on the support plane cover no patch of 6 cm x 6 cm; is it the right plane?"
        )
    patches, count = ndimage.label(ndimage.binary_closing(grid, iterations=_BRIDGE))
    patches[~grid] = 0
    pixels = np.bincount(patches[tuple((cells - lower).T)], minlength=count + 1)
    kept = grid & (pixels >= _MIN_PATCH * pixels.max())[patches]
    corners = (np.argwhere(kept) + lower - _MAX_CELLS // 2)[:, None] + list(np.ndindex(2, 2))
    hull = ConvexHull(corners.reshape(-1, 2) * _REGION_CELL + centre)
    return TableRegion(axes, np.asarray(hull.equations))
