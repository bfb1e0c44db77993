# SPDX-License-Identifier: BSD-3-Clause
"""Compiled kinematics, state checks and edge checks for single queries on the CPU.

A robot and a world reach these kernels as a few packed arrays, because every array
argument costs a call about 60 ns and the whole state check takes about one
microsecond. `vprism_plan.collision.packing` fills them:

the robot `rf`, `ri`: see `vprism_plan._kernels.robot`.

world floats `wf` = origin x, y, z, spacing, outside_occupied, n_planes, margin, then
    four numbers per plane (normal x, y, z, offset; obstacle where n.x < offset); then, where
    obstacles lie outside the grid, a coarse grid of those: origin, spacing, sizes, nodes.
distance fields `D` (rules, nx, ny, nz) float32: lower bounds of the signed distance at nodes.
block bounds `E` float32: one lower bound for everywhere in each block of 4 x 4 x 4 cells.
"""

import numpy as np

from vprism_plan._kernels.jit import njit
from vprism_plan._kernels.robot import (  # noqa: F401
    fk_frames,
    place_link,
    place_spheres,
    place_spheres_batch,
)

_INF = np.inf
# Radians or metres: what turns or slides farther is refused. Up to here angles are good to a
# nanometre; at 1e16 radians nothing of them is left.
FARTHEST = 1e6
_MOST_CHECKS = 1_000_000  # configurations of one edge, seconds; an edge of so many is refused
MAX_TURN = 0.5  # radians per step of a sampled path: keeps the bend between samples small


@njit(cache=True, nogil=True, inline="always")
def _transform(T, f, rf, o, out, row):
    x = rf[o]
    y = rf[o + 1]
    z = rf[o + 2]
    out[row, 0] = T[f, 0] * x + T[f, 1] * y + T[f, 2] * z + T[f, 9]
    out[row, 1] = T[f, 3] * x + T[f, 4] * y + T[f, 5] * z + T[f, 10]
    out[row, 2] = T[f, 6] * x + T[f, 7] * y + T[f, 8] * z + T[f, 11]


@njit(cache=True, nogil=True)
def _cell_bound(D, rule, h, cx, cy, cz):
    """Lower bound of the distance at grid point c from the eight nodes around it, metres.

    Two rules, both proofs from distances d_i at the nodes x_i; the larger counts.

    Cones: distance is 1-Lipschitz, so d(x) >= d_i - |x - x_i|.

    Parabolas: d(x)^2 - |x|^2 is concave (a minimum of linear functions of x), so with
    trilinear weights w_i and cell fractions f_a, where d_i >= 0,
    d(x)^2 >= sum_i w_i d_i^2 - h^2 sum_a f_a (1 - f_a).
    """
    i0 = min(int(cx), D.shape[1] - 2)
    j0 = min(int(cy), D.shape[2] - 2)
    k0 = min(int(cz), D.shape[3] - 2)
    fx = cx - i0
    fy = cy - j0
    fz = cz - k0
    cone = -_INF
    square = -(h * h) * (fx * (1.0 - fx) + fy * (1.0 - fy) + fz * (1.0 - fz))
    for a in range(2):
        wa = fx if a else 1.0 - fx
        ea = (fx - a) ** 2
        for b in range(2):
            wb = wa * (fy if b else 1.0 - fy)
            eb = ea + (fy - b) ** 2
            for c in range(2):
                d = D[rule, i0 + a, j0 + b, k0 + c]
                cone = max(cone, d - h * np.sqrt(eb + (fz - c) ** 2))
                d = min(max(d, 0.0), 1e9)  # no obstacle at all is an infinite distance
                square += wb * (fz if c else 1.0 - fz) * d * d
    if square > 0.0:
        cone = max(cone, np.sqrt(square))
    return cone


