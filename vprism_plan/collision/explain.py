# SPDX-License-Identifier: BSD-3-Clause
"""What every checker answers, and why it refuses: named reasons, not on the fast path."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Float

from vprism_plan._kernels.checking import FARTHEST
from vprism_plan.collision.packing import (
    Configuration,
    Numbers,
    Rows,
    configuration,
    configurations,
)
from vprism_plan.collision.reports import Contact, Kind, StateReport, as_point
from vprism_plan.robots.kinematics import outside_limits
from vprism_plan.world.grid import Balls, Points, Values, Vector, window
from vprism_plan.world.sources import policies, source_of
from vprism_plan.world.visibility import OCCLUDED, OUTSIDE, SEEN, UNSEEN, free_balls

# Signed distance, metres; where, world; unit direction that leads out.
Touch = tuple[Any, Vector, Vector]

UP = np.array([0.0, 0.0, 1.0])  # out of what says nothing of the way out
_SAMPLES = 96
_FEW_SAMPLES = 16  # where many configurations are asked about
_AROUND = 2  # nodes beyond a point's cell that are asked for the nearest obstacle's name


def unit_ball_points(n: int = _SAMPLES, surface: bool = True) -> Points:
    """Return n points spread evenly through the unit ball, a fourth of them on its surface if that
    is to be asked as well: a spiral, its radii shuffled."""
    i = np.arange(n) + 0.5
    polar = np.arccos(1.0 - 2.0 * i / n)
    azimuth = np.pi * (1.0 + np.sqrt(5.0)) * i
    # 0.7549: the inverse of the plastic number, the best second irrational beside the golden.
    radius = np.cbrt((i * 0.7548776662466927) % 1.0)
    if surface:
        radius[::4] = 1.0
    directions = np.column_stack(
        [np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)]
    )
    return directions * radius[:, None]


class Checker:
    """What checkers answer alike; see there for `is_valid_buffer` and `check_motion_buffer` (the
    same for contiguous float64 arrays, whatever their shape), `clearance` and `contacts`.

    A configuration is (dof,) joint values, radians or metres, in the order of `robot.joint_names`,
    a batch (n, dof); what has another shape raises RobotError.
    """

    def is_valid(self: Any, q: Numbers) -> bool:
        """Return whether a configuration is free; one that is not finite is not."""
        return self.is_valid_buffer(configuration(self.robot, q))

    def check_motion(self: Any, qa: Numbers, qb: Numbers) -> bool:
        """Return whether the edge from qa to qb, straight in joint space, is free, ends included.
        A continuous joint turns by their difference, however often round."""
        qa, qb = configuration(self.robot, qa), configuration(self.robot, qb)
        return self.check_motion_buffer(qa, qb)

    def explain(self: Any, q: Numbers) -> StateReport:
        """Return the verdict on a configuration with every reason that refuses it."""
        q = configuration(self.robot, q)
        margin = self.config.margin
        told: dict[str, Any] = {"policies": policies(self.world.config), "warnings": self.warnings}
        if not np.isfinite(q).all():
            limits = tuple(limit_contacts(self.robot, q))
            return StateReport(False, limits, np.nan, np.nan, margin, **told)
        valid = self.is_valid(q)
        return StateReport(
            valid=valid,
            contacts=() if valid else self.contacts(q),
            clearance=self.clearance(q),
            self_clearance=float(self.self_clearance_batch(q[None])[0]),
            margin=margin,
            shares={kind: float(own[0]) for kind, own in self._shares(q[None], _SAMPLES).items()},
            allowed=tuple(self._permitted(q)),
            **told,
        )

    def unseen_shares(self: Any, Q: Numbers) -> dict[str, Values]:
        """Return, for each row of Q, the share of the robot's volume in each kind of unseen space:
        `explain`'s, from fewer points."""
        return self._shares(configurations(self.robot, Q, finite=True), _FEW_SAMPLES)

    def _shares(self: Any, Q: Rows, samples: int) -> dict[str, Values]:
        centers = np.stack([self._centers(q) for q in Q])
        return volume_shares(self.world, self.robot, centers, unit_ball_points(samples))

    def _centers(self: Any, q: Configuration) -> Float[np.ndarray, "s 3"]:
        """Centres of the robot's spheres, world, metres."""
        return np.asarray(self.robot.sphere_centers(q))

    @property
    def warnings(self: Any) -> tuple[str, ...]:
        """What is usable but odd about the world and the robot; every verdict carries it."""
        found = (*getattr(self.world, "warnings", ()), *getattr(self.robot, "warnings", ()))
        return tuple(dict.fromkeys(found))


