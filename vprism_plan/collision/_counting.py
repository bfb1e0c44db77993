# SPDX-License-Identifier: BSD-3-Clause
"""Which posterior worlds a robot touches: at a configuration, along a path."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from vprism_plan._kernels import checking, risk
from vprism_plan.collision._risk_setting import Setting
from vprism_plan.collision._travel import AT_MOST
from vprism_plan.errors import RobotError

_FIRST = np.zeros(1, np.int64)


@dataclass(frozen=True)
class Sweep:
    """Samples of a path and what they touch.

    Attributes:
        centers: (n, 3, S) sphere centres, metres.
        slack: (n, S) metres by which the spheres grow to cover the way to the next sample.
        waypoints: (T,) samples that are waypoints.
        touched: (n_worlds,) worlds that touch anything.
        counts: (n,) worlds that touch at each sample.
        first: (n_worlds,) sample of the first touch, -1 if none.
    """

    centers: Float[np.ndarray, "n 3 s"]
    slack: Float[np.ndarray, "n s"]
    waypoints: Int[np.ndarray, " t"]
    touched: np.ndarray
    counts: Int[np.ndarray, " n"]
    first: Int[np.ndarray, " w"]


def count_path(at: Setting, path: Float[np.ndarray, "t dof"]) -> Sweep:
    """Sample a path without gaps and count the worlds that it touches."""
    if len(path) == 1:
        return count_each(at, path)
    steps = np.empty(len(path) - 1, np.int64)
    n = int(checking.count_steps(path, at.floats, at.ints, at.spacing, steps)) + 1
    if n > AT_MOST:
        raise RobotError(
            f"a path of {len(path)} waypoints needs {n:,} configurations to miss nothing on the "
            f"way; at most {AT_MOST:,}: ask for parts of it"
        )
    centers = np.empty((n, 3, len(at.radii)))
    slack = np.empty((n, len(at.radii)))
    checking.place_path(path, steps, at.floats, at.ints, centers, slack)
    waypoints = np.concatenate(([0], np.cumsum(steps)))
    return Sweep(centers, slack, waypoints, *_touch(at, centers, slack))


def count_each(at: Setting, Q: Float[np.ndarray, "n dof"]) -> Sweep:
    """Count the worlds that each configuration touches; nothing between them."""
    centers = np.empty((len(Q), 3, len(at.radii)))
    checking.place_spheres_batch(Q, at.floats, at.ints, centers)
    slack = np.zeros((len(Q), len(at.radii)))
    waypoints = np.arange(len(Q)) if len(Q) > 1 else _FIRST
    return Sweep(centers, slack, waypoints, *_touch(at, centers, slack))


def recount(at: Setting, sweep: Sweep, within: bool = False) -> Sweep:
    """Count again at a sweep's samples, for spheres of other radii.

    With `within`, the samples alone, not the way between them.
    """
    slack = np.zeros_like(sweep.slack) if within else sweep.slack
    return Sweep(sweep.centers, slack, sweep.waypoints, *_touch(at, sweep.centers, slack))


def count_at(at: Setting, q: Float[np.ndarray, "dof"]) -> tuple[Float[np.ndarray, "3 s"], int]:
    """Sphere centres at a configuration, and how many worlds they touch: the quick way."""
    worlds = at.worlds
    centers = np.empty((3, len(at.radii)))
    checking.place_spheres(q, at.floats, at.ints, centers)
    tables, (scale, reach) = worlds.tables, worlds.scale
    hits = risk.touch_one(
        centers, at.radii, at.sphere_tables, tables.distance_row, tables.rows, tables.lowest,
        worlds.first, worlds.resolution, scale, reach,
        np.zeros(worlds.n_worlds, np.uint8),
    )  # fmt: skip
    if hits < 0:  # the first to ask here: bake, then count
        hits = int(_touch(at, centers[None], np.zeros((1, len(at.radii))))[1][0])
    return centers, hits


def _touch(
    at: Setting, centers: Float[np.ndarray, "n 3 s"], slack: Float[np.ndarray, "n s"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Touched worlds, count at each sample, first sample of each world; bakes what it needs."""
    worlds = at.worlds
    scale, reach = worlds.scale
    while True:
        tables = worlds.tables
        touched = np.zeros(worlds.n_worlds, np.uint8)
        counts = np.empty(len(centers), np.int64)
        first = np.full(worlds.n_worlds, -1, np.int64)
        wanted = worlds.new_marks()
        missing = risk.touch(
            centers, slack, at.radii, at.sphere_tables, tables.distance_row, tables.rows,
            tables.lowest, worlds.first, worlds.resolution, scale, reach,
            touched, counts, first, wanted,
        )  # fmt: skip
        if not missing:
            return touched, counts, first
        worlds.bake_marked(wanted)
