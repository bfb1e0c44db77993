# SPDX-License-Identifier: BSD-3-Clause
"""Surfaces of the map's objects on a fine lattice, evaluated only near the surface.

A mesh whose nodes are those of the distance field's lattice is a surface that the field
must enclose: every triangle lies in a lattice cell that has an occupied corner. Taking
the samples of a coarse grid and halving its cells only where the surface runs makes such
a mesh affordable, and owes nothing to the octree that the field itself is traced with.
"""

import itertools
import logging
import math
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int

from vprism_plan.errors import ConfigError
from vprism_plan.world.config import check_level
from vprism_plan.world.meshes import surface
from vprism_plan.world.sampling import check_size, check_spacing, predicted, sample_box

if TYPE_CHECKING:
    import trimesh

_log = logging.getLogger(__name__)

_CORNERS = tuple(itertools.product((0, 1), repeat=3))
# Outside, for nodes that nobody has to evaluate.
_NOTHING = -0.1


def extract_refined_meshes(
    map: Any, level: float, spacing: float, halvings: int | None = None
) -> "dict[int, trimesh.Trimesh]":
    """Closed surface of every object on the lattice of nodes spacing * integers, metres.

    Objects are those of `extract_meshes`. A grid of spacing * 2^halvings is evaluated
    wholly; cells in which the surface runs, and at first their neighbours, are halved
    until they have the spacing. What is smaller than the first grid and touches none of
    its nodes is not found. An object of which nothing is found is left out, with a warning.

    Args:
        map: a `VPrismMap`.
        level: probability in (0, 1).
        spacing: edge of the marching cubes, metres.
        halvings: how often cells are halved; None takes the coarsest first grid that is
            no wider than half a kernel length.

    Raises:
        ConfigError: level, spacing or halvings is out of range.
        WorldError: a surface could not be closed.
    """
    check_level(level)
    check_spacing(spacing, "spacing")
    if halvings is None:
        halvings = max(0, math.floor(math.log2(0.5 * map.kernel_length / spacing)))
    if not 0 <= halvings <= 8:
        raise ConfigError(f"halvings is {halvings}; it must be between 0 and 8")
    lower, upper = (np.asarray(corner, dtype=np.float64) for corner in map.support_bounds())
    probabilities, first = sample_box(map, lower, upper, spacing * 2**halvings, "spacing")
    meshes = {}
    for k, object_id in enumerate(map.object_ids, start=1):
        values = _inside(probabilities, k, level)
        if not (values > 0).any():
            _log.warning("object %d has no surface at level %g: left out", object_id, level)
            continue
        values, corner = _cropped(values, first)
        for step in range(halvings):
            wide = step == 0
            values, corner = _halved(map, k, level, values, corner, halvings - step, spacing, wide)
        mesh = surface(values, spacing * corner, spacing)
        if mesh is not None:
            meshes[object_id] = mesh
    return meshes


def _inside(
    probabilities: Float[np.ndarray, "*shape k"], k: int, level: float
) -> Float[np.ndarray, "*shape"]:
    """Positive where P(occupied) exceeds the level and class k is the likeliest object."""
    occupied = probabilities[..., 1:].sum(axis=-1) - np.float32(level)
    if probabilities.shape[-1] == 2:
        return occupied
    others = np.delete(probabilities, (0, k), axis=-1).max(axis=-1)
    return np.minimum(occupied, probabilities[..., k] - others)


def _cropped(
    values: Float[np.ndarray, "nx ny nz"], first: Int[np.ndarray, " 3"]
) -> tuple[Float[np.ndarray, "mx my mz"], Int[np.ndarray, " 3"]]:
    """Keep three cells of room around the object: halving may move its surface by two."""
    hits = np.argwhere(values > 0)
    low = np.maximum(hits.min(axis=0) - 3, 0)
    high = np.minimum(hits.max(axis=0) + 4, values.shape)
    window = tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
    return values[window].copy(), first + low


def _halved(
    map_: Any,
    k: int,
    level: float,
    values: Float[np.ndarray, "nx ny nz"],
    corner: Int[np.ndarray, " 3"],
    halvings: int,
    spacing: float,
    wide: bool,
) -> tuple[Float[np.ndarray, "mx my mz"], Int[np.ndarray, " 3"]]:
    """Values on nodes half as far apart, evaluated where the surface may run.

    `halvings` still to come, this one included; `corner` in steps of the given grid; if
    `wide`, the cells around those in which the surface runs are evaluated, too.
    """
    check_size(2 * np.array(values.shape), spacing, "spacing")
    mixed = _mixed(values, wide)
    fine = _between(values)
    wanted = np.zeros(fine.shape, dtype=bool)
    cells = 2 * np.argwhere(mixed)
    for offset in itertools.product(range(3), repeat=3):
        wanted[tuple((cells + offset).T)] = True
    nodes = np.argwhere(wanted)
    corner = 2 * corner
    points = (spacing * 2 ** (halvings - 1)) * (nodes + corner).astype(np.float64)
    fine[tuple(nodes.T)] = _inside(predicted(map_, points), k, level)
    for axis in range(3):
        for end in (0, -1):
            face = np.moveaxis(fine, axis, 0)[end]
            np.minimum(face, _NOTHING, out=face)
    return fine, corner


def _mixed(values: Float[np.ndarray, "nx ny nz"], wide: bool) -> Bool[np.ndarray, "cx cy cz"]:
    """Cells with corners on both sides; if `wide`, the cells around them, too."""
    from scipy import ndimage

    positive = values > 0
    shape = tuple(n - 1 for n in values.shape)
    views = [positive[tuple(slice(c, c + n) for c, n in zip(o, shape, strict=True))]
             for o in _CORNERS]  # fmt: skip
    some, every = np.logical_or.reduce(views), np.logical_and.reduce(views)
    mixed = some & ~every
    if wide:
        mixed = np.asarray(ndimage.binary_dilation(mixed, np.ones((3, 3, 3), dtype=bool)))
    return mixed


def _between(values: Float[np.ndarray, "nx ny nz"]) -> Float[np.ndarray, "mx my mz"]:
    """Trilinear interpolation to nodes half as far apart: between equal signs, that sign."""
    for axis in range(3):
        along = np.moveaxis(values, axis, 0)
        fine = np.empty((2 * len(along) - 1, *along.shape[1:]), dtype=values.dtype)
        fine[::2] = along
        fine[1::2] = 0.5 * (along[:-1] + along[1:])
        values = np.moveaxis(fine, 0, axis)
    return np.ascontiguousarray(values)
