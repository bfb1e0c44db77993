# SPDX-License-Identifier: BSD-3-Clause
"""Spheres that hold a link: fitted to its surface and what is inside it, or tiles of a solid.

A sphere of radius ``r`` whose centre lies ``a`` deep in a solid stands out of it by ``r - a``
at most; one whose centre lies ``b`` outside, by ``r + b``: with the signed distance ``s`` to
the surface, both are ``r + s(centre)``. The surface is cut into small triangles, each of which
must lie in one sphere. Three steps, all without chance:

1. A greedy choice among centres inside the link, for the smallest ``r + s`` by bisection.
2. In turns, each triangle goes to the sphere that stands out least by holding it, and each
   sphere moves to where it stands out least while it holds its triangles (Lloyd's
   iteration, for the largest figure instead of the mean).
3. The radii shrink to what is needed; spheres that nothing needs are dropped.
"""

from __future__ import annotations

import hashlib
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.distance import cdist

from vprism_plan._arguments import number, whole
from vprism_plan._files import cache_folder, replacing
from vprism_plan._shapes import Indices, Points, Spheres, Triangles, Values, Vector
from vprism_plan.errors import RobotError
from vprism_plan.robots import surfaces
from vprism_plan.robots.geometry import PrimitiveGeometry
from vprism_plan.robots.surfaces import Surface, with_hull

_logger = logging.getLogger(__name__)
_MOST, _ARM_SIZED = 12, 0.35
_CENTRES, _MORE_CENTRES = 400, 1000
_CLOSE = 0.015  # of an object's diagonal, that spheres may stand out by without more of them
_MANY, _ROUNDS = 25_000, 30  # triangles beyond which boxes around them are held, as of scans
_SLACK, _HAIR = 1e-9, 1e-9  # relative, and metres: what rounding may take away from a radius
_STEPS = np.array(list(np.ndindex(3, 3, 3)), dtype=np.float64) - 1.0
_STEPS /= np.maximum(np.linalg.norm(_STEPS, axis=1, keepdims=True), 1.0)


@dataclass(frozen=True)
class SphereFit:
    """How spheres are fitted to links that have none.

    Of each link the fewest spheres are taken that stand out by no more than the tolerance, or
    ``max_spheres``, which stand out as little as they can.

    Attributes:
        tolerance: Metres by which a sphere may stand out of its link.
        relative: The same as a share of the diagonal of the link's box; the smaller counts.
        max_spheres: At most so many for each link: one number, or a table by link. None, and
            links that the table leaves out: 12, and for links whose box has a diagonal above
            0.35 m so many more as their surface is larger, 64 at most.

    Raises:
        RobotError: A value is not positive.
    """

    tolerance: float = 0.03
    relative: float = 0.15
    max_spheres: int | Mapping[str, int] | None = None

    def __post_init__(self) -> None:
        for name in ("tolerance", "relative"):
            number(name, getattr(self, name), 0.0, above=True, error=RobotError)
        table = self.max_spheres
        for most in table.values() if isinstance(table, Mapping) else [table]:
            if most is not None:
                whole("max_spheres", most, 1, error=RobotError)

    def most(self, link: str, triangles: Triangles) -> int:
        """Return the largest number of spheres for a link with this surface."""
        table = self.max_spheres
        most = table.get(link) if isinstance(table, Mapping) else table
        if most is not None:
            return int(most)
        return min(64, max(_MOST, math.ceil(_MOST * (_diagonal(triangles) / _ARM_SIZED) ** 2)))

    def allowed(self, triangles: Triangles) -> float:
        """Return the metres by which a sphere may stand out of these triangles."""
        return min(self.tolerance, self.relative * _diagonal(triangles))


def _diagonal(triangles: Triangles) -> float:
    return float(np.linalg.norm(np.ptp(triangles.reshape(-1, 3), axis=0)))


def fit_spheres(triangles: Triangles, tolerance: float, max_spheres: int) -> Spheres:
    """Spheres whose union holds a surface, and what it encloses.

    Of the inside, the cells of a lattice (18 to 40 along the longest edge) are held that the
    surface does not reach; what is left lies within two cells of the surface.

    Args:
        triangles: (f, 3, 3) corners, metres; closed or not, in one piece or many.
        tolerance: Metres by which spheres may stand out if `max_spheres` suffice for it.
        max_spheres: At most so many, but for a hollow that they leave.

    Returns:
        (n, 4) rows (x, y, z, radius), metres; the same for equal arguments.
    """
    corners = np.ascontiguousarray(triangles, dtype=np.float64)
    return _fit(corners.tobytes(), tolerance, max_spheres).copy()


