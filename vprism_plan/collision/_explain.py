# SPDX-License-Identifier: BSD-3-Clause
"""Turns a refused configuration into named reasons. Not on the fast path."""

from typing import Any

import numpy as np
from jaxtyping import Float

from vprism_plan._kernels.checking import FARTHEST
from vprism_plan.collision.protocols import Answers, BakedWorld, NodeField, RuledWorld
from vprism_plan.collision.reports import Contact, Kind, StateReport
from vprism_plan.world.pictured import free_balls

_STATUS_NAMES = {1: "occluded", 2: "unobserved", 3: "outside"}
_SAMPLES = 96
_AROUND = 2  # nodes beyond a point's cell that are asked for the nearest obstacle's name


def unit_ball_points(n: int = _SAMPLES) -> Float[np.ndarray, "n 3"]:
    """Return n points spread evenly through the unit ball, its surface included."""
    i = np.arange(n) + 0.5
    polar = np.arccos(1.0 - 2.0 * i / n)
    azimuth = np.pi * (1.0 + np.sqrt(5.0)) * i
    # Radii follow a second low-discrepancy sequence so that volume is covered evenly.
    radius = np.cbrt((i * 0.7548776662466927) % 1.0)
    radius[::4] = 1.0
    directions = np.column_stack(
        [np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)]
    )
    return directions * radius[:, None]


def explain(checker: Answers, q: Float[np.ndarray, "dof"]) -> StateReport:
    """Return the report of `CollisionChecker.explain`."""
    policies = {
        "occluded": checker.world.config.occluded,
        "unobserved": checker.world.config.unobserved,
    }
    limits = _limit_contacts(checker, q)
    if not np.isfinite(q).all():
        return StateReport(
            False, tuple(limits), np.nan, np.nan, checker.config.margin, policies=policies,
            warnings=checker.warnings,
        )  # fmt: skip
    valid = checker.is_valid(q)
    contacts: list[Contact] = []
    if not valid:
        contacts = [*_world_contacts(checker, q), *_self_contacts(checker, q), *limits]
        contacts.sort(key=lambda contact: -contact.depth)
        contacts += checker.risk_contacts(q)
    return StateReport(
        valid=valid,
        contacts=tuple(contacts),
        clearance=checker.clearance(q),
        self_clearance=float(checker.self_clearance_batch(q[None])[0]),
        margin=checker.config.margin,
        shares=volume_shares(checker, q),
        policies=policies,
        allowed=tuple(_allowed_contacts(checker, q)),
        warnings=checker.warnings,
    )


def volume_shares(checker: Answers, q: Float[np.ndarray, "dof"]) -> dict[str, float]:
    """Return which share of the moving links' sphere volume lies in space nobody has seen."""
    centers = checker.sphere_clearances(q)[0]
    moving = ~np.asarray(checker.robot.arrays.link_fixed)[checker.robot.sphere_links]
    if not moving.any():
        return dict.fromkeys(_STATUS_NAMES.values(), 0.0)
    centers, radii = centers[moving], checker.robot.sphere_radii[moving]
    ball = unit_ball_points()
    points = centers[:, None] + radii[:, None, None] * ball
    status = np.asarray(checker.world.status(points.reshape(-1, 3))).reshape(len(radii), -1)
    weight = radii**3 / np.sum(radii**3)
    return {
        name: float(weight @ np.mean(status == code, axis=1))
        for code, name in _STATUS_NAMES.items()
    }


def _limit_contacts(checker: Answers, q: Float[np.ndarray, "dof"]) -> list[Contact]:
    robot = checker.robot
    found = []
    for j, name in enumerate(robot.joint_names):
        if not np.isfinite(q[j]):
            detail = f"joint {name} is {q[j]}; give a finite value"
            found.append(Contact("not_finite", name, "not_finite", np.inf, detail=detail))
        elif abs(q[j]) > FARTHEST:
            detail = (
                f"joint {name} is {q[j]:g}, farther than {FARTHEST:g} from 0; count fewer turns"
            )
            excess = float(abs(q[j]) - FARTHEST)
            found.append(Contact("joint_limit", name, "joint_limit", excess, detail=detail))
        elif not robot.continuous[j] and not robot.lower[j] <= q[j] <= robot.upper[j]:
            excess = float(max(robot.lower[j] - q[j], q[j] - robot.upper[j]))
            detail = (
                f"joint {name} is {q[j]:.4f}, outside its limits "
                f"[{robot.lower[j]:.4f}, {robot.upper[j]:.4f}]"
            )
            found.append(Contact("joint_limit", name, "joint_limit", excess, detail=detail))
    return found