@njit(cache=True, nogil=True)
def _beyond_bound(wf, x, y, z):
    """Lower bound of the distance to the obstacles outside the grid, metres.

    As `_cell_bound`, on the coarse grid behind the planes in wf: origin, spacing, sizes, then
    its nodes. Beyond that grid nothing was judged: everything is an obstacle.
    """
    o = 7 + 4 * int(wf[5])
    h = wf[o + 3]
    nx = int(wf[o + 4])
    ny = int(wf[o + 5])
    nz = int(wf[o + 6])
    gx = (x - wf[o]) / h
    gy = (y - wf[o + 1]) / h
    gz = (z - wf[o + 2]) / h
    away = (gx - min(max(gx, 0.0), nx - 1.0)) ** 2 + (gy - min(max(gy, 0.0), ny - 1.0)) ** 2
    away += (gz - min(max(gz, 0.0), nz - 1.0)) ** 2
    if away > 0.0:
        return -h * np.sqrt(away)
    i0 = min(int(gx), nx - 2)
    j0 = min(int(gy), ny - 2)
    k0 = min(int(gz), nz - 2)
    fx = gx - i0
    fy = gy - j0
    fz = gz - k0
    cone = -_INF
    square = -(h * h) * (fx * (1.0 - fx) + fy * (1.0 - fy) + fz * (1.0 - fz))
    for a in range(2):
        wa = fx if a else 1.0 - fx
        for b in range(2):
            wb = wa * (fy if b else 1.0 - fy)
            row = o + 7 + ((i0 + a) * ny + j0 + b) * nz + k0
            for c in range(2):
                d = wf[row + c]
                cone = max(cone, d - h * np.sqrt((fx - a) ** 2 + (fy - b) ** 2 + (fz - c) ** 2))
                d = max(d, 0.0)
                square += wb * (fz if c else 1.0 - fz) * d * d
    if square > 0.0:
        cone = max(cone, np.sqrt(square))
    return cone


@njit(cache=True, nogil=True, inline="always")
def field_bound(D, E, wf, rule, x, y, z, enough, deep):
    """Lower bound of the distance from (x, y, z) to the baked obstacles, metres.

    Asked in this order until a bound exceeds `enough`; each is never below the one
    before, so verdicts do not depend on where it ends:
    the block (one number for 4 x 4 x 4 cells; a table that stays in the cache),
    the nearest node (its distance less the way to it),
    and, if `deep`, the best of the cell's eight nodes (`_cell_bound`).

    Outside the grid, with c the closest point of the grid box, every obstacle o of the
    grid satisfies |x - o|^2 >= |x - c|^2 + |c - o|^2, because the box is convex. What lies
    beyond the grid has a coarse field of its own (`_beyond_bound`).
    """
    h = wf[3]
    nx = D.shape[1]
    ny = D.shape[2]
    nz = D.shape[3]
    gx = (x - wf[0]) / h
    gy = (y - wf[1]) / h
    gz = (z - wf[2]) / h
    cx = min(max(gx, 0.0), nx - 1.0)
    cy = min(max(gy, 0.0), ny - 1.0)
    cz = min(max(gz, 0.0), nz - 1.0)
    out2 = (gx - cx) ** 2 + (gy - cy) ** 2 + (gz - cz) ** 2
    best = -_INF  # not finite, or absurdly far: never "free"
    if out2 < 1e18:
        if out2 > 0.0 and wf[4] > 0.0:
            best = -h * np.sqrt(out2)
        else:
            best = float(E[rule, int(cx) >> 2, int(cy) >> 2, int(cz) >> 2])
            if best <= enough:
                i = int(cx + 0.5)
                j = int(cy + 0.5)
                k = int(cz + 0.5)
                away = h * np.sqrt((cx - i) ** 2 + (cy - j) ** 2 + (cz - k) ** 2)
                best = D[rule, i, j, k] - away
                if deep and best <= enough:
                    best = max(best, _cell_bound(D, rule, h, cx, cy, cz))
            if out2 > 0.0:
                inside = max(best, 0.0)
                best = np.sqrt(out2 * h * h + inside * inside)
                if wf.size > 7 + 4 * int(wf[5]):
                    best = min(best, _beyond_bound(wf, x, y, z))
            elif wf[4] > 0.0:
                faces = min(gx, nx - 1.0 - gx, gy, ny - 1.0 - gy)
                best = min(best, h * min(faces, gz, nz - 1.0 - gz))
    return best


@njit(cache=True, nogil=True, inline="always")
def plane_bound(wf, x, y, z):
    """Distance from a point to the nearest half-space obstacle (exact for each one)."""
    best = _INF
    for p in range(int(wf[5])):
        o = 7 + 4 * p
        best = min(best, wf[o] * x + wf[o + 1] * y + wf[o + 2] * z - wf[o + 3])
    return best


