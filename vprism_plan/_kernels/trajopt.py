# SPDX-License-Identifier: BSD-3-Clause
"""Compiled costs of trajectories with their gradients, on the CPU.

Robots are packed as in `vprism_plan._kernels.robot`. Every kernel walks over the samples of a
trajectory, places the spheres, turns the slope of the cost at each sphere's centre into a force,
and the forces into joint gradients: moments about the joints' axes, summed from the leaves to the
base. `vprism_plan.trajopt` has the same in plain torch; the tests compare the two.

Samples are configurations q (m, dof), the waypoint before each (`edge`), how far on the edge it
is (`fraction`), and its share of the time (`weight`).

Fields V (rules, nx, ny, nz) hold signed distances at nodes, E the least of them per block, and wf:
origin x, y, z, spacing, solid outside, number of planes, margin, room, then the planes.
"""

import math

import numpy as np

from vprism_plan._kernels.checking import pose_links, scratch
from vprism_plan._kernels.jit import njit
from vprism_plan._kernels.robot import fk_frames, place_link, place_spheres

_SHORT = 1e-6  # metres; as in vprism_plan.trajopt.cost


@njit(cache=True, nogil=True)
def _add_wrench(W, f, px, py, pz, x, y, z):
    """Add a force at a point, and its moment about the world's origin, to a frame's."""
    W[f, 0] += x
    W[f, 1] += y
    W[f, 2] += z
    W[f, 3] += py * z - pz * y
    W[f, 4] += pz * x - px * z
    W[f, 5] += px * y - py * x


@njit(cache=True, nogil=True)
def _wrench_gradient(T, rf, ri, W):
    """Gradient (dof,) that wrenches W (frames, 6) make; W is used up."""
    tau = np.zeros(ri[4])
    fi = ri[8]
    for f in range(ri[0] - 1, 0, -1):
        ax, ay, az = T[f, 2], T[f, 5], T[f, 8]
        if ri[fi + 3 * f + 1] == 2:
            value = ax * W[f, 0] + ay * W[f, 1] + az * W[f, 2]
        else:
            px, py, pz = T[f, 9], T[f, 10], T[f, 11]
            value = ax * (W[f, 3] - py * W[f, 2] + pz * W[f, 1])
            value += ay * (W[f, 4] - pz * W[f, 0] + px * W[f, 2])
            value += az * (W[f, 5] - px * W[f, 1] + py * W[f, 0])
        tau[ri[fi + 3 * f + 2]] += rf[ri[16] + 14 * f + 12] * value
        for a in range(6):
            W[ri[fi + 3 * f], a] += W[f, a]
    return tau


@njit(cache=True, nogil=True)
def _pull(T, C, F, active, rf, ri, weight, e, fraction, grad):
    """Add to grad (T, dof) what forces F (3, spheres) on active links make of a sample."""
    W = np.zeros((ri[0], 6))
    for link in range(ri[2]):
        if active[link]:
            li = ri[9] + 4 * link
            for s in range(ri[li + 1], ri[li + 2]):
                _add_wrench(W, ri[li], C[0, s], C[1, s], C[2, s], F[0, s], F[1, s], F[2, s])
    tau = _wrench_gradient(T, rf, ri, W)
    for j in range(len(tau)):
        share = weight * tau[j]
        grad[e, j] += (1.0 - fraction) * share
        if fraction > 0.0:
            grad[e + 1, j] += fraction * share


@njit(cache=True, nogil=True)
def place_all(Q, rf, ri, spheres, T, out):
    """Place frames T (n, frames, 12) and the centres out (n, c, 3) of some spheres."""
    C = np.empty((3, ri[1]))
    for n in range(len(Q)):
        fk_frames(Q[n], rf, ri, T[n])
        for link in range(ri[2]):
            place_link(link, T[n], rf, ri, C)
        for c in range(len(spheres)):
            for a in range(3):
                out[n, c, a] = C[a, spheres[c]]