def by_depth(contacts: Iterable[Contact]) -> list[Contact]:
    """Return contacts, the deepest first."""
    return sorted(contacts, key=lambda contact: -contact.depth)


def volume_shares(
    world: Any,
    robot: Any,
    centers: Float[np.ndarray, "n s 3"],
    ball: Points,
    judged: bool = False,
) -> dict[str, Values]:
    """Return which share of the moving links' sphere volume lies in space nobody has seen, by
    points of the unit ball in each sphere. With `judged` it is space that the map cannot judge:
    hidden space that it has something to say of is left out, all beyond the grid counts."""
    moving = ~np.asarray(robot.arrays.link_fixed)[robot.sphere_links]
    if not moving.any():
        return {name: np.zeros(len(centers)) for name in UNSEEN.values()}
    centers, radii = centers[:, moving], robot.sphere_radii[moving]
    points = (centers[:, :, None] + radii[:, None, None] * ball).reshape(-1, 3)
    status = np.asarray(world.status(points))
    if judged:
        hidden = np.flatnonzero(status == OCCLUDED)
        status[hidden[world.map.judges(points[hidden], world.config.min_support)]] = SEEN
        beyond = (points < world.field.origin) | (points > world.field.upper)
        status[beyond.any(axis=1)] = OUTSIDE
    status = status.reshape(*centers.shape[:2], -1)
    weight = radii**3 / np.sum(radii**3)
    return {name: np.mean(status == k, axis=2) @ weight for k, name in UNSEEN.items()}


def limit_contacts(robot: Any, q: Configuration) -> list[Contact]:
    """Return the joints that are not finite, absurdly far, or outside their limits."""
    found = []
    for j, name in enumerate(robot.joint_names):
        value, low, high = q[j], robot.lower[j], robot.upper[j]
        if not np.isfinite(value):
            detail = f"joint {name} is {value}; give a finite value"
            found.append(Contact("not_finite", name, "not_finite", np.inf, detail=detail))
            continue
        if abs(value) > FARTHEST:
            excess = float(abs(value) - FARTHEST)
            detail = (
                f"joint {name} is {value:g}, farther than {FARTHEST:g} from 0; count fewer turns"
            )
        elif outside_limits(robot, q)[j]:
            excess = float(max(low - value, value - high))
            detail = (
                f"joint {name} is {value:.6g}, outside its limits [{low:.6g}, {high:.6g}] "
                f"by {excess:.3g}"
            )
        else:
            continue
        found.append(Contact("joint_limit", name, "joint_limit", excess, detail=detail))
    return found


def world_contacts(checker: Any, q: Configuration) -> list[Contact]:
    """Return the deepest contact of each (link, body), from every sphere's own distances."""
    robot, world, margin = checker.robot, checker.world, checker.config.margin
    centers, plane, which, field = checker.sphere_clearances(q)
    found = []
    robots = free_balls(getattr(world.map, "views", ()))
    for s in range(len(centers)):
        link = int(robot.sphere_links[s])
        if robot.arrays.link_fixed[link]:
            continue
        name, radius = robot.link_names[link], float(robot.sphere_radii[s])
        padding = float(robot.arrays.link_padding[link])  # a distance to keep, like the margin
        required = margin + padding
        if not plane[s] > margin:
            row = world.planes[which[s]]
            body = world.plane_names[which[s]]
            touch = plane[s] + padding, centers[s] - radius * row[:3], row[:3]
            found.append(contact(source_of(body).kind, name, body, touch, required, s))
        if not field[s] > margin:
            body, normal = nearest_source(world, checker.verdict_field(link), centers[s])
            source, sure = source_of(body), None
            if source.judged:
                ball = centers[s] + radius * unit_ball_points()
                sure = float(np.max(world.map.occupancy(ball)))
            touch = field[s] + padding, centers[s] - radius * normal, normal
            detail = source.reason(world.config)
            if source.kind == "occluded":
                at = np.append(centers[s], radius)
                detail += _beside_pictured_robot(at, robots, margin, world)
            found.append(contact(source.kind, name, body, touch, required, s, sure, detail))
    return deepest(found)


def contact(
    kind: Kind,
    link: str,
    body: str,
    touch: Touch,
    required: float,
    sphere: int,
    probability: float | None = None,
    detail: str = "",
) -> Contact:
    """Return a contact from how near, where and which way out, and the distance asked for."""
    gap, position, normal = touch
    return Contact(
        kind, link, body, float(required - gap), sphere, as_point(position), as_point(normal),
        probability, detail, float(required),
    )  # fmt: skip


