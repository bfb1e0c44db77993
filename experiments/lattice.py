# SPDX-License-Identifier: BSD-3-Clause
"""How much an answer depends on where the hinge lattice happens to lie.

The lattice is no property of the scene: shifted by half a cell, a map should answer as
before. What is left of a difference is an error of the map's finite basis.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from experiments.path_calibration import inside_sweep, swept_voxels
from vprism_plan.mapping import MapConfig, VPrismMap, fit_map
from vprism_plan.simulation.camera import Camera, DepthNoise
from vprism_plan.simulation.scenes import Scene, upright
from vprism_plan.simulation.solids import sphere
from vprism_plan.world import PosteriorWorlds

RADIUS = 0.02  # metres, of the ball that is swept
_GAPS = (0.0, 0.005, 0.01, 0.02, 0.03)  # metres between the two balls as they pass
_SHIFTS = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1))  # half cells


@dataclass(frozen=True, eq=False)
class LatticeShift:
    """Joint risks (shifts, paths) of the same paths with the lattice shifted; row 0 is not."""

    risks: Float[np.ndarray, "s p"]

    @property
    def change(self) -> Float[np.ndarray, " p"]:
        """The largest change of each path's risk by a shift."""
        return np.asarray(np.abs(self.risks[1:] - self.risks[0]).max(axis=0))


def ball_scene(seed: int) -> tuple[Scene, Float[np.ndarray, "p 2 3"]]:
    """Return a ball of 3, 4 or 5 cm on a table, and 20 cm sweeps behind it, farther and farther.

    The first sweep, of a ball of `RADIUS`, just touches the true ball; the others pass
    0.5 to 3 cm behind it. Camera and place follow from the seed.
    """
    rng = np.random.default_rng([seed, 0xBA11])
    radius = (0.03, 0.04, 0.05)[seed % 3]
    center = np.array([*rng.uniform(-0.02, 0.02, 2), radius])
    azimuth = float(rng.uniform(-np.pi, np.pi))
    elevation = float(np.deg2rad(rng.uniform(35.0, 50.0)))
    camera = Camera.orbit(np.array([0.0, 0.0, 0.04]), 0.9, azimuth, elevation)
    ball = sphere(radius, upright(center[:2], radius, 0.0))
    away = -np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    aside = 0.1 * np.array([-away[1], away[0], 0.0])
    passing = [center + (radius + RADIUS + gap) * away for gap in _GAPS]
    ends = np.array([[middle - aside, middle + aside] for middle in passing])
    return Scene((ball,), (1,), camera, DepthNoise(), seed, f"ball-{seed}"), ends


def sweep_risks(
    fitted: VPrismMap, ends: Float[np.ndarray, "p 2 3"], radius: float, n_worlds: int, seed: int
) -> Float[np.ndarray, " p"]:
    """Return the share of the worlds in which an occupied voxel's centre lies in each sweep."""
    worlds = PosteriorWorlds(fitted, n_worlds, seed)
    voxels = [swept_voxels(a, b, radius, worlds.resolution) for a, b in ends]
    return np.array([inside_sweep(worlds, index).mean() for index in voxels])


def shift_lattice(
    scene: Scene,
    ends: Float[np.ndarray, "p 2 3"],
    config: MapConfig,
    *,
    radius: float = RADIUS,
    n_worlds: int = 2048,
) -> LatticeShift:
    """Fit a scene with its lattice shifted by half a cell, along each axis and along all.

    Data, sampling and draws follow from the same seeds every time. The draws' own
    standard error of a difference is at most sqrt(0.5 / n_worlds), 0.016 for 2048.
    """
    rows = []
    for half in _SHIFTS:
        x, y, z = np.array(config.hinge_shift) + 0.5 * config.hinge_spacing * np.array(half)
        shifted = replace(config, hinge_shift=(float(x), float(y), float(z)))
        fitted = fit_map(scene.observation, shifted, seed=0, prior=None)
        rows.append(sweep_risks(fitted, ends, radius, n_worlds, seed=0))
    return LatticeShift(np.array(rows))