@njit(cache=True, nogil=True)
def pull_all(T, centers, frames, forces, rf, ri, grad):
    """Fill grad (n, dof) with what forces (n, c, 3) at centres that move with frames make."""
    for n in range(len(forces)):
        W = np.zeros((ri[0], 6))
        for c in range(len(frames)):
            x, y, z = forces[n, c, 0], forces[n, c, 1], forces[n, c, 2]
            if x != 0.0 or y != 0.0 or z != 0.0:
                _add_wrench(
                    W, frames[c], centers[n, c, 0], centers[n, c, 1], centers[n, c, 2], x, y, z
                )
        grad[n] = _wrench_gradient(T[n], rf, ri, W)


@njit(cache=True, nogil=True)
def divide(Q, rf, ri, turns, spacing, max_turn, most, fixed):
    """Samples q, edge, fraction, weight of one trajectory Q (T, dof), as `sample_paths` has them.

    turns (dof,): joints whose turn counts; fixed: parts of every edge, 0 is as many as needed.
    """
    edges = len(Q) - 1
    parts = np.full(edges + 1, max(fixed, 1))
    if fixed == 0:
        C = np.empty((2, 3, ri[1]))
        for e in range(edges + 1):
            place_spheres(Q[e], rf, ri, C[e & 1])
            if e > 0:
                square = 0.0
                for s in range(ri[1]):
                    x = C[1, 0, s] - C[0, 0, s]
                    y = C[1, 1, s] - C[0, 1, s]
                    z = C[1, 2, s] - C[0, 2, s]
                    square = max(square, x * x + y * y + z * z)
                wanted = math.sqrt(square) / spacing
                for j in range(ri[4]):
                    if turns[j]:
                        wanted = max(wanted, abs(Q[e, j] - Q[e - 1, j]) / max_turn)
                parts[e - 1] = max(1, math.ceil(min(wanted, float(most))))
    parts[edges] = 1  # the last waypoint is an edge that goes nowhere
    n = parts.sum()
    q, edge = np.empty((n, ri[4])), np.empty(n, np.int64)
    fraction, weight = np.empty(n), np.empty(n)
    i = 0
    before = 0.0
    for e in range(edges + 1):
        own = 1.0 / (parts[e] * edges) if e < edges else 0.0
        for k in range(parts[e]):
            edge[i] = e
            fraction[i] = k / parts[e]
            weight[i] = 0.5 * (own + (own if k > 0 else before))
            for j in range(ri[4]):
                q[i, j] = Q[e, j]
                if k > 0:
                    q[i, j] += fraction[i] * (Q[e + 1, j] - Q[e, j])
            i += 1
        before = own
    if edges == 0:
        weight[0] = 1.0
    return q, edge, fraction, weight


# --- fields ------------------------------------------------------------------------


@njit(cache=True, nogil=True, inline="always")
def _hinge(gap, margin):
    """CHOMP's potential and its slope."""
    if gap >= margin:
        return 0.0, 0.0
    if gap < 0.0:
        return 0.5 * margin - gap, -1.0
    short = margin - gap
    return 0.5 * short * short / margin, -short / margin


@njit(cache=True, nogil=True)
def _taps(v, n):
    """The three nodes of a quadratic B-spline along one axis, their weights and slopes."""
    i = min(int(v + 0.5), n - 1)
    t = v - i
    return (
        (max(i - 1, 0), i, min(i + 1, n - 1)),
        (0.5 * (0.5 - t) * (0.5 - t), 0.75 - t * t, 0.5 * (0.5 + t) * (0.5 + t)),
        (t - 0.5, -2.0 * t, t + 0.5),
    )