@njit(cache=True, nogil=True, inline="always")
def within_limits(q, rf, ri):
    """Whether every joint is within `FARTHEST` of 0 (and so finite), and inside its limits
    unless it is continuous."""
    lo = ri[19]
    co = ri[11]
    for j in range(ri[4]):
        v = q[j]
        if not abs(v) <= FARTHEST:
            return False
        if ri[co + j] == 0 and not (rf[lo + 2 * j] <= v <= rf[lo + 2 * j + 1]):
            return False
    return True


@njit(cache=True, nogil=True)
def _world_clear(T, lc, C, placed, rf, ri, D, E, wf):
    """Whether every moving link keeps more than the margin from the world.

    Bounding spheres first; one loop without calls, since each call would pass (and
    count references of) all arrays anew.
    """
    margin = wf[6]
    ro = ri[17] + 3 * ri[1]
    # Distal links first: the hand is what hits things.
    for link in range(ri[2] - 1, -1, -1):
        li = ri[9] + 4 * link
        rule = ri[li + 3]
        if rule < 0:
            continue
        need = margin + rf[ri[18] + 4 * link + 3]
        x = lc[link, 0]
        y = lc[link, 1]
        z = lc[link, 2]
        plane_ok = plane_bound(wf, x, y, z) > need
        field_ok = field_bound(D, E, wf, rule, x, y, z, need, False) > need
        if plane_ok and field_ok:
            continue
        if not placed[link]:
            placed[link] = True
            place_link(link, T, rf, ri, C)
        for s in range(ri[li + 1], ri[li + 2]):
            x = C[0, s]
            y = C[1, s]
            z = C[2, s]
            need = margin + rf[ro + s]
            if not plane_ok and not plane_bound(wf, x, y, z) > need:
                return False
            if not field_ok and not field_bound(D, E, wf, rule, x, y, z, need, True) > need:
                return False
    return True


@njit(cache=True, nogil=True)
def _link_clearance(link, T, lc, C, placed, rf, ri, D, E, wf, enough):
    """Lower bound of the distance from a link to the world, exact per sphere below `enough`.

    A sphere is never nearer than the link's bounding sphere, so each bound is the
    larger of the two: that keeps this consistent with `_world_clear`.
    """
    r = rf[ri[18] + 4 * link + 3]
    rule = ri[ri[9] + 4 * link + 3]
    x = lc[link, 0]
    y = lc[link, 1]
    z = lc[link, 2]
    plane_all = plane_bound(wf, x, y, z) - r
    field_all = field_bound(D, E, wf, rule, x, y, z, _INF, False) - r
    if min(plane_all, field_all) >= enough:
        return min(plane_all, field_all)
    if not placed[link]:
        placed[link] = True
        place_link(link, T, rf, ri, C)
    best = _INF
    li = ri[9] + 4 * link
    ro = ri[17] + 3 * ri[1]
    for s in range(ri[li + 1], ri[li + 2]):
        x = C[0, s]
        y = C[1, s]
        z = C[2, s]
        r = rf[ro + s]
        plane = max(plane_bound(wf, x, y, z) - r, plane_all)
        field = max(field_bound(D, E, wf, rule, x, y, z, _INF, True) - r, field_all)
        best = min(best, plane, field)
    return best


@njit(cache=True, nogil=True, inline="always")
def _place_pair(a, b, T, C, placed, rf, ri):
    """Make sure that the spheres of both links are placed."""
    if not placed[a]:
        placed[a] = True
        place_link(a, T, rf, ri, C)
    if not placed[b]:
        placed[b] = True
        place_link(b, T, rf, ri, C)


