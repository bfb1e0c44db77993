# SPDX-License-Identifier: BSD-3-Clause
"""Scores of probabilities as their definitions say, one prediction at a time."""

import math


def brier(p: list[float], y: list[bool]) -> float:
    return sum((pi - (1.0 if yi else 0.0)) ** 2 for pi, yi in zip(p, y, strict=True)) / len(p)


def ece(p: list[float], y: list[bool], bins: int) -> float:
    total = 0.0
    for b in range(bins):
        inside = [
            i
            for i, pi in enumerate(p)
            if b / bins <= pi < (b + 1) / bins or (b == bins - 1 and pi >= 1.0)
        ]
        if inside:
            predicted = sum(p[i] for i in inside) / len(inside)
            observed = sum(bool(y[i]) for i in inside) / len(inside)
            total += len(inside) / len(p) * abs(predicted - observed)
    return total


def binomial_tail(k: int, n: int, p: float) -> float:
    """P(at least k of n)."""
    return sum(math.comb(n, i) * p**i * (1.0 - p) ** (n - i) for i in range(k, n + 1))


def iou(found: list[int], true: list[int], k: int) -> float:
    a = {i for i, value in enumerate(found) if value == k}
    b = {i for i, value in enumerate(true) if value == k}
    return len(a & b) / len(a | b) if a | b else math.nan


def sweep_is_touched(
    centre: tuple[float, ...], start: tuple[float, ...], end: tuple[float, ...], radius: float
) -> bool:
    """Whether any of 201 places of the ball on the segment holds the point."""
    for step in range(201):
        t = step / 200
        square = sum((c - a - t * (b - a)) ** 2 for c, a, b in zip(centre, start, end, strict=True))
        if square <= radius**2:
            return True
    return False
