"""What is measured of a reconstruction, one point after the other."""

import math


def grid_of(center, spacing, reach, shift):
    """All nodes spacing * (i + shift) within reach of a centre along each axis."""
    axes = []
    for c in center:
        reachable = range(
            math.floor((c - reach) / spacing) - 2, math.ceil((c + reach) / spacing) + 2
        )
        axes.append(
            [spacing * (i + shift) for i in reachable if abs(spacing * (i + shift) - c) <= reach]
        )
    return [(x, y, z) for x in axes[0] for y in axes[1] for z in axes[2]]


def iou_counts(points, probability, true_id, k, level):
    """Points in both and in either of {P >= level} and object k."""
    both = either = 0
    for point in points:
        held, there = probability(point) >= level, true_id(point) == k
        both += held and there
        either += held or there
    return both, either


def chamfer(a, b):
    """Both mean distances to the nearest point of the other cloud, added."""
    there = [min(math.dist(p, q) for q in b) for p in a]
    back = [min(math.dist(p, q) for q in a) for p in b]
    return sum(there) / len(there) + sum(back) / len(back)


def kernel_mass(point, hinges, gamma, cutoff):
    """Sum of the Gaussian kernel over all hinge points, values below the cutoff left out."""
    values = [math.exp(-gamma * math.dist(point, hinge) ** 2) for hinge in hinges]
    return sum(value for value in values if value >= cutoff)


def entropy(row):
    """Of a row scaled to sum 1."""
    total = sum(row)
    return -sum(p / total * math.log(p / total) for p in row if p > 0)