def _world_contacts(checker: Answers, q: Float[np.ndarray, "dof"]) -> list[Contact]:
    """Return the deepest contact of each (link, body), from every sphere's own distances."""
    robot, world, margin = checker.robot, checker.world, checker.config.margin
    centers, plane, which, field = checker.sphere_clearances(q)
    deepest: dict[tuple[str, str], Contact] = {}
    robots = free_balls(getattr(world.map, "views", ()))

    def keep(contact: Contact) -> None:
        key = (contact.link, contact.body)
        if key not in deepest or deepest[key].depth < contact.depth:
            deepest[key] = contact

    for s in range(len(centers)):
        link = int(robot.sphere_links[s])
        if robot.arrays.link_fixed[link]:
            continue
        radius = float(robot.sphere_radii[s])
        if not plane[s] > margin:
            row = world.planes[which[s]]
            body = world.plane_names[which[s]]
            point = centers[s] - radius * row[:3]
            kind: Kind = "support" if body == "support surface" else "known"
            keep(_contact(kind, robot.link_names[link], body, margin - plane[s], s, point, row[:3]))
        if not field[s] > margin:
            body, normal = nearest_source(world, checker.verdict_field(link), centers[s])
            kind = _kind_of(body)
            point = centers[s] - radius * normal
            sure = None
            if kind not in {"known", "support"}:
                ball = centers[s] + radius * unit_ball_points()
                sure = float(np.max(world.map.occupancy(ball)))
            detail = _policy_detail(checker, kind)
            if kind == "occluded":
                at = np.append(centers[s], radius)
                detail += _beside_pictured_robot(at, robots, margin, world)
            keep(
                _contact(
                    kind,
                    robot.link_names[link],
                    body,
                    margin - field[s],
                    s,
                    point,
                    normal,
                    sure,
                    detail,
                )
            )
    return list(deepest.values())


def _contact(
    kind: Kind,
    link: str,
    body: str,
    depth: float,
    sphere: int,
    position: np.ndarray,
    normal: np.ndarray,
    probability: float | None = None,
    detail: str = "",
) -> Contact:
    x, y, z = (float(v) for v in position)
    nx, ny, nz = (float(v) for v in normal)
    return Contact(
        kind, link, body, float(depth), sphere, (x, y, z), (nx, ny, nz), probability, detail
    )


def _kind_of(body: str) -> Kind:
    head = body.split(":", 1)[0]
    kinds: dict[str, Kind] = {
        "object": "object",
        "background": "background",
        "occluded": "occluded",
        "unobserved": "unobserved",
        "support surface": "support",
    }
    return kinds.get(head, "known")


def _policy_detail(checker: Answers, kind: Kind) -> str:
    config = checker.world.config
    if kind == "occluded":
        return f"no camera saw this space; policy occluded={config.occluded!r}"
    if kind == "unobserved" and config.unobserved == "free":
        return "farther away than was judged; WorldConfig(bounds=...) can take it in"
    if kind == "unobserved":
        return f"no camera looked here; policy unobserved={config.unobserved!r}"
    if kind == "background":
        return "observed points without an object label"
    return ""


def _beside_pictured_robot(
    sphere: Float[np.ndarray, "4"],
    robots: Float[np.ndarray, "s 4"],
    margin: float,
    world: BakedWorld,
) -> str:
    """The remedy for a sphere in the shadow of the robot as it was in a picture, or nothing."""
    away = np.linalg.norm(robots[:, :3] - sphere[:3], axis=1)
    if not (away <= robots[:, 3] + sphere[3]).any():
        return ""
    room = margin + 2.0 * float(world.config.resolution)
    return f"; beside the pictured robot: ignore_self(..., room={room:g}) is your word for it"