def deepest(contacts: Iterable[Contact]) -> list[Contact]:
    """Return the deepest contact of each link and body."""
    found: dict[tuple[str, str], Contact] = {}
    for item in contacts:
        kept = found.setdefault((item.link, item.body), item)
        if kept.depth < item.depth:
            found[item.link, item.body] = item
    return list(found.values())


def _beside_pictured_robot(
    sphere: Float[np.ndarray, "4"], robots: Balls, margin: float, world: Any
) -> str:
    """The remedy for a sphere in the shadow of the robot as it was in a picture, or nothing."""
    away = np.linalg.norm(robots[:, :3] - sphere[:3], axis=1)
    if not (away <= robots[:, 3] + sphere[3]).any():
        return ""
    room = margin + 2.0 * float(world.config.resolution)
    return f"; beside the pictured robot: ignore_self(..., room={room:g}) is your word for it"


def allowed_contacts(checker: Any, q: Configuration) -> list[Contact]:
    """Return the deepest contact of each link with each object that it may touch."""
    robot, world = checker.robot, checker.world
    if not any(checker.allowed_objects(link) for link in range(len(robot.link_names))):
        return []
    centers = checker.sphere_clearances(q)[0]
    found = []
    for s, center in enumerate(centers):
        link, radius = int(robot.sphere_links[s]), float(robot.sphere_radii[s])
        if robot.arrays.link_fixed[link]:
            continue
        for object_id in sorted(checker.allowed_objects(link)):
            field = world.source_field(f"object:{object_id}")
            gap = float(field.lower_bound(center[None])[0]) - radius
            if gap <= 0.0:
                _, normal = nearest_source(world, field, center)
                touch = gap, center - radius * normal, normal
                body = f"object:{object_id}"
                name = robot.link_names[link]
                found.append(contact("object", name, body, touch, 0.0, s, None, "allowed"))
    return deepest(found)


def nearest_source(world: Any, field: Any, point: Vector) -> tuple[str, Vector]:
    """Return the name of the obstacle nearest to a point and the direction away from it.

    A node at the distance d from an obstacle says that it is at most d plus the way to the node
    from the point. The smallest such sum over the nodes around names the nearest one to within a
    fraction of a voxel: some node lies close to the way there.
    """
    shape = np.array(field.distance.shape)
    g = (point - field.origin) / field.spacing
    past = bool(np.any(g < 0) or np.any(g > shape - 1))
    beyond = getattr(field, "beyond", None)
    if past and beyond is not None:
        bounds = [float(grid.lower_bound(point[None])[0]) for grid in (beyond, field)]
        if bounds[0] <= bounds[1]:
            return nearest_source(world, beyond, point)
    solid = world.config.unobserved == "occupied" or getattr(field, "solid_outside", False)
    outside = past and solid
    inside = np.clip(g, 0.0, shape - 1.0)
    cell = np.minimum(inside.astype(int), shape - 2)
    corners = cell + np.indices((2, 2, 2)).reshape(3, -1).T
    values = np.asarray(field.distance[tuple(corners.T)], dtype=np.float64)
    low, high = np.maximum(cell - _AROUND, 0), np.minimum(cell + _AROUND + 2, shape)
    nodes = low + np.moveaxis(np.indices(tuple(high - low)), 0, -1)
    ways = np.asarray(field.spacing * np.linalg.norm(nodes - inside, axis=-1))
    ways += np.maximum(field.distance[window(low, high)], 0.0)
    nearest = low + np.array(np.unravel_index(int(np.argmin(ways)), ways.shape))
    slope = values.reshape(2, 2, 2)
    gradient = np.array([np.mean(np.diff(slope, axis=axis)) for axis in range(3)], dtype=np.float64)
    if outside:
        gradient = inside - g
    length = float(np.linalg.norm(gradient))
    normal = gradient / length if np.isfinite(length) and length > 0 else UP
    name = "unobserved" if outside else world.sources[int(field.source[tuple(nearest)])]
    return name, normal


def self_contacts(checker: Any, q: Configuration) -> list[Contact]:
    """Return the link pairs that come too near to each other."""
    robot, margin = checker.robot, checker.config.self_margin
    gaps, spheres = checker.pair_gaps(q)
    centers = checker.sphere_clearances(q)[0]
    found = []
    for p in np.flatnonzero(~(gaps > margin)):
        a, b = (int(link) for link in robot.collision_pairs[p])
        s, t = (int(sphere) for sphere in spheres[p])
        apart = centers[s] - centers[t]
        length = float(np.linalg.norm(apart))
        normal = apart / length if length > 0 else UP
        point = centers[s] - robot.sphere_radii[s] * normal
        names, touch = robot.link_names, (float(gaps[p]), point, normal)
        found.append(contact("self", names[a], names[b], touch, margin, s))
    return found
