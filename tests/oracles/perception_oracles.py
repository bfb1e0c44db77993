# SPDX-License-Identifier: BSD-3-Clause
"""Small analytic scenes seen by a pinhole camera, with the faults of a stereo sensor."""

from dataclasses import dataclass, field

import numpy as np

BACKGROUND = 0


def intrinsics(width: int = 320, height: int = 240) -> np.ndarray:
    focal = 0.96 * width
    return np.array([[focal, 0, width / 2 - 0.5], [0, focal, height / 2 - 0.5], [0, 0, 1.0]])


def look_at(eye, target=(0.0, 0.0, 0.0)) -> np.ndarray:
    """Pose of a camera at `eye` (world z up) looking at `target`; OpenCV axes."""
    eye, target = np.asarray(eye, float), np.asarray(target, float)
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x = np.array([1.0, 0, 0]) if np.linalg.norm(x) < 1e-9 else x / np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    pose[:3, 3] = eye
    return pose


@dataclass
class Scene:
    """Spheres (centre, radius) and boxes (lower, upper) on the table z = 0, x, y in `table`.

    `panels` are unlabelled parallelograms, each a corner and two edges: walls, boards, floors.
    """

    spheres: list = field(default_factory=list)
    boxes: list = field(default_factory=list)
    table: tuple = ((-0.6, -0.6), (0.6, 0.6))
    floor: float | None = None
    wall: float | None = None  # a wall at x = wall, facing -x
    panels: list = field(default_factory=list)

    def render(self, pose, K, shape=(240, 320)) -> tuple[np.ndarray, np.ndarray]:
        """Exact depth (0 = nothing) and labels: spheres first, then boxes."""
        rows, cols = np.mgrid[: shape[0], : shape[1]]
        rays = np.stack(
            [(cols - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1], np.ones(shape)], -1
        ).reshape(-1, 3)
        direction = rays @ pose[:3, :3].T  # z-depth = ray parameter
        origin = pose[:3, 3]
        depth = np.full(len(rays), np.inf)
        labels = np.zeros(len(rays), np.int32)

        def hit(t, label):
            closer = (t > 1e-6) & (t < depth)
            depth[closer], labels[closer] = t[closer], label

        with np.errstate(divide="ignore", invalid="ignore"):
            t = -origin[2] / direction[:, 2]
            on = origin + t[:, None] * direction
            lower, upper = np.array(self.table)
            inside = ((on[:, :2] >= lower) & (on[:, :2] <= upper)).all(axis=1)
            hit(np.where(inside, t, np.inf), BACKGROUND)
            if self.floor is not None:
                hit((self.floor - origin[2]) / direction[:, 2], BACKGROUND)
            if self.wall is not None:
                hit((self.wall - origin[0]) / direction[:, 0], BACKGROUND)
            for corner, first, second in self.panels:
                hit(_panel(origin - np.asarray(corner), direction, first, second), BACKGROUND)
            for number, (centre, radius) in enumerate(self.spheres, start=1):
                hit(_sphere(origin - np.asarray(centre), direction, radius), number)
            for number, (low, high) in enumerate(self.boxes, start=len(self.spheres) + 1):
                hit(_box(origin, direction, np.asarray(low), np.asarray(high)), number)
        depth[~np.isfinite(depth)] = 0.0
        return depth.reshape(shape), labels.reshape(shape)


def bin_walls(slope, half=(0.16, 0.09), height=0.15) -> list:
    """Panels of a bin around a floor of `half` sizes (m) at z = 0; `slope` in degrees."""
    out = height / np.tan(np.radians(slope))
    a, b = half
    walls = []
    for side in (1.0, -1.0):  # wider than the corner, where the next wall hides it
        walls.append(((side * a, -b - out, 0), (0, 2 * (b + out), 0), (side * out, 0, height)))
        walls.append(((-a - out, side * b, 0), (2 * (a + out), 0, 0), (0, side * out, height)))
    return walls


def shelf_walls(width=0.8, depth=0.3, clear=0.35) -> list:
    """Back, sides and upper board of a shelf, open towards -x, over a board at z = 0."""
    left, up, back = (0, width, 0), (0, 0, clear), (depth, 0, 0)
    low = (-depth / 2, -width / 2, 0.0)
    return [
        ((depth / 2, -width / 2, 0.0), left, up),
        (low, back, up),
        ((-depth / 2, width / 2, 0.0), back, up),
        ((-depth / 2, -width / 2, clear), back, left),
    ]


def _panel(origin, direction, first, second):
    edges = np.array([first, second], dtype=float)
    normal = np.cross(*edges)
    t = -(origin @ normal) / (direction @ normal)
    along = np.linalg.solve(edges @ edges.T, edges @ (origin + t[:, None] * direction).T)
    return np.where(((along >= 0) & (along <= 1)).all(axis=0), t, np.inf)


def _sphere(origin, direction, radius):
    a = (direction**2).sum(axis=1)
    b = direction @ origin
    square = b**2 - a * (origin @ origin - radius**2)
    return np.where(square >= 0, (-b - np.sqrt(np.maximum(square, 0))) / a, np.inf)


def _box(origin, direction, low, high):
    first, second = (low - origin) / direction, (high - origin) / direction
    near = np.minimum(first, second).max(axis=1)
    far = np.maximum(first, second).min(axis=1)
    return np.where((near <= far) & (near > 0), near, np.inf)


def spoil(depth, rng, noise=0.0015, holes=0.01, flying=True, specks=0):
    """Add noise that grows as depth^2, holes, ramps across depth edges, and specks.

    Returns the depth and a mask of the pixels that were made to fly.
    """
    spoiled = depth + rng.normal(size=depth.shape) * noise * depth**2
    made = np.zeros(depth.shape, dtype=bool)
    if flying:
        for axis in (0, 1):
            for r, c in np.argwhere(np.abs(np.diff(depth, axis=axis)) > 0.1):
                other = (r + 1, c) if axis == 0 else (r, c + 1)
                if depth[r, c] > 0 and depth[other] > 0:
                    spoiled[r, c] = (depth[r, c] + depth[other]) / 2
                    made[r, c] = True
    spoiled[(depth == 0) | (rng.random(depth.shape) < holes)] = 0.0
    for r, c in zip(
        rng.integers(2, depth.shape[0] - 2, specks),
        rng.integers(2, depth.shape[1] - 2, specks),
        strict=True,
    ):
        spoiled[r, c : c + 2] = 0.6 * depth[r, c]
        made[r, c : c + 2] = True
    return np.maximum(spoiled, 0.0).astype(np.float32), made & (spoiled > 0)


def intersection_over_union(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max(1, (a | b).sum()))
