# SPDX-License-Identifier: BSD-3-Clause
"""A point robot among balls in its own joint space: exact, fast, no map needed."""

from dataclasses import dataclass, field
from itertools import product
from types import SimpleNamespace

import numpy as np


@dataclass
class PointRobot:
    lower: np.ndarray
    upper: np.ndarray
    continuous: np.ndarray
    name: str = "point"

    @property
    def dof(self):
        return len(self.lower)

    @property
    def joint_names(self):
        return tuple(f"joint_{i}" for i in range(self.dof))

    @property
    def velocity_limits(self):
        return np.linspace(1.0, 2.0, self.dof)


@dataclass(frozen=True)
class DiskReport:
    valid: bool
    reasons: str
    shares: dict = field(default_factory=lambda: {"occluded": 0.25})
    certified: bool = True
    tolerance: float = 0.0

    def text(self):
        return self.reasons


class DiskChecker:
    """Free outside the balls; a motion is free if the whole closed segment is.

    Continuous joints make the world periodic: the balls repeat every turn.
    """

    def __init__(self, centers, radii, robot):
        self.robot = robot
        self.config = SimpleNamespace(margin=0.0)
        shifts = [(-2 * np.pi, 0.0, 2 * np.pi) if free else (0.0,) for free in robot.continuous]
        copies = np.array(list(product(*shifts)))
        centers = np.asarray(centers, dtype=float).reshape(-1, robot.dof)
        self.centers = (centers[:, None] + copies).reshape(-1, robot.dof)
        self.radii = np.repeat(np.asarray(radii, dtype=float), len(copies))

    def _segment_distances(self, qa, qb):
        step = qb - qa
        length2 = float(step @ step)
        rel = self.centers - qa
        t = np.clip(rel @ step / length2, 0.0, 1.0) if length2 > 0.0 else np.zeros(len(rel))
        return np.linalg.norm(rel - t[:, None] * step, axis=1) - self.radii

    def _inside_limits(self, q):
        fixed = ~self.robot.continuous
        low, high = self.robot.lower, self.robot.upper
        return bool(np.all((q >= low)[fixed]) and np.all((q <= high)[fixed]))

    def is_valid(self, q):
        return self.is_valid_buffer(np.asarray(q, dtype=float))

    def is_valid_buffer(self, q):
        return self._inside_limits(q) and self.clearance(q) > 0.0

    def clearance(self, q):
        q = np.asarray(q, dtype=float)
        q = np.where(self.robot.continuous, np.mod(q + np.pi, 2 * np.pi) - np.pi, q)
        return float(np.min(self._segment_distances(q, q), initial=np.inf))

    def check_motion(self, qa, qb):
        return self.check_motion_buffer(np.asarray(qa, dtype=float), np.asarray(qb, dtype=float))

    def check_motion_buffer(self, qa, qb):
        assert np.all(np.abs(qb - qa)[self.robot.continuous] <= 2 * np.pi), "beyond the copies"
        if not (self._inside_limits(qa) and self._inside_limits(qb)):
            return False
        home = np.where(self.robot.continuous, 2 * np.pi * np.round(qa / (2 * np.pi)), 0.0)
        return bool(np.min(self._segment_distances(qa - home, qb - home), initial=np.inf) > 0.0)

    def explain(self, q):
        valid = self.is_valid(q)
        return DiskReport(valid, "free" if valid else "point touches\na ball")

    def check_motion_report(self, qa, qb):
        valid = self.check_motion(qa, qb)
        return DiskReport(valid, "free" if valid else "point touches a ball on the way")


def robot(dof=2, continuous=()):
    free = np.isin(np.arange(dof), continuous)
    return PointRobot(np.where(free, -np.pi, -1.0), np.where(free, np.pi, 1.0), free)


def wall_with_gap(dof=2):
    """A wall of balls across the middle, open at the top: start left, goal right."""
    across = [np.linspace(-1.0, 0.55, 14)] + [np.linspace(-1.0, 1.0, 14)] * (dof - 2)
    centers = np.array([(0.0, *rest) for rest in product(*across)])
    return DiskChecker(centers, np.full(len(centers), 0.15), robot(dof))


def closed_wall():
    """The same wall without the gap: no path exists."""
    ys = np.linspace(-1.2, 1.2, 20)
    return DiskChecker(np.stack([0 * ys, ys], axis=1), np.full(20, 0.15), robot())
