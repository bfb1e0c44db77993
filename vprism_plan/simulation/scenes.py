# SPDX-License-Identifier: BSD-3-Clause
"""Table scenes with known geometry, seen by a simulated depth camera.

World frame: z up, table top at z = 0, metres. A scene keeps the analytic solids, so
the signed distance to the truth is exact everywhere, also where no camera sees.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from vprism_plan.perception.observation import Observation
from vprism_plan.simulation.camera import Camera, DepthNoise, sense, table_depth
from vprism_plan.simulation.solids import Box, Capsule, Frustum, Solid, cylinder, sphere

if TYPE_CHECKING:
    import trimesh

_SPACING = 0.006  # metres between the surface samples that gaps between solids are measured with


@dataclass(frozen=True, eq=False)
class Scene:
    """Solids on a table, the camera, and what the camera saw.

    `labels[i]` is the object id of `solids[i]`; 0 marks clutter that the segmentation
    does not know. The table is the half-space z <= 0.
    """

    solids: tuple[Solid, ...]
    labels: tuple[int, ...]
    camera: Camera
    noise: DepthNoise | None = None
    seed: int = 0
    name: str = "scene"

    @cached_property
    def observation(self) -> Observation:
        """What the scene's own camera saw, with its noise."""
        return render(self, self.camera, noise=self.noise, seed=self.seed)

    @property
    def object_ids(self) -> tuple[int, ...]:
        """Return the sorted labels of all labelled solids, hidden ones included."""
        return tuple(sorted({label for label in self.labels if label > 0}))

    def signed_distance(
        self, points: Float[np.ndarray, "n 3"], *, table: bool = False
    ) -> Float[np.ndarray, "n"]:
        """Return the exact signed distance to the nearest true solid, metres, negative inside.

        With `table`, the half-space z <= 0 counts too. Inside touching solids the value is
        exact per solid (the union's may be deeper).
        """
        points = np.asarray(points, dtype=np.float64)
        best = points[:, 2].copy() if table else np.full(len(points), np.inf)
        for solid in self.solids:
            np.minimum(best, solid.signed_distance(points), out=best)
        return best

    def object_of(self, points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n"]:
        """Return the object id at each point: 0 where no solid is, -1 in unlabelled clutter."""
        ids = np.zeros(len(points), dtype=np.int64)
        for solid, label in zip(self.solids, self.labels, strict=True):
            ids[solid.signed_distance(points) <= 0] = label if label > 0 else -1
        return ids

    def truth_meshes(self) -> "dict[int, trimesh.Trimesh]":
        """Return the true surface of each labelled object as a watertight mesh."""
        import trimesh

        meshes: dict[int, trimesh.Trimesh] = {}
        for solid, label in zip(self.solids, self.labels, strict=True):
            if label > 0:
                mesh = solid.mesh()
                meshes[label] = meshes[label] + mesh if label in meshes else mesh
        return dict(sorted(meshes.items()))


def render(
    scene: Scene, camera: Camera, *, noise: DepthNoise | None = None, seed: int = 0
) -> Observation:
    """Ray-cast depth, labels and a shaded colour image of a scene.

    Args:
        scene: the solids; its own camera is not used.
        camera: the view to render.
        noise: sensor model, or None for exact depth.
        seed: of the noise; the same seed gives the same bits.
    """
    directions = camera.ray_directions()
    shape = directions.shape[:2]
    depth = table_depth(camera, directions)
    labels = np.zeros(shape, dtype=np.int32)
    hit = np.full(shape, -1)
    for index, (solid, label) in enumerate(zip(scene.solids, scene.labels, strict=True)):
        rows, columns = camera.window(solid.center, solid.bounding_radius)
        rays = directions[rows, columns]
        if rays.size == 0:
            continue
        t = solid.intersect(camera.center, rays.reshape(-1, 3)).reshape(rays.shape[:2])
        closer = t < depth[rows, columns]
        depth[rows, columns][closer] = t[closer]
        labels[rows, columns][closer] = label
        hit[rows, columns][closer] = index
    normals = np.zeros((*shape, 3))
    normals[..., 2] = 1.0
    for index, solid in enumerate(scene.solids):
        mask = hit == index
        points = camera.center + depth[mask][:, None] * directions[mask]
        normals[mask] = solid.normals(points)
    depth, color = sense(camera, directions, depth, normals, labels, hit, noise, seed)
    return Observation(
        depth.astype(np.float32),
        labels,
        camera.intrinsics.copy(),
        camera.T_world_camera.copy(),
        color=color,
    )


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
            pose = solid.pose.copy()
            pose[:2, 3] += distance * heading
            candidate = replace(solid, pose=pose)
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


def random_scene(
    n_objects: int,
    seed: int,
    noise: bool = True,
    *,
    n_clutter: int = 0,
    gap: tuple[float, float] = (0.01, 0.05),
) -> Scene:
    """Return a seeded scene of objects that stand close together.

    Args:
        n_objects: labelled objects, ids 1 to n_objects.
        seed: every choice and the sensor noise follow from it.
        noise: whether the depth carries `DepthNoise()`.
        n_clutter: further solids that carry no label.
        gap: range of the clearance between neighbours, metres (at least 5 mm).
    """
    rng = np.random.default_rng([seed, 0x5CE2])
    solids = gather([random_solid(rng) for _ in range(n_objects + n_clutter)], gap, rng)
    order = rng.permutation(len(solids))  # clutter anywhere, not always outermost
    labels = np.zeros(len(solids), dtype=int)
    labels[order[:n_objects]] = np.arange(1, n_objects + 1)
    return Scene(
        tuple(solids),
        tuple(int(label) for label in labels),
        random_camera(rng),
        DepthNoise() if noise else None,
        seed,
        f"random-{n_objects}-{seed}",
    )


def hidden_object_scene(seed: int, noise: bool = True) -> Scene:
    """Return a scene in which object 2 is wholly hidden behind object 1.

    Object 2 stands within 1 to 6 cm behind a large box and has no visible pixel
    (checked here); object 3 stands freely to the side. The observation's
    `object_ids` are therefore (1, 3).
    """
    rng = np.random.default_rng([seed, 0x41DD])
    azimuth = rng.uniform(-np.pi, np.pi)
    camera = Camera.orbit(np.array([0.0, 0.0, 0.08]), rng.uniform(0.85, 1.1), azimuth, 0.55)
    away = -np.array([np.cos(azimuth), np.sin(azimuth)])  # from the camera to the scene
    aside = np.array([-away[1], away[0]])
    half = (0.03, 0.12, rng.uniform(0.12, 0.14))
    screen = Box(half, pose=upright(np.zeros(2), half[2], azimuth))
    size = rng.uniform(0.02, 0.03)
    spot = away * (half[0] + size + rng.uniform(0.01, 0.06)) + aside * rng.uniform(-0.04, 0.04)
    if rng.random() < 0.5:
        hidden: Solid = Capsule(size, 0.0, pose=upright(spot, size, 0.0))
    else:
        hidden = cylinder(size, size, upright(spot, size, 0.0))
    place = aside * rng.choice([-1.0, 1.0]) * rng.uniform(0.2, 0.25)
    free = cylinder(0.035, 0.06, upright(place, 0.06, 0.0))
    scene = Scene(
        (screen, hidden, free),
        (1, 2, 3),
        camera,
        DepthNoise() if noise else None,
        seed,
        f"hidden-{seed}",
    )
    visible = int((render(scene, camera).labels == 2).sum())
    if visible:
        raise AssertionError(f"hidden_object_scene({seed}): {visible} pixels of object 2 are seen")
    return scene


def demo_scene() -> Scene:
    """Return the scene of the demo, which `save_scene` wrote to `vprism_plan/data/demo_scene`.

    Six objects form a wall along y, seen from one side, that an arm must cross around or over,
    with short objects hidden behind tall ones.
    """
    solids = (
        Box((0.03, 0.08, 0.115), pose=upright(np.array([-0.02, -0.02]), 0.115, 0.15)),
        cylinder(0.034, 0.055, upright(np.array([0.07, 0.10]), 0.055, 0.0)),
        Frustum(0.045, 0.03, 0.08, pose=upright(np.array([-0.045, 0.135]), 0.08, 0.0)),
        Box((0.045, 0.035, 0.03), pose=upright(np.array([0.09, -0.01]), 0.03, 0.7)),
        sphere(0.037, upright(np.array([0.075, -0.125]), 0.037, 0.0)),
        cylinder(0.033, 0.09, upright(np.array([-0.05, -0.175]), 0.09, 0.0)),
    )
    camera = Camera.orbit(np.array([0.0, 0.0, 0.06]), 0.95, np.deg2rad(200.0), np.deg2rad(38.0))
    return Scene(solids, (1, 2, 3, 4, 5, 6), camera, DepthNoise(), 7, "demo")
