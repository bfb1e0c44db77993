# SPDX-License-Identifier: BSD-3-Clause
"""Surfaces of the objects that any method reconstructs, by marching cubes."""

from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from experiments.protocols import Reconstruction
from vprism_plan.errors import ConfigError, WorldError
from vprism_plan.world.config import check_level
from vprism_plan.world.meshes import check_spacing, sample_box, surface

if TYPE_CHECKING:
    import trimesh

_MAX_NODES = 20_000_000
_RISES = (0.0, 0.003, 0.01, 0.03)  # probability


def meshes_of(
    reconstruction: Reconstruction,
    level: float = 0.5,
    resolution: float = 0.01,
    *,
    bounds: Any = None,
) -> "dict[int, trimesh.Trimesh]":
    """Return the watertight surface of {x : P(object k | x) >= level} of every object, metres.

    Nodes are whole multiples of `resolution`, world frame. Sets that leave the box are
    closed at its sides. An object that reaches the level at no node is left out.

    Args:
        reconstruction: of any method.
        level: probability in (0, 1).
        resolution: edge of the marching cubes, m.
        bounds: (2, 3) corners of the box to look in, m; None asks the reconstruction's own
            `support_bounds()`.

    Raises:
        ConfigError: level, resolution or bounds cannot be used.
        WorldError: a surface could not be closed.
    """
    check_level(level)
    check_spacing(resolution, "resolution")
    lower, upper = _box(reconstruction, bounds)
    probabilities, first = sample_box(
        reconstruction, lower, upper, resolution, "resolution", _MAX_NODES
    )
    found = {}
    for k, object_id in enumerate(reconstruction.object_ids, start=1):
        mesh = _closed(probabilities[..., k] - np.float32(level), resolution * first, resolution)
        if mesh is not None:
            found[int(object_id)] = mesh
    return found


def _closed(
    inside: Float[np.ndarray, "nx ny nz"], origin: Float[np.ndarray, " 3"], resolution: float
) -> "trimesh.Trimesh | None":
    """Surface around {inside > 0}; None if there is none.

    Where voxels that are all or nothing meet in an edge, the trilinear surface crosses
    itself and no choice of triangles closes it: a slightly higher level keeps them apart.
    """
    for rise in _RISES:
        try:
            return surface(inside - np.float32(rise), origin, resolution)
        except WorldError:
            if rise == _RISES[-1]:
                raise
    return None


def _box(
    reconstruction: Reconstruction, bounds: Any
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
    """Return the corners of the box to look in."""
    if bounds is None:
        own = getattr(reconstruction, "support_bounds", None)
        if own is None:
            raise ConfigError(
                f"a {type(reconstruction).__name__} does not say where it may be occupied; "
                "pass bounds=((x, y, z), (x, y, z)) in metres"
            )
        bounds = own()
    box = np.asarray(bounds, dtype=np.float64)
    if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[0] < box[1]).all():
        raise ConfigError(
            f"bounds is {bounds!r}; it must be ((x, y, z), (x, y, z)) in metres, finite, "
            "with every lower coordinate below the upper one"
        )
    return box[0], box[1]
