# SPDX-License-Identifier: BSD-3-Clause
"""From a set's name and a seed to a scene at rest, seen once."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from experiments.generation.dropping import drop
from experiments.generation.raycasting import observe
from experiments.generation.saving import as_saved
from experiments.generation.scene import MeshObject, MeshScene
from experiments.generation.sources import KINDS, Source, source
from vprism_plan.errors import ConfigError
from vprism_plan.simulation.camera import DepthNoise
from vprism_plan.simulation.scenes import random_camera

FEWEST, MOST = 3, 10  # objects, where the seed draws the number
_ATTEMPTS = 50


def generate(
    kind: str,
    seed: int,
    *,
    n_objects: int | None = None,
    noise: bool = True,
    data: Path | None = None,
) -> MeshScene:
    """Return a scene of objects that were dropped close together and came to rest.

    The same arguments give the same scene, bit for bit. A drop that does not come to
    rest, or loses an object that rolls away, is repeated with other numbers (and other
    objects) that follow from the same seed; camera and number of objects stay.

    Args:
        kind: "analytic", "ycb", "random", "random-train" or "folder" (see `sources`).
        seed: whole number from 0 that everything follows from.
        n_objects: 1 to 10; None draws 3 to 10.
        noise: whether the depth carries `DepthNoise()`.
        data: folder of meshes, required for "folder", optional for "ycb".

    Raises:
        ConfigError: an argument out of range, meshes that are missing or unusable, or
            50 drops that came to nothing.
        MissingDependencyError: the extra `experiments` is not installed.
    """
    if kind not in KINDS:
        raise ConfigError(f"source {kind!r} is unknown; valid: {', '.join(KINDS)}")
    if seed < 0:
        raise ConfigError(f"seed is {seed}; it must be 0 or more")
    if n_objects is not None and not 1 <= n_objects <= MOST:
        raise ConfigError(f"n_objects is {n_objects}; it must be 1 to {MOST}")
    origin = source(kind, None if data is None else Path(data))
    key = [seed, 0x3E5A, KINDS.index(kind)]
    rng = np.random.default_rng(key)
    drawn = int(rng.integers(FEWEST, MOST + 1))
    count = drawn if n_objects is None else n_objects
    camera = as_saved(random_camera(rng))
    objects = _dropped(
        kind, lambda attempt: np.random.default_rng([*key, count, attempt]), origin, count
    )
    sensor = DepthNoise() if noise else None
    labels = tuple(range(1, len(objects) + 1))
    seen = observe([body.mesh() for body in objects], labels, camera, sensor, seed)
    return MeshScene(
        objects,
        camera,
        seen,
        sensor,
        seed,
        f"{kind}-{'any' if n_objects is None else n_objects}-{seed}",
        kind,
    )


def _dropped(
    kind: str, rng_of: Callable[[int], np.random.Generator], origin: Source, count: int
) -> tuple[MeshObject, ...]:
    for attempt in range(_ATTEMPTS):
        rng = rng_of(attempt)
        shapes = [origin.draw(rng) for _ in range(count)]
        poses = drop(shapes, rng)
        if poses is not None:
            return tuple(
                MeshObject(shape.name, shape.vertices, shape.faces, pose)
                for shape, pose in zip(shapes, poses, strict=True)
            )
    raise ConfigError(
        f"{count} objects of {kind!r} did not come to rest within 30 cm of each other in "
        f"{_ATTEMPTS} drops; use fewer objects, or meshes that do not roll"
    )
