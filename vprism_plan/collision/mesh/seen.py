# SPDX-License-Identifier: BSD-3-Clause
"""What the cameras saw off the support surface, and what they could not see, point by point. Of the
map this takes the images alone: neither its classes nor the field have a say."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Bool, Int
from scipy.spatial import cKDTree

from vprism_plan._shapes import Indices
from vprism_plan.collision.mesh.solids import PlacedSolids
from vprism_plan.robots.surfaces import drawn_points
from vprism_plan.world import visibility
from vprism_plan.world.grid import Chosen, Points, Values
from vprism_plan.world.marks import Evidence
from vprism_plan.world.seen import lost_cones, lost_points, surface_points
from vprism_plan.world.unseen_objects import open_sides

SEEN = "a camera saw it there"  # the detail of contacts with observed points
_CELL = 0.03  # metres: one sample of a solid's surface per cube of this edge
_DRAWN = 4000  # points per solid from which they are taken
_ENOUGH = 64  # points of one body whose depth in a solid is worked out, those deepest in its hull


class SeenPoints:
    """Observed points off the support surface, as balls of half their pixel's width.

    Those of the robot are none, nor are flying pixels: the same pixels count as for the world, but
    all of them, however near they lie to the map's surfaces. Where a labelled pixel has no depth,
    the points where its object may be, a grid step apart.

    Attributes:
        bodies: what the points show, and how that is known: ("object:3", SEEN), ...
        classes: (bodies,) class of the map, 0 for what no rule lets a link touch.
    """

    def __init__(
        self, world: Any, placed: PlacedSolids, allowed: Bool[np.ndarray, "links classes"]
    ) -> None:
        self._placed, self._allowed = placed, allowed[placed.links]
        map_, config = world.map, world.config
        bounded = config.support == "seen"
        points, half = visibility.background_points(
            map_.views, map_.plane, config.background_height, config.lone_share, bounded
        )
        parts = [(0, points, half)]
        parts += surface_points(map_, bounded)
        bodies = [("background", SEEN), *((f"object:{i}", SEEN) for i in map_.object_ids)]
        step, judged = config.resolution, judged_field(world)
        for view in map_.views:
            cones = lost_cones(view, map_.plane)
            for object_id, points, half in lost_points(
                view, cones, judged.origin, judged.upper, step
            ):
                body = (f"object:{object_id}", "labelled there, without a depth return")
                bodies += [] if body in bodies else [body]
                parts.append((bodies.index(body), points, half - 0.5 * step))
        self.bodies = tuple(bodies)
        ids = ["background", *(f"object:{i}" for i in map_.object_ids)]
        self.classes = np.array([ids.index(n) if n in ids else 0 for n, _ in bodies])
        self.points = np.concatenate([points for _, points, _ in parts])
        self.half = np.concatenate([half for _, _, half in parts])
        self.body = np.repeat([k for k, _, _ in parts], [len(points) for _, points, _ in parts])
        self._tree = cKDTree(self.points)
        self._widest = float(np.max(self.half, initial=0.0))

    def near(self, need: Values) -> list[int]:
        """Moving solids whose balls come within `need` (metres) of any point."""
        placed, reach = self._placed, self._placed.radii + need + self._widest
        most = float(np.max(reach[placed.moving], initial=0.0))
        away, _ = self._tree.query(placed.centers, distance_upper_bound=most + 1e-9)
        return np.flatnonzero(placed.moving & (away <= reach)).tolist()

    def inside(self, i: int, need: float) -> Iterator[int]:
        """Points within `need` (metres) of solid i that it may not touch, those that seem
        deepest first."""
        rows = self._around(i, need)
        if len(rows):
            reach = self.half[rows] + need
            for row in self._placed.points_within(i, self.points[rows], reach):
                yield int(rows[row])

    def distance(self, i: int, best: float) -> float:
        """Signed distance from a solid to the nearest point, metres; `best` if none is nearer."""
        placed, rows = self._placed, self._around(i, max(best, 0.0))
        bound = placed.solids[i].bound(placed.to_link(i, self.points[rows])) - self.half[rows]
        order = np.argsort(bound, kind="stable")
        for row, least in zip(rows[order].tolist(), bound[order].tolist(), strict=True):
            if least >= best:
                break
            best = min(best, placed.point_gap(i, self.points[row]) - float(self.half[row]))
        return best

    def deepest(self, i: int, need: float) -> dict[int, tuple[float, int]]:
        """Body -> how far its deepest point is from a solid (signed, metres), and which it is."""
        found: dict[int, tuple[float, int]] = {}
        looked = np.zeros(len(self.bodies), dtype=np.int64)
        for row in self.inside(i, need):
            body = int(self.body[row])
            looked[body] += 1
            if looked[body] <= _ENOUGH:
                gap = self._placed.point_gap(i, self.points[row]) - float(self.half[row])
                if body not in found or gap < found[body][0]:
                    found[body] = gap, row
        return found

    def _around(self, i: int, reach: float) -> Int[np.ndarray, "n"]:
        """Points near a solid's ball, but for what it may touch; all, if the reach is infinite."""
        rows = np.arange(len(self.points))
        if np.isfinite(reach):
            ball = float(self._placed.radii[i]) + reach + self._widest
            found = self._tree.query_ball_point(self._placed.centers[i], ball)
            rows = np.array(found, dtype=np.int64)
        return rows[~self._allowed[i, self.classes[self.body[rows]]]]


