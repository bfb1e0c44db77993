# SPDX-License-Identifier: BSD-3-Clause
"""Examples to learn from: what a camera saw of an object, query points, and which lie inside."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Self

import numpy as np
from jaxtyping import Bool, Float, Float16, Float32, Int

from experiments.baselines.pointsdf.cloud import ObjectFrame, prepare_cloud
from experiments.protocols import TrueScene
from vprism_plan._files import replacing
from vprism_plan.errors import ConfigError
from vprism_plan.perception.plane import Plane

MIN_PIXELS = 30  # of an object that is learnt from
_NEAR = (0.004, 0.015, 0.04)  # metres: standard deviations of the queries about the surface
_PLANE_NOISE = 0.0015  # metres, as a fitted plane is off


@dataclass(frozen=True, eq=False)
class Examples:
    """Objects as the network is given them, and what it should answer.

    Attributes:
        clouds: (n, points, 3) in each object's normalised frame, farthest first.
        contexts: (n, 3) scale, height and elevation (`ObjectFrame.context`).
        queries: (n, q, 3) in the same frame, some uniform in the frame's box, the others about
            the true surface.
        inside: (n, q) whether each lies inside the true object.
    """

    clouds: Float32[np.ndarray, "n p 3"]
    contexts: Float32[np.ndarray, "n 3"]
    queries: Float16[np.ndarray, "n q 3"]
    inside: Bool[np.ndarray, "n q"]

    def __len__(self) -> int:
        return len(self.clouds)

    @classmethod
    def joined(cls, parts: Iterable["Examples"]) -> Self:
        """Return all examples of several sets, in order; at least one set."""
        parts = list(parts)
        if not parts:
            raise ConfigError("no examples to join: every scene was without a visible object")
        names = [field.name for field in fields(cls)]
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def subset(self, index: Int[np.ndarray, "m"] | slice) -> Self:
        """Return some of the examples."""
        return type(self)(*(getattr(self, field.name)[index] for field in fields(self)))

    def save(self, path: str | Path) -> None:
        """Write a .npz file, whole or not at all."""
        with replacing(path) as temporary:
            np.savez(temporary, **{f.name: getattr(self, f.name) for f in fields(self)})

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read what `save` wrote."""
        with np.load(path) as stored:
            return cls(*(stored[field.name] for field in fields(cls)))


def examples_of(
    views: Sequence[TrueScene],
    *,
    seed: int,
    points: int = 256,
    queries: int = 512,
    uniform: float = 0.25,
    only: Collection[int] | None = None,
) -> Examples | None:
    """Make one example of every object in every view that shows it by at least 30 pixels.

    Args:
        views: views of one arrangement: the same objects, other cameras.
        seed: of the query points and of the support plane's error.
        points: of each cloud.
        queries: per object.
        uniform: share of them that is uniform in the box; the rest is about the surface.
        only: ids of the objects to use; None uses all.

    Returns:
        None if no view shows an object.
    """
    surfaces = {
        k: np.asarray(mesh.sample(2048, seed=seed)) for k, mesh in views[0].truth_meshes().items()
    }
    rng = np.random.default_rng([seed, 0xDA7A])
    found = []
    for scene in views:
        seen, labels = scene.observation.points()
        plane = Plane(np.array([0.0, 0.0, 1.0]), float(rng.normal(0.0, _PLANE_NOISE)))
        for k in scene.observation.object_ids:
            own = seen[labels == k]
            if len(own) < MIN_PIXELS or (only is not None and k not in only):
                continue
            cloud, frame = prepare_cloud(own, plane, scene.observation.camera_center, points)
            asked = _queries(frame, surfaces[k], queries, uniform, rng)
            # Rounded first, so that the truth is that of the point that is kept.
            asked = asked.astype(np.float16)
            inside = views[0].object_of(frame.to_world(asked)) == k
            found.append(Examples(cloud[None], frame.context[None], asked[None], inside[None]))
    return Examples.joined(found) if found else None


def _queries(
    frame: ObjectFrame,
    surface: Float[np.ndarray, "s 3"],
    count: int,
    uniform: float,
    rng: np.random.Generator,
) -> Float[np.ndarray, "n 3"]:
    """Points of the box in random order: uniform, and about the true surface where inside it."""
    queries = rng.uniform(frame.lower, frame.upper, (count, 3))
    sigma = rng.choice(_NEAR, size=(count, 1))
    chosen = surface[rng.integers(len(surface), size=count)]
    near = frame.to_object(chosen + sigma * rng.normal(size=(count, 3)))
    use = (rng.random(count) >= uniform) & frame.covers(near)
    queries[use] = near[use]
    return queries