@njit(cache=True, nogil=True)
def _spline(V, rule, sx, sy, sz, h, slope):
    """Quadratic B-spline of V[rule] at grid point s inside the grid; slope (3,) per metre."""
    i, wx, dx = _taps(sx, V.shape[1])
    j, wy, dy = _taps(sy, V.shape[2])
    k, wz, dz = _taps(sz, V.shape[3])
    value = 0.0
    gx = gy = gz = 0.0
    for a in range(3):
        for b in range(3):
            u = V[rule, i[a], j[b], k[0]]
            v = V[rule, i[a], j[b], k[1]]
            w = V[rule, i[a], j[b], k[2]]
            along = wz[0] * u + wz[1] * v + wz[2] * w
            value += wx[a] * wy[b] * along
            gx += dx[a] * wy[b] * along
            gy += wx[a] * dy[b] * along
            gz += wx[a] * wy[b] * (dz[0] * u + dz[1] * v + dz[2] * w)
    slope[0] = gx / h
    slope[1] = gy / h
    slope[2] = gz / h
    return value


@njit(cache=True, nogil=True, inline="always")
def _on_grid(V, wf, x, y, z):
    """A point in steps of the grid, and the nearest to it inside."""
    g = ((x - wf[0]) / wf[3], (y - wf[1]) / wf[3], (z - wf[2]) / wf[3])
    return g, (
        min(max(g[0], 0.0), V.shape[1] - 1.0),
        min(max(g[1], 0.0), V.shape[2] - 1.0),
        min(max(g[2], 0.0), V.shape[3] - 1.0),
    )


@njit(cache=True, nogil=True)
def _distance(V, rule, wf, x, y, z, slope):
    """Spline of signed distances anywhere, with its slope."""
    h = wf[3]
    g, c = _on_grid(V, wf, x, y, z)
    off = (h * (g[0] - c[0]), h * (g[1] - c[1]), h * (g[2] - c[2]))
    away = off[0] * off[0] + off[1] * off[1] + off[2] * off[2]
    value = _spline(V, rule, c[0], c[1], c[2], h, slope)
    if away == 0.0:
        return value
    for a in range(3):
        if g[a] != c[a]:
            slope[a] = 0.0
    if wf[4] > 0.0:
        far = math.sqrt(away)
        for a in range(3):
            slope[a] -= off[a] / far
        return value - far
    kept = max(value, 0.0)
    part = 0.5 + 0.5 * min(kept / h, 1.0)
    far = math.sqrt(part * part * away + kept * kept)
    share = 1.0
    if value > 0.0:
        share = value / far
        if value < h:
            share += 0.5 * part * away / (h * far)
    outward = part * part / far
    for a in range(3):
        slope[a] = share * slope[a] + outward * off[a]
    return min(value, 0.0) + far


@njit(cache=True, nogil=True, inline="always")
def _may_be_below(V, E, rule, wf, x, y, z, need):
    """Whether the spline may be below `need` at a point, by two bounds that cost less.

    E holds the least node of each 4 x 4 x 4 cells and those next to them. And nodes hold
    distances, 1-Lipschitz: the 27 nodes lie within sqrt(3) steps of the middle one. Outside the
    grid the spline at the nearest point of it counts, unless everything there is an obstacle.
    """
    g, c = _on_grid(V, wf, x, y, z)
    if wf[4] > 0.0 and (c[0] != g[0] or c[1] != g[1] or c[2] != g[2]):
        return True
    if E[rule, int(c[0]) >> 2, int(c[1]) >> 2, int(c[2]) >> 2] >= need:
        return False
    return V[rule, int(c[0] + 0.5), int(c[1] + 0.5), int(c[2] + 0.5)] < need + 1.75 * wf[3]


@njit(cache=True, nogil=True, inline="always")
def _over(wf, o, x, y, z):
    """Height of a point over the plane at o."""
    return wf[o] * x + wf[o + 1] * y + wf[o + 2] * z - wf[o + 3]


