# SPDX-License-Identifier: BSD-3-Clause
"""Hinge points: a lattice around the objects plus random points of their surfaces."""

import numpy as np
from jaxtyping import Bool, Float, Int

from vprism_plan.errors import MapError
from vprism_plan.mapping.config import MapConfig


def lattice_hinges(
    lower: Float[np.ndarray, "c 3"],
    upper: Float[np.ndarray, "c 3"],
    normal: Float[np.ndarray, " 3"],
    offset: float,
    config: MapConfig,
    sunk: Bool[np.ndarray, " c"] | None = None,
) -> Float[np.ndarray, "h 3"]:
    """Return the lattice nodes (m, world) around the objects' boxes.

    Nodes are world multiples of `config.hinge_spacing` plus `config.hinge_shift`, so two
    fits of one scene share them. Kept: within `hinge_radius` of a box centre or
    `hinge_margin` of a box, and at most `hinge_depth` under the plane
    {normal . x = offset}, unless the object is `sunk`, lower than that itself.
    """
    sunk = np.zeros(len(lower), dtype=bool) if sunk is None else sunk
    spacing, shift = config.hinge_spacing, np.asarray(config.hinge_shift)
    centers = 0.5 * (lower + upper)
    found: list[np.ndarray] = []
    for low, high, center, lies_lower in zip(lower, upper, centers, sunk, strict=True):
        reach_low = np.minimum(low - config.hinge_margin, center - config.hinge_radius)
        reach_high = np.maximum(high + config.hinge_margin, center + config.hinge_radius)
        first = np.ceil((reach_low - shift) / spacing)
        last = np.floor((reach_high - shift) / spacing)
        if np.prod(last - first + 1.0) > 50.0 * config.max_hinges:
            raise MapError(
                f"an object's box is {np.round(high - low, 3).tolist()} m wide, too many hinge "
                f"points at {spacing} m; check its labels and the scale of depth (metres), or "
                "raise hinge_spacing"
            )
        axes = [np.arange(a, b + 1.0) for a, b in zip(first, last, strict=True)]
        index = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        nodes = index * spacing + shift
        beyond = np.maximum(np.maximum(low - nodes, nodes - high), 0.0)
        near = np.linalg.norm(nodes - center, axis=1) <= config.hinge_radius
        near |= (config.hinge_margin > 0) & (np.linalg.norm(beyond, axis=1) <= config.hinge_margin)
        if config.hinge_depth is not None and not lies_lower:
            near &= nodes @ normal >= offset - config.hinge_depth
        found.append(index[near])
    index = np.unique(np.concatenate(found), axis=0)
    return index * spacing + shift


def surface_hinges(
    points: Float[np.ndarray, "n 3"],
    labels: Int[np.ndarray, " n"],
    object_ids: tuple[int, ...],
    count: int,
    rng: np.random.Generator,
) -> Float[np.ndarray, "h 3"]:
    """Return up to `count` distinct random points of each object (m, world)."""
    chosen = [np.zeros((0, 3))]
    for object_id in object_ids:
        own = points[labels == object_id]
        chosen.append(own[rng.permutation(len(own))[:count]])
    return np.concatenate(chosen)