@njit(cache=True, nogil=True)
def _self_clear(T, lc, C, placed, rf, ri):
    """Whether every pair of links keeps more than the self margin; bounding spheres first."""
    bo = ri[18]
    ro = ri[17] + 3 * ri[1]
    for pair in range(ri[3]):
        a = ri[ri[10] + 2 * pair]
        b = ri[ri[10] + 2 * pair + 1]
        x = lc[b, 0]
        y = lc[b, 1]
        z = lc[b, 2]
        d2 = (lc[a, 0] - x) ** 2 + (lc[a, 1] - y) ** 2 + (lc[a, 2] - z) ** 2
        margin = rf[ri[21]] - rf[ri[21] + 1 + pair]
        ball = rf[bo + 4 * b + 3] + margin
        reach = rf[bo + 4 * a + 3] + ball
        if d2 > reach * reach:
            continue
        _place_pair(a, b, T, C, placed, rf, ri)
        b0 = ri[ri[9] + 4 * b + 1]
        b1 = ri[ri[9] + 4 * b + 2]
        for s in range(ri[ri[9] + 4 * a + 1], ri[ri[9] + 4 * a + 2]):
            px = C[0, s]
            py = C[1, s]
            pz = C[2, s]
            bound = rf[ro + s] + ball
            if (px - x) ** 2 + (py - y) ** 2 + (pz - z) ** 2 > bound * bound:
                continue
            ra = rf[ro + s] + margin
            for t in range(b0, b1):
                d2 = (px - C[0, t]) ** 2 + (py - C[1, t]) ** 2 + (pz - C[2, t]) ** 2
                bound = ra + rf[ro + t]
                if d2 <= bound * bound:
                    return False
    return True


@njit(cache=True, nogil=True)
def _pair_gap(pair, T, lc, C, placed, rf, ri, enough):
    """Gap between two links: exact if at most `enough`, else some value above `enough`."""
    a = ri[ri[10] + 2 * pair]
    b = ri[ri[10] + 2 * pair + 1]
    bo = ri[18]
    x = lc[b, 0]
    y = lc[b, 1]
    z = lc[b, 2]
    d2 = (lc[a, 0] - x) ** 2 + (lc[a, 1] - y) ** 2 + (lc[a, 2] - z) ** 2
    padding = rf[ri[21] + 1 + pair]
    ball = rf[bo + 4 * b + 3] - padding
    reach = rf[bo + 4 * a + 3] + ball
    if d2 > (reach + enough) ** 2:
        return np.sqrt(d2) - reach
    _place_pair(a, b, T, C, placed, rf, ri)
    la = ri[9] + 4 * a
    lb = ri[9] + 4 * b
    ro = ri[17] + 3 * ri[1]
    best = _INF
    for s in range(ri[la + 1], ri[la + 2]):
        px = C[0, s]
        py = C[1, s]
        pz = C[2, s]
        ra = rf[ro + s]
        d2 = (px - x) ** 2 + (py - y) ** 2 + (pz - z) ** 2
        bound = ra + ball + enough
        if d2 > bound * bound:
            best = min(best, np.sqrt(d2) - ra - ball)
            continue
        for t in range(ri[lb + 1], ri[lb + 2]):
            d2 = (px - C[0, t]) ** 2 + (py - C[1, t]) ** 2 + (pz - C[2, t]) ** 2
            best = min(best, np.sqrt(d2) - ra - rf[ro + t] + padding)
    return best


@njit(cache=True, nogil=True, inline="always")
def scratch(ri):
    """Room for frame poses, link centres, sphere centres and which links are placed."""
    n_links = ri[2]
    C = np.empty((3, ri[1]))
    return np.empty((ri[0], 12)), np.empty((n_links, 3)), C, np.empty(n_links, np.bool_)


@njit(cache=True, nogil=True)
def pose_links(q, rf, ri, T, lc, placed):
    """Place frames and link bounding spheres; no sphere is placed yet."""
    fk_frames(q, rf, ri, T)
    for link in range(ri[2]):
        placed[link] = False
        _transform(T, ri[ri[9] + 4 * link], rf, ri[18] + 4 * link, lc, link)


@njit(cache=True, nogil=True, inline="always")
def _state_valid(q, rf, ri, D, E, wf, T, lc, C, placed):
    if not within_limits(q, rf, ri):
        return False
    pose_links(q, rf, ri, T, lc, placed)
    if not _world_clear(T, lc, C, placed, rf, ri, D, E, wf):
        return False
    return _self_clear(T, lc, C, placed, rf, ri)


@njit(cache=True, nogil=True)
def is_valid(q, rf, ri, D, E, wf):
    """Whether a configuration is inside its limits and clear of the world and itself."""
    T, lc, C, placed = scratch(ri)
    return _state_valid(q, rf, ri, D, E, wf, T, lc, C, placed)


