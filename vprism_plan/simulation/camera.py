# SPDX-License-Identifier: BSD-3-Clause
"""A pinhole camera, what it sees, and the sensor noise of a structured-light depth camera."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int, UInt8

from vprism_plan._shapes import Image, Vector

MAX_RANGE = 3.0  # metres of depth beyond which the simulated sensor reports nothing
_PALETTE = np.frombuffer(  # label 0: table and clutter
    bytes.fromhex("b2b0aad6604d4393c35aae61e3aa3c9970ab50bebec878a0968c466e6ec8e68c64"), np.uint8
).reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class Camera:
    """A posed pinhole camera; pixel (column u, row v) is centred on integer coordinates."""

    T_world_camera: Float[np.ndarray, "4 4"]
    intrinsics: Float[np.ndarray, "3 3"] = field(
        default_factory=lambda: np.array([[608.0, 0, 319.5], [0, 608.0, 239.5], [0, 0, 1.0]])
    )
    width: int = 640
    height: int = 480

    @classmethod
    def look_at(cls, eye: Vector, target: Vector, **kwargs: object) -> "Camera":
        """Return a camera at `eye` that looks at `target`, image rows level with the table."""
        forward = np.asarray(target, dtype=np.float64) - eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        pose[:3, 3] = eye
        return cls(pose, **kwargs)  # type: ignore[arg-type]

    @classmethod
    def orbit(
        cls, target: Vector, distance: float, azimuth: float, elevation: float, **kwargs: object
    ) -> "Camera":
        """Return a camera at `distance` metres from `target`, angles in radians."""
        level = np.cos(elevation)
        offset = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
        return cls.look_at(np.asarray(target) + distance * offset, np.asarray(target), **kwargs)

    @property
    def center(self) -> Float[np.ndarray, "3"]:
        """Return the optical centre in the world, metres."""
        return self.T_world_camera[:3, 3]

    def ray_directions(self) -> Float[np.ndarray, "h w 3"]:
        """Return world directions of all pixels, scaled so that t equals optical depth."""
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        pixels = np.stack([u, v, np.ones_like(u)], axis=-1).astype(np.float64)
        return pixels @ np.linalg.inv(self.intrinsics).T @ self.T_world_camera[:3, :3].T

    def window(self, center: np.ndarray, radius: float) -> tuple[slice, slice]:
        """Return the (rows, columns) that a ball in front of the camera can cover.

        Conservative: a ball that reaches the camera's plane covers the whole image.
        """
        local = (center - self.center) @ self.T_world_camera[:3, :3]
        near = local[2] - radius
        if near <= 1e-3:
            return slice(0, self.height), slice(0, self.width)
        slices = []
        for axis, size in ((1, self.height), (0, self.width)):
            f, c = self.intrinsics[axis, axis], self.intrinsics[axis, 2]
            ends = [
                f * (local[axis] + s * radius) / z + c
                for s in (-1.0, 1.0)
                for z in (near, local[2] + radius)
            ]
            low, high = int(np.floor(min(ends))), int(np.ceil(max(ends))) + 1
            slices.append(slice(min(max(low, 0), size), max(min(high, size), 0)))
        return slices[0], slices[1]


@dataclass(frozen=True)
class DepthNoise:
    """Noise of an active stereo camera at table range.

    The standard deviation of depth grows with depth squared, since disparity is
    measured with a constant error; neighbours share a part of it (the matching
    window). Surfaces seen at grazing angles and pixels beside a depth step are lost
    with some probability, or report a depth between the two sides ("flying").
    """

    sigma_at_1m: float = 0.0015  # metres
    correlation_pixels: float = 2.0
    correlated_share: float = 0.7  # of the variance
    grazing_cosine: float = 0.15  # below it, pixels begin to vanish
    edge_step: float = 0.02  # metres between neighbours that count as a depth step
    edge_hole_probability: float = 0.25
    flying_probability: float = 0.15
    quantum: float = 0.001  # metres

    def apply(self, depth: Image, cosine: Image, pixel_angle: float, seed: int) -> Image:
        """Return a noisy copy of a clean depth image (0 = no return stays 0).

        Args:
            depth: metres along the optical axis.
            cosine: between the ray and the surface normal, per pixel.
            pixel_angle: angle between neighbouring rays, radians.
            seed: of this image; the same seed gives the same bits.
        """
        from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter

        rng = np.random.default_rng([seed, 0x0D3B])
        valid = depth > 0
        white = rng.standard_normal(depth.shape)
        smooth = gaussian_filter(rng.standard_normal(depth.shape), self.correlation_pixels)
        smooth /= smooth.std()
        unit = np.sqrt(self.correlated_share) * smooth + np.sqrt(1 - self.correlated_share) * white
        noisy = depth + self.sigma_at_1m * depth**2 * unit
        near = minimum_filter(np.where(valid, depth, np.inf), size=3)
        far = maximum_filter(depth, size=3)
        # A slanted surface also changes depth from pixel to pixel: that is no step.
        slope = 2.0 * pixel_angle * depth / np.maximum(cosine, 1e-3)
        edge = valid & (far - near > self.edge_step + slope)
        draw = rng.random(depth.shape)
        flying = edge & (draw < self.flying_probability)
        mix = rng.random(depth.shape)
        other_side = np.where(depth - near > far - depth, near, far)
        noisy[flying] = (mix * depth + (1 - mix) * other_side)[flying]
        lost = edge & (draw > 1 - self.edge_hole_probability)
        lost |= cosine < self.grazing_cosine * rng.random(depth.shape)
        noisy = np.round(noisy / self.quantum) * self.quantum
        return np.where(valid & ~lost & (noisy > 0), noisy, 0.0)


def table_depth(camera: Camera, directions: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    """Return the optical depth of the table z = 0 along each ray, metres; inf for a miss."""
    with np.errstate(divide="ignore"):
        table = -camera.center[2] / directions[..., 2]
    return np.where(table > 0, table, np.inf)


def sense(
    camera: Camera,
    directions: Float[np.ndarray, "h w 3"],
    depth: Float[np.ndarray, "h w"],
    normals: Float[np.ndarray, "h w 3"],
    labels: Int[np.ndarray, "h w"],
    hit: Int[np.ndarray, "h w"],
    noise: DepthNoise | None,
    seed: int,
) -> tuple[Float[np.ndarray, "h w"], UInt8[np.ndarray, "h w 3"]]:
    """Return the depth that the sensor reports (0 = no return), and a shaded picture.

    Args:
        camera: the view.
        directions: rays with optical depth 1 per unit of parameter.
        depth: exact optical depth, metres, inf for a miss.
        normals: unit normals of what each ray hits.
        labels: object id, 0 for the table and for clutter.
        hit: index of the body, -1 for the table.
        noise: sensor model, or None for exact depth.
        seed: of the noise.
    """
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    cosine = np.abs((unit * normals).sum(-1))
    depth = np.where(depth > MAX_RANGE, 0.0, depth)
    # Lambert shading with one light from above, one palette colour per object.
    light = np.array([0.35, -0.25, 0.9])
    intensity = 0.45 + 0.55 * np.clip(normals @ (light / np.linalg.norm(light)), 0.0, 1.0)
    base = _PALETTE[np.where(labels > 0, (labels - 1) % (len(_PALETTE) - 1) + 1, 0)].astype(float)
    base[(hit >= 0) & (labels == 0)] = (120, 110, 100)
    base[depth == 0] = 60
    color = np.clip(base * intensity[..., None], 0, 255).astype(np.uint8)
    if noise is not None:
        depth = noise.apply(depth, cosine, 1.0 / camera.intrinsics[0, 0], seed)
    return depth, color
