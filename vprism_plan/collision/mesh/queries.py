# SPDX-License-Identifier: BSD-3-Clause
"""What touches what at one configuration: a robot's solids, a world's surfaces, FCL between."""

import math
from collections.abc import Iterator
from itertools import chain
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from vprism_plan.collision.config import CheckerConfig
from vprism_plan.collision.explain import UP, Touch, contact, deepest
from vprism_plan.collision.mesh import fcl
from vprism_plan.collision.mesh.seen import HiddenSpace, SeenPoints
from vprism_plan.collision.mesh.solids import MeshWorld, PlacedSolids
from vprism_plan.collision.reports import Contact
from vprism_plan.world.grid import Chosen, Values, Vector
from vprism_plan.world.sources import source_of
from vprism_plan.world.visibility import UNSEEN


class Queries:
    """Answers about the configuration that was placed last.

    Bounds are compared with numpy first, and FCL is asked only about pairs whose bounds meet: no
    manager has to be told what moved. `allowed` says of each link and class whether they may touch
    (class 0 never), `seen` whether observed points and hidden space count, too.
    """

    def __init__(
        self,
        world: Any,
        placed: PlacedSolids,
        surfaces: MeshWorld,
        allowed: Bool[np.ndarray, "links classes"],
        config: CheckerConfig,
        seen: bool,
    ) -> None:
        self.world = world
        self.placed = placed
        self.solids = placed.solids
        self.surfaces = surfaces
        self._allowed = allowed
        self._planes = np.asarray(world.planes, dtype=np.float64).reshape(-1, 4)
        self._pairs = placed.pairs()
        self._margin, self._self_margin = config.margin, config.self_margin
        # Padding is a distance to keep from the world: the solids stay as they are.
        self._padding = placed.robot.arrays.link_padding[placed.links]
        self._need = config.margin + self._padding
        self._apart = placed.radii[self._pairs].sum(axis=1) + config.self_margin
        # Pairs of solid and body that are never looked at: allowed, or of a fixed link.
        self._ignored = allowed[placed.links][:, surfaces.classes] | ~placed.moving[:, None]
        self._points = SeenPoints(world, placed, allowed) if seen else None
        self._hidden = HiddenSpace(world, placed, self._padding) if seen else None

    def collides(self) -> bool:
        """Whether a moving solid comes too near to the world, or two links to each other."""
        for plane in self._planes:
            if (self.placed.plane_gaps(plane) <= self._need)[self.placed.moving].any():
                return True
        near = self._near()
        return (
            any(self._touches(int(i), int(b)) for i, b in np.argwhere(near))
            or bool(self._swallowed(near).any())
            or any(self._collide(int(i), int(j)) for i, j in self._near_pairs())
            or self._touches_points()
            or any(True for _ in self._unseen(self._margin))
        )

    def clearance(self) -> float:
        """Return `MeshChecker.clearance`, metres."""
        placed, best = self.placed, math.inf
        for plane in self._planes:
            gaps = placed.plane_gaps(plane) - self._padding
            best = min(best, float(np.min(gaps[placed.moving], initial=best)))
        if self._swallowed(self._near()).any() or any(True for _ in self._unseen(0.0)):
            best = min(best, 0.0)
        bounds = self.surfaces.box_distances(placed.centers)
        bounds -= (placed.radii + self._padding)[:, None]
        bounds[self._ignored] = np.inf
        owner = self._owners()
        for flat in np.argsort(bounds, axis=None):
            i, b = (int(v) for v in np.unravel_index(flat, bounds.shape))
            # Where the bounds overlap they say nothing of how deep the solid is.
            if bounds[i, b] > max(best, 0.0) or not np.isfinite(bounds[i, b]):
                break
            best = min(best, self._gap(i, b, int(owner[i])) - self._padding[i])
        if self._points is not None:
            for i in np.flatnonzero(placed.moving).tolist():
                padding = float(self._padding[i])
                best = min(best, self._points.distance(i, best + padding) - padding)
        return float(best)

    def self_clearance(self) -> float:
        """Return the smallest gap between two links that the robot tests, metres."""
        return min((self._link_gap(int(i), int(j)) for i, j in self._pairs), default=math.inf)

    def contacts(self) -> list[Contact]:
        """Return the deepest contact of each link and body."""
        near = self._near()
        world = self._plane_contacts(), self._body_contacts(near, self._need)
        seen = self._swallowed_contacts(near), self._point_contacts(), self._hidden_contacts()
        return deepest(chain(*world, *seen, self._self_contacts()))

    def permitted(self) -> list[Contact]:
        """Return the deepest contact of each link with each object that it may touch."""
        distances = self.surfaces.box_distances(self.placed.centers)
        near = (distances <= self.placed.radii[:, None]) & self._ignored
        near &= self.placed.moving[:, None]
        return deepest(self._body_contacts(near, np.zeros(len(self.solids)), "allowed"))

    def link_distance(self, link: str, body: str) -> float:
        """Return `MeshChecker.link_distance`, metres."""
        placed, names = self.placed, self.placed.robot.link_names
        rows = np.flatnonzero(placed.links == names.index(link)).tolist()
        if body in self.world.plane_names:
            plane = self._planes[self.world.plane_names.index(body)]
            gaps = (placed.plane_gaps(plane) - self._padding)[rows].tolist()
        elif body in names:
            others = np.flatnonzero(placed.links == names.index(body)).tolist()
            gaps = [self._link_gap(i, j) for i in rows for j in others]
        else:
            owner = self._owners()
            own = [b for b, found in enumerate(self.surfaces.bodies) if found.name == body]
            gaps = [self._gap(i, b, int(owner[i])) - self._padding[i] for b in own for i in rows]
        return float(min(gaps, default=math.inf))

    def allows(self, link: str, body: str) -> bool:
        """Return `MeshChecker.allows`."""
        names = ["", *(f"object:{i}" for i in self.world.map.object_ids)]
        column = names.index(body) if body in names else 0
        return bool(self._allowed[self.placed.robot.link_names.index(link), column])

    # --- what touches what ---------------------------------------------------------

    def _near(self) -> Bool[np.ndarray, "n b"]:
        """Pairs of solid and body whose bounds meet."""
        distances = self.surfaces.box_distances(self.placed.centers)
        return (distances <= (self.placed.radii + self._need)[:, None]) & ~self._ignored

    def _near_pairs(self) -> np.ndarray:
        """Pairs of solids of different links whose balls meet, (p, 2)."""
        centers = self.placed.centers
        apart = centers[self._pairs[:, 0]] - centers[self._pairs[:, 1]]
        return self._pairs[np.einsum("ni,ni->n", apart, apart) <= self._apart**2]

    def _owners(self) -> np.ndarray:
        """(n,) class of the object that holds each moving solid's witness point, 0 if none."""
        owner = np.zeros(len(self.solids), dtype=np.int64)
        moving = self.placed.moving
        owner[moving] = self.surfaces.object_at(self.placed.witnesses[moving])
        return owner

    def _swallowed(self, near: Bool[np.ndarray, "n b"]) -> Chosen:
        """Solids whose witness point lies inside an object they may not touch."""
        inside = np.zeros(len(self.solids), dtype=bool)
        rows = np.flatnonzero(near.any(axis=1))
        if len(rows):
            owner = self.surfaces.object_at(self.placed.witnesses[rows])
            allowed = self._allowed[self.placed.links[rows], owner]
            inside[rows] = (owner > 0) & ~allowed
        return inside

    def _touches(self, i: int, b: int) -> bool:
        """Whether solid i comes too near to body b's surface, lies in a known mesh, or holds
        the body."""
        body = self.surfaces.bodies[b]
        if _within(body.shape, self.placed.shape(i), float(self._need[i])):
            return True
        return body.contains(self.placed.witnesses[i]) or self._holds(i, body.witnesses)

    def _holds(self, i: int, points: Float[np.ndarray, "w 3"]) -> bool:
        """Whether a closed link mesh holds one of some world points: hollow, it cuts nothing."""
        solid = self.solids[i]
        if not solid.closed:
            return False
        near = points[np.linalg.norm(points - self.placed.centers[i], axis=1) <= solid.radius]
        return any(solid.holds(point) for point in self.placed.to_link(i, near))

    def _collide(self, i: int, j: int) -> bool:
        """Whether two solids of the robot come too near to each other."""
        if _within(self.placed.shape(i), self.placed.shape(j), self._self_margin):
            return True
        witnesses = self.placed.witnesses
        return self._holds(i, witnesses[j : j + 1]) or self._holds(j, witnesses[i : i + 1])

    def _touches_points(self) -> bool:
        """Whether a moving solid comes too near to an observed point."""
        points, need = self._points, self._need
        return points is not None and any(
            True for i in points.near(need) for _ in points.inside(i, float(need[i]))
        )

    def _unseen(self, margin: float) -> Iterator[tuple[int, str, Vector]]:
        """Solid, body and place of the samples of the robot's surface that are hidden."""
        if self._hidden is None:
            return
        for i, point, code in zip(*self._hidden.find(margin), strict=True):
            yield int(i), UNSEEN[int(code)], point

    def _link_gap(self, i: int, j: int) -> float:
        """Distance between two solids of the robot; 0 where a mesh is touched."""
        a, b = self.placed.shape(i), self.placed.shape(j)
        return fcl.gap(a, b) if a.hollow or b.hollow else fcl.signed_gap(a, b)

    def _gap(self, i: int, b: int, owner: int) -> float:
        """Distance of solid i to body b, padding aside; `owner` as of `_owners`."""
        body, shape = self.surfaces.bodies[b], self.placed.shape(i)
        if not (body.shape.hollow or shape.hollow):
            return fcl.signed_gap(body.shape, shape)
        inside = self._is_inside(i, b, owner)
        if shape.kind == "sphere":
            way, _ = fcl.point_distance(body.shape, self.placed.centers[i])
            return (-way if inside else way) - shape.size[0]
        gap = fcl.gap(body.shape, shape)
        return -gap if inside or self._holds(i, body.witnesses) else gap

    def _is_inside(self, i: int, b: int, owner: int) -> bool:
        body = self.surfaces.bodies[b]
        if body.class_index:
            return owner == body.class_index
        return body.contains(self.placed.witnesses[i])

    # --- reasons -------------------------------------------------------------------

    def _plane_contacts(self) -> Iterator[Contact]:
        for plane, name in zip(self._planes, self.world.plane_names, strict=True):
            gaps = self.placed.plane_gaps(plane)
            for i in np.flatnonzero(self.placed.moving & (gaps <= self._need)).tolist():
                point = self.placed.lowest_point(i, plane[:3])
                yield self._contact(i, name, (float(gaps[i]), point, plane[:3]), self._need[i])

    def _body_contacts(
        self, near: Bool[np.ndarray, "n b"], need: Values, detail: str = ""
    ) -> Iterator[Contact]:
        owner = self._owners()
        for row, column in np.argwhere(near):
            i, b = int(row), int(column)
            inside = self._is_inside(i, b, int(owner[i]))
            if inside or self._touches(i, b):
                touch = self._touch(i, b, inside)
                yield self._contact(i, self.surfaces.bodies[b].name, touch, need[i], detail)

    def _swallowed_contacts(self, near: Bool[np.ndarray, "n b"]) -> Iterator[Contact]:
        """What lies inside an object's level set, but outside the box of its mesh."""
        owner = self._owners()
        for i in np.flatnonzero(self._swallowed(near)).tolist():
            name = f"object:{self.world.map.object_ids[int(owner[i]) - 1]}"
            boxed = [b for b, body in enumerate(self.surfaces.bodies) if body.name == name]
            if not near[i, boxed].any():
                yield self._contact(i, name, (0.0, self.placed.witnesses[i], UP), self._need[i])

    def _touch(self, i: int, b: int, inside: bool) -> Touch:
        """How near solid i and body b are, or how deep in each other."""
        body, shape = self.surfaces.bodies[b], self.placed.shape(i)
        if shape.kind != "sphere" or not body.shape.hollow:
            touch = fcl.deepest_touch(body.shape, shape)
            if touch is not None:
                return touch
        start = self.placed.witnesses[i]
        if body.shape.hollow and (shape.kind == "sphere" or inside):
            way, point = fcl.point_distance(body.shape, start)
            out = point - start if inside else start - point
            normal = out / way if way > 1e-9 else UP
            if shape.kind == "sphere":
                return (-way if inside else way) - shape.size[0], point, normal
            return -fcl.gap(body.shape, shape), start, normal
        if self._holds(i, body.witnesses):  # a body inside a link's mesh
            return 0.0, body.witnesses[0], UP
        return _apart(body.shape, shape)

    def _point_contacts(self) -> Iterator[Contact]:
        points = self._points
        if points is None:
            return
        for i in points.near(self._need):
            need = float(self._need[i])
            for body, (gap, row) in points.deepest(i, need).items():
                place = points.points[row]
                out = self.placed.centers[i] - place
                length = float(np.linalg.norm(out))
                normal = out / length if length > 1e-9 else UP
                name, detail = points.bodies[body]
                yield self._contact(i, name, (gap, place, normal), need, detail)

    def _hidden_contacts(self) -> Iterator[Contact]:
        """Samples in hidden space, or as near to it as the margin: how near is not known."""
        for margin in (0.0, self._margin) if self._margin > 0.0 else (0.0,):
            for i, body, place in self._unseen(margin):
                detail = source_of(body).reason(self.world.config)
                yield self._contact(i, body, (margin, place, UP), self._need[i], detail)

    def _self_contacts(self) -> Iterator[Contact]:
        for row in self._near_pairs():
            i, j = int(row[0]), int(row[1])
            if not self._collide(i, j):
                continue
            # From the second link to the first: out of the contact for the one that is named.
            a, b = self.placed.shape(j), self.placed.shape(i)
            touch: Touch | None = fcl.deepest_touch(a, b)
            if touch is None:
                near = fcl.gap(a, b) <= self._self_margin
                touch = _apart(a, b) if near else (0.0, self.placed.witnesses[i], UP)
            other = self.placed.robot.link_names[self.solids[j].link]
            yield self._contact(i, other, touch, self._self_margin)

    def _contact(
        self, i: int, body: str, touch: Touch, required: float, detail: str = ""
    ) -> Contact:
        solid, names = self.solids[i], self.placed.robot.link_names
        kind = "self" if body in names else source_of(body).kind
        sure = None
        if kind != "self" and source_of(body).judged:
            sure = float(np.asarray(self.world.map.occupancy(touch[1][None]))[0])
        name, sphere = names[solid.link], solid.sphere
        return contact(kind, name, body, touch, float(required), sphere, sure, detail)


def _within(a: fcl.Shape, b: fcl.Shape, distance: float) -> bool:
    """Whether two shapes touch, or are at most so many metres apart."""
    return fcl.gap(a, b) <= distance if distance > 0.0 else fcl.touches(a, b)


def _apart(a: fcl.Shape, b: fcl.Shape) -> Touch:
    """Two shapes that do not touch: the place is on the first, and the way out leads to the
    second."""
    on_a, on_b = fcl.nearest_points(a, b)
    gap = fcl.gap(a, b)
    return gap, on_a, (on_b - on_a) / gap if gap > 1e-9 else UP
