# SPDX-License-Identifier: BSD-3-Clause
"""Surfaces of the map's objects by marching cubes."""

import itertools
import logging
import math
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy import ndimage

from vprism_plan._arguments import number, whole
from vprism_plan.errors import ConfigError, WorldError
from vprism_plan.world.config import check_level
from vprism_plan.world.grid import Index, Points, Vector, corners, window

if TYPE_CHECKING:
    import trimesh

_log = logging.getLogger(__name__)

# Probability: moves a surface by less than its own discretisation error.
_PUSHES = (1e-3, 3e-3, 1e-2)


def extract_meshes(
    map: Any, level: float = 0.5, resolution: float = 0.01
) -> "dict[int, trimesh.Trimesh]":
    """Closed surface of every object, world frame, metres.

    Object k is {x : P(occupied) >= level and k is the most probable object}, so objects do not
    overlap. Surfaces are watertight, with outward normals (positive volume). An object that reaches
    the level nowhere on the grid is left out, with a warning.

    Args:
        map: a `VPrismMap`.
        level: probability in (0, 1).
        resolution: edge of the marching cubes, metres.

    Raises:
        WorldError: a surface could not be closed.
    """
    probabilities, origin = _sample(map, level, resolution)
    meshes = {}
    for k, object_id in enumerate(map.object_ids, start=1):
        mesh = surface(_inside(probabilities, k, level), origin, resolution)
        if mesh is not None:
            meshes[object_id] = mesh
        else:
            why = "object %d has no surface at level %g on a grid of %g m: left out"
            _log.warning(why, object_id, level, resolution)
    return meshes


def extract_union_mesh(
    map: Any, level: float = 0.5, resolution: float = 0.01
) -> "trimesh.Trimesh | None":
    """Closed surface of all objects together, {x : P(occupied) >= level}; None if empty. Arguments,
    guarantees and errors as for `extract_meshes`."""
    probabilities, origin = _sample(map, level, resolution)
    mesh = surface(probabilities[..., 1:].sum(axis=-1) - level, origin, resolution)
    if mesh is None:
        _log.warning("no object reaches level %g on a grid of %g m", level, resolution)
    return mesh


def _sample(
    map_: Any, level: float, resolution: float
) -> tuple[Float[np.ndarray, "nx ny nz k"], Vector]:
    """Class probabilities on a grid over the map's support, with an empty layer round it."""
    check_level(level)
    check_spacing(resolution, "resolution")
    lower, upper = (np.asarray(corner, dtype=np.float64) for corner in map_.support_bounds())
    probabilities, first = sample_box(map_, lower, upper, resolution, "resolution")
    return probabilities, resolution * first


def surface(
    inside: Float[np.ndarray, "nx ny nz"], origin: Vector, resolution: float
) -> "trimesh.Trimesh | None":
    """Surface {inside = 0} around {inside > 0}; None if there is none. A vertex that nearly
    coincides with a node leaves triangles without area and, when those are merged, holes: values
    this close to 0 are pushed away from it first."""
    import trimesh
    from skimage.measure import marching_cubes

    if not (inside > 0).any():
        return None
    for push in _PUSHES:
        values = np.where(inside > 0, np.maximum(inside, push), np.minimum(inside, -push))
        vertices, faces, _, _ = marching_cubes(
            values.astype(np.float32), 0.0, gradient_direction="ascent", allow_degenerate=False
        )
        mesh = trimesh.Trimesh(
            origin + resolution * vertices.astype(np.float64), faces, process=True
        )
        if mesh.is_watertight and mesh.volume > 0:
            return mesh
    raise WorldError(
        f"marching cubes at {resolution} m gave no closed surface; use another resolution or level"
    )


# Outside, for nodes that nobody has to evaluate.
_NOTHING = -0.1


