# SPDX-License-Identifier: BSD-3-Clause
"""Spheres that hold a mesh: what a gripper carries is rarely a box."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from vprism_plan._files import reading
from vprism_plan.errors import RobotError
from vprism_plan.robots._xml import refuse_growing_scene

_logger = logging.getLogger(__name__)
# Cells along the longest edge of the mesh's box (the cover's own error is one cell), and
# for thin shapes, which fill few of them, as many more as make about this many.
_CELLS = 20
_MOST_CELLS = 60
_ENOUGH = 3000
_CANDIDATES = 1000
_CHUNK = 20_000
# Nothing an arm carries is longer, metres: such a mesh is in millimetres.
_MAX_EXTENT = 5.0
MOST_BYTES = 2**26  # of a mesh file: 64 MiB, or 1.3 million triangles as STL
_MOST_TRIANGLES = 10_000_000
# trimesh also reads archives and formats of its own, which stand for more than they hold.
_FORMATS = (".stl", ".obj", ".dae", ".ply", ".off", ".glb", ".gltf")


def read_scene(path: Path) -> Any:
    """What a mesh file holds, as a ``trimesh.Scene``; call it inside of `reading`.

    Raises:
        RobotError: Another format, or more triangles than any link has. Else whatever the
            format's reader raises.
    """
    import trimesh

    format = path.suffix.lower()
    if format not in _FORMATS:
        raise RobotError(
            f"'{path}' is a mesh of format {format!r}; formats that are read: {', '.join(_FORMATS)}"
        )
    if format == ".dae":
        refuse_growing_scene(path)
    # Processing would cut out vertices that are not finite, and their faces, in silence.
    scene = trimesh.load_scene(path, process=False)
    sizes = {name: len(getattr(part, "faces", ())) for name, part in scene.geometry.items()}
    count = sum(sizes[scene.graph[node][1]] for node in scene.graph.nodes_geometry)
    if count > _MOST_TRIANGLES:
        raise RobotError(f"'{path}' has {count:,} triangles; at most {_MOST_TRIANGLES:,} are read")
    return scene


def read_triangles(
    mesh: Any, what: str, max_extent: float = _MAX_EXTENT
) -> Float[np.ndarray, "f 3 3"]:
    """Triangles of a mesh or of a mesh file, metres.

    Args:
        mesh: A ``trimesh.Trimesh``, or the path of a file that trimesh reads.
        what: Whose mesh it is, for messages.
        max_extent: Metres; what is longer is not in metres.

    Raises:
        RobotError: There is no such file, it holds no triangles, a vertex is not finite,
            or it is larger than `max_extent`.
    """
    if isinstance(mesh, str | Path):
        path = Path(mesh)
        if not path.is_file():
            raise RobotError(f"{what}: no mesh file at '{path}'; give an existing file")
        with reading(path, f"a usable mesh of {what}", RobotError, MOST_BYTES):
            return read_triangles(read_scene(path).to_mesh(), f"{what}, '{path}'", max_extent)
    vertices = np.asarray(getattr(mesh, "vertices", ()), dtype=np.float64)
    faces = np.asarray(getattr(mesh, "faces", ()))
    if len(vertices) == 0 or len(faces) == 0:
        raise RobotError(
            f"{what}: a {type(mesh).__name__} without triangles; give a trimesh.Trimesh or the "
            "path of a mesh file (for a scene: scene.to_mesh())"
        )
    triangles = vertices[faces]
    if not np.isfinite(triangles).all():
        raise RobotError(f"{what}: the mesh has vertices that are not finite")
    extent = float(np.ptp(triangles.reshape(-1, 3), axis=0).max())
    if not 0.0 < extent <= max_extent:
        raise RobotError(
            f"{what}: the mesh is {extent:.6g} m long; it must be more than 0 and at most "
            f'{max_extent:g} m (a mesh in millimetres: mesh.apply_scale(0.001), or scale="0.001 '
            '0.001 0.001" in a URDF)'
        )
    return np.asarray(triangles, dtype=np.float64)


def mesh_spheres(
    triangles: Float[np.ndarray, "f 3 3"], max_spheres: int = 32
) -> Float[np.ndarray, "n 4"]:
    """At most so many spheres whose union holds a mesh: its surface and what it encloses.

    A box around the mesh is cut into cells, 20 to 60 along its longest edge. Cells that a triangle
    touches hold the surface; cells that cannot be reached from outside without passing
    one of these hold the inside. Every such cell lies in one sphere, up to its farthest
    corner, so the union holds the mesh whatever its shape, and the inside too if the
    mesh is closed (of an open one, what no opening of a cell's size leads to).

    A sphere round a cell's centre that reaches ``d`` metres beyond the nearest cell outside
    protrudes by ``d`` at most. The smallest ``d`` for which a greedy choice of such spheres
    holds all cells is searched; the protrusion from the mesh is at most ``d`` and one
    cell's diagonal. It is logged; see ``tests/robots/test_attached.py`` for figures.

    Args:
        triangles: (f, 3, 3) corners, metres.
        max_spheres: At least 1.

    Returns:
        (n, 4) rows (x, y, z, radius), metres.
    """
    axes = _box_axes(triangles)
    local = triangles @ axes.T
    lower, cell, filled = _covered_cells(local, _CELLS)
    if filled.sum() < _ENOUGH:
        finer = int(_CELLS * np.sqrt(_ENOUGH / filled.sum()))
        lower, cell, filled = _covered_cells(local, min(finer, _MOST_CELLS))
    index = np.argwhere(filled)
    centers = lower + cell * (index + 0.5)
    depth = _depth(filled, index, cell)
    chosen = candidate_cells(depth)
    # Distance from each candidate to the farthest corner of each cell.
    reach = np.empty((len(chosen), len(index)), dtype=np.float32)
    for row, candidate in enumerate(chosen):
        far = np.abs(centers - centers[candidate]) + 0.5 * cell
        # Rounded up, so that single precision never calls a corner covered that is not.
        reach[row] = np.sqrt(np.einsum("ij,ij->i", far, far)) * (1.0 + 1e-6)
    low, high = 0.0, float(reach.max())
    best = greedy_cover(reach, depth[chosen] + high, 1)
    assert best is not None  # one sphere of that reach holds everything
    protrusion = high
    for _ in range(10):
        middle = 0.5 * (low + high)
        found = greedy_cover(reach, depth[chosen] + middle, max_spheres)
        if found is None:
            low = middle
        else:
            best, high, protrusion = found, middle, middle
        if high - low < 0.02 * high:
            break
    # The turn back rounds, too: a nanometre more than that.
    rows = [[*(centers[chosen[which]] @ axes), radius + 1e-9] for which, radius in best]
    _logger.info(
        "%d spheres hold the mesh and protrude by %.1f mm at most",
        len(rows),
        1e3 * (protrusion + float(np.linalg.norm(cell))),
    )
    return np.array(rows, dtype=np.float64)


def _box_axes(triangles: Float[np.ndarray, "f 3 3"]) -> Float[np.ndarray, "3 3"]:
    """Rows: axes of a small box around the mesh; any axes are right, these waste least."""
    import trimesh

    points = triangles.reshape(-1, 3)
    points = points[:: len(points) // 3000 + 1]
    _, spread, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    if spread[2] > 1e-6 * spread[0]:
        axes = trimesh.bounds.oriented_bounds(points)[0][:3, :3]
    straight = np.ptp(points, axis=0).prod() <= 1.001 * np.ptp(points @ axes.T, axis=0).prod()
    return np.eye(3) if straight else np.ascontiguousarray(axes)


def _covered_cells(
    triangles: Float[np.ndarray, "f 3 3"], along: int
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], Bool[np.ndarray, "x y z"]]:
    """Lower corner and edges of a lattice of cells, and which of them hold the mesh."""
    from scipy import ndimage

    points = triangles.reshape(-1, 3)
    # A hair wider than the mesh, so that rounding leaves no vertex outside.
    hair = 1e-9 * (1.0 + float(np.abs(points).max()))
    lower, upper = points.min(axis=0) - hair, points.max(axis=0) + hair
    counts = np.ceil((upper - lower) / ((upper - lower).max() / along) - 1e-6).astype(np.int64)
    counts = np.maximum(counts, 1)
    cell = (upper - lower) / counts
    touched = np.zeros(tuple(counts), dtype=bool)
    for start in range(0, len(triangles), _CHUNK):
        part = triangles[start : start + _CHUNK]
        first = np.floor((part.min(axis=1) - hair - lower) / cell).astype(np.int64)
        last = np.floor((part.max(axis=1) + hair - lower) / cell).astype(np.int64)
        first, last = np.clip(first, 0, counts - 1), np.clip(last, 0, counts - 1)
        owner, index = _boxes(first, last)
        for a in range(0, len(owner), 200_000):
            where = index[a : a + 200_000]
            middle = lower + cell * (where + 0.5)
            local = part[owner[a : a + 200_000]] - middle[:, None]
            hit = where[_triangles_touch_box(local, 0.5 * cell + hair)]
            touched[tuple(hit.T)] = True
    return lower, cell, np.asarray(ndimage.binary_fill_holes(touched))


def _boxes(
    first: Int[np.ndarray, "n 3"], last: Int[np.ndarray, "n 3"]
) -> tuple[Int[np.ndarray, "m"], Int[np.ndarray, "m 3"]]:
    """All lattice cells of n boxes (ends included), and the box each belongs to."""
    size = last - first + 1
    count = size.prod(axis=1)
    owner = np.repeat(np.arange(len(first)), count)
    rest = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    _, ny, nz = size[owner].T
    offset = np.stack([rest // (ny * nz), rest // nz % ny, rest % nz], axis=1)
    return owner, first[owner] + offset


def _triangles_touch_box(
    corners: Float[np.ndarray, "n 3 3"], half: Float[np.ndarray, "3"]
) -> Bool[np.ndarray, "n"]:
    """Whether triangles touch a box round the origin, by its separating axes.

    Akenine-Moller, "Fast 3D triangle-box overlap testing" (2001): the box's axes, the
    triangle's normal, and the products of their edges.
    """
    edges = np.roll(corners, -1, axis=1) - corners
    normal = np.cross(edges[:, 0], edges[:, 1])
    touch = np.abs(np.einsum("ni,ni->n", normal, corners[:, 0])) <= np.abs(normal) @ half
    touch &= ((corners.min(axis=1) <= half) & (corners.max(axis=1) >= -half)).all(axis=1)
    for edge in range(3):
        for axis in range(3):
            direction = np.cross(edges[:, edge], np.eye(3)[axis])
            shadow = np.einsum("nki,ni->nk", corners, direction)
            radius = np.abs(direction) @ half
            touch &= (shadow.min(axis=1) <= radius) & (shadow.max(axis=1) >= -radius)
    return np.asarray(touch)


def _depth(
    filled: Bool[np.ndarray, "x y z"], index: Int[np.ndarray, "n 3"], cell: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n"]:
    """Distance from the centre of each covered cell to the nearest cell outside."""
    from scipy import ndimage

    outside = ~np.pad(filled, 1)
    rim = (
        np.argwhere(outside & ndimage.binary_dilation(~outside, np.ones((3, 3, 3), dtype=bool))) - 1
    )
    depth = np.empty(len(index))
    for row, where in enumerate(index):
        gap = cell * np.maximum(np.abs(rim - where) - 0.5, 0.0)
        depth[row] = np.sqrt(np.einsum("ij,ij->i", gap, gap).min())
    return depth


def candidate_cells(depth: Float[np.ndarray, "n"], most: int = _CANDIDATES) -> Int[np.ndarray, "c"]:
    """Cells to centre spheres on: the deepest ones and an even selection of the others."""
    if len(depth) <= most:
        return np.arange(len(depth))
    deepest = np.argsort(-depth, kind="stable")[: most // 4]
    spread = np.linspace(0, len(depth) - 1, most - len(deepest)).astype(np.int64)
    return np.unique(np.concatenate([deepest, spread]))


def greedy_cover(
    reach: np.ndarray, radius: Float[np.ndarray, "c"], most: int
) -> list[tuple[int, float]] | None:
    """Choose spheres until all cells are held: each time the one that holds most new cells.

    Returns:
        (candidate, radius) with each radius cut to what its new cells need, or None if
        more than `most` would be needed.
    """
    holds = reach <= radius[:, None]
    if not holds.any(axis=0).all():
        return None
    left = np.ones(reach.shape[1], dtype=bool)
    gain = holds.sum(axis=1)
    chosen: list[tuple[int, float]] = []
    while left.any():
        if len(chosen) == most:
            return None
        which = int(np.argmax(gain))
        new = left & holds[which]
        chosen.append((which, float(reach[which, new].max())))
        left &= ~new
        gain -= holds[:, new].sum(axis=1)
    return chosen
