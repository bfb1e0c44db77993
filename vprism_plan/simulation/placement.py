# SPDX-License-Identifier: BSD-3-Clause
"""Choosing solids, and placing them close together without touching."""

from dataclasses import replace

import numpy as np

from vprism_plan.simulation.camera import Camera
from vprism_plan.simulation.solids import Box, Capsule, Frustum, Solid, cylinder

_SPACING = 0.006  # metres between the surface samples that the gap is measured with


def upright(xy: np.ndarray, z: float, yaw: float) -> np.ndarray:
    """Return the pose (4, 4) of a solid with its axis vertical, its origin at (xy, z)."""
    c, s = np.cos(yaw), np.sin(yaw)
    pose = np.eye(4)
    pose[:2, :2] = [[c, -s], [s, c]]
    pose[:3, 3] = (xy[0], xy[1], z)
    return pose


def _lying(z: float, yaw: float) -> np.ndarray:
    """Return a pose whose local z axis is horizontal."""
    tilt = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    pose = upright(np.zeros(2), z, yaw)
    pose[:3, :3] = pose[:3, :3] @ tilt
    return pose


def random_solid(rng: np.random.Generator) -> Solid:
    """Return a household-sized solid that rests on z = 0 above the origin."""
    kind = rng.choice(["box", "cylinder", "lying", "cup", "sphere", "capsule"])
    yaw = rng.uniform(-np.pi, np.pi)
    if kind == "box":
        x, y, z = (float(v) for v in rng.uniform([0.02, 0.025, 0.02], [0.05, 0.08, 0.11]))
        return Box((x, y, z), pose=upright(np.zeros(2), z, yaw))
    radius = float(rng.uniform(0.022, 0.045))
    if kind == "sphere":
        return Capsule(radius, 0.0, pose=upright(np.zeros(2), radius, 0.0))
    half = float(rng.uniform(0.03, 0.1))
    if kind == "cylinder":
        return cylinder(radius, half, upright(np.zeros(2), half, yaw))
    if kind == "lying":
        return cylinder(radius, half, _lying(radius, yaw))
    if kind == "capsule":
        return Capsule(radius, half * 0.7, pose=_lying(radius, yaw))
    top = radius * float(rng.uniform(0.5, 1.3))
    return Frustum(radius, top, half, pose=upright(np.zeros(2), half, yaw))


def clearance_between(a: Solid, b: Solid) -> float:
    """Return a lower bound of the distance between two solids, metres.

    Measured from surface samples of each against the exact distance of the other;
    half the diagonal of the sample spacing covers what lies between samples.
    """
    near = min(
        float(b.signed_distance(a.surface_points(_SPACING)).min()),
        float(a.signed_distance(b.surface_points(_SPACING)).min()),
    )
    return near - _SPACING / np.sqrt(2.0)


def _moved(solid: Solid, xy: np.ndarray) -> Solid:
    pose = solid.pose.copy()
    pose[:2, 3] += xy
    return replace(solid, pose=pose)


def gather(solids: list[Solid], gap: tuple[float, float], rng: np.random.Generator) -> list[Solid]:
    """Slide solids towards the origin, one after another, each up to a random gap.

    Returns them in the given order, no two closer than 5 mm.
    """
    placed: list[Solid] = []
    for solid in solids:
        direction = rng.uniform(-np.pi, np.pi)
        heading = np.array([np.cos(direction), np.sin(direction)])
        wanted = max(0.005, float(rng.uniform(*gap)))
        distance = 0.0
        while True:
            candidate = _moved(solid, distance * heading)
            near = min(
                (_quick_clearance(candidate, other, wanted) for other in placed), default=1.0
            )
            if near >= wanted:
                break
            distance += max(0.25 * (wanted - near), 0.003)
        placed.append(candidate)
    return placed


def _quick_clearance(a: Solid, b: Solid, enough: float) -> float:
    """Return the clearance, or the bounding balls' when that alone is enough."""
    balls = float(np.linalg.norm(a.center - b.center)) - a.bounding_radius - b.bounding_radius
    return balls if balls >= enough else clearance_between(a, b)


def random_camera(rng: np.random.Generator) -> Camera:
    """Return a camera 0.8 to 1.2 m from the middle of the scene, 30 to 50 degrees above it."""
    return Camera.orbit(
        np.array([0.0, 0.0, 0.06]),
        float(rng.uniform(0.8, 1.2)),
        float(rng.uniform(-np.pi, np.pi)),
        float(np.deg2rad(rng.uniform(30.0, 50.0))),
    )
