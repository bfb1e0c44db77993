# SPDX-License-Identifier: BSD-3-Clause
"""How far every link is from every obstacle, and which way leads out."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from vprism_plan.collision._bodies import Body, bodies_of
from vprism_plan.collision._travel import (
    checked_tolerance,
    edges_of,
    joint_units,
    place_points,
    sphere_jacobians,
)
from vprism_plan.collision.margin_reports import BodyMargin, SafetyMargins
from vprism_plan.collision.path_margins import (
    PathClearance,
    SafeMotion,
    max_safe_motion,
    min_clearance,
)
from vprism_plan.collision.protocols import Numbers
from vprism_plan.robots.kinematics import frame_poses, joint_values

__all__ = [
    "BodyMargin",
    "PathClearance",
    "SafeMotion",
    "SafetyMargins",
    "margin_profile",
    "max_safe_motion",
    "min_clearance",
    "safety_margin",
]

_CHUNK = 512  # configurations whose spheres are in memory at once


def safety_margin(checker: Any, q_or_path: Numbers, tolerance: float = 0.002) -> SafetyMargins:
    """Return the margin between every moving link and every obstacle.

    Each obstacle is asked by itself, so what stands behind something nearer is named,
    too. All clearances are lower bounds by the checker's own rules, and none is below
    `checker.clearance` but by rounding. Along a path the edges are sampled so closely
    that no sphere moves more than `tolerance` to the nearest sample, and that much is
    subtracted; for a tight bound over everything ask `min_clearance`. Joint limits do
    not enter.

    The first call bakes one distance field per obstacle (`_bodies.bodies_of`); after
    that a configuration costs milliseconds, a path O(configurations x spheres x bodies).

    Args:
        checker: a `CollisionChecker` over a `World`.
        q_or_path: (dof,) or (T, dof) joint values, radians or metres.
        tolerance: see above, metres; for a path only.

    Raises:
        RobotError: the shape is wrong, a value is not finite, or the path is too long
            for the tolerance.
    """
    checked_tolerance(tolerance)
    array = joint_values(q_or_path, checker.robot, "a path")
    if array.ndim == 1:
        checker.clearance(array)  # refuses what is not a configuration
        Q, places, slack = array[None], np.zeros(1), 0.0
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
) -> tuple[Float[np.ndarray, " n"], dict[str, Float[np.ndarray, " n"]]]:
    """Return the clearance of the whole robot to each obstacle along a path, metres.

    Contacts that a rule allows do not count.

    Args:
        checker: a `CollisionChecker` over a `World`.
        path: (T, dof) waypoints.
        tolerance: no sphere moves more than this, metres, to the nearest sample.

    Returns:
        Places on the path (number of the edge plus the fraction of it), and for each
        obstacle the clearance there; at the samples, nothing subtracted.

    Raises:
        RobotError: see `safety_margin`.
    """
    checked_tolerance(tolerance)
    Q, places = edges_of(checker, path).samples(tolerance)
    profile: dict[str, np.ndarray] = {}
    for rule, links in _rules(checker):
        bodies = [b for b in bodies_of(checker.world, rule) if not _is_allowed(b, rule)]
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


def _is_allowed(body: Body, rule: frozenset[int]) -> bool:
    return body.kind == "object" and int(body.name.split(":")[1]) in rule


def _scan(
    checker: Any,
    Q: Float[np.ndarray, "n dof"],
    bodies: Sequence[Body],
    links: Int[np.ndarray, " l"],
) -> Iterator[tuple[slice, int, Float[np.ndarray, "m l"], Int[np.ndarray, "m l"]]]:
    """Yield, per piece of Q and number of a body, each link's bound and the sphere that has it.

    As in the checker, a link's bound is the larger of that of its nearest sphere and
    that of the ball around all its spheres.
    """
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


def _nearest_pairs(
    checker: Any, Q: Float[np.ndarray, "n dof"], places: Float[np.ndarray, " n"], slack: float
) -> Iterator[BodyMargin]:
    for rule, links in _rules(checker):
        bodies = bodies_of(checker.world, rule)
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
    checker: Any,
    Q: Float[np.ndarray, "l dof"],
    body: Body,
    spheres: Int[np.ndarray, " l"],
) -> list[dict[str, Any]]:
    """Slope, nearest points and what the map says there, for one sphere at each configuration."""
    arrays = checker.robot.arrays
    centers, jacobians = sphere_jacobians(arrays, Q, spheres)
    nearest, normal = body.nearest(centers)
    witness = centers - arrays.sphere_radius[spheres][:, None] * normal
    gradient = np.einsum("nk,nkj->nj", normal, jacobians)
    occupancy: list[float | None] = [None] * len(Q)
    entropy: list[float | None] = [None] * len(Q)
    if body.of_map:
        occupancy = checker.world.map.occupancy(nearest).tolist()
        entropy = checker.world.map.entropy(nearest).tolist()
    return [
        {
            "gradient": tuple(gradient[i].tolist()),
            "nearest": tuple(nearest[i].tolist()),
            "witness": tuple(witness[i].tolist()),
            "occupancy": occupancy[i],
            "entropy": entropy[i],
        }
        for i in range(len(Q))
    ]
