# SPDX-License-Identifier: BSD-3-Clause
"""Names what the worlds in which a robot collides collide with."""

from collections import Counter

import numpy as np
from jaxtyping import Float, Int

from vprism_plan._kernels import checking, risk
from vprism_plan.collision._counting import Sweep
from vprism_plan.collision._explain import nearest_source
from vprism_plan.collision._risk_setting import Setting
from vprism_plan.collision.reports import Contact
from vprism_plan.collision.risk import FirstContact


def first_contacts(
    at: Setting, path: Float[np.ndarray, "t dof"], sweep: Sweep, edge: int, fraction: float
) -> tuple[FirstContact, ...]:
    """Rank what the worlds collide with first; certain obstacles stop all that are left."""
    if edge < 0 and not sweep.touched.any():
        return ()
    first = sweep.first.copy()
    n = len(first)
    found: Counter[tuple[str, str, int]] = Counter()
    if edge >= 0:
        start = int(sweep.waypoints[edge])
        stop = int(sweep.waypoints[min(edge + 1, len(sweep.waypoints) - 1)])
        late = (first < 0) | (first > start + fraction * (stop - start))
        body, link = _certain_cause(at, path, edge, fraction)
        found[body, link, edge] = int(late.sum())
        first[late] = -1
    for (sphere, owner, sample), count in _touching(at, sweep, first).items():
        link = at.robot.link_names[int(at.robot.sphere_links[sphere])]
        waypoint = int(np.searchsorted(sweep.waypoints, sample, side="right")) - 1
        body = f"object:{at.world.map.object_ids[owner - 1]}"
        found[body, link, waypoint] += count
    total = n if edge >= 0 else int(sweep.touched.sum())
    ranked = sorted(found.items(), key=lambda item: (-item[1], item[0]))
    return tuple(
        FirstContact(body, link, waypoint, count / total)
        for (body, link, waypoint), count in ranked
        if count > 0
    )


def risky_contacts(at: Setting, sweep: Sweep, upper: float) -> tuple[Contact, ...]:
    """Which links touch which objects in how many worlds, the most frequent first.

    Each world counts for its deepest contact alone, so the shares add up to the probability
    of collision, whose upper bound is given.
    """
    n = at.worlds.n_worlds
    found = []
    for (sphere, owner, _), count in _touching(at, sweep, sweep.first).most_common():
        x, y, z = (float(v) for v in sweep.centers[0, :, sphere])
        found.append(
            Contact(
                kind="risk",
                link=at.robot.link_names[int(at.robot.sphere_links[sphere])],
                body=f"object:{at.world.map.object_ids[owner - 1]}",
                depth=upper - float(at.config.max_risk or 0.0),
                sphere=sphere,
                position=(x, y, z),
                probability=count / n,
                detail=f"upper bound of all {upper:.3f}, max_risk {at.config.max_risk}",
            )
        )
    return tuple(found)


def _touching(
    at: Setting, sweep: Sweep, first: Int[np.ndarray, " w"]
) -> Counter[tuple[int, int, int]]:
    """Count (sphere, owner, sample) of the first touch over the worlds."""
    n = len(first)
    sphere, owner = np.empty(n, np.int64), np.empty(n, np.int64)
    rows, owners, origin = at.worlds.owner_tables
    risk.causes(
        sweep.centers, sweep.slack, at.radii, at.sphere_tables, origin, at.worlds.resolution,
        first, at.worlds.counting(), rows, owners, sphere, owner,
    )  # fmt: skip
    hit = np.flatnonzero(sphere >= 0)
    return Counter((int(sphere[s]), int(owner[s]), int(first[s])) for s in hit)


def _certain_cause(
    at: Setting, path: Float[np.ndarray, "t dof"], edge: int, fraction: float
) -> tuple[str, str]:
    """Name the body and the link of the deepest certain contact at a point of an edge."""
    robot = at.robot
    qa, qb = path[edge], path[min(edge + 1, len(path) - 1)]
    q = qa + fraction * (qb - qa)
    n = len(at.radii)
    centers, plane, field = np.empty((3, n)), np.empty(n), np.empty(n)
    which = np.empty(n, np.int64)
    checking.sphere_clearances(q, at.floats, at.ints, *at.packed, centers, plane, which, field)
    gap = np.where(at.sphere_tables >= 0, np.minimum(plane, field), np.inf)
    s = int(np.argmin(gap))
    link = int(robot.sphere_links[s])
    if plane[s] <= field[s]:
        return at.world.plane_names[which[s]], robot.link_names[link]
    rule = int(np.flatnonzero(at.tables == at.sphere_tables[s])[0])
    body, _ = nearest_source(at.world, at.fields[rule], centers[:, s])
    return body, robot.link_names[link]
