# SPDX-License-Identifier: BSD-3-Clause
"""Is the joint collision probability of a path true? Swept balls against known solids."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from experiments.calibration import UNSUPPORTED, knowledge
from experiments.metrics import Reliability
from experiments.stored import Stored
from vprism_plan.collision.risk import clopper_pearson
from vprism_plan.mapping import VPrismMap
from vprism_plan.simulation.scenes import Scene
from vprism_plan.world import PosteriorWorlds

RADIUS = 0.03  # metres
_LENGTHS = (0.1, 0.4)  # metres
_FINE = 0.002  # metres between the places where a path is compared with the truth


@dataclass(frozen=True)
class PathCase(Stored):
    """One path: how many of the worlds object to it, and what the solids say.

    Attributes:
        hits: worlds in which a ball of the sweep touches anything (`PosteriorWorlds.touched`).
        inside: worlds in which the centre of an occupied voxel lies inside the sweep.
        n_worlds: of how many.
        distance: signed distance of the sweep to the nearest true solid, metres; the path
            collides where it is below 0.
        unsupported: whether the sweep holds occluded space that the map cannot judge. No
            draw speaks for it; a checker refuses it unless told otherwise.
    """

    hits: int
    inside: int
    n_worlds: int
    distance: float
    unsupported: bool


@dataclass(frozen=True)
class PathCalibration(Stored):
    """Joint collision probabilities of many paths against what really happens."""

    cases: tuple[PathCase, ...]

    @property
    def judged(self) -> tuple[PathCase, ...]:
        """The paths for which the draws speak: none of their sweep is unsupported."""
        return tuple(case for case in self.cases if not case.unsupported)

    def reliability(self, *, inside: bool = False) -> Reliability:
        """Return the table of the judged paths, as reported or (`inside`) by voxel centres."""
        p = [(case.inside if inside else case.hits) / case.n_worlds for case in self.judged]
        return Reliability.of(np.array(p), np.array([c.distance < 0.0 for c in self.judged], bool))

    def called_safe(self, bound: float = 0.01, confidence: float = 0.95) -> tuple[int, int]:
        """Return how many judged paths have an upper bound below `bound`, and how many collide.

        The bound is Clopper and Pearson's, from the hits as reported.
        """
        safe = collided = 0
        for case in self.judged:
            upper = clopper_pearson(case.n_worlds, confidence)[1][case.hits]
            safe += upper < bound
            collided += upper < bound and case.distance < 0.0
        return int(safe), int(collided)


def random_sweeps(scene: Scene, n: int, seed: int) -> Float[np.ndarray, "n 2 3"]:
    """Return start and end (m) of n straight sweeps, 10 to 40 cm long, near and behind objects.

    Their middles scatter about the objects, up to 8 cm farther from the camera, 3.5 to
    20 cm above the support; none touches the support.
    """
    rng = np.random.default_rng([seed, 0xCA11])
    ends = np.empty((n, 2, 3))
    for row in range(n):
        solid = scene.solids[rng.integers(len(scene.solids))]
        away = solid.center - scene.camera.center
        away[2] = 0.0
        away /= np.linalg.norm(away)
        middle = solid.center + rng.uniform(0.0, 0.08) * away
        middle[:2] += rng.normal(0.0, 0.06, 2)
        middle[2] = rng.uniform(RADIUS + 0.005, 0.2)
        heading = rng.normal(size=3) * [1.0, 1.0, 0.3]
        heading *= 0.5 * rng.uniform(*_LENGTHS) / np.linalg.norm(heading)
        ends[row] = middle - heading, middle + heading
    ends[:, :, 2] = np.maximum(ends[:, :, 2], RADIUS + 0.005)
    return ends


def swept_voxels(
    start: Float[np.ndarray, " 3"], end: Float[np.ndarray, " 3"], radius: float, resolution: float
) -> Int[np.ndarray, "n 3"]:
    """Return the indices of the voxels whose centres lie within `radius` (m) of a segment."""
    lower = np.floor((np.minimum(start, end) - radius) / resolution).astype(np.int64)
    upper = np.ceil((np.maximum(start, end) + radius) / resolution).astype(np.int64)
    axes = [np.arange(a, b + 1) for a, b in zip(lower, upper, strict=True)]
    index = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return index[_distance_to_segment(resolution * index, start, end) <= radius]


def _distance_to_segment(
    points: Float[np.ndarray, "n 3"], start: Float[np.ndarray, " 3"], end: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, " n"]:
    along = end - start
    share = np.clip((points - start) @ along / (along @ along), 0.0, 1.0)
    return np.linalg.norm(points - start - share[:, None] * along, axis=1)


def inside_sweep(worlds: PosteriorWorlds, index: Int[np.ndarray, "n 3"]) -> Bool[np.ndarray, " s"]:
    """Return in which draws any of these voxels is occupied."""
    if len(index) == 0:
        return np.zeros(worlds.n_worlds, dtype=bool)
    return np.asarray((worlds.owners(index) > 0).any(axis=0))


def evaluate_paths(
    scene: Scene, fitted: VPrismMap, n_paths: int, seed: int, n_worlds: int = 512
) -> PathCalibration:
    """Ask `n_worlds` draws and the true solids about the same random sweeps (at least one)."""
    worlds = PosteriorWorlds(fitted, n_worlds, seed, reach=0.06)
    sweeps = random_sweeps(scene, n_paths, seed)
    indices = [swept_voxels(a, b, RADIUS, worlds.resolution) for a, b in sweeps]
    part = knowledge(fitted, worlds.resolution * np.concatenate(indices))
    parts = np.split(part, np.cumsum([len(index) for index in indices])[:-1])
    cases = []
    for (start, end), index, known in zip(sweeps, indices, parts, strict=True):
        length = float(np.linalg.norm(end - start))
        balls = np.linspace(start, end, int(np.ceil(length / (0.5 * worlds.resolution))) + 1)
        places = np.linspace(start, end, int(np.ceil(length / _FINE)) + 1)
        cases.append(
            PathCase(
                int(worlds.touched(balls, RADIUS).any(axis=0).sum()),
                int(inside_sweep(worlds, index).sum()),
                n_worlds,
                float(scene.signed_distance(places).min()) - RADIUS,
                bool((known == UNSUPPORTED).any()),
            )
        )
    return PathCalibration(tuple(cases))
