# SPDX-License-Identifier: BSD-3-Clause
"""A depth camera's view of triangle meshes on the table, by ray casting (Embree)."""

from typing import TYPE_CHECKING

import numpy as np

from vprism_plan.errors import MissingDependencyError
from vprism_plan.perception.observation import Observation
from vprism_plan.simulation.camera import Camera, DepthNoise, sense, table_depth

if TYPE_CHECKING:
    import trimesh

DEPTH_UNIT = 0.1  # millimetres per step of a saved depth image
_MILLIMETRE = 0.001


def metres(raw: np.ndarray) -> np.ndarray:
    """Return metres of raw depth, to the last bit as `load_observation` computes them."""
    return raw * (DEPTH_UNIT * _MILLIMETRE)


def observe(
    meshes: "list[trimesh.Trimesh]",
    labels: tuple[int, ...],
    camera: Camera,
    noise: DepthNoise | None,
    seed: int,
) -> Observation:
    """Return what a camera sees of meshes (world, m) with these labels: depth, labels, a picture.

    Depth is rounded to 0.1 mm, which is what the saved image holds; the noise follows `seed`.
    """
    directions = camera.ray_directions()
    depth = table_depth(camera, directions)
    hit = np.full(depth.shape, -1)
    normals = np.zeros_like(directions)
    normals[..., 2] = 1.0
    _cast(meshes, camera, directions, depth, hit, normals)
    ids = np.where(hit >= 0, np.asarray(labels, dtype=np.int32)[hit], 0).astype(np.int32)
    reported, color = sense(camera, directions, depth, normals, ids, hit, noise, seed)
    raw = np.rint(reported / (DEPTH_UNIT * _MILLIMETRE)).astype(np.uint16)
    return Observation(
        metres(raw), ids, camera.intrinsics.copy(), camera.T_world_camera.copy(), color=color
    )


def _cast(
    meshes: "list[trimesh.Trimesh]",
    camera: Camera,
    directions: np.ndarray,
    depth: np.ndarray,
    hit: np.ndarray,
    normals: np.ndarray,
) -> None:
    """Write what lies in front of the table into depth, index of the hit mesh and normals."""
    import trimesh

    try:
        from trimesh.ray.ray_pyembree import RayMeshIntersector
    except ImportError as error:
        raise MissingDependencyError(
            "meshes are rendered with Embree: pip install embreex"
        ) from error
    looked_at = np.zeros(depth.shape, dtype=bool)
    for mesh in meshes:
        middle = mesh.bounds.mean(axis=0)
        looked_at[camera.window(middle, 0.5 * float(np.linalg.norm(mesh.extents)))] = True
    rays = directions[looked_at]
    everything = trimesh.Trimesh(*_joined(meshes), process=False)
    origin = np.broadcast_to(camera.center, rays.shape)
    face = RayMeshIntersector(everything).intersects_first(origin, rays)
    found = face >= 0
    a, b, c = everything.vertices[everything.faces[face[found]]].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    # Embree finds the triangle in single precision; its plane gives the depth in double.
    along = (normal * rays[found]).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (normal * (a - camera.center)).sum(axis=1) / along
    owner = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])[face[found]]
    rows, columns = (index[found] for index in np.nonzero(looked_at))
    closer = np.isfinite(t) & (t > 0) & (t < depth[rows, columns])
    rows, columns = rows[closer], columns[closer]
    depth[rows, columns] = t[closer]
    hit[rows, columns] = owner[closer]
    normals[rows, columns] = normal[closer] / np.linalg.norm(normal[closer], axis=1, keepdims=True)


def _joined(meshes: "list[trimesh.Trimesh]") -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices and faces of all meshes, one after another."""
    before = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + shift for mesh, shift in zip(meshes, before[:-1], strict=True)]
    return np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces)
