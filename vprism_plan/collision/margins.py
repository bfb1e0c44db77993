# SPDX-License-Identifier: BSD-3-Clause
"""How far every link is from every obstacle, and which way leads out."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from vprism_plan.collision.motion import edges_of, joint_units, place_points, sphere_jacobians
from vprism_plan.collision.packing import Numbers, Rows, checked_tolerance, configurations
from vprism_plan.collision.reports import Answer, Kind
from vprism_plan.errors import RobotError
from vprism_plan.robots.kinematics import frame_poses, joint_values
from vprism_plan.world.distance import DistanceField
from vprism_plan.world.grid import Points, Values
from vprism_plan.world.sources import object_id, source_of, spoken

_CHUNK = 512  # configurations whose spheres are in memory at once


@dataclass(frozen=True)
class BodyMargin(Answer):
    """Where one link and one obstacle are nearest to each other; metres, world frame.

    Attributes:
        link: the link.
        body: the obstacle, and ...
        kind: ... what it is, as in `Contact`.
        clearance: lower bound of the distance between them (over all of a path); negative inside.
        gradient: (dof,) its change per radian or metre of each joint, from the slope of the
            distance field; zeros where that has none (in the middle of an obstacle).
        nearest: point of the obstacle nearest to the sphere's centre, to within a voxel (exact for
            half-spaces; rough from beyond the grid). From inside the obstacle: the nearest way out.
        witness: point of the link's surface nearest to it.
        sphere: the link's collision sphere on which `witness` lies.
        occupancy: the map's P(occupied) at `nearest`; None where the map has no say (support
            surface, known geometry).
        entropy: the map's entropy there, nats; None likewise.
        allowed: whether a contact rule lets this link touch this object.
        place: where on the path: number of the edge plus the fraction of it.
    """

    link: str
    body: str
    kind: Kind
    clearance: float
    gradient: tuple[float, ...]
    nearest: tuple[float, float, float]
    witness: tuple[float, float, float]
    sphere: int
    occupancy: float | None
    entropy: float | None
    allowed: bool = False
    place: float = 0.0


@dataclass(frozen=True)
class SafetyMargins(Answer):
    """Answer of `safety_margin`: every moving link against every obstacle.

    Attributes:
        margins: one per link and obstacle, nearest first.
        clearance: lower bound of the distance to all of them that count, metres (that of
            `CollisionChecker.clearance`; contacts that a rule allows do not count).
        self_clearance: lower bound of the gap between links that may collide, metres.
        margin: clearance that the checker requires, metres.
        joint_names: names of the gradients' entries.
        joint_units: their units, "rad" or "m".
        resolution: voxel of the world's field, metres: how exact `nearest` is.
        tolerance: what was subtracted, metres, so that the bounds hold between the configurations
            that were looked at; 0 for a single one.
        configurations: how many that were.
    """

    margins: tuple[BodyMargin, ...]
    clearance: float
    self_clearance: float
    margin: float
    joint_names: tuple[str, ...]
    joint_units: tuple[str, ...]
    resolution: float
    tolerance: float
    configurations: int

    def between(self, link: str, body: str) -> BodyMargin:
        """Return the margin of one link and one obstacle.

        Raises:
            RobotError: there is none; the message lists what there is.
        """
        for margin in self.margins:
            if (margin.link, margin.body) == (link, body):
                return margin
        links = ", ".join(dict.fromkeys(m.link for m in self.margins))
        raise RobotError(
            f"no margin between {link!r} and {body!r}; links that move: {links}; "
            f"obstacles: {', '.join(self.of_bodies())}"
        )

    def of_bodies(self) -> dict[str, BodyMargin]:
        """Return the smallest margin of each obstacle, nearest first."""
        nearest: dict[str, BodyMargin] = {}
        for margin in self.margins:
            nearest.setdefault(margin.body, margin)
        return nearest

    def text(self, rows: int = 10) -> str:
        """Return the nearest pairs as a table: clearance, P(occupied), entropy, steepest joint."""
        table: list[tuple[str, ...]] = [
            ("link", "body", "clearance", "P(occ)", "entropy", "steepest joint")
        ]
        table += [self._row(margin) for margin in self.margins[:rows]]
        a, b, c, d, e, _ = (max(map(len, column)) for column in zip(*table, strict=True))
        shape = f"{{:{a}}}  {{:{b}}}  {{:>{c}}}  {{:>{d}}}  {{:>{e}}}  {{}}"
        lines = [shape.format(*row).rstrip() for row in table]
        if len(self.margins) > rows:
            lines.append(f"and {len(self.margins) - rows} farther pairs")
        return "\n".join(lines)

    def _row(self, margin: BodyMargin) -> tuple[str, ...]:
        steepest = int(np.argmax(np.abs(margin.gradient)))
        slope = 1000 * margin.gradient[steepest]
        joint = f"{self.joint_names[steepest]} {slope:+.0f} mm/{self.joint_units[steepest]}"
        body = spoken(margin.body) if source_of(margin.body).policy else margin.body
        return (
            margin.link,
            body + (" (allowed)" if margin.allowed else ""),
            f"{1000 * margin.clearance:.1f} mm",
            "-" if margin.occupancy is None else f"{margin.occupancy:.2f}",
            "-" if margin.entropy is None else f"{margin.entropy:.2f}",
            joint if abs(slope) >= 0.5 else "-",
        )


@dataclass(frozen=True, eq=False)
class Obstacle:
    """One of `World.sources` or `World.plane_names`: a half-space with its normal and offset
    (4,), or what has a field of distances."""

    name: str
    kind: Kind
    plane: Any = None
    field: DistanceField | None = None

    def bound(self, points: Points) -> Values:
        """Lower bound of the signed distance from points (world, metres); exact for planes."""
        if self.field is None:
            return np.asarray(points @ self.plane[:3] - self.plane[3])
        return self.field.lower_bound(points)

    def nearest(self, points: Points) -> tuple[Points, Points]:
        """Nearest points of the obstacle (from inside it, of what is not), and the unit directions
        in which the distance grows (0 where it has no slope): one step down the slope of the nodes'
        distances, to within a voxel; from beyond the grid, as seen from its face. Directions are
        within a degree for most points, a few degrees off within a voxel of an edge."""
        if self.field is None:
            normal = np.tile(self.plane[:3], (len(points), 1))
            return points - self.bound(points)[:, None] * normal, normal
        inside = points
        if not self.field.solid_outside:
            inside = np.clip(points, self.field.origin, self.field.upper)
        distance, normal = _slope(self.field, inside)
        # Not nearer than is proven: the interpolated distance can be a voxel off.
        found = inside - np.maximum(distance, self.bound(inside))[:, None] * normal
        beyond = (inside != points).any(axis=1)
        away = points[beyond] - found[beyond]
        normal[beyond] = away / np.linalg.norm(away, axis=1, keepdims=True)
        return found, normal


def _slope(field: DistanceField, points: Points) -> tuple[Values, Points]:
    """Interpolated distance and its unit slope, from differences over one voxel: the slope of a
    trilinear interpolation errs by three degrees off a ball, these by less than one."""
    import torch

    half = 0.5 * field.spacing
    steps = np.concatenate([np.zeros((1, 3)), half * np.eye(3), -half * np.eye(3)])
    asked = points + steps[:, None]
    if not field.solid_outside:  # beyond the faces distances are bounds, not distances
        asked[1:] = np.clip(asked[1:], field.origin, field.upper)
    with torch.no_grad():
        around = field.distance_at(torch.from_numpy(asked)).numpy()
    apart = np.stack([asked[1 + k, :, k] - asked[4 + k, :, k] for k in range(3)], axis=1)
    gradient = (around[1:4] - around[4:7]).T / apart
    length = np.linalg.norm(gradient, axis=1, keepdims=True)
    return around[0], np.where(length > 0, gradient / np.where(length > 0, length, 1.0), 0.0)


def obstacles_of(world: Any, without: frozenset[int] = frozenset()) -> tuple[Obstacle, ...]:
    """All obstacles of a `World`: half-spaces, then `world.sources`. Objects `without` may be
    touched: occluded space inside them goes. Fields are baked on first use: about half a second
    each for a table top at 1 cm, 6 bytes per node while the world lives."""
    planes = zip(world.plane_names, world.planes, strict=True)
    found = [Obstacle(name, source_of(name).kind, plane=row) for name, row in planes]
    for name in world.sources:
        field = world.source_field(name, without)
        if field.source.flat[0] >= 0:
            found.append(Obstacle(name, source_of(name).kind, field=field))
    return tuple(found)


def safety_margin(checker: Any, q_or_path: Numbers, tolerance: float = 0.002) -> SafetyMargins:
    """Return the margin between every moving link and every obstacle.

    Each obstacle is asked by itself, so what stands behind something nearer is named, too. All
    clearances are lower bounds by the checker's own rules, and none is below `checker.clearance`
    but by rounding. Along a path no sphere moves more than `tolerance` to the nearest sample, and
    that much is subtracted; for a tight bound ask `min_clearance`. Joint limits do not enter.

    The first call bakes one distance field per obstacle (`obstacles_of`); after that a
    configuration costs milliseconds, a path O(configurations x spheres x bodies).

    Args:
        checker: a `CollisionChecker` over a `World`.
        q_or_path: (dof,) or (T, dof) joint values, radians or metres.
        tolerance: metres; for a path only.

    Raises:
        RobotError: see `waypoints`; or the path is too long for the tolerance.
    """
    checked_tolerance(tolerance)
    array = joint_values(q_or_path, checker.robot, "a path")
    if array.ndim == 1:
        Q = configurations(checker.robot, array[None], finite=True)
        places, slack = np.zeros(1), 0.0
    else:
        edges = edges_of(checker, array)
        (Q, places), slack = edges.samples(tolerance), tolerance if len(array) > 1 else 0.0
    found = sorted(_nearest_pairs(checker, Q, places, slack), key=lambda margin: margin.clearance)
    return SafetyMargins(
        margins=tuple(found),
        clearance=float(checker.clearance_batch(Q).min()) - slack,
        self_clearance=float(checker.self_clearance_batch(Q).min()) - slack,
        margin=checker.config.margin,
        joint_names=tuple(checker.robot.joint_names),
        joint_units=joint_units(checker.robot.arrays),
        resolution=float(checker.world.field.spacing),
        tolerance=slack,
        configurations=len(Q),
    )


def margin_profile(
    checker: Any, path: Numbers, tolerance: float = 0.005
) -> tuple[Values, dict[str, Values]]:
    """Return the clearance of the whole robot to each obstacle along a path (T, dof), metres.

    Contacts that a rule allows do not count. Errors as for `safety_margin`.

    Returns:
        Places on the path (number of the edge plus the fraction of it), so close that no sphere
        moves more than the tolerance (metres) to the nearest, and for each obstacle the clearance
        there, nothing subtracted.
    """
    checked_tolerance(tolerance)
    Q, places = edges_of(checker, path).samples(tolerance)
    profile: dict[str, np.ndarray] = {}
    for rule, links in _rules(checker):
        bodies = [b for b in obstacles_of(checker.world, rule) if not _is_allowed(b, rule)]
        for rows, number, bound, _ in _scan(checker, Q, bodies, links):
            name = bodies[number].name
            part = profile.setdefault(name, np.full(len(Q), np.inf))[rows]
            np.minimum(part, bound.min(axis=1), out=part)
    return places, profile


def _rules(checker: Any) -> Iterator[tuple[frozenset[int], Int[np.ndarray, " l"]]]:
    """Yield the moving links that share a contact rule, with the objects they may touch."""
    by_rule: dict[frozenset[int], list[int]] = {}
    for link in np.flatnonzero(~np.asarray(checker.robot.arrays.link_fixed)).tolist():
        by_rule.setdefault(checker.allowed_objects(link), []).append(link)
    for rule, links in by_rule.items():
        yield rule, np.array(links)


def _is_allowed(body: Obstacle, rule: frozenset[int]) -> bool:
    return object_id(body.name) in rule


def _scan(
    checker: Any, Q: Rows, bodies: Sequence[Obstacle], links: Int[np.ndarray, " l"]
) -> Iterator[tuple[slice, int, Float[np.ndarray, "m l"], Int[np.ndarray, "m l"]]]:
    """Yield, per piece of Q and number of a body, each link's bound and the sphere that has it:
    the larger of that of its nearest sphere and that of the ball around all its spheres."""
    arrays = checker.robot.arrays
    spheres = [np.arange(arrays.link_start[k], arrays.link_start[k + 1]) for k in links]
    used = np.concatenate([*spheres, np.empty(0, dtype=np.int64)])
    starts = np.cumsum([0, *(len(own) for own in spheres)])[:-1]
    for begin in range(0, len(Q), _CHUNK):
        rows = slice(begin, min(begin + _CHUNK, len(Q)))
        R, t = frame_poses(arrays, Q[rows])
        centers = place_points(R, t, arrays.sphere_frame[used], arrays.sphere_center[used])
        balls = place_points(R, t, arrays.link_frame[links], arrays.link_center[links])
        for number, body in enumerate(bodies):
            shape = centers.shape[:2]
            gap = body.bound(centers.reshape(-1, 3)).reshape(shape) - arrays.sphere_radius[used]
            whole = body.bound(balls.reshape(-1, 3)).reshape(balls.shape[:2])
            bound = np.minimum.reduceat(gap, starts, axis=1)
            # The first sphere of each link that attains its smallest gap.
            ends = [*starts[1:], len(used)]
            nearest = np.stack(
                [own[gap[:, a:b].argmin(axis=1)]
                 for own, a, b in zip(spheres, starts, ends, strict=True)], axis=1,
            )  # fmt: skip
            yield rows, number, np.maximum(bound, whole - arrays.link_radius[links]), nearest


def _nearest_pairs(checker: Any, Q: Rows, places: Values, slack: float) -> Iterator[BodyMargin]:
    for rule, links in _rules(checker):
        bodies = obstacles_of(checker.world, rule)
        shape = (len(bodies), len(links))
        best, row = np.full(shape, np.inf), np.zeros(shape, dtype=np.int64)
        sphere = np.zeros(shape, dtype=np.int64)
        for rows, number, bound, nearest in _scan(checker, Q, bodies, links):
            at = bound.argmin(axis=0)
            smallest = np.take_along_axis(bound, at[None], axis=0)[0]
            closer = smallest < best[number]
            best[number, closer] = smallest[closer]
            row[number, closer] = rows.start + at[closer]
            sphere[number, closer] = np.take_along_axis(nearest, at[None], axis=0)[0][closer]
        for number, body in enumerate(bodies):
            details = _details(checker, Q[row[number]], body, sphere[number])
            for column, link in enumerate(links.tolist()):
                yield BodyMargin(
                    link=checker.robot.link_names[link],
                    body=body.name,
                    kind=body.kind,
                    clearance=float(best[number, column]) - slack,
                    sphere=int(sphere[number, column]),
                    allowed=_is_allowed(body, rule),
                    place=float(places[row[number, column]]),
                    **details[column],
                )


def _details(
    checker: Any, Q: Float[np.ndarray, "l dof"], body: Obstacle, spheres: Int[np.ndarray, " l"]
) -> list[dict[str, Any]]:
    """Slope, nearest points and what the map says there, for one sphere at each configuration."""
    arrays = checker.robot.arrays
    centers, jacobians = sphere_jacobians(arrays, Q, spheres)
    nearest, normal = body.nearest(centers)
    witness = centers - arrays.sphere_radius[spheres][:, None] * normal
    gradient = np.einsum("nk,nkj->nj", normal, jacobians)
    occupancy: list[float | None] = [None] * len(Q)
    entropy: list[float | None] = [None] * len(Q)
    if source_of(body.name).judged:
        occupancy = checker.world.map.occupancy(nearest).tolist()
        entropy = checker.world.map.entropy(nearest).tolist()
    names = "gradient", "nearest", "witness", "occupancy", "entropy"
    columns = (*(map(tuple, a.tolist()) for a in (gradient, nearest, witness)), occupancy, entropy)
    return [dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)]