def _allowed_contacts(checker: Answers, q: Float[np.ndarray, "dof"]) -> list[Contact]:
    """Return the deepest contact of each link with each object that it may touch."""
    robot, world = checker.robot, checker.world
    if not isinstance(world, RuledWorld) or not any(
        checker.allowed_objects(link) for link in range(len(robot.link_names))
    ):
        return []
    centers = checker.sphere_clearances(q)[0]
    deepest: dict[tuple[int, int], Contact] = {}
    for s, center in enumerate(centers):
        link, radius = int(robot.sphere_links[s]), float(robot.sphere_radii[s])
        if robot.arrays.link_fixed[link]:
            continue
        for object_id in sorted(checker.allowed_objects(link)):
            field = world.object_field(object_id)
            depth = radius - float(field.lower_bound(center[None])[0])
            kept = deepest.get((link, object_id))
            if depth < 0.0 or (kept is not None and kept.depth >= depth):
                continue
            _, normal = nearest_source(world, field, center)
            deepest[link, object_id] = _contact(
                "object", robot.link_names[link], f"object:{object_id}", depth, s,
                center - radius * normal, normal, None, "allowed",
            )  # fmt: skip
    return list(deepest.values())


def nearest_source(
    world: BakedWorld, field: NodeField, point: Float[np.ndarray, "3"]
) -> tuple[str, Float[np.ndarray, "3"]]:
    """Return the name of the obstacle nearest to a point and the direction away from it.

    A node at the distance d from an obstacle says that it is at most d plus the way to the
    node from the point. The smallest such sum over the nodes around names the nearest one
    to within a fraction of a voxel: some node lies close to the way there.
    """
    shape = np.array(field.distance.shape)
    g = (point - field.origin) / field.spacing
    past = bool(np.any(g < 0) or np.any(g > shape - 1))
    grid: Any = field
    beyond: Any = getattr(field, "beyond", None)
    if past and beyond is not None:
        at = point[None]
        if float(beyond.lower_bound(at)[0]) <= float(grid.lower_bound(at)[0]):
            return nearest_source(world, beyond, point)
    solid = world.config.unobserved == "occupied" or getattr(field, "solid_outside", False)
    outside = past and solid
    inside = np.clip(g, 0.0, shape - 1.0)
    cell = np.minimum(inside.astype(int), shape - 2)
    corners = cell + np.indices((2, 2, 2)).reshape(3, -1).T
    values = np.asarray(field.distance[tuple(corners.T)], dtype=np.float64)
    low, high = np.maximum(cell - _AROUND, 0), np.minimum(cell + _AROUND + 2, shape)
    window = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    nodes = low + np.moveaxis(np.indices(tuple(high - low)), 0, -1)
    ways = np.asarray(field.spacing * np.linalg.norm(nodes - inside, axis=-1))
    ways += np.maximum(field.distance[window], 0.0)
    nearest = low + np.array(np.unravel_index(int(np.argmin(ways)), ways.shape))
    slope = values.reshape(2, 2, 2)
    gradient = np.array([np.mean(np.diff(slope, axis=axis)) for axis in range(3)], dtype=np.float64)
    if outside:
        gradient = inside - g
    length = float(np.linalg.norm(gradient))
    normal = gradient / length if np.isfinite(length) and length > 0 else np.array([0.0, 0.0, 1.0])
    name = "unobserved" if outside else world.sources[int(field.source[tuple(nearest)])]
    return name, normal


def _self_contacts(checker: Answers, q: Float[np.ndarray, "dof"]) -> list[Contact]:
    robot, margin = checker.robot, checker.config.self_margin
    gaps, spheres = checker.pair_gaps(q)
    centers = checker.sphere_clearances(q)[0]
    found = []
    for p in np.flatnonzero(~(gaps > margin)):
        a, b = (int(link) for link in robot.collision_pairs[p])
        s, t = (int(sphere) for sphere in spheres[p])
        apart = centers[s] - centers[t]
        length = float(np.linalg.norm(apart))
        normal = apart / length if length > 0 else np.array([0.0, 0.0, 1.0])
        point = centers[s] - robot.sphere_radii[s] * normal
        names = robot.link_names
        found.append(_contact("self", names[a], names[b], margin - gaps[p], s, point, normal))
    return found
