# SPDX-License-Identifier: BSD-3-Clause
"""What every simulated view has in common, whatever its objects are made of."""

import numpy as np
from jaxtyping import Float, Int, UInt8

from vprism_plan.simulation.camera import Camera, DepthNoise

MAX_RANGE = 3.0  # metres of depth beyond which the simulated sensor reports nothing
_PALETTE = np.array(
    [
        [178, 176, 170],  # label 0: table and clutter
        [214, 96, 77],
        [67, 147, 195],
        [90, 174, 97],
        [227, 170, 60],
        [153, 112, 171],
        [80, 190, 190],
        [200, 120, 160],
        [150, 140, 70],
        [110, 110, 200],
        [230, 140, 100],
    ]
)


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
    color = _shade(hit, labels, normals, depth)
    if noise is not None:
        depth = noise.apply(depth, cosine, 1.0 / camera.intrinsics[0, 0], seed)
    return depth, color


def _shade(
    hit: np.ndarray, labels: np.ndarray, normals: np.ndarray, depth: np.ndarray
) -> np.ndarray:
    """Lambert shading with one light from above, one palette colour per object."""
    light = np.array([0.35, -0.25, 0.9])
    intensity = 0.45 + 0.55 * np.clip(normals @ (light / np.linalg.norm(light)), 0.0, 1.0)
    base = _PALETTE[np.where(labels > 0, (labels - 1) % (len(_PALETTE) - 1) + 1, 0)].astype(float)
    base[(hit >= 0) & (labels == 0)] = (120, 110, 100)
    base[depth == 0] = 60
    return np.clip(base * intensity[..., None], 0, 255).astype(np.uint8)