@njit(cache=True, nogil=True)
def _obstacle_terms(T, L, C, rf, ri, V, E, wf, radii, grown, slope, G, active):
    """Fill the slope of each sphere's potential at its centre; return the sum of them all.

    Links that are not marked active are wholly beyond the margin.
    """
    margin = wf[6]
    total = 0.0
    for link in range(ri[2]):
        li = ri[9] + 4 * link
        rule = ri[li + 3]
        if rule < 0:
            continue
        # The spline at a sphere's centre lies between nodes at most 2.6 steps from it, a node is
        # within 0.9 of the ball's centre, and `grown` adds at most 0.9 to a radius.
        need = rf[ri[18] + 4 * link + 3] + wf[7] + margin
        x, y, z = L[link, 0], L[link, 1], L[link, 2]
        near = _may_be_below(V, E, rule, wf, x, y, z, need + 4.4 * wf[3])
        for p in range(int(wf[5])):
            near = near or _over(wf, 8 + 4 * p, x, y, z) < need
        if not near:
            continue
        active[link] = True
        place_link(link, T, rf, ri, C)
        for s in range(ri[li + 1], ri[li + 2]):
            for a in range(3):
                G[a, s] = 0.0
            x, y, z = C[0, s], C[1, s], C[2, s]
            if _may_be_below(V, E, rule, wf, x, y, z, grown[s] + margin):
                gap = _distance(V, rule, wf, x, y, z, slope) - grown[s]
                if gap < margin:
                    value, steep = _hinge(gap, margin)
                    total += value
                    for a in range(3):
                        G[a, s] = steep * slope[a]
            for p in range(int(wf[5])):
                gap = _over(wf, 8 + 4 * p, x, y, z) - radii[s]
                if gap < margin:
                    value, steep = _hinge(gap, margin)
                    total += value
                    for a in range(3):
                        G[a, s] += steep * wf[8 + 4 * p + a]
    return total


@njit(cache=True, nogil=True)
def clearance(q, edge, fraction, weight, rf, ri, V, E, wf, radii, grown, grad):
    """Obstacle cost of one trajectory over time; adds its gradient to grad (T, dof)."""
    T, L, C, active = scratch(ri)
    G = np.zeros((3, ri[1]))
    slope = np.empty(3)
    total = 0.0
    for i in range(len(q)):
        pose_links(q[i], rf, ri, T, L, active)
        value = _obstacle_terms(T, L, C, rf, ri, V, E, wf, radii, grown, slope, G, active)
        if value > 0.0:
            total += weight[i] * value
            _pull(T, C, G, active, rf, ri, weight[i], edge[i], fraction[i], grad)
    return total


@njit(cache=True, nogil=True)
def _contacts(centers, rules, V, E, wf, radii, grown, reach):
    """Contacts with the field and the planes of spheres (n, s, 3) that are nearer than reach.

    Returns (sample, sphere), depth and the depth's slope of each.
    """
    most = centers.shape[0] * centers.shape[1] * (1 + int(wf[5]))
    which = np.empty((most, 2), np.int64)
    depth = np.empty(most)
    slopes = np.empty((most, 3))
    slope = np.empty(3)
    found = 0
    for i in range(centers.shape[0]):
        for s in range(centers.shape[1]):
            x, y, z = centers[i, s, 0], centers[i, s, 1], centers[i, s, 2]
            if _may_be_below(V, E, rules[s], wf, x, y, z, grown[s] + reach):
                which[found] = (i, s)
                depth[found] = grown[s] - _distance(V, rules[s], wf, x, y, z, slope)
                for a in range(3):
                    slopes[found, a] = -slope[a]
                found += 1
            for p in range(int(wf[5])):
                value = _over(wf, 8 + 4 * p, x, y, z)
                if value < radii[s] + reach:
                    which[found] = (i, s)
                    depth[found] = radii[s] - value
                    for a in range(3):
                        slopes[found, a] = -wf[8 + 4 * p + a]
                    found += 1
    return which[:found], depth[:found], slopes[:found]


@njit(cache=True, nogil=True)
def _soft_contact(x, cut):
    """log(1 + exp(x)) (1 - exp(-(x + cut)))^2 and its slope; 0 for x <= -cut."""
    if x <= -cut:
        return 0.0, 0.0
    e = math.exp(-abs(x))
    value = max(x, 0.0) + math.log1p(e)
    steep = 1.0 / (1.0 + e) if x > 0.0 else e / (1.0 + e)
    gone = math.exp(-(x + cut))
    kept = 1.0 - gone
    return value * kept * kept, kept * (steep * kept + 2.0 * gone * value)


