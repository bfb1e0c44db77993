# SPDX-License-Identifier: BSD-3-Clause
"""PointConv as its definition says: one centre, one neighbour, one channel at a time."""

import math

import numpy as np


def mlp(layers: list[tuple[np.ndarray, np.ndarray]], x: np.ndarray, last: str) -> np.ndarray:
    """Linear layers (weight (out, in), bias) with ReLU between, and `last` after the last."""
    for i, (weight, bias) in enumerate(layers):
        x = np.array([sum(w * v for w, v in zip(row, x, strict=True)) for row in weight]) + bias
        if i < len(layers) - 1 or last == "relu":
            x = np.array([max(v, 0.0) for v in x])
        else:
            x = np.array([1.0 / (1.0 + math.exp(-v)) for v in x])
    return x


def pointconv(points, features, centers, neighbours, bandwidth, lift, weigh, dense, mix, norm):
    """Features (m, out) of the first `centers` points, or of the origin if `centers` is None."""
    n = len(points)
    sparse = [
        n / sum(math.exp(max(-(math.dist(p, q) ** 2) / (2 * bandwidth**2), -20.0)) for q in points)
        for p in points
    ]
    chosen = []
    if centers is None:
        chosen.append((np.zeros(3), list(range(n)), points))
    else:
        for c in points[:centers]:
            order = sorted(range(n), key=lambda j, c=c: math.dist(points[j], c))[:neighbours]
            chosen.append((c, order, [points[j] - c for j in order]))
    squares = [math.dist(points[j], c) ** 2 for c, order, _ in chosen for j in order]
    reach = max(math.sqrt(sum(squares) / len(squares)), 1e-3)
    rows = []
    for c, order, seen in chosen:
        largest = max(sparse[j] for j in order)
        outer = 0.0
        for j, place in zip(order, seen, strict=True):
            h = mlp(lift, np.concatenate([place, features[j]]), "relu")
            h = h * mlp(dense, np.array([sparse[j] / largest]), "sigmoid")[0]
            w = mlp(weigh, (points[j] - c) / reach, "relu")
            outer = outer + np.array([[a * b for b in w] for a in h])
        out = mix[0] @ (outer / len(order)).ravel() + mix[1]
        out = (out - out.mean()) / math.sqrt(out.var() + 1e-5) * norm[0] + norm[1]
        rows.append([max(v, 0.0) for v in out])
    return np.array(rows)