@njit(cache=True, nogil=True)
def is_valid_batch(Q, rf, ri, D, E, wf, out):
    """Fill out (n,) with `is_valid` of each row of Q (n, dof).

    Calls it rather than inlining its body again, which would compile for seconds more.
    """
    for n in range(Q.shape[0]):
        out[n] = is_valid(Q[n], rf, ri, D, E, wf)


@njit(cache=True, nogil=True)
def clearance_batch(Q, rf, ri, D, E, wf, world, own):
    """Fill world (n,) and own (n,): distance bounds to the world and between links, metres."""
    T, lc, C, placed = scratch(ri)
    li = ri[9]
    for n in range(Q.shape[0]):
        pose_links(Q[n], rf, ri, T, lc, placed)
        best = _INF
        for link in range(ri[2]):
            if ri[li + 4 * link + 3] >= 0:
                best = min(best, _link_clearance(link, T, lc, C, placed, rf, ri, D, E, wf, best))
        world[n] = best
        gap = _INF
        for pair in range(ri[3]):
            gap = min(gap, _pair_gap(pair, T, lc, C, placed, rf, ri, gap))
        own[n] = gap


@njit(cache=True, nogil=True)
def sphere_clearances(q, rf, ri, D, E, wf, C, plane, which, field):
    """Per sphere: centre, distance to the nearest plane and its index, bound from the field.

    Every sphere's own values (no bounding spheres): what `explain` reports.
    """
    place_spheres(q, rf, ri, C)
    ro = ri[17] + 3 * ri[1]
    for link in range(ri[2]):
        li = ri[9] + 4 * link
        rule = max(ri[li + 3], 0)
        for s in range(ri[li + 1], ri[li + 2]):
            x = C[0, s]
            y = C[1, s]
            z = C[2, s]
            r = rf[ro + s]
            plane[s] = _INF
            which[s] = -1
            for p in range(int(wf[5])):
                o = 7 + 4 * p
                d = wf[o] * x + wf[o + 1] * y + wf[o + 2] * z - wf[o + 3] - r
                if d < plane[s]:
                    plane[s] = d
                    which[s] = p
            field[s] = field_bound(D, E, wf, rule, x, y, z, _INF, True) - r


@njit(cache=True, nogil=True)
def pair_gaps(q, rf, ri, gaps, spheres):
    """Fill gaps (n_pairs,) with the smallest sphere gap of each link pair (metres, padding
    not counted), and spheres (n_pairs, 2) with the two spheres that have it."""
    C = np.empty((3, ri[1]))
    place_spheres(q, rf, ri, C)
    li = ri[9]
    ro = ri[17] + 3 * ri[1]
    for pair in range(ri[3]):
        a = ri[ri[10] + 2 * pair]
        b = ri[ri[10] + 2 * pair + 1]
        gaps[pair] = _INF
        for s in range(ri[li + 4 * a + 1], ri[li + 4 * a + 2]):
            for t in range(ri[li + 4 * b + 1], ri[li + 4 * b + 2]):
                d2 = 0.0
                for k in range(3):
                    d2 += (C[k, s] - C[k, t]) ** 2
                gap = np.sqrt(d2) - rf[ro + s] - rf[ro + t] + rf[ri[21] + 1 + pair]
                if gap < gaps[pair]:
                    gaps[pair] = gap
                    spheres[pair, 0] = s
                    spheres[pair, 1] = t


@njit(cache=True, nogil=True)
def motion_rates(delta, rf, ri, link_rate, pair_rate):
    """Bounds on motion per unit of path parameter; return the largest of them.

    link_rate[l]: displacement of any sphere centre of link l in the world.
    pair_rate[p]: change of the distance between two links, to which only the joints
    between them contribute.
    """
    n_frames = ri[0]
    n_links = ri[2]
    fi = ri[8]
    ff = ri[16]
    ro = ri[20]
    speed = np.zeros(n_frames)
    for f in range(1, n_frames):
        speed[f] = abs(rf[ff + 14 * f + 12] * delta[ri[fi + 3 * f + 2]])
    fastest = 0.0
    for link in range(n_links):
        rate = 0.0
        for f in range(1, n_frames):
            rate += speed[f] * max(rf[ro + f * n_links + link], 0.0)
        link_rate[link] = rate
        fastest = max(fastest, rate)
    for pair in range(ri[3]):
        a = ri[ri[10] + 2 * pair]
        b = ri[ri[10] + 2 * pair + 1]
        rate = 0.0
        for f in range(1, n_frames):
            reach_a = rf[ro + f * n_links + a]  # -1 where the joint does not move the link
            reach_b = rf[ro + f * n_links + b]
            if (reach_a >= 0.0) != (reach_b >= 0.0):
                rate += speed[f] * max(reach_a, reach_b)
        pair_rate[pair] = rate
        fastest = max(fastest, rate)
    return fastest