@njit(cache=True, nogil=True)
def certain_potentials(centers, rules, V, E, wf, radii, grown, soft, cut, value, slopes):
    """Potential of the field and the planes for spheres (n, s, 3), and its slopes: CHOMP's, or the
    hazard of contact where the margin is 0."""
    margin = wf[6]
    value[:] = 0.0
    slopes[:] = 0.0
    reach = margin if margin > 0.0 else cut * soft
    which, depth, steeper = _contacts(centers, rules, V, E, wf, radii, grown, reach)
    for c in range(len(depth)):
        n = which[c, 0]
        s = which[c, 1]
        if margin > 0.0:
            more, steep = _hinge(-depth[c], margin)
            steep = -steep
        else:
            more, steep = _soft_contact(depth[c] / soft, cut)
            steep /= soft
        value[n, s] += more
        for a in range(3):
            slopes[n, s, a] += steep * steeper[c, a]


@njit(cache=True, nogil=True)
def ball_averages(centers, rules, radii, V, grid, nodes, weights, value, slopes):
    """Average of a spline over balls around the centres (n, s, 3), with its slopes.

    grid: origin x, y, z, spacing. Beyond the grid the spline is 0.
    nodes (p, 3), weights (p,): a quadrature of the unit ball.
    """
    h = grid[3]
    slope = np.empty(3)
    tx, ty, tz = V.shape[1] - 1.0, V.shape[2] - 1.0, V.shape[3] - 1.0
    value[:] = 0.0
    slopes[:] = 0.0
    for n in range(centers.shape[0]):
        for s in range(centers.shape[1]):
            gx = (centers[n, s, 0] - grid[0]) / h
            gy = (centers[n, s, 1] - grid[1]) / h
            gz = (centers[n, s, 2] - grid[2]) / h
            r = radii[s] / h
            if min(gx, gy, gz) < -r or gx > tx + r or gy > ty + r or gz > tz + r:
                continue
            for p in range(len(weights)):
                x, y, z = gx + r * nodes[p, 0], gy + r * nodes[p, 1], gz + r * nodes[p, 2]
                if x <= 0.0 or y <= 0.0 or z <= 0.0 or x >= tx or y >= ty or z >= tz:
                    continue
                value[n, s] += weights[p] * _spline(V, rules[s], x, y, z, h, slope)
                for a in range(3):
                    slopes[n, s, a] += weights[p] * slope[a]


# --- self-collision ----------------------------------------------------------------


@njit(cache=True, nogil=True)
def _pair_terms(T, C, L, active, rf, ri, margin, kept, F):
    """Sum of the potentials of all sphere pairs of the link pairs, and the forces they make.

    Links with a force are marked active; forces of all others are left as they are.
    """
    ro = ri[17] + 3 * ri[1]
    bo = ri[18]
    total = 0.0
    for pair in range(ri[3]):
        a = ri[ri[10] + 2 * pair]
        b = ri[ri[10] + 2 * pair + 1]
        room = margin + kept - rf[ri[21] + 1 + pair]
        x, y, z = L[a, 0] - L[b, 0], L[a, 1] - L[b, 1], L[a, 2] - L[b, 2]
        reach = rf[bo + 4 * a + 3] + rf[bo + 4 * b + 3] + room
        if reach <= 0.0 or x * x + y * y + z * z >= reach * reach:
            continue
        for link in (a, b):
            if not active[link]:
                active[link] = True
                place_link(link, T, rf, ri, C)
                F[:, ri[ri[9] + 4 * link + 1] : ri[ri[9] + 4 * link + 2]] = 0.0
        t0 = ri[ri[9] + 4 * b + 1]
        t1 = ri[ri[9] + 4 * b + 2]
        for s in range(ri[ri[9] + 4 * a + 1], ri[ri[9] + 4 * a + 2]):
            px, py, pz = C[0, s], C[1, s], C[2, s]
            x, y, z = px - L[b, 0], py - L[b, 1], pz - L[b, 2]
            reach = rf[ro + s] + rf[bo + 4 * b + 3] + room
            if reach <= 0.0 or x * x + y * y + z * z >= reach * reach:
                continue
            own = rf[ro + s] + room
            near = 0  # counted first: a loop without branches is vectorised
            for t in range(t0, t1):
                x, y, z = px - C[0, t], py - C[1, t], pz - C[2, t]
                reach = own + rf[ro + t]
                near += x * x + y * y + z * z < reach * reach
            if near == 0:
                continue
            for t in range(t0, t1):
                x, y, z = px - C[0, t], py - C[1, t], pz - C[2, t]
                square = x * x + y * y + z * z + _SHORT * _SHORT
                reach = own + rf[ro + t]
                if reach <= 0.0 or square >= reach * reach:
                    continue
                far = math.sqrt(square)
                value, steep = _hinge(far - (reach - margin), margin)
                total += value
                for row in range(3):
                    force = steep / far * (C[row, s] - C[row, t])
                    F[row, s] += force
                    F[row, t] -= force
    return total


