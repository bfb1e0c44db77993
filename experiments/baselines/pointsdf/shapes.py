# SPDX-License-Identifier: BSD-3-Clause
"""Table scenes to train on: single solids and assemblies of several, close together.

Broader than `random_scene`, whose solids are all convex: bottles, hammers, bent and branching
things out of two to four solids, lying, standing or tilted.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from vprism_plan.simulation.camera import Camera, DepthNoise
from vprism_plan.simulation.scenes import Scene, random_solid
from vprism_plan.simulation.solids import Box, Capsule, Frustum, Solid, cylinder

Body = tuple[Solid, ...]  # the solids of one object

_SPACING = 0.008  # metres between the surface samples that bodies are kept apart by
_ROOM = 12  # pixels of table around what a cropped camera sees


def training_scene(seed: int, *, views: int = 1) -> list[Scene]:
    """Return one arrangement of 3 to 9 objects, seen by `views` cameras with noise of their own.

    Objects have ids 1, 2, ... and z = 0 is the table, as in `random_scene`; the images are
    cropped to what the objects can cover.
    """
    rng = np.random.default_rng([seed, 0x5DF])
    count = int(rng.integers(3, 10))
    bodies = [(random_solid(rng),) if rng.random() < 0.4 else assembly(rng) for _ in range(count)]
    bodies = _huddle(bodies, rng)
    solids = tuple(solid for body in bodies for solid in body)
    labels = tuple(i + 1 for i, body in enumerate(bodies) for _ in body)
    return [
        Scene(
            solids, labels, cropped(_camera(rng), solids), DepthNoise(), 1000 * seed + view,
            f"training-{seed}-{view}",
        )
        for view in range(views)
    ]  # fmt: skip


def assembly(rng: np.random.Generator) -> Body:
    """Return an object of two to four overlapping solids that touches z = 0 from above."""
    kind = rng.choice(["bottle", "limbs", "arc", "lumps", "tilted"])
    body: list[Solid] = []
    if kind == "bottle":
        radius, half = rng.uniform(0.02, 0.045), rng.uniform(0.03, 0.08)
        neck, reach = radius * rng.uniform(0.3, 0.8), rng.uniform(0.01, 0.035)
        body.append(cylinder(radius, half, _at(0.0, 0.0, 0.0)))
        if rng.random() < 0.5:
            shoulder = rng.uniform(0.008, 0.02)
            body.append(Frustum(radius, neck, shoulder, pose=_at(0.0, 0.0, half + shoulder)))
            body.append(cylinder(neck, reach, _at(0.0, 0.0, half + 2 * shoulder + reach)))
        else:
            body.append(cylinder(neck, reach, _at(0.0, 0.0, half + reach)))
    elif kind == "limbs":
        main = rng.uniform(0.04, 0.1)
        body.append(_limb(rng, main))
        for _ in range(int(rng.integers(1, 3))):
            long = main * rng.uniform(0.4, 0.9)
            turn = np.eye(4)
            turn[:3, :3] = Rotation.from_euler(
                "xz", [rng.uniform(60, 120), rng.choice([0.0, 0.0, 180.0, 90.0])], degrees=True
            ).as_matrix()
            turn[:3, 3] = (0.0, 0.0, main * rng.uniform(-1.0, 1.0))
            out = np.eye(4)
            out[2, 3] = long * rng.uniform(0.7, 1.0)
            body.append(_moved(_limb(rng, long), turn @ out))
    elif kind == "arc":
        radius, bend = rng.uniform(0.05, 0.12), rng.uniform(0.3, 0.7)
        thick = rng.uniform(0.013, 0.024)
        for step in range(4):
            angle = bend * (step - 1.5)
            pose = np.eye(4)
            pose[:3, :3] = Rotation.from_euler("y", angle).as_matrix()
            pose[:3, 3] = radius * np.array([np.cos(angle) - 1.0, 0.0, -np.sin(angle)])
            body.append(Capsule(thick, radius * bend * 0.5, pose=pose))
    elif kind == "lumps":
        for _ in range(int(rng.integers(2, 5))):
            radius = rng.uniform(0.018, 0.04)
            place = rng.normal(size=3)
            place *= rng.uniform(0.0, 0.045) / np.linalg.norm(place)
            body.append(Capsule(radius, rng.uniform(0.0, 0.02), pose=_at(*place)))
    else:
        body.append(random_solid(rng))
    return _resting(body, rng, free=kind in {"lumps", "tilted"})


def cropped(camera: Camera, solids: Sequence[Solid]) -> Camera:
    """Return the camera with its image cut to what the solids can cover; the same pixels."""
    windows = [camera.window(solid.center, solid.bounding_radius) for solid in solids]
    top = max(min(rows.start for rows, _ in windows) - _ROOM, 0)
    bottom = min(max(rows.stop for rows, _ in windows) + _ROOM, camera.height)
    left = max(min(columns.start for _, columns in windows) - _ROOM, 0)
    right = min(max(columns.stop for _, columns in windows) + _ROOM, camera.width)
    intrinsics = camera.intrinsics.copy()
    intrinsics[:2, 2] -= (left, top)
    return Camera(camera.T_world_camera, intrinsics, right - left, bottom - top)


def _camera(rng: np.random.Generator) -> Camera:
    return Camera.orbit(
        np.array([0.0, 0.0, 0.06]),
        float(rng.uniform(0.7, 1.3)),
        float(rng.uniform(-np.pi, np.pi)),
        float(np.deg2rad(rng.uniform(22.0, 60.0))),
    )


def _limb(rng: np.random.Generator, half: float) -> Solid:
    """Return a solid about twice `half` (m) long in z."""
    thick = rng.uniform(0.012, 0.03)
    kind = rng.choice(["box", "cylinder", "capsule"])
    if kind == "box":
        return Box((thick, float(rng.uniform(0.012, 0.035)), half))
    return cylinder(thick, half) if kind == "cylinder" else Capsule(thick, half)


def _at(x: float, y: float, z: float) -> Float[np.ndarray, "4 4"]:
    pose = np.eye(4)
    pose[:3, 3] = (x, y, z)
    return pose


def _moved(solid: Solid, transform: Float[np.ndarray, "4 4"]) -> Solid:
    return replace(solid, pose=transform @ solid.pose)


def _resting(body: Sequence[Solid], rng: np.random.Generator, *, free: bool) -> Body:
    """Turn a body to stand, lie or (`free`, or one in ten) anyhow, its lowest point at z = 0."""
    turn = np.eye(4)
    if free or rng.random() < 0.1:
        turn[:3, :3] = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    else:
        tilt = rng.choice([0.0, 0.0, 90.0, 180.0])
        spin, yaw = rng.choice([0.0, 90.0, 180.0, 270.0]), rng.uniform(0.0, 360.0)
        angles = [spin, tilt, yaw]
        turn[:3, :3] = Rotation.from_euler("zyz", angles, degrees=True).as_matrix()
    turned = [_moved(solid, turn) for solid in body]
    low = min(float(s.surface_points(_SPACING)[:, 2].min()) for s in turned)
    return tuple(_moved(solid, _at(0.0, 0.0, -low)) for solid in turned)


def _huddle(bodies: Sequence[Body], rng: np.random.Generator) -> list[Body]:
    """Slide bodies to the origin one after another, until 5 mm to 5 cm from those before."""
    placed: list[Body] = []
    for body in bodies:
        own = np.concatenate([solid.surface_points(_SPACING) for solid in body])
        middle = np.array([*own[:, :2].mean(axis=0), 0.0])
        own -= middle
        angle, wanted = rng.uniform(-np.pi, np.pi), rng.uniform(0.005, 0.05)
        heading, distance = np.array([np.cos(angle), np.sin(angle), 0.0]), 0.0
        others = [solid for other in placed for solid in other]
        while others:
            at = own + distance * heading
            near = min(float(solid.signed_distance(at).min()) for solid in others)
            if near >= wanted:
                break
            distance += max(0.5 * (wanted - near), 0.004)
        shift = distance * heading - middle
        placed.append(tuple(_moved(solid, _at(*shift)) for solid in body))
    return placed
