# SPDX-License-Identifier: BSD-3-Clause
"""Class probabilities on the nodes of a lattice, as surfaces are made of."""

import math
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int

from vprism_plan.errors import ConfigError

_CHUNK = 1 << 16  # points
_MAX_NODES = 60_000_000


def check_spacing(spacing: float, name: str) -> None:
    """Raise ConfigError, calling it by its name, unless nodes can be so many metres apart."""
    if not 1e-4 <= spacing <= 1.0:
        raise ConfigError(f"{name} is {spacing}; it must be between 0.0001 and 1 metres")


def check_size(shape: Any, spacing: float, name: str, most: int = _MAX_NODES) -> None:
    """Raise ConfigError if so many nodes, whose spacing goes by that name, are too many."""
    count = math.prod(int(n) for n in shape)
    if count > most:
        raise ConfigError(
            f"{name} {spacing} m gives {count:,} samples (at most {most:,}); use a coarser one"
        )


def predicted(source: Any, points: Float[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n k"]:
    """Return `source.predict_proba` at points (metres), asked for piece by piece."""
    out = np.empty((len(points), len(source.object_ids) + 1), dtype=np.float32)
    for start in range(0, len(points), _CHUNK):
        piece = slice(start, start + _CHUNK)
        out[piece] = source.predict_proba(points[piece])
    return out


def sample_box(
    source: Any,
    lower: Float[np.ndarray, " 3"],
    upper: Float[np.ndarray, " 3"],
    spacing: float,
    name: str,
    most: int = _MAX_NODES,
) -> tuple[Float32[np.ndarray, "nx ny nz k"], Int[np.ndarray, " 3"]]:
    """Return class probabilities over a box and a layer around it in which all is empty.

    Args:
        source: a `VPrismMap`, or what else has `object_ids` and `predict_proba`.
        lower, upper: corners, metres.
        spacing: of the nodes, which are whole multiples of it, metres.
        name: what the user calls the spacing.
        most: nodes.

    Returns:
        The probabilities, and the first node in steps.

    Raises:
        ConfigError: too many nodes.
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
