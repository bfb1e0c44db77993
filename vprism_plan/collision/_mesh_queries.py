# SPDX-License-Identifier: BSD-3-Clause
"""What touches what at one configuration: a robot's solids, a world's surfaces, FCL between."""

import math
from collections.abc import Collection, Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float

from vprism_plan.collision import _fcl
from vprism_plan.collision._mesh_world import MeshWorld
from vprism_plan.collision._solids import PlacedSolids
from vprism_plan.collision.protocols import BakedWorld
from vprism_plan.collision.reports import Contact, Kind
from vprism_plan.errors import ConfigError
from vprism_plan.robots import Robot

_UP = np.array([0.0, 0.0, 1.0])


class Queries:
    """Answers about the configuration that was placed last.

    Bounds are compared with numpy first, and FCL is asked only about pairs whose bounds
    meet: no manager has to be told what moved.

    Args:
        world: what to avoid.
        placed: the robot's solids.
        surfaces: the world's bodies.
        allowed: link -> class -> whether they may touch; see `contact_rules`.
    """

    def __init__(
        self,
        world: BakedWorld,
        placed: PlacedSolids,
        surfaces: MeshWorld,
        allowed: Bool[np.ndarray, "links classes"],
    ) -> None:
        self.world = world
        self.placed = placed
        self.solids = placed.solids
        self.surfaces = surfaces
        self._allowed = allowed
        self._planes = np.asarray(world.planes, dtype=np.float64).reshape(-1, 4)
        self._pairs = placed.pairs()
        padding = np.array([solid.padding for solid in placed.solids])
        self._apart = (placed.radii - padding)[self._pairs].sum(axis=1)
        # Pairs of solid and body that are never looked at: allowed, or of a fixed link.
        self._ignored = allowed[placed.links][:, surfaces.classes] | ~placed.moving[:, None]

    def collides(self) -> bool:
        """Whether a moving solid touches the world, or two links each other."""
        for plane in self._planes:
            if (self.placed.plane_gaps(plane)[self.placed.moving] <= 0.0).any():
                return True
        near = self._near()
        return (
            any(self._touches(int(i), int(b)) for i, b in np.argwhere(near))
            or bool(self._swallowed(near).any())
            or any(self._collide(int(i), int(j)) for i, j in self._near_pairs())
        )

    def distance(self) -> float:
        """Return `MeshChecker.distance`, metres."""
        placed = self.placed
        best = math.inf
        for plane in self._planes:
            best = min(best, float(np.min(placed.plane_gaps(plane)[placed.moving], initial=best)))
        if self._swallowed(self._near()).any():
            best = min(best, 0.0)
        bounds = self.surfaces.box_distances(placed.centers) - placed.radii[:, None]
        bounds[self._ignored] = np.inf
        owner = self._owners()
        for flat in np.argsort(bounds, axis=None):
            i, b = (int(v) for v in np.unravel_index(flat, bounds.shape))
            # Where the bounds overlap they say nothing of how deep the solid is.
            if bounds[i, b] > max(best, 0.0) or not np.isfinite(bounds[i, b]):
                break
            best = min(best, self._gap(i, b, int(owner[i])))
        return best

    def contacts(self) -> list[Contact]:
        """Return the deepest contact of each link and body."""
        deepest: dict[tuple[str, str], Contact] = {}
        for contact in (*self._plane_contacts(), *self._body_contacts(), *self._self_contacts()):
            key = (contact.link, contact.body)
            if key not in deepest or deepest[key].depth < contact.depth:
                deepest[key] = contact
        return list(deepest.values())

    def link_distance(self, link: str, body: str) -> float:
        """Return `MeshChecker.link_distance`, metres."""
        placed, names = self.placed, self.placed.robot.link_names
        rows = np.flatnonzero(placed.links == names.index(link))
        if body in self.world.plane_names:
            plane = self._planes[self.world.plane_names.index(body)]
            return float(np.min(placed.plane_gaps(plane)[rows], initial=math.inf))
        if body in names:
            others = np.flatnonzero(placed.links == names.index(body))
            return min(
                (self._link_gap(int(i), int(j)) for i in rows for j in others), default=math.inf
            )
        owner = self._owners()
        return min(
            (
                self._gap(int(i), b, int(owner[i]))
                for b, found in enumerate(self.surfaces.bodies)
                if found.name == body
                for i in rows
            ),
            default=math.inf,
        )

    def allows(self, link: str, body: str) -> bool:
        """Return `MeshChecker.allows`."""
        object_ids = [f"object:{i}" for i in self.world.map.object_ids]
        if body not in object_ids:
            return False
        row = self.placed.robot.link_names.index(link)
        return bool(self._allowed[row, 1 + object_ids.index(body)])

    # --- what touches what ---------------------------------------------------------

    def _near(self) -> Bool[np.ndarray, "n b"]:
        """Pairs of solid and body whose bounds meet."""
        distances = self.surfaces.box_distances(self.placed.centers)
        return (distances <= self.placed.radii[:, None]) & ~self._ignored

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

    def _swallowed(self, near: Bool[np.ndarray, "n b"]) -> Bool[np.ndarray, "n"]:
        """Solids whose witness point lies inside an object they may not touch."""
        inside = np.zeros(len(self.solids), dtype=bool)
        rows = np.flatnonzero(near.any(axis=1))
        if len(rows):
            owner = self.surfaces.object_at(self.placed.witnesses[rows])
            allowed = self._allowed[self.placed.links[rows], owner]
            inside[rows] = (owner > 0) & ~allowed
        return inside

    def _touches(self, i: int, b: int) -> bool:
        """Whether solid i cuts body b's surface, lies in a known mesh, or holds the body."""
        body = self.surfaces.bodies[b]
        if _fcl.touches(body.shape, self.placed.shape(i)):
            return True
        return body.contains(self.placed.witnesses[i]) or self._holds(i, body.witnesses)

    def _holds(self, i: int, points: Float[np.ndarray, "w 3"]) -> bool:
        """Whether a closed link mesh holds one of some world points: hollow, it cuts nothing."""
        solid = self.solids[i]
        if solid.mesh is None:
            return False
        near = points[np.linalg.norm(points - self.placed.centers[i], axis=1) <= solid.radius]
        return any(solid.holds(point) for point in self.placed.to_link(i, near))

    def _collide(self, i: int, j: int) -> bool:
        """Whether two solids of the robot touch."""
        if _fcl.touches(self.placed.own_shape(i), self.placed.own_shape(j)):
            return True
        witnesses = self.placed.witnesses
        return self._holds(i, witnesses[j : j + 1]) or self._holds(j, witnesses[i : i + 1])

    def _link_gap(self, i: int, j: int) -> float:
        """Distance between two solids of the robot; 0 where a mesh is touched."""
        a, b = self.placed.own_shape(i), self.placed.own_shape(j)
        return _fcl.gap(a, b) if a.hollow or b.hollow else _fcl.signed_gap(a, b)

    def _gap(self, i: int, b: int, owner: int) -> float:
        """Distance of solid i to body b as `distance` states it; `owner` as of `_owners`."""
        body, shape = self.surfaces.bodies[b], self.placed.shape(i)
        if not (body.shape.hollow or shape.hollow):
            return _fcl.signed_gap(body.shape, shape)
        inside = self._is_inside(i, b, owner)
        if shape.kind == "sphere":
            way, _ = _fcl.point_distance(body.shape, self.placed.centers[i])
            return (-way if inside else way) - shape.size[0]
        gap = _fcl.gap(body.shape, shape)
        return -gap if inside or self._holds(i, body.witnesses) else gap

    def _is_inside(self, i: int, b: int, owner: int) -> bool:
        body = self.surfaces.bodies[b]
        if body.class_index:
            return owner == body.class_index
        return body.contains(self.placed.witnesses[i])

    # --- reasons -------------------------------------------------------------------

    def _plane_contacts(self) -> list[Contact]:
        found = []
        for plane, name in zip(self._planes, self.world.plane_names, strict=True):
            gaps = self.placed.plane_gaps(plane)
            for i in np.flatnonzero(self.placed.moving & (gaps <= 0.0)):
                point = self.placed.lowest_point(int(i), plane[:3])
                kind: Kind = "support" if name == "support surface" else "known"
                found.append(self._contact(int(i), kind, name, -gaps[i], point, plane[:3]))
        return found

    def _body_contacts(self) -> list[Contact]:
        near = self._near()
        swallowed = self._swallowed(near)
        owner = self._owners()
        found = []
        reported = np.zeros(len(self.solids), dtype=bool)
        for row, column in np.argwhere(near):
            i, b = int(row), int(column)
            inside = self._is_inside(i, b, int(owner[i]))
            if not (inside or self._touches(i, b)):
                continue
            reported[i] |= inside
            body = self.surfaces.bodies[b]
            kind: Kind = "object" if body.class_index else "known"
            depth, point, normal = self._touch(i, b, inside)
            found.append(self._contact(i, kind, body.name, depth, point, normal))
        # Inside an object's level set, but outside the box of its mesh.
        for row in np.flatnonzero(swallowed & ~reported):
            i = int(row)
            name = f"object:{self.world.map.object_ids[int(owner[i]) - 1]}"
            found.append(self._contact(i, "object", name, 0.0, self.placed.witnesses[i], _UP))
        return found

    def _touch(
        self, i: int, b: int, inside: bool
    ) -> tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """Depth, position and direction out of the contact of solid i with body b."""
        body, shape = self.surfaces.bodies[b], self.placed.shape(i)
        if shape.kind != "sphere" or not body.shape.hollow:
            touch = _fcl.deepest_touch(body.shape, shape)
            if touch is not None:
                return touch.depth, touch.position, touch.normal
        start = self.placed.witnesses[i]
        if not body.shape.hollow:  # a primitive inside a link's mesh
            return 0.0, body.witnesses[0], _UP
        way, point = _fcl.point_distance(body.shape, start)
        out = point - start if inside else start - point
        normal = out / way if way > 1e-9 else _UP
        if shape.kind == "sphere":
            return max(0.0, shape.size[0] + (way if inside else -way)), point, normal
        return _fcl.gap(body.shape, shape), start, normal

    def _self_contacts(self) -> list[Contact]:
        found = []
        for i, j in self._near_pairs():
            if not self._collide(int(i), int(j)):
                continue
            # From the second link to the first: out of the contact for the one that is named.
            touch = _fcl.deepest_touch(self.placed.own_shape(int(j)), self.placed.own_shape(int(i)))
            depth, point = 0.0, self.placed.witnesses[i]
            normal = _UP
            if touch is not None:
                depth, point, normal = touch.depth, touch.position, touch.normal
            other = self.placed.robot.link_names[self.solids[j].link]
            found.append(self._contact(int(i), "self", other, depth, point, normal))
        return found

    def _contact(
        self,
        i: int,
        kind: Kind,
        body: str,
        depth: float,
        position: Float[np.ndarray, "3"],
        normal: Float[np.ndarray, "3"],
    ) -> Contact:
        solid = self.solids[i]
        probability = None
        if kind == "object":
            probability = float(np.asarray(self.world.map.occupancy(position[None]))[0])
        x, y, z = (float(v) for v in position)
        nx, ny, nz = (float(v) for v in normal)
        link = self.placed.robot.link_names[solid.link]
        return Contact(
            kind, link, body, float(depth), solid.sphere, (x, y, z), (nx, ny, nz), probability
        )


def contact_rules(
    robot: Robot, object_ids: Sequence[int], allowed: Mapping[str, Collection[int]]
) -> Bool[np.ndarray, "links classes"]:
    """Return which link may touch which class; column 0 (known geometry) is never allowed."""
    rules = np.zeros((len(robot.link_names), 1 + len(object_ids)), dtype=bool)
    for name, ids in allowed.items():
        unknown = sorted(set(ids) - set(object_ids))
        if unknown:
            raise ConfigError(
                f"allowed_contacts of {name!r} names object {unknown[0]}; the map has "
                f"{list(object_ids)}"
            )
        for link in robot.links_of(name):
            for object_id in ids:
                rules[robot.link_names.index(link), 1 + list(object_ids).index(object_id)] = True
    return rules