@njit(cache=True, nogil=True)
def self_collision(q, edge, fraction, weight, rf, ri, margin, kept, grad):
    """Cost of links near each other of one trajectory; adds its gradient to grad (T, dof)."""
    T, L, C, active = scratch(ri)
    F = np.zeros((3, ri[1]))
    total = 0.0
    for i in range(len(q)):
        pose_links(q[i], rf, ri, T, L, active)
        value = _pair_terms(T, C, L, active, rf, ri, margin, kept, F)
        if value > 0.0:
            total += weight[i] * value
            _pull(T, C, F, active, rf, ri, weight[i], edge[i], fraction[i], grad)
    return total


# --- draws -------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _draw_distances(V, rule, x, y, z, unit, out):
    """Spline of every draw's signed distance, metres; x, y, z: see `_taps`."""
    out[:] = 0.0
    for a in range(3):
        for b in range(3):
            across = unit * x[1][a] * y[1][b]
            for c in range(3):
                w = across * z[1][c]
                row = V[rule, x[0][a], y[0][b], z[0][c]]
                for s in range(len(out)):
                    out[s] += w * row[s]


@njit(cache=True, nogil=True)
def _draw_slope(V, rule, x, y, z, unit, share, slope):
    """Slope of the sum over draws of share times distance."""
    slope[:] = 0.0
    for a in range(3):
        for b in range(3):
            for c in range(3):
                row = V[rule, x[0][a], y[0][b], z[0][c]]
                total = 0.0
                for s in range(len(share)):
                    total += share[s] * row[s]
                total *= unit
                slope[0] += x[2][a] * y[1][b] * z[1][c] * total
                slope[1] += x[1][a] * y[2][b] * z[1][c] * total
                slope[2] += x[1][a] * y[1][b] * z[2][c] * total


@njit(cache=True, nogil=True)
def _near_draws(centers, rules, D, E, grid, grown, reach):
    """(sample, sphere) where any draw may count, and where on the grid they are."""
    most = centers.shape[0] * centers.shape[1]
    rows = np.empty((most, 2), np.int64)
    places = np.empty((most, 3))
    tx, ty, tz = D.shape[1] - 1.0, D.shape[2] - 1.0, D.shape[3] - 1.0
    found = 0
    for i in range(centers.shape[0]):
        for s in range(centers.shape[1]):
            x = (centers[i, s, 0] - grid[0]) / grid[3]
            y = (centers[i, s, 1] - grid[1]) / grid[3]
            z = (centers[i, s, 2] - grid[2]) / grid[3]
            if min(x, y, z) < 0.0 or x > tx or y > ty or z > tz:
                continue
            if E[rules[s], int(x) >> 2, int(y) >> 2, int(z) >> 2] < grown[s] + reach:
                rows[found] = (i, s)
                places[found] = (x, y, z)
                found += 1
    return rows[:found], places[:found]


