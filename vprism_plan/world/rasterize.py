# SPDX-License-Identifier: BSD-3-Clause
"""Obstacles as marked nodes of a lattice: level sets, meshes, observed points."""

import math
from collections.abc import Collection

import numpy as np
from jaxtyping import Float, Int

from vprism_plan._kernels import world as kernels
from vprism_plan.errors import WorldError
from vprism_plan.world.distance import Lattice
from vprism_plan.world.grid import Grid
from vprism_plan.world.known import KnownMesh
from vprism_plan.world.levelset import Cells, LevelSet

_MAX_LATTICE = 400_000_000


def _room(shape: Int[np.ndarray, " 3"], what: str) -> np.ndarray:
    if math.prod(int(n) for n in shape) > _MAX_LATTICE:
        raise WorldError(
            f"{what} spans {' x '.join(str(int(n)) for n in shape)} lattice nodes (at most "
            f"{_MAX_LATTICE:,}); use a coarser resolution"
        )
    return np.zeros(tuple(int(n) for n in shape), dtype=np.uint8)


def rasterize_level_set(
    level_set: LevelSet, factor: int, classes: Collection[int] | None = None
) -> Lattice | None:
    """Mark the corners of the cells of a level set with the object class found there.

    With `classes`, only cells in which one of these classes is the most probable at
    some corner, and the whole of such cells. None if there is no cell.
    """
    cells = [*level_set.inner, level_set.border]
    if classes is not None:
        cells = [_owned(part, classes) for part in cells]
    box = LevelSet(level_set.spacing, tuple(cells[:-1]), cells[-1], 0).box()
    if box is None:
        return None
    lower, upper = box
    labels = _room(upper - lower + 1, "the level set")
    for part in cells:
        kernels.fill_blocks(labels, part.index - lower, part.label, part.size)
    return Lattice(labels, lower, factor)


def _owned(cells: Cells, classes: Collection[int]) -> Cells:
    """Cells with one of the classes at some corner around them, relabelled with it."""
    mine = np.isin(cells.around, np.array(sorted(classes), dtype=cells.around.dtype))
    label = np.where(mine, cells.around, 0).max(axis=1, initial=0)
    return Cells(cells.index, cells.size, label, cells.around).select(label > 0)


def rasterize_mesh(known: KnownMesh, grid: Grid, factor: int) -> Lattice:
    """Mark every cell a mesh touches, and its inside if it is watertight.

    The surface is divided until its edges are no longer than a cell; every point of a
    triangle is then within edge / sqrt(3) of a corner, and the cells that a cube of that
    size round a corner touches are marked.
    """
    import trimesh

    spacing = grid.spacing / factor
    lower, upper = known.box()
    corner = np.floor(lower / spacing).astype(np.int64) - 2
    last = np.ceil(upper / spacing).astype(np.int64) + 2
    labels = _room(last - corner + 1, f"known mesh {known.name!r}")
    vertices = np.asarray(known.mesh.vertices, dtype=np.float64)
    faces = np.asarray(known.mesh.faces)
    fine, fine_faces = trimesh.remesh.subdivide_to_size(vertices, faces, spacing, max_iter=40)
    samples = np.ascontiguousarray(fine[np.unique(fine_faces)], dtype=np.float64)
    half = np.full(len(samples), spacing / math.sqrt(3.0))
    kernels.mark_boxes(samples, half, spacing * corner, spacing, np.uint8(1), labels)
    if known.mesh.is_watertight:
        _fill_inside(labels, spacing * corner, spacing, vertices[faces])
    return Lattice(labels, corner, factor)


def _fill_inside(
    labels: np.ndarray,
    origin: Float[np.ndarray, " 3"],
    spacing: float,
    triangles: Float[np.ndarray, "f 3 3"],
) -> None:
    """Mark the unmarked regions that lie inside a closed surface, one test per region."""
    from scipy import ndimage

    regions, count = ndimage.label(labels == 0)
    outside = regions[0, 0, 0]
    first = ndimage.find_objects(regions)
    for region in range(1, count + 1):
        if region == outside:
            continue
        box = first[region - 1]
        where = np.argwhere(regions[box] == region)[0] + [s.start for s in box]
        if abs(winding_number(origin + spacing * where, triangles)) > 0.5:
            labels[regions == region] = 1


def winding_number(point: Float[np.ndarray, " 3"], triangles: Float[np.ndarray, "f 3 3"]) -> float:
    """How often a closed surface winds round a point: its solid angle over 4 pi.

    Van Oosterom and Strackee, "The solid angle of a plane triangle" (1983), eq. 8.
    """
    a, b, c = (triangles[:, i] - point for i in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c))
    dots = la * lb * lc
    for (p, q), length in (((a, b), lc), ((b, c), la), ((c, a), lb)):
        dots = dots + np.einsum("ij,ij->i", p, q) * length
    return float(np.arctan2(volume, dots).sum() / (2.0 * math.pi))