@njit(cache=True, nogil=True)
def _safe_span(q, rf, ri, D, E, wf, link_rate, pair_rate, longest, T, lc, C, placed):
    """How far along the edge (path parameter) a configuration's clearance reaches; < 0: invalid.

    Each link may move by its clearance, each pair by its gap, before anything can
    touch; spans beyond `longest` are not worth refining.
    """
    if not within_limits(q, rf, ri):
        return -1.0
    pose_links(q, rf, ri, T, lc, placed)
    margin = wf[6]
    li = ri[9]
    span = longest
    for link in range(ri[2] - 1, -1, -1):
        if ri[li + 4 * link + 3] < 0:
            continue
        rate = link_rate[link]
        c = _link_clearance(link, T, lc, C, placed, rf, ri, D, E, wf, margin + span * rate) - margin
        if not c > 0.0:
            return -1.0
        if c < span * rate:
            span = c / rate
    self_margin = rf[ri[21]]
    for pair in range(ri[3]):
        rate = pair_rate[pair]
        g = _pair_gap(pair, T, lc, C, placed, rf, ri, self_margin + span * rate) - self_margin
        if not g > 0.0:
            return -1.0
        if g < span * rate:
            span = g / rate
    return span


@njit(cache=True, nogil=True)
def check_motion(qa, qb, rf, ri, D, E, wf, min_motion, stats):
    """Whether the straight edge qa -> qb is free, by conservative advancement.

    The edge is what the two ends say: a joint that differs by several turns makes them all.
    Intervals between checked configurations are covered by what their clearances
    guarantee; the middle of what is left is checked next. A gap in which no sphere
    can move more than `min_motion` metres is accepted: any point of it lies within
    min_motion / 2 of a configuration known to be free.

    stats (4,): path parameter of a collision (or -1), configurations checked,
    largest motion of an accepted gap (metres; 0 = certified throughout), motion bound.
    """
    dof = ri[4]
    delta = qb - qa
    stats[0] = -1.0
    stats[1] = 0.0
    stats[2] = 0.0
    stats[3] = 0.0
    if not within_limits(qa, rf, ri):
        stats[0] = 0.0
        return False
    if not within_limits(qb, rf, ri):
        stats[0] = 1.0
        return False
    link_rate = np.empty(ri[2])
    pair_rate = np.empty(ri[3])
    total = motion_rates(delta, rf, ri, link_rate, pair_rate)
    stats[3] = total
    T, lc, C, placed = scratch(ri)
    q = np.empty(dof)
    lo = np.empty(128)
    hi = np.empty(128)
    span_a = _safe_span(qa, rf, ri, D, E, wf, link_rate, pair_rate, 1.0, T, lc, C, placed)
    stats[1] = 1.0
    if span_a < 0.0:
        stats[0] = 0.0
        return False
    span_b = _safe_span(qb, rf, ri, D, E, wf, link_rate, pair_rate, 1.0, T, lc, C, placed)
    stats[1] = 2.0
    if span_b < 0.0:
        stats[0] = 1.0
        return False
    lo[0] = span_a
    hi[0] = 1.0 - span_b
    depth = 1
    while depth > 0:
        depth -= 1
        a = lo[depth]
        b = hi[depth]
        gap = (b - a) * total
        if gap <= min_motion:
            stats[2] = max(stats[2], gap)
            continue
        t = 0.5 * (a + b)
        # What cannot be divided, or only beyond the stack or all patience, counts as a collision.
        span = -1.0
        if depth <= 120 and a < t < b and stats[1] < _MOST_CHECKS:
            for j in range(dof):
                q[j] = qa[j] + t * delta[j]
            span = _safe_span(
                q, rf, ri, D, E, wf, link_rate, pair_rate, 0.5 * (b - a), T, lc, C, placed
            )
            stats[1] += 1.0
        if span < 0.0:
            stats[0] = t
            return False
        # Each interval is at most half its parent, so the stack stays small.
        lo[depth] = a
        hi[depth] = t - span
        lo[depth + 1] = t + span
        hi[depth + 1] = b
        depth += 2
    return True