def extract_refined_meshes(
    map: Any, level: float, spacing: float, halvings: int | None = None
) -> "dict[int, trimesh.Trimesh]":
    """Closed surface of every object on the lattice of nodes spacing * integers, metres.

    Objects are those of `extract_meshes`. A grid of spacing * 2^halvings is evaluated wholly; cells
    in which the surface runs, and at first their neighbours, are halved until they have the
    spacing. What is smaller than the first grid and touches none of its nodes is not found. An
    object of which nothing is found is left out, with a warning. `halvings` may be up to 8; None
    takes the coarsest first grid that is no wider than half a kernel length. WorldError if one
    could not be closed.
    """
    check_level(level)
    check_spacing(spacing, "spacing")
    if halvings is None:
        halvings = max(0, math.floor(math.log2(0.5 * map.kernel_length / spacing)))
    whole("halvings", halvings, 0, 8)
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
    values: Float[np.ndarray, "nx ny nz"], first: Index
) -> tuple[Float[np.ndarray, "mx my mz"], Index]:
    """Keep three cells of room around the object: halving may move its surface by two."""
    hits = np.argwhere(values > 0)
    low = np.maximum(hits.min(axis=0) - 3, 0)
    high = np.minimum(hits.max(axis=0) + 4, values.shape)
    return values[window(low, high)].copy(), first + low


def _halved(
    map_: Any,
    k: int,
    level: float,
    values: Float[np.ndarray, "nx ny nz"],
    corner: Index,
    halvings: int,
    spacing: float,
    wide: bool,
) -> tuple[Float[np.ndarray, "mx my mz"], Index]:
    """Values on nodes half as far apart, evaluated where the surface may run, if `wide` in the
    cells around as well; `halvings` still to come, `corner` in steps of the given grid."""
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
    positive = values > 0
    views = [positive[corner] for corner in corners(values.shape)]
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


_CHUNK = 1 << 16  # points
_MAX_NODES = 60_000_000


def check_spacing(spacing: float, name: str) -> None:
    """Raise ConfigError, calling it by its name, unless nodes can be so many metres apart."""
    number(name, spacing, 1e-4, 1.0, "metres")


def check_size(shape: Any, spacing: float, name: str, most: int = _MAX_NODES) -> None:
    """Raise ConfigError if so many nodes, whose spacing goes by that name, are too many."""
    count = math.prod(int(n) for n in shape)
    if count > most:
        raise ConfigError(
            f"{name} {spacing} m gives {count:,} samples (at most {most:,}); use a coarser one"
        )


def predicted(source: Any, points: Points) -> Float32[np.ndarray, "n k"]:
    """Return `source.predict_proba` at points (metres), asked for piece by piece."""
    out = np.empty((len(points), len(source.object_ids) + 1), dtype=np.float32)
    for start in range(0, len(points), _CHUNK):
        piece = slice(start, start + _CHUNK)
        out[piece] = source.predict_proba(points[piece])
    return out


def sample_box(
    source: Any, lower: Vector, upper: Vector, spacing: float, name: str, most: int = _MAX_NODES
) -> tuple[Float32[np.ndarray, "nx ny nz k"], Index]:
    """Return class probabilities over a box (corners, metres) and a layer around it in which all is
    empty, at whole multiples of the spacing (metres; `name` is what the user calls it), and the
    first node in steps. `source` has `object_ids` and `predict_proba`.

    Raises:
        ConfigError: more than `most` nodes.
    """
    first = np.floor(lower / spacing).astype(np.int64) - 1
    shape = np.ceil(upper / spacing).astype(np.int64) + 2 - first
    check_size(shape, spacing, name, most)
    probabilities = np.zeros((*shape, len(source.object_ids) + 1), dtype=np.float32)
    probabilities[..., 0] = 1.0
    inner = np.moveaxis(np.indices(tuple(shape - 2)), 0, -1).reshape(-1, 3) + 1
    found = predicted(source, spacing * (inner + first).astype(np.float64))
    probabilities[1:-1, 1:-1, 1:-1] = found.reshape(*(shape - 2), -1)
    return probabilities, first
