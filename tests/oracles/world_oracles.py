# SPDX-License-Identifier: BSD-3-Clause
"""Slow, plain twins of the world's fast parts, and maps with a formula."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vprism_plan.perception import Observation, Plane


@dataclass
class KernelMap:
    """A map with the interface of `VPrismMap`, made of a few Gaussian kernels per class.

    Class logits are bias_k + sum_i weights[i, k] exp(-|x - hinge_i|^2 / (2 length^2)),
    with the kernel cut off at `cutoff_radius`; probabilities are their softmax.
    """

    hinges: np.ndarray
    weights: np.ndarray
    bias: np.ndarray
    kernel_length: float = 0.02236
    views: tuple[Observation, ...] = ()
    plane: Plane | None = None
    object_ids: tuple[int, ...] = ()
    cutoff_radius: float = field(init=False)

    def __post_init__(self) -> None:
        self.cutoff_radius = self.kernel_length * np.sqrt(-2.0 * np.log(1e-5))
        if not self.object_ids:
            self.object_ids = tuple(range(1, self.weights.shape[1]))

    @property
    def n_classes(self) -> int:
        return self.weights.shape[1]

    def _kernels(self, points: np.ndarray) -> np.ndarray:
        square = (
            (points**2).sum(1)[:, None]
            - 2.0 * points @ self.hinges.T
            + (self.hinges**2).sum(1)[None, :]
        )
        values = np.exp(-square / (2.0 * self.kernel_length**2))
        values[values < 1e-5] = 0.0
        return values

    def predict_proba(self, points: np.ndarray) -> np.ndarray:
        out = np.empty((len(points), self.n_classes))
        for start in range(0, len(points), 20000):
            piece = slice(start, start + 20000)
            logits = self.bias + self._kernels(np.asarray(points[piece])) @ self.weights
            logits -= logits.max(axis=1, keepdims=True)
            exp = np.exp(logits)
            out[piece] = exp / exp.sum(axis=1, keepdims=True)
        return out

    def occupancy(self, points: np.ndarray) -> np.ndarray:
        return self.predict_proba(points)[:, 1:].sum(axis=1)

    def occupied_on_lattice(self, axes: list[np.ndarray], level: float) -> np.ndarray:
        """Return the points of a regular lattice with P(occupied) >= level.

        The kernel is a product over the axes, so this costs one product per hinge and node.
        """
        logits = np.tile(self.bias, (*(len(axis) for axis in axes), 1))
        for hinge, weight in zip(self.hinges, self.weights, strict=True):
            parts = []
            for axis, h in zip(axes, hinge, strict=True):
                a, b = np.searchsorted(axis, (h - self.cutoff_radius, h + self.cutoff_radius))
                parts.append(slice(a, b))
            ex, ey, ez = (
                np.exp(-((axis[part] - h) ** 2) / (2.0 * self.kernel_length**2))
                for axis, part, h in zip(axes, parts, hinge, strict=True)
            )
            values = ex[:, None, None] * ey[None, :, None] * ez
            values[values < 1e-5] = 0.0
            for k in np.flatnonzero(weight):
                logits[(*parts, k)] += weight[k] * values
        top = logits.max(axis=-1)
        occupied = np.exp(logits[..., 1:] - top[..., None]).sum(axis=-1)
        empty = np.exp(logits[..., 0] - top)
        index = np.argwhere(occupied >= level * (occupied + empty))
        return np.stack([axis[i] for axis, i in zip(axes, index.T, strict=True)], axis=1)

    def entropy(self, points: np.ndarray) -> np.ndarray:
        p = np.clip(self.predict_proba(points), 1e-300, 1.0)
        return -(p * np.log(p)).sum(axis=1)

    def support(self, points: np.ndarray) -> np.ndarray:
        return self._kernels(np.asarray(points)).sum(axis=1)

    def judges(self, points: np.ndarray, min_support: float) -> np.ndarray:
        return self.support(points) >= min_support

    def occupancy_log_odds(self, points: np.ndarray) -> np.ndarray:
        p = self.predict_proba(points)
        return np.clip(np.log(p[:, 1:].sum(axis=1)) - np.log(p[:, 0]), -40, 40)

    @property
    def unsupported_occupancy(self) -> float:
        exp = np.exp(self.bias - self.bias.max())
        return float(exp[1:].sum() / exp.sum())

    def support_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return (
            self.hinges.min(axis=0) - self.cutoff_radius,
            self.hinges.max(axis=0) + self.cutoff_radius,
        )


def random_map(seed: int, objects: int = 2, **extra: Any) -> KernelMap:
    """Return lumpy objects on a table: clusters of positive weights, negative ones around."""
    rng = np.random.default_rng(seed)
    hinges, weights = [], []
    for k in range(1, objects + 1):
        center = np.append(rng.uniform(-0.12, 0.12, 2), rng.uniform(0.04, 0.08))
        inside = center + rng.normal(0.0, rng.uniform(0.01, 0.03), (rng.integers(4, 10), 3))
        around = rng.normal(size=(15, 3))
        around = center + around / np.linalg.norm(around, axis=1)[:, None] * rng.uniform(0.05, 0.09)
        hinges += [inside, around]
        positive = np.zeros((len(inside), objects + 1))
        positive[:, k] = rng.uniform(2.0, 8.0, len(inside))
        positive[:, 0] = -rng.uniform(2.0, 8.0, len(inside))
        negative = np.zeros((len(around), objects + 1))
        negative[:, 0] = rng.uniform(0.0, 8.0, len(around))
        weights += [positive, negative]
    bias = np.append(rng.uniform(1.0, 2.5), -rng.uniform(0.5, 1.5, objects))
    return KernelMap(np.concatenate(hinges), np.concatenate(weights), bias, **extra)


def level_points(map_: Any, spacing: float, level: float, shift: np.ndarray) -> np.ndarray:
    """All points of a shifted lattice over the support with P(occupied) >= level."""
    lower, upper = map_.support_bounds()
    axes = [
        np.arange(a + s * spacing, b, spacing) for a, b, s in zip(lower, upper, shift, strict=True)
    ]
    if isinstance(map_, KernelMap):
        return map_.occupied_on_lattice(axes, level)
    found = []
    for x in axes[0]:
        y, z = np.meshgrid(axes[1], axes[2], indexing="ij")
        points = np.stack([np.full(y.size, x), y.reshape(-1), z.reshape(-1)], axis=1)
        found.append(points[map_.occupancy(points) >= level])
    return np.concatenate(found)


def brute_force_distance(labels: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Distance, in lattice steps, from each target to the nearest marked node."""
    marked = np.argwhere(labels)
    if len(marked) == 0:
        return np.full(len(targets), np.inf)
    return np.sqrt(((targets[:, None, :] - marked[None, :, :]) ** 2).sum(axis=2)).min(axis=1)


def point_status(observation: Observation, point: np.ndarray, tolerance: float) -> int:
    """What one view says of a point, from the four pixels around its image."""
    local = np.linalg.inv(observation.pose) @ np.append(point, 1.0)
    if local[2] <= 1e-6:
        return 2
    K = observation.intrinsics
    u = K[0, 0] * local[0] / local[2] + K[0, 2]
    v = K[1, 1] * local[1] / local[2] + K[1, 2]
    height, width = observation.shape
    complete, nearest = True, np.inf
    for row in {int(np.floor(v)), int(np.ceil(v))}:
        for column in {int(np.floor(u)), int(np.ceil(u))}:
            if not (0 <= row < height and 0 <= column < width):
                complete = False
                continue
            depth = float(observation.depth[row, column])
            if depth <= 0:
                complete = False
                continue
            sigma = 0.0012 + 0.0019 * (depth - 0.4) ** 2
            nearest = min(nearest, depth + max(tolerance, 3 * sigma))
    if local[2] > nearest:
        return 1
    return 0 if complete else 2