@njit(cache=True, nogil=True)
def check_path(P, rf, ri, D, E, wf, min_motion, stats):
    """Index of the first edge of P (n, dof) that is in collision, or -1; see `check_motion`.

    stats (4,): of the refused edge. A single configuration counts as an edge to itself.
    """
    for e in range(max(P.shape[0] - 1, 1)):
        if not check_motion(
            P[e], P[min(e + 1, P.shape[0] - 1)], rf, ri, D, E, wf, min_motion, stats
        ):
            return e
    return -1


@njit(cache=True, nogil=True)
def turned_by(delta, rf, ri):
    """Sum of the angles by which the joints turn, mimicking ones included."""
    total = 0.0
    for f in range(1, ri[0]):
        if ri[ri[8] + 3 * f + 1] == 1:
            total += abs(rf[ri[16] + 14 * f + 12] * delta[ri[ri[8] + 3 * f + 2]])
    return total


@njit(cache=True, nogil=True)
def count_steps(P, rf, ri, spacing, steps):
    """Fill steps (n - 1,) so that in one step of an edge no sphere centre moves more than
    `spacing` metres and all joints together turn by at most half a radian; return their sum."""
    link_rate = np.empty(ri[2])
    pair_rate = np.empty(ri[3])
    total = 0
    for e in range(P.shape[0] - 1):
        delta = P[e + 1] - P[e]
        motion_rates(delta, rf, ri, link_rate, pair_rate)
        fastest = turned_by(delta, rf, ri) * spacing / MAX_TURN
        for link in range(ri[2]):
            fastest = max(fastest, link_rate[link])
        steps[e] = max(1, int(np.ceil(fastest / spacing)))
        total += steps[e]
    return total


@njit(cache=True, nogil=True)
def place_path(P, steps, rf, ri, C, slack):
    """Sample a path: C (n, 3, S) sphere centres, and slack (n, S) that covers the gaps.

    Grown by its slack, a sphere of radius r at one of two neighbouring samples holds every
    point that it holds anywhere between them: sqrt(r^2 + chord^2 / 4) - r for the chord, and
    a quarter of (joint angle turned) x (path length) for the bend.

    The first, because a point within r of the chord, where that is divided into a and b, is
    at a squared distance of at most r^2 + ab from one of its ends (the mean of the two
    squares with weights b and a is that). The second, because the second derivative of a
    centre along the edge is a sum over pairs of joints of |dq_f| |dq_g| |dC/dq_g|, at most
    twice the product of the two, and a curve leaves its chord by at most an eighth of that.
    """
    dof = ri[4]
    q = np.empty(dof)
    link_rate = np.empty(ri[2])
    pair_rate = np.empty(ri[3])
    slack[:] = 0.0
    i = 0
    for e in range(P.shape[0] - 1):
        delta = P[e + 1] - P[e]
        motion_rates(delta, rf, ri, link_rate, pair_rate)
        turned = turned_by(delta, rf, ri) / steps[e]
        for t in range(steps[e] + 1):
            for j in range(dof):
                q[j] = P[e, j] + (t / steps[e]) * delta[j]
            if t > 0 or e == 0:
                place_spheres(q, rf, ri, C[i + t])
            if t == 0:
                continue
            for link in range(ri[2]):
                bend = 0.25 * turned * link_rate[link] / steps[e]
                li = ri[9] + 4 * link
                for s in range(ri[li + 1], ri[li + 2]):
                    chord = 0.0
                    for k in range(3):
                        chord += (C[i + t, k, s] - C[i + t - 1, k, s]) ** 2
                    r = rf[ri[17] + 3 * ri[1] + s]
                    way = np.sqrt(r * r + 0.25 * chord) - r + bend
                    slack[i + t - 1, s] = max(slack[i + t - 1, s], way)
                    slack[i + t, s] = max(slack[i + t, s], way)
        i += steps[e]
    if P.shape[0] == 1:
        place_spheres(P[0], rf, ri, C[0])
