"""Textbook twin of the checking kernels: 4x4 products, every sphere, every obstacle."""

from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
from scipy.spatial.transform import Rotation

from vprism_plan.robots import KinematicArrays


def frame_poses(arrays: KinematicArrays, q: np.ndarray) -> np.ndarray:
    """(F, 4, 4) world poses by products of homogeneous matrices."""
    poses = np.tile(np.eye(4), (len(arrays.parent), 1, 1))
    poses[0, :3, :3] = arrays.base_R
    poses[0, :3, 3] = arrays.base_t
    for f in range(1, len(arrays.parent)):
        value = arrays.q_mult[f] * q[arrays.q_index[f]] + arrays.q_offset[f]
        offset, motion = np.eye(4), np.eye(4)
        offset[:3, :3], offset[:3, 3] = arrays.R_off[f], arrays.t_off[f]
        if arrays.kind[f] == 1:
            motion[:3, :3] = Rotation.from_rotvec(value * arrays.axis[f]).as_matrix()
        else:
            motion[:3, 3] = value * arrays.axis[f]
        poses[f] = poses[arrays.parent[f]] @ offset @ motion
    return poses


def sphere_positions(arrays: KinematicArrays, q: np.ndarray) -> np.ndarray:
    """(S, 3) world sphere centres."""
    poses = frame_poses(arrays, q)[arrays.sphere_frame]
    return np.einsum("sij,sj->si", poses[:, :3, :3], arrays.sphere_center) + poses[:, :3, 3]


@dataclass(frozen=True)
class BallWorld:
    """Obstacles that are balls and half-spaces, so that true distances are formulas."""

    centers: np.ndarray
    radii: np.ndarray
    planes: np.ndarray
    names: tuple[str, ...] = field(default=("object:1",))

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Exact signed distance to everything, metres."""
        gaps = np.linalg.norm(points[:, None] - self.centers, axis=2) - self.radii
        best = gaps.min(axis=1)
        if len(self.planes):
            best = np.minimum(best, (points @ self.planes[:, :3].T - self.planes[:, 3]).min(axis=1))
        return best

    def baked(
        self, spacing=0.03, lower=(-1.0, -1.0, -1.0), upper=(1.0, 1.0, 1.0), unobserved="free"
    ):
        """What a checker needs: exact distances at the nodes, rounded down to float32."""
        axes = [np.arange(lo, hi, spacing) for lo, hi in zip(lower, upper, strict=True)]
        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        gaps = np.linalg.norm(nodes[:, None] - self.centers, axis=2) - self.radii
        shape = tuple(len(axis) for axis in axes)
        distance = np.nextafter(gaps.min(axis=1).astype(np.float32), np.float32(-np.inf))
        baked = SimpleNamespace(
            origin=np.array(lower, dtype=float),
            spacing=spacing,
            distance=distance.reshape(shape),
            source=np.argmin(gaps, axis=1).astype(np.int16).reshape(shape),
        )
        return SimpleNamespace(
            field=baked,
            planes=self.planes,
            plane_names=("support surface", "known:wall")[: len(self.planes)],
            sources=tuple(f"object:{i + 1}" for i in range(len(self.radii))),
            config=SimpleNamespace(occluded="occupied", unobserved=unobserved),
            map=SimpleNamespace(occupancy=lambda x: (self.distance(x) < 0).astype(float)),
            status=lambda x: np.zeros(len(x), dtype=np.uint8),
        )


def world_clearance(arrays: KinematicArrays, world: BallWorld, q: np.ndarray) -> float:
    """Exact distance of the moving links' spheres to the world, metres."""
    moving = ~arrays.link_fixed[arrays.sphere_link]
    centers = sphere_positions(arrays, q)[moving]
    gaps = world.distance(centers) - arrays.sphere_radius[moving]
    return float(np.min(gaps, initial=np.inf))


def self_clearance(arrays: KinematicArrays, q: np.ndarray) -> float:
    """Smallest gap over all sphere pairs of all link pairs, metres."""
    centers = sphere_positions(arrays, q)
    best = np.inf
    for a, b in arrays.pairs:
        for s in np.flatnonzero(arrays.sphere_link == a):
            for t in np.flatnonzero(arrays.sphere_link == b):
                gap = np.linalg.norm(centers[s] - centers[t])
                best = min(best, gap - arrays.sphere_radius[s] - arrays.sphere_radius[t])
    return best
