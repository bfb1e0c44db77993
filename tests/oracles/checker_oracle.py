"""Textbook twin of the checking kernels: 4x4 products, every sphere, every obstacle."""

from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
from scipy.spatial.transform import Rotation

from vprism_plan.robots.kinematics import KinematicArrays


def frame_poses(arrays: KinematicArrays, q: np.ndarray) -> np.ndarray:
    """(..., F, 4, 4) world poses of configurations (..., dof) by products of 4x4 matrices."""
    poses = np.tile(np.eye(4), (*q.shape[:-1], len(arrays.parent), 1, 1))
    poses[..., 0, :3, :3] = arrays.base_R
    poses[..., 0, :3, 3] = arrays.base_t
    for f in range(1, len(arrays.parent)):
        value = arrays.q_mult[f] * q[..., arrays.q_index[f]] + arrays.q_offset[f]
        along = value[..., None] * arrays.axis[f]
        offset, motion = np.eye(4), np.tile(np.eye(4), (*q.shape[:-1], 1, 1))
        offset[:3, :3], offset[:3, 3] = arrays.R_off[f], arrays.t_off[f]
        if arrays.kind[f] == 1:
            turn = Rotation.from_rotvec(along.reshape(-1, 3)).as_matrix()
            motion[..., :3, :3] = turn.reshape(*along.shape, 3)
        else:
            motion[..., :3, 3] = along
        poses[..., f, :, :] = poses[..., arrays.parent[f], :, :] @ offset @ motion
    return poses


def sphere_positions(arrays: KinematicArrays, q: np.ndarray) -> np.ndarray:
    """(..., S, 3) world sphere centres of configurations (..., dof)."""
    poses = frame_poses(arrays, q)[..., arrays.sphere_frame, :, :]
    turned = np.einsum("...sij,sj->...si", poses[..., :3, :3], arrays.sphere_center)
    return turned + poses[..., :3, 3]


@dataclass(frozen=True)
class BallWorld:
    """Obstacles that are balls and half-spaces, so that true distances are formulas."""

    centers: np.ndarray
    radii: np.ndarray
    planes: np.ndarray
    names: tuple[str, ...] = field(default=("object:1",))

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Exact signed distance of points (..., 3) to everything, metres."""
        gaps = np.linalg.norm(points[..., None, :] - self.centers, axis=-1) - self.radii
        best = gaps.min(axis=-1)
        if len(self.planes):
            heights = points @ self.planes[:, :3].T - self.planes[:, 3]
            best = np.minimum(best, heights.min(axis=-1))
        return best

    def baked(
        self, spacing=0.03, lower=(-1.0, -1.0, -1.0), upper=(1.0, 1.0, 1.0), unobserved="free"
    ):
        """What a checker needs: exact distances at the nodes, rounded down to float32."""
        axes = [np.arange(lo, hi, spacing) for lo, hi in zip(lower, upper, strict=True)]
        x, y, z = np.meshgrid(*axes, indexing="ij", sparse=True)
        gaps = np.stack(
            [
                np.sqrt((x - c[0]) ** 2 + (y - c[1]) ** 2 + (z - c[2]) ** 2) - r
                for c, r in zip(self.centers, self.radii, strict=True)
            ]
        )
        distance = np.nextafter(gaps.min(axis=0).astype(np.float32), np.float32(-np.inf))
        baked = SimpleNamespace(
            origin=np.array(lower, dtype=float),
            spacing=spacing,
            distance=distance,
            source=np.argmin(gaps, axis=0).astype(np.int16),
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


def world_clearance(arrays: KinematicArrays, world: BallWorld, q: np.ndarray) -> np.ndarray:
    """(...) exact distance of the moving links' spheres to the world, metres, at q (..., dof)."""
    moving = ~arrays.link_fixed[arrays.sphere_link]
    centers = sphere_positions(arrays, q)[..., moving, :]
    gaps = world.distance(centers) - arrays.sphere_radius[moving]
    return np.min(gaps, axis=-1, initial=np.inf)


def self_clearance(arrays: KinematicArrays, q: np.ndarray) -> np.ndarray:
    """(...) smallest gap over all sphere pairs of all link pairs, metres, at q (..., dof)."""
    centers = sphere_positions(arrays, q)
    best = np.full(q.shape[:-1], np.inf)
    for a, b in arrays.pairs:
        s, t = (np.flatnonzero(arrays.sphere_link == link) for link in (a, b))
        gaps = np.linalg.norm(centers[..., s, None, :] - centers[..., None, t, :], axis=-1)
        gaps = gaps - arrays.sphere_radius[s][:, None] - arrays.sphere_radius[t]
        best = np.minimum(best, gaps.min(axis=(-2, -1), initial=np.inf))
    return best