def hold_object(triangles: Triangles, max_spheres: int = 32) -> Spheres:
    """As :func:`fit_spheres`, but never more than so many, and no open shell counts as solid.

    Figures of how far they stand out are in ``tests/robots/test_attached.py``.
    """
    count, tolerance = max_spheres, _CLOSE * _diagonal(triangles)
    while True:
        rows = _fitted(triangles, tolerance, count, strict=True)
        # One sphere around the surface holds what it encloses.
        if len(rows) <= max_spheres or count == 1:
            return rows[:max_spheres]
        count = max(1, count + max_spheres - len(rows))


# The wheels, fingers and arms of a robot are often alike.
@lru_cache(maxsize=256)
def _fit(corners: bytes, tolerance: float, max_spheres: int) -> Spheres:
    """Of a file of the cache, whose name is a digest of all that the spheres hang on, else made."""
    program = b"".join(Path(file).read_bytes() for file in (__file__, surfaces.__file__))
    libraries = [version(name) for name in ("numpy", "scipy", "trimesh")]
    key = hashlib.sha256(program + f"{libraries} {tolerance!r} {max_spheres} ".encode() + corners)
    folder = cache_folder("spheres")
    file = None if folder is None else folder / key.hexdigest()
    content = file.read_bytes() if file is not None and file.is_file() else b""
    if hashlib.sha256(content[32:]).digest() == content[:32]:
        return np.frombuffer(content[32:]).reshape(-1, 4)
    surface = with_hull(np.frombuffer(corners).reshape(-1, 3, 3))
    rows = np.ascontiguousarray(_fitted(surface, tolerance, max_spheres))
    if file is not None:
        try:
            with replacing(file) as temporary:
                temporary.write_bytes(hashlib.sha256(rows.tobytes()).digest() + rows.tobytes())
        except OSError as error:
            _logger.warning("fitted spheres are not kept: %s", error)
    return rows


