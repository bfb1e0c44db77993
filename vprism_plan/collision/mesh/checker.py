# SPDX-License-Identifier: BSD-3-Clause
"""A second opinion by FCL: the surfaces of a world against the solids of a robot.

It judges the same map at the same level for the same robot, but with neither the distance field,
nor the octree that it is traced with, nor the compiled kernels; and what the cameras saw it takes
from the images, so it can contradict the map as well.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from itertools import chain, pairwise
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from vprism_plan._arguments import number
from vprism_plan.collision import explain
from vprism_plan.collision.config import CheckerConfig, contact_rules
from vprism_plan.collision.mesh import fcl
from vprism_plan.collision.mesh.comparison import PathFinding, PathOpinion, causes_between
from vprism_plan.collision.mesh.seen import HiddenSpace, SeenPoints
from vprism_plan.collision.mesh.solids import LinkShapes, MeshWorld, PlacedSolids, robot_solids
from vprism_plan.collision.packing import Configuration, Numbers, configuration, configurations
from vprism_plan.collision.reports import Contact, MotionReport
from vprism_plan.errors import ConfigError, RobotError
from vprism_plan.robots import Robot
from vprism_plan.world.grid import Chosen, Values, Vector
from vprism_plan.world.sources import source_of
from vprism_plan.world.visibility import UNSEEN

_MAX_CONFIGURATIONS = 1_000_000


class MeshChecker(explain.Checker):
    """Checks a robot's solids against extracted meshes, half-spaces and known geometry.

    What it judges: every object's surface {P(occupied) >= level} as a closed mesh, the support
    surface and known half-spaces (by formula), known primitives and meshes, self-collision of the
    pairs the robot tests, and joint limits; and, by the images alone, every observed point off the
    support surface (a ball of half its pixel's width) and, as the world's policies say, hidden
    space. Of that it asks one point per 3 cm cube of the solids' surfaces: a narrower shadow can be
    missed.

    The robot is what the URDF has, scaled if the robot was scaled, whatever its spheres are. Its
    padding is a distance to keep from the world, beside `config.margin`.

    FCL's meshes are hollow. A solid that no surface cuts lies wholly on one side, and the map's
    level set at one of its points says which (for known meshes: the winding number). Links that no
    joint moves are not checked against the world. Touching counts as collision; FCL's own tolerance
    is about 1e-5 m. Bounds are compared first, and FCL is asked only about pairs whose bounds meet.

    It can be given to `plan` in place of a `CollisionChecker`, some hundred times slower, with
    edges checked at discrete configurations. Not safe to share between threads: shapes are moved
    while they are asked about.

    Args:
        world: what to avoid.
        robot: whose configurations are asked about.
        config: margins and allowed contacts. `max_risk` is not judged (nothing is drawn here), and
            `min_motion` says nothing of what is sampled by `step`.
        links: "geometry": the URDF's meshes, boxes, cylinders and spheres, or `link_meshes`, and
            the collision spheres of links that have neither (or whose meshes are missing, or in
            more than 20 pieces). "spheres": the collision spheres of every link.
        link_meshes: link -> `trimesh.Trimesh` in the link's frame, metres, for its primitives.
        resolution: edge of the objects' marching cubes, metres. None: the lattice of the world's
            distance field (a quarter of its resolution), on which no mesh reaches beyond what the
            field encloses. A coarser mesh is made sooner, and may.
        step: motion, metres, that no point of the robot exceeds between two configurations of an
            edge: a collision may hide in at most half of that.
        seen: False leaves observed points and hidden space out: surfaces alone.

    Raises:
        MissingDependencyError: python-fcl is not installed.
        ConfigError: an option is out of range, or names an unknown object.
        RobotError: an option names an unknown link, or a mesh cannot be used.
    """

    def __init__(
        self,
        world: Any,
        robot: Robot,
        config: CheckerConfig | None = None,
        *,
        links: LinkShapes = "geometry",
        link_meshes: Mapping[str, Any] | None = None,
        resolution: float | None = None,
        step: float = 0.005,
        seen: bool = True,
    ) -> None:
        fcl.fcl()
        number("step", step, 1e-5, unit="metres")
        self._made: Callable[[], MeshChecker] = partial(
            MeshChecker, world, robot, config, links=links, link_meshes=link_meshes,
            resolution=resolution, step=step, seen=seen,
        )  # fmt: skip
        if hasattr(world, "for_base"):
            world = world.for_base(robot.base_pose[:3, 3])
        self.world = world
        self.robot = robot
        self.config = CheckerConfig() if config is None else config
        self.links = links
        self.step = float(step)
        self.solids = robot_solids(robot, links, link_meshes)
        self.surfaces = MeshWorld(world, resolution)
        self.placed = placed = PlacedSolids(robot, self.solids)
        self._allowed = allowed = self._allowed_classes()
        self._planes = np.asarray(world.planes, dtype=np.float64).reshape(-1, 4)
        self._pairs = placed.pairs()
        # Padding is a distance to keep from the world: the solids stay as they are.
        self._padding = placed.robot.arrays.link_padding[placed.links]
        self._need = self.config.margin + self._padding
        self._buffer = placed.robot.arrays.link_buffer[placed.links]
        self._apart = (placed.radii + self._buffer)[self._pairs].sum(axis=1)
        self._apart += self.config.self_margin
        # Pairs of solid and body that are never looked at: allowed, or of a fixed link.
        self._ignored = allowed[placed.links][:, self.surfaces.classes] | ~placed.moving[:, None]
        self._points = SeenPoints(world, placed, allowed) if seen else None
        self._hidden = HiddenSpace(world, placed, self._padding) if seen else None

    def __reduce__(self) -> Any:
        """A copy is made anew: FCL's objects cannot be copied."""
        return self._made, ()

    @classmethod
    def like(cls, checker: Any, **options: Any) -> "MeshChecker":
        """Make the second opinion on a `CollisionChecker`: its world, robot, margins and rules,
        with `options` of `MeshChecker`. What the checker's edges may miss (`config.tolerance`) is
        taken off the margins: paths are shaved down to them."""
        config = checker.config
        margins = {
            name: max(0.0, getattr(config, name) - config.tolerance)
            for name in ("margin", "self_margin")
        }
        options.setdefault("config", replace(config, **margins))
        return cls(checker.world, checker.robot, **options)

    def _allowed_classes(self) -> Bool[np.ndarray, "links classes"]:
        """Which link may touch which class of the map; column 0, all else, is never allowed."""
        object_ids = list(self.world.map.object_ids)
        rules, index = contact_rules(self.robot, self.config.allowed_contacts)
        unknown = sorted(set().union(*rules) - set(object_ids))
        if unknown:
            raise ConfigError(
                f"allowed_contacts names object {unknown[0]}; the map has {object_ids}"
            )
        table = np.array([[False, *(i in rule for i in object_ids)] for rule in rules])
        return np.asarray(table[index])

    def is_valid_buffer(self, q: Configuration) -> bool:
        """`is_valid` without looking at the shape: every solid keeps its distances."""
        if explain.limit_contacts(self.robot, q):
            return False
        self.placed.place(q)
        return not self._collides()

    def is_valid_batch(self, Q: Numbers) -> Chosen:
        """Return `is_valid` for each row of Q."""
        return np.array([*map(self.is_valid_buffer, configurations(self.robot, Q))], dtype=bool)

    def clearance(self, q: Numbers) -> float:
        """Return the distance from the moving links to the nearest surface, metres.

        At most 0 exactly when a moving link touches the world. The margin is not subtracted,
        padding is; self-collision, joint limits and what `allowed_contacts` permits do not enter.
        inf if there is nothing.

        Apart, the figure is FCL's distance, exact for what is compared; of hidden space only that a
        link is in it is known (0). In touch it is what FCL can say: exact depth for half-spaces,
        for spheres against anything, and between primitives; 0 for a box, cylinder or mesh that
        crosses a mesh's surface (FCL has no depth for that); minus the gap to the surface for one
        wholly inside. RobotError if q is not finite.
        """
        self.placed.place(self.robot.check_configuration(q))
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

    def clearance_batch(self, Q: Numbers) -> Values:
        """Return `clearance` for each row of Q, metres."""
        return np.array([*map(self.clearance, configurations(self.robot, Q))], dtype=np.float64)

    def self_clearance_batch(self, Q: Numbers) -> Values:
        """Return the smallest gap between links that may collide, for each row of Q, metres."""
        found = []
        for q in configurations(self.robot, Q, finite=True):
            self.placed.place(q)
            gaps = (self._link_gap(int(i), int(j)) for i, j in self._pairs)
            found.append(min(gaps, default=math.inf))
        return np.array(found, dtype=np.float64)

    def contacts(self, q: Numbers) -> tuple[Contact, ...]:
        """Return every reason to refuse q: the deepest contact of each link and body.

        Depths are exact where those of `clearance` are. Where a box, cylinder or mesh crosses a
        mesh's surface, the depth is FCL's figure for the deepest triangle: how far the solid
        reaches through it, not the way out. Normals of meshes are those of the triangle.

        Returns:
            Deepest first; empty exactly if `is_valid(q)`. `sphere` is -1 for solids.
        """
        q = configuration(self.robot, q)
        reasons = explain.limit_contacts(self.robot, q)
        if np.isfinite(q).all():
            self.placed.place(q)
            near = self._near()
            world = self._plane_contacts(), self._body_contacts(near, self._need)
            seen = self._swallowed_contacts(near), self._point_contacts(), self._hidden_contacts()
            reasons += explain.deepest(chain(*world, *seen, self._self_contacts()))
        return tuple(explain.by_depth(reasons))

    def link_distance(self, q: Numbers, link: str, body: str) -> float:
        """Return the distance from one link to one body, metres, as `clearance` states it.

        Args:
            q: configuration.
            link: one of `robot.link_names`, or RobotError.
            body: "object:3", "known:NAME", a half-space, or another link; inf for what has no
                surface here ("occluded", an object left out of the meshes, ...).
        """
        self.placed.place(self.robot.check_configuration(q))
        if link not in self.robot.link_names:
            raise RobotError(f"no link {link!r} to check; links: {list(self.robot.link_names)}")
        placed, names = self.placed, self.robot.link_names
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
        """Whether `allowed_contacts` lets a link touch a body."""
        names = ["", *(f"object:{i}" for i in self.world.map.object_ids)]
        column = names.index(body) if body in names else 0
        return bool(self._allowed[self.robot.link_names.index(link), column])

    def check_motion_buffer(self, qa: Configuration, qb: Configuration) -> bool:
        """`check_motion` without looking at shapes, at discrete configurations.

        Between two of them no point of the robot moves more than `step` metres. (FCL's continuous
        check crashes or misses with meshes, and is not used.) ConfigError if that asks for too
        many.
        """
        return all(self.is_valid_buffer(q) for _, q in self._between(qa, qb))

    def check_motion_report(self, qa: Numbers, qb: Numbers) -> MotionReport:
        """Return the verdict on an edge, how far apart it was looked at, and the reason."""
        qa, qb = configuration(self.robot, qa), configuration(self.robot, qb)
        checked, refused, state = 0, None, None
        for t, q in self._between(qa, qb):
            checked += 1
            if not self.is_valid_buffer(q):
                refused, state = t, self.explain(q)
                break
        finite = np.isfinite(qa).all() and np.isfinite(qb).all()
        return MotionReport(
            valid=refused is None,
            certified=False,
            tolerance=0.5 * self.step,
            collision_fraction=refused,
            configurations=checked,
            motion_bound=self.placed.motion_bound(qb - qa) if finite else math.inf,
            state=state,
        )

    def check_path(self, path: Numbers) -> PathOpinion:
        """Check every edge of a path (T, dof) as `check_motion` does, and return the first
        collision found on each refused one; RobotError without a waypoint, or if one is not
        finite."""
        rows = configurations(self.robot, path, finite=True)
        if len(rows) == 0:
            raise RobotError(f"a path has shape {rows.shape}; it needs at least one waypoint")
        ends = pairwise(rows) if len(rows) > 1 else iter([(rows[0], rows[0])])
        findings, checked = [], 0
        for edge, (qa, qb) in enumerate(ends):
            for t in self._fractions(qa, qb):
                checked += 1
                q = qa + t * (qb - qa)
                if not self.is_valid_buffer(q):
                    values = tuple(float(v) for v in q)
                    findings.append(PathFinding(edge, float(t), values, self.contacts(q)))
                    break
        return PathOpinion(not findings, self.step, checked, tuple(findings))

    def review(self, checker: Any, path: Numbers) -> PathOpinion:
        """Check a path that another checker accepted, and say why the two disagree.

        Returns:
            `check_path`, with the causes of each disagreement as `compare` names them; "edge
            tolerance" where the checker refuses the very configuration, too, and accepted the edge
            within its tolerance.
        """
        opinion = self.check_path(path)
        findings = tuple(
            replace(found, causes=causes_between(checker, self, np.array(found.configuration)))
            for found in opinion.findings
        )
        return replace(opinion, findings=findings)

    def _fractions(self, qa: np.ndarray, qb: np.ndarray) -> Values:
        """Where to look on an edge: no point of the robot moves more than `step` in between."""
        pieces = max(1, math.ceil(self.placed.motion_bound(qb - qa) / self.step))
        if pieces > _MAX_CONFIGURATIONS:
            raise ConfigError(
                f"step {self.step} m asks for {pieces:,} configurations on one edge (at most "
                f"{_MAX_CONFIGURATIONS:,}); use a larger one"
            )
        return np.linspace(0.0, 1.0, pieces + 1)

    def _between(self, qa: np.ndarray, qb: np.ndarray) -> Iterator[tuple[float, Configuration]]:
        """Where to look and what is there: both ends, then each time the middles of what is
        left. Who gets an invalid end asks no further."""
        yield 0.0, qa
        yield 1.0, qb
        fractions = self._fractions(qa, qb)
        spans = [(0, len(fractions) - 1)]
        while spans:
            middles = [(a, (a + b) // 2, b) for a, b in spans if b - a > 1]
            for _, m, _ in middles:
                yield float(fractions[m]), qa + fractions[m] * (qb - qa)
            spans = [span for a, m, b in middles for span in ((a, m), (m, b))]

    def _permitted(self, q: Configuration) -> list[Contact]:
        self.placed.place(q)
        distances = self.surfaces.box_distances(self.placed.centers)
        near = (distances <= self.placed.radii[:, None]) & self._ignored
        near &= self.placed.moving[:, None]
        return explain.deepest(self._body_contacts(near, np.zeros(len(self.solids)), "allowed"))

    def _collides(self) -> bool:
        """Whether a moving solid comes too near to the world, or two links to each other."""
        for plane in self._planes:
            if (self.placed.plane_gaps(plane) <= self._need)[self.placed.moving].any():
                return True
        near, points, need = self._near(), self._points, self._need
        return (
            any(self._touches(int(i), int(b)) for i, b in np.argwhere(near))
            or bool(self._swallowed(near).any())
            or any(self._collide(int(i), int(j)) for i, j in self._near_pairs())
            or (
                points is not None
                and any(True for i in points.near(need) for _ in points.inside(i, float(need[i])))
            )
            or any(True for _ in self._unseen(self.config.margin))
        )

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

    def _kept(self, i: int, j: int) -> float:
        """Metres that two solids of the robot must be apart."""
        return float(self.config.self_margin + self._buffer[i] + self._buffer[j])

    def _collide(self, i: int, j: int) -> bool:
        """Whether two solids of the robot come too near to each other."""
        if _within(self.placed.shape(i), self.placed.shape(j), self._kept(i, j)):
            return True
        witnesses = self.placed.witnesses
        return self._holds(i, witnesses[j : j + 1]) or self._holds(j, witnesses[i : i + 1])

    def _unseen(self, margin: float) -> Iterator[tuple[int, str, Vector]]:
        """Solid, body and place of the samples of the robot's surface that are hidden."""
        if self._hidden is None:
            return
        for i, point, code in zip(*self._hidden.find(margin), strict=True):
            yield int(i), UNSEEN[int(code)], point

    def _link_gap(self, i: int, j: int) -> float:
        """Distance between two solids of the robot, less their buffers; 0 of meshes that touch."""
        gap = fcl.signed_gap(self.placed.shape(i), self.placed.shape(j))
        return float(gap - self._buffer[i] - self._buffer[j])

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

    def _plane_contacts(self) -> Iterator[Contact]:
        for plane, name in zip(self._planes, self.world.plane_names, strict=True):
            gaps, lowest = self.placed.plane_gaps(plane), self.placed.lowest_points(plane[:3])
            for i in np.flatnonzero(self.placed.moving & (gaps <= self._need)).tolist():
                touch = float(gaps[i]), lowest[i], plane[:3]
                yield self._contact(i, name, touch, self._need[i])

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
                yield self._contact(
                    i, name, (0.0, self.placed.witnesses[i], explain.UP), self._need[i]
                )

    def _touch(self, i: int, b: int, inside: bool) -> explain.Touch:
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
            normal = out / way if way > 1e-9 else explain.UP
            if shape.kind == "sphere":
                return (-way if inside else way) - shape.size[0], point, normal
            return -fcl.gap(body.shape, shape), start, normal
        if self._holds(i, body.witnesses):  # a body inside a link's mesh
            return 0.0, body.witnesses[0], explain.UP
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
                normal = out / length if length > 1e-9 else explain.UP
                name, detail = points.bodies[body]
                yield self._contact(i, name, (gap, place, normal), need, detail)

    def _hidden_contacts(self) -> Iterator[Contact]:
        """Samples in hidden space, or as near to it as the margin: how near is not known."""
        for margin in (0.0, self.config.margin) if self.config.margin > 0.0 else (0.0,):
            for i, body, place in self._unseen(margin):
                detail = source_of(body).reason(self.world.config)
                yield self._contact(i, body, (margin, place, explain.UP), self._need[i], detail)

    def _self_contacts(self) -> Iterator[Contact]:
        for row in self._near_pairs():
            i, j = int(row[0]), int(row[1])
            if not self._collide(i, j):
                continue
            # From the second link to the first: out of the contact for the one that is named.
            a, b = self.placed.shape(j), self.placed.shape(i)
            touch: explain.Touch | None = fcl.deepest_touch(a, b)
            if touch is None:
                near = fcl.gap(a, b) <= self._kept(i, j)
                touch = _apart(a, b) if near else (0.0, self.placed.witnesses[i], explain.UP)
            other = self.robot.link_names[self.solids[j].link]
            yield self._contact(i, other, touch, self._kept(i, j))

    def _contact(
        self, i: int, body: str, touch: explain.Touch, required: float, detail: str = ""
    ) -> Contact:
        solid, names = self.solids[i], self.robot.link_names
        kind = "self" if body in names else source_of(body).kind
        sure = None
        if kind != "self" and source_of(body).judged:
            sure = float(np.asarray(self.world.map.occupancy(touch[1][None]))[0])
        name, sphere = names[solid.link], solid.sphere
        return explain.contact(kind, name, body, touch, float(required), sphere, sure, detail)


def _within(a: fcl.Shape, b: fcl.Shape, distance: float) -> bool:
    """Whether two shapes touch, or are at most so many metres apart."""
    return fcl.gap(a, b) <= distance if distance > 0.0 else fcl.touches(a, b)


def _apart(a: fcl.Shape, b: fcl.Shape) -> explain.Touch:
    """Two shapes that do not touch: the place is on the first, and the way out leads to the
    second."""
    on_a, on_b = fcl.nearest_points(a, b)
    gap = fcl.gap(a, b)
    return gap, on_a, (on_b - on_a) / gap if gap > 1e-9 else explain.UP