def judged_field(world: Any) -> Any:
    """The field of the largest box in which a world has judged what was seen."""
    beyond = getattr(world.field, "beyond", None)
    return world.field if beyond is None else beyond


class HiddenSpace:
    """What no camera saw, by the world's policies, asked at points of the robot's surface.

    One point per cube of 3 cm of each moving solid's surface, moved outward by its padding. What
    lies between the points is not noticed.
    """

    def __init__(self, world: Any, placed: PlacedSolids, padding: Values) -> None:
        map_, config = world.map, world.config
        self._map, self._config, self._placed = map_, config, placed
        self._plane = map_.plane
        evidence = Evidence(map_, config)
        self._views, self._below = evidence.views, evidence.below
        # As much room around the robot as the world's cells leave it.
        self._balls = np.concatenate([np.empty((0, 4)), *(view.robot for view in self._views)])
        self._clutter: list[visibility.View] = []
        for view in map_.views:
            start = visibility.clutter_depth(view, map_.plane, config)
            if config.occluded == "posterior" and np.isfinite(start).any():
                self._clutter.append(visibility.shadow_behind(view, start))
        self._sides = open_sides(map_, config, self._views)
        self._near, self._judged = world.field, judged_field(world)
        self._ends = self._judged is not world.field or config.unobserved == "occupied"
        self._idle = (not self._views or config.occluded == "free") and not self._ends
        self._solid, self._samples, self._outward = _samples(placed)
        self._samples += padding[self._solid, None] * self._outward

    def find(self, margin: float) -> tuple[Int[np.ndarray, "n"], Points, Int[np.ndarray, "n"]]:
        """Samples of the placed robot that are hidden once they are moved outward by a margin:
        their solids, places (world, metres) and codes (`visibility.OCCLUDED` or `UNOBSERVED`)."""
        if self._idle or len(self._samples) == 0:
            return np.empty(0, np.int64), np.empty((0, 3)), np.empty(0, np.int64)
        local = self._samples + margin * self._outward
        points = self._placed.from_links(self._solid, local)
        codes = self.codes(points)
        hit = np.flatnonzero(codes)
        return self._solid[hit], points[hit], codes[hit]

    def codes(self, points: Points) -> Int[np.ndarray, "n"]:
        """OCCLUDED or UNOBSERVED for each point (world) that the policies refuse, else 0."""
        config = self._config
        under = np.zeros(len(points), dtype=bool)
        if self._plane is not None:
            under = self._plane.signed_distance(points) < 0.0
        status = visibility.classify_points(self._views, points)
        if self._below is not None and under.any():
            status[under] = visibility.classify_points(self._below, points[under])
        hidden, unknown = status == visibility.OCCLUDED, status == visibility.UNOBSERVED
        if config.occluded == "free":
            hidden[:] = False
        elif config.occluded == "posterior":
            self._leave_to_posterior(points, hidden)
        if config.unobserved == "free":
            unknown[:] = False
        for ball in self._balls:
            reach = ball[3] + config.resolution
            own = ((points - ball[:3]) ** 2).sum(axis=1) <= reach**2
            hidden[own] = unknown[own] = False
        if self._ends:
            lower, upper = self._judged.origin, self._judged.upper
            unknown |= ((points < lower) | (points > upper)).any(axis=1)
        codes = np.where(unknown, visibility.UNOBSERVED, 0)
        codes[hidden] = visibility.OCCLUDED
        if self._below is None:
            codes[under] = 0  # the half-space answers there
        return codes

    def _leave_to_posterior(self, points: Points, hidden: Chosen) -> None:
        """Call what the map has support for not hidden, or what is left to unseen objects, unless
        clutter hides it. Half the support is enough here: the world asks at the middle of a cell.
        """
        rows = np.flatnonzero(hidden)
        if len(rows) == 0:
            return
        known = self._map.judges(points[rows], 0.5 * self._config.min_support)
        if self._sides is not None:
            lower, upper = self._near.origin, self._near.upper
            inside = ((points[rows] >= lower) & (points[rows] <= upper)).all(axis=1)
            known |= inside & ~self._sides.reach(points[rows])
        for shadow in self._clutter:
            known &= visibility.classify_points([shadow], points[rows]) != visibility.OCCLUDED
        hidden[rows[known]] = False


def _samples(placed: PlacedSolids) -> tuple[Indices, Points, Points]:
    """Points of the moving links' surfaces: their solids, places and normals, link frame."""
    moving = np.flatnonzero(placed.moving)
    drawn = [drawn_points(placed.solids[i].triangles, _DRAWN) for i in moving]
    points = np.concatenate([np.empty((0, 3)), *(places for places, _ in drawn)])
    normals = np.concatenate([np.empty((0, 3)), *(outward for _, outward in drawn)])
    solids = np.repeat(moving, _DRAWN)
    cells = np.column_stack([placed.links[solids], np.floor(points / _CELL)])
    _, first = np.unique(cells, axis=0, return_index=True)
    return solids[first], points[first], normals[first]
