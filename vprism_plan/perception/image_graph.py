# SPDX-License-Identifier: BSD-3-Clause
"""Depth images as graphs: which neighbouring pixels lie on one surface.

Two neighbours do if their depth differs by no more than an oblique surface explains, with the
sensor's noise on top. All is local to the image: a few array passes, no 3-D search.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from vprism_plan._shapes import Image, Indices, Matrix, Pixels
from vprism_plan.perception.camera import stereo_noise

# Offsets (rows, columns) of half of the eight neighbours; the other half is symmetric.
_HALF = ((0, 1), (1, 0), (1, 1), (1, -1))
# Slant (degrees) beyond which neighbours count as a jump. A pixel is deleted only where no
# sensor would return anything from a surface; a cut is cheap, since what it cuts off goes
# back to the nearest cluster, so it may come sooner and catch the mild ramps too.
_LINK_SLANT, _FLYING_SLANT, _CUT_SLANT = 75.0, 78.0, 70.0
_MAX_RAMP = 3
# Along a step in depth between two objects height changes too; on a table top or the
# lid of a box it does not, however obliquely it is seen.
_LEVEL = 0.15

Slices = tuple[slice, slice]


@dataclass(frozen=True, eq=False)
class SurfaceImage:
    """What the pixel graph needs to know of a view."""

    depth: Image  # metres, 0 = no return
    height: Image  # metres above the support plane, any value where there is no return
    pitch: Image  # metres between neighbouring pixels on a surface that faces the camera

    def pairs(
        self, reach: int, slant: float
    ) -> Iterator[tuple[Slices, Slices, np.ndarray, np.ndarray]]:
        """Yield, for each of four directions, pixel pairs `reach` pixels apart.

        That is slices of the first and second pixel, whether both have a return, and -1, 0 or 1
        for a jump towards the camera, none, or away.
        """
        rows, cols = self.depth.shape
        for unit_row, unit_col in _HALF:
            dr, dc = unit_row * reach, unit_col * reach
            here = (slice(0, rows - dr), slice(max(0, -dc), cols - max(0, dc)))
            there = (slice(dr, rows), slice(max(0, dc), cols - max(0, -dc)))
            valid = (self.depth[here] > 0) & (self.depth[there] > 0)
            change = self.depth[there] - self.depth[here]
            nearer = np.minimum(self.depth[here], self.depth[there])
            pitch = np.minimum(self.pitch[here], self.pitch[there])
            per_pitch = float(np.hypot(dr, dc) * np.tan(np.radians(slant)))
            explained = per_pitch * pitch + 2.0 * stereo_noise(nearer)
            rise = np.abs(self.height[there] - self.height[here])
            jump = valid & (np.abs(change) > explained) & (rise > _LEVEL * np.abs(change))
            yield here, there, valid, np.where(jump, np.sign(change), 0.0).astype(np.int8)


def surface_image(depth: Image, intrinsics: Matrix, height: Image) -> SurfaceImage:
    """Prepare a view for the functions of this module."""
    depth = np.asarray(depth, dtype=np.float64)
    return SurfaceImage(depth, height, depth / min(intrinsics[0, 0], intrinsics[1, 1]))


def graph_edges(image: SurfaceImage, mask: Pixels) -> tuple[Indices, Indices]:
    """Return the edges between neighbours of `mask`, counted row by row, on one surface."""
    index = np.cumsum(mask.ravel()).reshape(mask.shape) - 1
    starts, ends = [], []
    for here, there, valid, step in image.pairs(1, _LINK_SLANT):
        linked = mask[here] & mask[there] & valid & (step == 0)
        starts.append(index[here][linked])
        ends.append(index[there][linked])
    return np.concatenate(starts), np.concatenate(ends)


def components(count: int, start: Indices, end: Indices) -> Indices:
    """Number the connected components of a graph, from 0."""
    graph = coo_matrix((np.ones(len(start), dtype=bool), (start, end)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def flying_pixels(image: SurfaceImage) -> Pixels:
    """Find pixels that hang in the air between a near and a far surface.

    Stereo and time-of-flight cameras blend the two sides of an edge into a short ramp along the
    line of sight: in some direction depth jumps the same way on both sides of such a pixel. A
    ramp of more than three pixels may be the side of a box seen at a glancing angle and stays.
    A pixel with fewer than two of its eight neighbours on its own surface counts too.
    """
    shape = image.depth.shape
    near, ramp = np.zeros(shape, dtype=np.int8), np.zeros(shape, dtype=bool)
    diagonal = np.eye(_MAX_RAMP + 1, dtype=bool)
    row = np.ones((1, _MAX_RAMP + 1), dtype=bool)
    lines = (row, row.T, diagonal, diagonal[:, ::-1])  # along the directions of `_HALF`
    pairs = image.pairs(1, _FLYING_SLANT)
    for (here, there, valid, step), line in zip(pairs, lines, strict=True):
        close = valid & (step == 0)
        near[here] += close
        near[there] += close
        ahead, behind = np.zeros((2, *shape), dtype=np.int8)
        ahead[here], behind[there] = step, step
        steep = (ahead != 0) & (ahead == behind)
        ramp |= steep & ~ndimage.binary_opening(steep, structure=line)
    return np.asarray((image.depth > 0) & (ramp | (near < 2)))


def jump_pixels(image: SurfaceImage, reach: int = 2) -> Pixels:
    """Find the pixels within `reach` of a jump in depth: edges, and all but the mildest ramps."""
    jumps = np.zeros(image.depth.shape, dtype=bool)
    for here, there, _, step in image.pairs(reach, _CUT_SLANT):
        jumps[here] |= step != 0
        jumps[there] |= step != 0
    return jumps


def specks(image: SurfaceImage, mask: Pixels, max_pixels: int, max_area: float) -> Pixels:
    """Find pieces of `mask` that no surface continues: few pixels and a tiny area (m^2)."""
    piece = components(int(mask.sum()), *graph_edges(image, mask))
    area = np.bincount(piece, weights=image.pitch[mask] ** 2)
    small = (np.bincount(piece) <= max_pixels) & (area <= max_area)
    result = np.zeros(mask.shape, dtype=bool)
    result[mask] = small[piece]
    return result
