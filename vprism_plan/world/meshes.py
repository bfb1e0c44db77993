# SPDX-License-Identifier: BSD-3-Clause
"""Surfaces of the map's objects by marching cubes."""

import logging
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from vprism_plan.errors import WorldError
from vprism_plan.world.config import check_level
from vprism_plan.world.sampling import check_spacing, sample_box

if TYPE_CHECKING:
    import trimesh

_log = logging.getLogger(__name__)

# Probability: moves a surface by less than its own discretisation error.
_PUSHES = (1e-3, 3e-3, 1e-2)


def extract_meshes(
    map: Any, level: float = 0.5, resolution: float = 0.01
) -> "dict[int, trimesh.Trimesh]":
    """Closed surface of every object, world frame, metres.

    Object k is {x : P(occupied) >= level and k is the most probable object}, so objects
    do not overlap. Surfaces are watertight, with outward normals (positive volume). An
    object that reaches the level nowhere on the grid is left out, with a warning.

    Args:
        map: a `VPrismMap`.
        level: probability in (0, 1).
        resolution: edge of the marching cubes, metres.

    Raises:
        ConfigError: level or resolution is out of range.
        WorldError: a surface could not be closed.
    """
    probabilities, origin = _sample(map, level, resolution)
    occupied = probabilities[..., 1:].sum(axis=-1) - level
    meshes = {}
    for k, object_id in enumerate(map.object_ids, start=1):
        inside = occupied
        if len(map.object_ids) > 1:
            others = np.delete(probabilities, (0, k), axis=-1).max(axis=-1)
            inside = np.minimum(occupied, probabilities[..., k] - others)
        mesh = surface(inside, origin, resolution)
        if mesh is None:
            _log.warning(
                "object %d has no surface at level %g on a grid of %g m: left out",
                object_id,
                level,
                resolution,
            )
            continue
        meshes[object_id] = mesh
    return meshes


def extract_union_mesh(
    map: Any, level: float = 0.5, resolution: float = 0.01
) -> "trimesh.Trimesh | None":
    """Closed surface of all objects together, {x : P(occupied) >= level}; None if empty.

    Arguments, guarantees and errors as for `extract_meshes`.
    """
    probabilities, origin = _sample(map, level, resolution)
    mesh = surface(probabilities[..., 1:].sum(axis=-1) - level, origin, resolution)
    if mesh is None:
        _log.warning("no object reaches level %g on a grid of %g m", level, resolution)
    return mesh


def _sample(
    map_: Any, level: float, resolution: float
) -> tuple[Float[np.ndarray, "nx ny nz k"], Float[np.ndarray, " 3"]]:
    """Class probabilities on a grid over the map's support, with an empty layer round it."""
    check_level(level)
    check_spacing(resolution, "resolution")
    lower, upper = (np.asarray(corner, dtype=np.float64) for corner in map_.support_bounds())
    probabilities, first = sample_box(map_, lower, upper, resolution, "resolution")
    return probabilities, resolution * first


def surface(
    inside: Float[np.ndarray, "nx ny nz"], origin: Float[np.ndarray, " 3"], resolution: float
) -> "trimesh.Trimesh | None":
    """Surface {inside = 0} around {inside > 0}; None if there is none.

    A vertex that nearly coincides with a node leaves triangles without area and, when
    those are merged, holes: values this close to 0 are pushed away from it first.
    """
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