def _fitted(
    triangles: Triangles, tolerance: float, max_spheres: int, strict: bool = False
) -> Spheres:
    surface = Surface.of(triangles, tolerance, _MANY if strict else None)
    index = np.argwhere(surface.filled)
    centres = surface.lower + surface.cell * (index + 0.5)
    depth = -surface.lattice[tuple(index.T)]
    chosen = _candidate_cells(depth, _MORE_CENTRES if strict else _CENTRES)
    centres, depth = centres[chosen], depth[chosen]
    reach = surface.reach(centres).astype(np.float32) * np.float32(1.0 + 1e-6)
    # Moving the spheres afterwards gains about a fifth.
    first = _greedy_cover(reach, depth + 1.25 * tolerance, max_spheres)
    count = max_spheres if first is None else len(first)
    while True:
        start = _smallest(reach, depth, count)
        spheres, protrusion = _settled(surface, centres[start])
        if protrusion <= tolerance or count >= max_spheres:
            break
        count = min(max_spheres, count + max(1, count // 4))
    return _filled_up(surface, spheres, max(protrusion, 0.0) if strict else 0.0)


def _smallest(reach: np.ndarray, depth: Values, count: int) -> list[int]:
    """Centres of at most `count` spheres that hold all and stand out least, by bisection."""
    alone = reach.max(axis=1) - depth
    best, low, high = [int(alone.argmin())], 0.0, float(alone.min())
    for _ in range(7):
        middle = 0.5 * (low + high)
        found = _greedy_cover(reach, depth + middle, count)
        if found is None:
            low = middle
        else:
            best, high = found, middle
    return best


def _candidate_cells(depth: Values, most: int) -> Indices:
    """Cells to centre spheres on: the deepest ones and an even selection of the others."""
    if len(depth) <= most:
        return np.arange(len(depth))
    deepest = np.argsort(-depth, kind="stable")[: most // 4]
    spread = np.linspace(0, len(depth) - 1, most - len(deepest)).astype(np.int64)
    return np.unique(np.concatenate([deepest, spread]))


def _greedy_cover(reach: np.ndarray, radius: Values, most: int) -> list[int] | None:
    """Choose spheres until all is held, always the one that holds most of what is new."""
    holds = reach <= radius[:, None]
    if not holds.any(axis=0).all():
        return None
    left = np.ones(reach.shape[1], dtype=bool)
    gain = holds.sum(axis=1)
    chosen: list[int] = []
    while left.any():
        if len(chosen) == most:
            return None
        chosen.append(int(np.argmax(gain)))
        new = left & holds[chosen[-1]]
        left &= ~new
        gain -= holds[:, new].sum(axis=1)
    return chosen


def _settled(surface: Surface, centres: Points) -> tuple[Spheres, float]:
    """Move spheres until their largest protrusion stands still; return it, too."""
    centres = centres.copy()
    reach = surface.reach(centres)
    before, still = math.inf, 0
    for _ in range(_ROUNDS):
        cost = reach + surface.signed(centres)[:, None]
        owner, worst = cost.argmin(axis=0), float(cost.min(axis=0).max())
        still = still + 1 if before - worst < 1e-3 * worst else 0
        if still > 2:
            break
        before = worst
        for i in range(len(centres)):
            own = np.flatnonzero(owner == i)
            if len(own):
                centres[i] = _moved(surface, centres[i], own)
                reach[i] = surface.reach(centres[i : i + 1])[0]
    cost = reach + surface.signed(centres)[:, None]
    radius = cost.min(axis=0).max() - surface.signed(centres)
    return _tightened(surface, centres, reach, radius)


def _moved(surface: Surface, centre: Vector, own: Indices) -> Vector:
    """Where a sphere that holds these triangles stands out least, by a pattern search."""
    points = surface.points[np.unique(surface.faces[own])]

    def cost(x: np.ndarray) -> np.ndarray:
        return np.sqrt(cdist(x, points, "sqeuclidean").max(axis=1)) + surface.signed(x)

    best = float(cost(centre[None])[0])
    step = 0.3 * float(np.linalg.norm(points - centre, axis=1).max())
    for _ in range(10):
        around = centre + step * _STEPS
        values = cost(around)
        least = int(values.argmin())
        if values[least] < best - 1e-6:
            best, centre = float(values[least]), around[least]
        else:
            step *= 0.5
    return centre


def _tightened(
    surface: Surface, centres: Points, reach: Float[np.ndarray, "n t"], radius: Values
) -> tuple[Spheres, float]:
    """Cut every radius to what no other sphere holds, worst first."""
    centres, reach, radius = centres.copy(), reach.copy(), radius.copy()
    kept = np.ones(len(centres), dtype=bool)
    holds = reach <= radius[:, None] * (1.0 + _SLACK)
    for i in np.argsort(-(radius + surface.signed(centres)), kind="stable"):
        kept[i] = False
        own = np.flatnonzero(~holds[kept].any(axis=0))
        if len(own) == 0:
            continue
        kept[i] = True
        centres[i] = _moved(surface, centres[i], own)
        reach[i] = surface.reach(centres[i : i + 1])[0]
        radius[i] = reach[i, own].max() * (1.0 + _SLACK) + _HAIR
        holds[i] = reach[i] <= radius[i]
    spheres = np.column_stack([centres[kept], radius[kept]])
    return spheres, float((radius + surface.signed(centres))[kept].max())


def _filled_up(surface: Surface, spheres: Spheres, room: float) -> Spheres:
    """Add spheres that stand out by `room` until every cell that no surface reaches is held."""
    index = np.argwhere(surface.whole)
    middles = surface.lower + surface.cell * (index + 0.5)
    depth = -surface.lattice[tuple(index.T)]
    half = 0.5 * math.sqrt(3.0) * surface.cell
    while True:
        gap = np.linalg.norm(middles[:, None] - spheres[None, :, :3], axis=2) - spheres[:, 3]
        open_cells = gap.min(axis=1) > -half
        open_cells[open_cells] = ~_cells_held(middles[open_cells], surface.cell, spheres)
        if not open_cells.any():
            return spheres
        deepest = int(np.argmax(np.where(open_cells, depth, -np.inf)))
        radius = max(float(depth[deepest]) + room, half)
        spheres = np.vstack([spheres, [*middles[deepest], radius * (1.0 + _SLACK)]])


def _cells_held(
    middles: Points, edge: float, spheres: Spheres, deep: int = 3
) -> Bool[np.ndarray, "n"]:
    """Whether cubes lie in the union of spheres: each, or each of its eighths, in one."""
    offsets = np.array(list(np.ndindex(2, 2, 2))) - 0.5
    if len(middles) == 0:
        return np.zeros(0, dtype=bool)
    corners = middles[:, None] + edge * offsets
    away = np.linalg.norm(corners[:, :, None] - spheres[None, None, :, :3], axis=3)
    held = (away <= spheres[:, 3]).all(axis=1).any(axis=1)
    if deep and not held.all():
        parts = (middles[~held][:, None] + 0.5 * edge * offsets).reshape(-1, 3)
        held[~held] = _cells_held(parts, 0.5 * edge, spheres, deep - 1).reshape(-1, 8).all(axis=1)
    return np.asarray(held)


# -------------------------------------------------------------------------------------- tiles
# Pieces of about this size (metres) protrude by about half of it.
_TILE_EDGE, _MAX_TILES = 0.06, 64


def enclosing_spheres(solid: PrimitiveGeometry) -> Spheres:
    """Spheres whose union holds a solid.

    A box is cut into box cells, a cylinder into slices of rings of sectors; each piece gets a
    ball through its corners, which are what is farthest from the ball's centre.

    Returns:
        (n, 4) rows (x, y, z, radius) in the link's frame, metres.
    """
    if solid.kind == "sphere":
        return np.array([[*solid.T_link[:3, 3], solid.size[0] + solid.padding]])
    local = _tile_cylinder(*solid.size) if solid.kind == "cylinder" else _tile_box(solid.size)
    local[:, :3] = local[:, :3] @ solid.T_link[:3, :3].T + solid.T_link[:3, 3]
    # Neither rounding nor a proof, for which a cylinder is a prism, may find a gap at corners.
    local[:, 3] = local[:, 3] * (1.0 + 1e-3) + solid.padding
    return local


def _tile_cylinder(radius: float, length: float) -> Spheres:
    """A ball on the axis and rings of balls around it, repeated along the axis."""
    edge = max(_TILE_EDGE, radius / 5.0)  # five rings are more than the most tiles
    while True:
        disc = _tile_disc(radius, edge)
        # A slender cylinder gains nothing from slices much thinner than it is wide.
        slices = math.ceil(length / max(0.5 * edge, min(edge, radius)))
        if len(disc) * slices <= _MAX_TILES:
            break
        edge *= 1.1
    step = length / slices
    heights = (np.arange(slices) + 0.5) * step - 0.5 * length
    rows = np.empty((slices, len(disc), 4))
    rows[..., :2] = disc[:, :2]
    rows[..., 2] = heights[:, None]
    rows[..., 3] = np.hypot(disc[:, 2], 0.5 * step)
    return rows.reshape(-1, 4)


def _tile_disc(radius: float, edge: float) -> Points:
    """Circles (x, y, radius) whose union holds a disc: one in the middle, and rings of sectors."""
    rings = math.ceil(radius / edge)
    width = radius / rings
    circles = [np.array([[0.0, 0.0, width]])]
    for ring in range(1, rings):
        inner, outer = ring * width, (ring + 1) * width
        n = max(4, math.ceil(2 * math.pi * outer / edge))
        half = math.pi / n
        # Equally far from the sector's inner and outer corners.
        middle = (inner + outer) / (2 * math.cos(half))
        reach = math.hypot(outer * math.cos(half) - middle, outer * math.sin(half))
        turn = 2 * half * np.arange(n)
        circles.append(
            np.column_stack([middle * np.cos(turn), middle * np.sin(turn), np.full(n, reach)])
        )
    return np.vstack(circles)


def _tile_box(size: Sequence[float]) -> Spheres:
    edges = np.asarray(size)
    edge = min(_TILE_EDGE, float(edges.min()))
    while (counts := np.ceil(edges / edge).astype(int)).prod() > _MAX_TILES:
        edge *= 1.1
    cell = edges / counts
    axes = [(np.arange(n) + 0.5) * c - 0.5 * e for n, c, e in zip(counts, cell, edges, strict=True)]
    centers = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.column_stack([centers, np.full(len(centers), 0.5 * np.linalg.norm(cell))])