@njit(cache=True, nogil=True)
def risk(centers, rules, grown, radii, D, DE, grid, unit, V, E, wf, tau, cut, force):
    """Minus log of the share of draws that survive one trajectory; fills force (n, s, 3).

    centers (n, s, 3): of the spheres at all samples. D (g, x, y, z, S) int16: signed distances
    of every draw in steps of `unit` metres; DE: least of any draw per block, metres; grid:
    origin, spacing. V, E, wf: what is certain; planes use radii.
    With depth m, a contact adds exp(m / tau) (1 - exp(-(m + cut) / tau))^2 to the odds of every
    draw it concerns, nothing for m <= -cut; a draw survives with probability 1 / (1 + odds).
    """
    S = D.shape[4]
    rows, places = _near_draws(centers, rules, D, DE, grid, grown, cut)
    which, hit, slopes = _contacts(centers, rules, V, E, wf, radii, grown, cut)
    depth = np.empty((len(rows), S))
    highest = 0.0
    for c in range(len(hit)):
        highest = max(highest, hit[c] / tau)
    shift = np.full(S, highest)
    for n in range(len(rows)):
        s = rows[n, 1]
        x = _taps(places[n, 0], D.shape[1])
        y = _taps(places[n, 1], D.shape[2])
        z = _taps(places[n, 2], D.shape[3])
        _draw_distances(D, rules[s], x, y, z, unit, depth[n])
        for d in range(S):
            depth[n, d] = grown[s] - depth[n, d]
            shift[d] = max(shift[d], depth[n, d] / tau)
    odds = np.zeros(S)
    for n in range(len(rows)):
        for d in range(S):
            m = depth[n, d]
            if m > -cut:
                odds[d] += math.exp(m / tau - shift[d]) * (1.0 - math.exp(-(m + cut) / tau)) ** 2
    for c in range(len(hit)):
        if hit[c] > -cut:
            soft = (1.0 - math.exp(-(hit[c] + cut) / tau)) ** 2
            for d in range(S):
                odds[d] += math.exp(hit[c] / tau - shift[d]) * soft

    # log(1 + odds) of each draw, and the share of each in the survivors
    lowest = np.inf
    loss = np.empty(S)
    for d in range(S):
        odds[d] += math.exp(-shift[d])
        loss[d] = shift[d] + math.log(odds[d])
        lowest = min(lowest, loss[d])
    total = 0.0
    for d in range(S):
        total += math.exp(lowest - loss[d])
    share = np.empty(S)
    for d in range(S):
        share[d] = math.exp(lowest - loss[d]) / (total * odds[d] * tau)

    slope = np.empty(3)
    pull = np.empty(S)
    for n in range(len(rows)):
        s = rows[n, 1]
        strong = 0.0
        for d in range(S):
            m = depth[n, d]
            pull[d] = 0.0
            if m > -cut:
                fall = 1.0 - math.exp(-2.0 * (m + cut) / tau)
                pull[d] = share[d] * math.exp(m / tau - shift[d]) * fall
                strong = max(strong, pull[d])
        if strong > 0.0:
            x = _taps(places[n, 0], D.shape[1])
            y = _taps(places[n, 1], D.shape[2])
            z = _taps(places[n, 2], D.shape[3])
            _draw_slope(D, rules[s], x, y, z, unit / grid[3], pull, slope)
            for a in range(3):
                force[rows[n, 0], s, a] -= slope[a]
    for c in range(len(hit)):
        if hit[c] > -cut:
            fall = 1.0 - math.exp(-2.0 * (hit[c] + cut) / tau)
            strong = 0.0
            for d in range(S):
                strong += share[d] * math.exp(hit[c] / tau - shift[d])
            for a in range(3):
                force[which[c, 0], which[c, 1], a] += fall * strong * slopes[c, a]
    return lowest - math.log(total / S)
