# SPDX-License-Identifier: BSD-3-Clause
"""Compiled costs of trajectories with their gradients, on the CPU.

Robots are packed as in `vprism_plan._kernels.robot`. Every kernel walks over the samples of a
trajectory, places the spheres, turns the slope of the cost at each sphere's centre into a force,
and the forces into joint gradients: moments about the joints' axes, summed from the leaves to the
base. `vprism_plan.trajopt` has the same in plain torch; the tests compare the two.
"""

import math

import numpy as np

from vprism_plan._kernels.jit import njit
from vprism_plan._kernels.robot import fk_frames, place_link

_SHORT = 1e-6  # metres; as in vprism_plan.trajopt.cost


@njit(cache=True, nogil=True)
def _frames(q, rf, ri, T, L):
    """Fill T (frames, 12) with frame poses, L (links, 3) with the centres of the balls around
    the links."""
    fk_frames(q, rf, ri, T)
    for link in range(ri[2]):
        f = ri[ri[9] + 4 * link]
        o = ri[18] + 4 * link
        for r in range(3):
            L[link, r] = T[f, 9 + r]
            for c in range(3):
                L[link, r] += T[f, 3 * r + c] * rf[o + c]


@njit(cache=True, nogil=True)
def _place(q, rf, ri, T, L, C):
    """Place frames, links and all spheres."""
    _frames(q, rf, ri, T, L)
    for link in range(ri[2]):
        place_link(link, T, rf, ri, C)


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
def _wrench_gradient(T, rf, ri, W, tau):
    """Fill tau (dof,) with the gradient that wrenches W (frames, 6) make; W is used up."""
    for j in range(ri[4]):
        tau[j] = 0.0
    fi = ri[8]
    for f in range(ri[0] - 1, 0, -1):
        ax = T[f, 2]
        ay = T[f, 5]
        az = T[f, 8]
        if ri[fi + 3 * f + 1] == 2:
            value = ax * W[f, 0] + ay * W[f, 1] + az * W[f, 2]
        else:
            px = T[f, 9]
            py = T[f, 10]
            pz = T[f, 11]
            value = ax * (W[f, 3] - py * W[f, 2] + pz * W[f, 1])
            value += ay * (W[f, 4] - pz * W[f, 0] + px * W[f, 2])
            value += az * (W[f, 5] - px * W[f, 1] + py * W[f, 0])
        tau[ri[fi + 3 * f + 2]] += rf[ri[16] + 14 * f + 12] * value
        p = ri[fi + 3 * f]
        for a in range(6):
            W[p, a] += W[f, a]


@njit(cache=True, nogil=True)
def _joint_gradient(T, C, F, active, rf, ri, W, tau):
    """Fill tau (dof,) with the gradient that forces F (3, spheres) at the centres make.

    Only links that are active have forces.
    """
    W[:] = 0.0
    for link in range(ri[2]):
        if not active[link]:
            continue
        li = ri[9] + 4 * link
        for s in range(ri[li + 1], ri[li + 2]):
            _add_wrench(W, ri[li], C[0, s], C[1, s], C[2, s], F[0, s], F[1, s], F[2, s])
    _wrench_gradient(T, rf, ri, W, tau)


@njit(cache=True, nogil=True)
def place_all(Q, rf, ri, spheres, T, out):
    """Place frames T (n, frames, 12) and the centres out (n, c, 3) of some spheres."""
    L = np.empty((ri[2], 3))
    C = np.empty((3, ri[1]))
    for n in range(len(Q)):
        _place(Q[n], rf, ri, T[n], L, C)
        for c in range(len(spheres)):
            for a in range(3):
                out[n, c, a] = C[a, spheres[c]]


@njit(cache=True, nogil=True)
def pull_all(T, centers, frames, forces, rf, ri, grad):
    """Fill grad (n, dof) with what forces (n, c, 3) at centres that move with frames make."""
    W = np.empty((ri[0], 6))
    for n in range(len(forces)):
        W[:] = 0.0
        for c in range(len(frames)):
            x = forces[n, c, 0]
            y = forces[n, c, 1]
            z = forces[n, c, 2]
            if x != 0.0 or y != 0.0 or z != 0.0:
                _add_wrench(
                    W, frames[c], centers[n, c, 0], centers[n, c, 1], centers[n, c, 2], x, y, z
                )
        _wrench_gradient(T[n], rf, ri, W, grad[n])


@njit(cache=True, nogil=True)
def subdivide(Q, delta, rf, ri, turns, spacing, max_turn, most, parts):
    """Fill parts (T - 1,): into how many each edge of a trajectory is divided."""
    n = ri[1]
    T = np.empty((ri[0], 12))
    C = np.empty((2, 3, n))
    L = np.empty((ri[2], 3))
    _place(Q[0], rf, ri, T, L, C[0])
    for e in range(len(parts)):
        now = (e + 1) & 1
        _place(Q[e + 1], rf, ri, T, L, C[now])
        square = 0.0
        for s in range(n):
            x = C[1, 0, s] - C[0, 0, s]
            y = C[1, 1, s] - C[0, 1, s]
            z = C[1, 2, s] - C[0, 2, s]
            square = max(square, x * x + y * y + z * z)
        turn = 0.0
        for j in range(Q.shape[1]):
            if turns[j]:
                turn = max(turn, abs(delta[e, j]))
        wanted = max(math.sqrt(square) / spacing, turn / max_turn)
        parts[e] = max(1, math.ceil(min(wanted, float(most))))


@njit(cache=True, nogil=True)
def _weight(parts, e, k):
    """Share of the time of the sample that begins part k of edge e (trapezoid rule)."""
    edges = len(parts)
    if edges == 0:
        return 1.0
    own = 0.0
    if e < edges:
        own = 1.0 / (parts[e] * edges)
    before = own
    if k == 0:
        before = 0.0
        if e > 0:
            before = 1.0 / (parts[e - 1] * edges)
    return 0.5 * (own + before)


@njit(cache=True, nogil=True)
def _add(tau, e, fraction, grad):
    """Share a sample's gradient between the waypoints it lies between."""
    for j in range(len(tau)):
        grad[e, j] += (1.0 - fraction) * tau[j]
        if fraction > 0.0:
            grad[e + 1, j] += fraction * tau[j]


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
def _spline(V, rule, sx, sy, sz, h, slope):
    """Quadratic B-spline of V[rule] at grid point s inside the grid; slope (3,) per metre."""
    nx = V.shape[1]
    ny = V.shape[2]
    nz = V.shape[3]
    i = min(int(sx + 0.5), nx - 1)
    j = min(int(sy + 0.5), ny - 1)
    k = min(int(sz + 0.5), nz - 1)
    tx = sx - i
    ty = sy - j
    tz = sz - k
    k0 = max(k - 1, 0)
    k2 = min(k + 1, nz - 1)
    z0 = 0.5 * (0.5 - tz) * (0.5 - tz)
    z1 = 0.75 - tz * tz
    z2 = 0.5 * (0.5 + tz) * (0.5 + tz)
    value = 0.0
    gx = 0.0
    gy = 0.0
    gz = 0.0
    for a in range(3):
        if a == 0:
            wx = 0.5 * (0.5 - tx) * (0.5 - tx)
            dx = tx - 0.5
        elif a == 1:
            wx = 0.75 - tx * tx
            dx = -2.0 * tx
        else:
            wx = 0.5 * (0.5 + tx) * (0.5 + tx)
            dx = tx + 0.5
        ia = min(max(i + a - 1, 0), nx - 1)
        for b in range(3):
            if b == 0:
                wy = 0.5 * (0.5 - ty) * (0.5 - ty)
                dy = ty - 0.5
            elif b == 1:
                wy = 0.75 - ty * ty
                dy = -2.0 * ty
            else:
                wy = 0.5 * (0.5 + ty) * (0.5 + ty)
                dy = ty + 0.5
            jb = min(max(j + b - 1, 0), ny - 1)
            u = V[rule, ia, jb, k0]
            v = V[rule, ia, jb, k]
            w = V[rule, ia, jb, k2]
            along = z0 * u + z1 * v + z2 * w
            value += wx * wy * along
            gx += dx * wy * along
            gy += wx * dy * along
            gz += wx * wy * ((tz - 0.5) * u - 2.0 * tz * v + (tz + 0.5) * w)
    slope[0] = gx / h
    slope[1] = gy / h
    slope[2] = gz / h
    return value


@njit(cache=True, nogil=True)
def _distance(V, rule, origin, h, solid, x, y, z, slope):
    """Spline of signed distances anywhere, with its slope."""
    gx = (x - origin[0]) / h
    gy = (y - origin[1]) / h
    gz = (z - origin[2]) / h
    cx = min(max(gx, 0.0), V.shape[1] - 1.0)
    cy = min(max(gy, 0.0), V.shape[2] - 1.0)
    cz = min(max(gz, 0.0), V.shape[3] - 1.0)
    ax = h * (gx - cx)
    ay = h * (gy - cy)
    az = h * (gz - cz)
    away = ax * ax + ay * ay + az * az
    value = _spline(V, rule, cx, cy, cz, h, slope)
    if away == 0.0:
        return value
    if gx != cx:
        slope[0] = 0.0
    if gy != cy:
        slope[1] = 0.0
    if gz != cz:
        slope[2] = 0.0
    if solid:
        far = math.sqrt(away)
        slope[0] -= ax / far
        slope[1] -= ay / far
        slope[2] -= az / far
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
    slope[0] = share * slope[0] + outward * ax
    slope[1] = share * slope[1] + outward * ay
    slope[2] = share * slope[2] + outward * az
    return min(value, 0.0) + far


@njit(cache=True, nogil=True, inline="always")
def _may_be_below(V, E, rule, wf, x, y, z, need):
    """Whether the spline may be below `need` at a point, by two bounds that cost less.

    E holds the least node of each 4 x 4 x 4 cells and those next to them. And nodes hold
    distances, 1-Lipschitz: the 27 nodes lie within sqrt(3) steps of the middle one. Outside the
    grid the spline at the nearest point of it counts, unless everything there is an obstacle.
    """
    gx = (x - wf[0]) / wf[3]
    gy = (y - wf[1]) / wf[3]
    gz = (z - wf[2]) / wf[3]
    cx = min(max(gx, 0.0), V.shape[1] - 1.0)
    cy = min(max(gy, 0.0), V.shape[2] - 1.0)
    cz = min(max(gz, 0.0), V.shape[3] - 1.0)
    if wf[4] > 0.0 and (cx != gx or cy != gy or cz != gz):
        return True
    if E[rule, int(cx) >> 2, int(cy) >> 2, int(cz) >> 2] >= need:
        return False
    return V[rule, int(cx + 0.5), int(cy + 0.5), int(cz + 0.5)] < need + 1.75 * wf[3]


@njit(cache=True, nogil=True)
def _obstacle_terms(T, L, C, placed, rf, ri, V, E, wf, radii, grown, slope, value, G, active):
    """Fill each sphere's potential and its slope at the centre; whether any is not 0.

    wf: origin x, y, z, spacing, solid outside, number of planes, margin, then the planes.
    Links that are not active are wholly beyond the margin.
    """
    h = wf[3]
    margin = wf[6]
    found = False
    for link in range(ri[2]):
        li = ri[9] + 4 * link
        rule = ri[li + 3]
        active[link] = False
        if rule < 0:
            continue
        # The spline at a sphere's centre lies between nodes at most 2.6 steps from it, a node is
        # within 0.9 of the ball's centre, and `grown` adds at most 0.9 to a radius.
        ball = rf[ri[18] + 4 * link + 3] + wf[7]
        x = L[link, 0]
        y = L[link, 1]
        z = L[link, 2]
        near = _may_be_below(V, E, rule, wf, x, y, z, ball + margin + 4.4 * h)
        for p in range(int(wf[5])):
            o = 8 + 4 * p
            away = wf[o] * x + wf[o + 1] * y + wf[o + 2] * z - wf[o + 3]
            near = near or away < ball + margin
        if not near:
            continue
        active[link] = True
        if not placed:
            place_link(link, T, rf, ri, C)
        for s in range(ri[li + 1], ri[li + 2]):
            value[s] = 0.0
            G[0, s] = 0.0
            G[1, s] = 0.0
            G[2, s] = 0.0
            x = C[0, s]
            y = C[1, s]
            z = C[2, s]
            need = grown[s] + margin
            if _may_be_below(V, E, rule, wf, x, y, z, need):
                gap = _distance(V, rule, wf, h, wf[4] > 0.0, x, y, z, slope) - grown[s]
                if gap < margin:
                    found = True
                    value[s], steep = _hinge(gap, margin)
                    G[0, s] = steep * slope[0]
                    G[1, s] = steep * slope[1]
                    G[2, s] = steep * slope[2]
            for p in range(int(wf[5])):
                o = 8 + 4 * p
                gap = wf[o] * x + wf[o + 1] * y + wf[o + 2] * z - wf[o + 3] - radii[s]
                if gap < margin:
                    found = True
                    more, steep = _hinge(gap, margin)
                    value[s] += more
                    G[0, s] += steep * wf[o]
                    G[1, s] += steep * wf[o + 1]
                    G[2, s] += steep * wf[o + 2]
    return found


@njit(cache=True, nogil=True)
def clearance(Q, delta, parts, rf, ri, V, E, wf, radii, grown, grad):
    """Obstacle cost of one trajectory (T, dof) over time; adds its gradient to grad (T, dof)."""
    n = ri[1]
    T = np.empty((ri[0], 12))
    L = np.empty((ri[2], 3))
    C = np.empty((3, n))
    value = np.zeros(n)
    G = np.zeros((3, n))
    active = np.zeros(ri[2], np.bool_)
    W = np.empty((ri[0], 6))
    tau = np.empty(ri[4])
    q = np.empty(ri[4])
    slope = np.empty(3)
    total = 0.0
    edges = len(parts)
    for e in range(edges + 1):
        count = parts[e] if e < edges else 1
        for k in range(count):
            fraction = k / count
            for j in range(ri[4]):
                q[j] = Q[e, j]
                if k > 0:
                    q[j] += fraction * delta[e, j]
            _frames(q, rf, ri, T, L)
            if not _obstacle_terms(
                T, L, C, False, rf, ri, V, E, wf, radii, grown, slope, value, G, active
            ):
                continue
            w = _weight(parts, e, k)
            _joint_gradient(T, C, G, active, rf, ri, W, tau)
            for j in range(ri[4]):
                tau[j] *= w
            _add(tau, e, fraction, grad)
            for link in range(ri[2]):
                if active[link]:
                    li = ri[9] + 4 * link
                    for s in range(ri[li + 1], ri[li + 2]):
                        total += w * value[s]
    return total


@njit(cache=True, nogil=True)
def clearance_by_length(Q, delta, parts, rf, ri, V, E, wf, radii, grown, grad):
    """The same over the ways of the spheres' centres; sample by sample, the last one kept."""
    n = ri[1]
    T = np.empty((2, ri[0], 12))
    L = np.empty((ri[2], 3))
    C = np.empty((2, 3, n))
    value = np.zeros((2, n))
    G = np.zeros((2, 3, n))
    F = np.zeros((2, 3, n))
    active = np.zeros((2, ri[2]), np.bool_)
    everywhere = np.ones(ri[2], np.bool_)
    W = np.empty((ri[0], 6))
    tau = np.empty(ri[4])
    q = np.empty(ri[4])
    slope = np.empty(3)
    total = 0.0
    edges = len(parts)
    now = 0
    edge_before = -1
    fraction_before = 0.0
    for e in range(edges + 1):
        count = parts[e] if e < edges else 1
        for k in range(count):
            fraction = k / count
            for j in range(ri[4]):
                q[j] = Q[e, j]
                if k > 0:
                    q[j] += fraction * delta[e, j]
            now = 1 - now
            _place(q, rf, ri, T[now], L, C[now])
            value[now] = 0.0
            G[now] = 0.0
            F[now] = 0.0
            _obstacle_terms(
                T[now], L, C[now], True, rf, ri, V, E, wf, radii, grown, slope,
                value[now], G[now], active[now],
            )  # fmt: skip
            if edge_before >= 0:
                total += _segment(C, value, G, F, now)
                old = 1 - now
                _joint_gradient(T[old], C[old], F[old], everywhere, rf, ri, W, tau)
                _add(tau, edge_before, fraction_before, grad)
            edge_before = e
            fraction_before = fraction
    _joint_gradient(T[now], C[now], F[now], everywhere, rf, ri, W, tau)
    _add(tau, edge_before, fraction_before, grad)
    return total


@njit(cache=True, nogil=True)
def _segment(C, value, G, F, now):
    """Cost of the way between two samples; adds the forces on both."""
    old = 1 - now
    total = 0.0
    for s in range(C.shape[2]):
        both = 0.5 * (value[0, s] + value[1, s])
        if both == 0.0:
            continue
        x = C[now, 0, s] - C[old, 0, s]
        y = C[now, 1, s] - C[old, 1, s]
        z = C[now, 2, s] - C[old, 2, s]
        length = math.sqrt(x * x + y * y + z * z + _SHORT * _SHORT)
        way = length - _SHORT
        total += both * way
        pull = both / length
        F[now, 0, s] += 0.5 * way * G[now, 0, s] + pull * x
        F[now, 1, s] += 0.5 * way * G[now, 1, s] + pull * y
        F[now, 2, s] += 0.5 * way * G[now, 2, s] + pull * z
        F[old, 0, s] += 0.5 * way * G[old, 0, s] - pull * x
        F[old, 1, s] += 0.5 * way * G[old, 1, s] - pull * y
        F[old, 2, s] += 0.5 * way * G[old, 2, s] - pull * z
    return total


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
def certain_hazards(centers, rules, V, E, wf, radii, grown, soft, cut, value, slopes):
    """Hazard of contact with the field and the planes for spheres (n, s, 3), and its slopes."""
    slope = np.empty(3)
    far = cut * soft
    for n in range(centers.shape[0]):
        for s in range(centers.shape[1]):
            x = centers[n, s, 0]
            y = centers[n, s, 1]
            z = centers[n, s, 2]
            value[n, s] = 0.0
            slopes[n, s] = 0.0
            if _may_be_below(V, E, rules[s], wf, x, y, z, grown[s] + far):
                away = _distance(V, rules[s], wf, wf[3], wf[4] > 0.0, x, y, z, slope)
                value[n, s], steep = _soft_contact((grown[s] - away) / soft, cut)
                for a in range(3):
                    slopes[n, s, a] = -steep / soft * slope[a]
            for p in range(int(wf[5])):
                o = 8 + 4 * p
                gap = wf[o] * x + wf[o + 1] * y + wf[o + 2] * z - wf[o + 3] - radii[s]
                if gap < far:
                    more, steep = _soft_contact(-gap / soft, cut)
                    value[n, s] += more
                    for a in range(3):
                        slopes[n, s, a] -= steep / soft * wf[o + a]


@njit(cache=True, nogil=True)
def ball_averages(centers, rules, radii, V, grid, nodes, weights, value, slopes):
    """Average of a spline over balls around the centres (n, s, 3), with its slopes.

    grid: origin x, y, z, spacing. Beyond the grid the spline is 0.
    nodes (p, 3), weights (p,): a quadrature of the unit ball.
    """
    h = grid[3]
    slope = np.empty(3)
    top = np.empty(3)
    for a in range(3):
        top[a] = V.shape[a + 1] - 1.0
    for n in range(centers.shape[0]):
        for s in range(centers.shape[1]):
            total = 0.0
            for a in range(3):
                slopes[n, s, a] = 0.0
            gx = (centers[n, s, 0] - grid[0]) / h
            gy = (centers[n, s, 1] - grid[1]) / h
            gz = (centers[n, s, 2] - grid[2]) / h
            r = radii[s] / h
            rule = rules[s]
            if (
                gx < -r or gy < -r or gz < -r
                or gx > top[0] + r or gy > top[1] + r or gz > top[2] + r
            ):  # fmt: skip
                value[n, s] = 0.0
                continue
            for p in range(len(weights)):
                x = gx + r * nodes[p, 0]
                y = gy + r * nodes[p, 1]
                z = gz + r * nodes[p, 2]
                if x <= 0.0 or y <= 0.0 or z <= 0.0 or x >= top[0] or y >= top[1] or z >= top[2]:
                    continue
                total += weights[p] * _spline(V, rule, x, y, z, h, slope)
                for a in range(3):
                    slopes[n, s, a] += weights[p] * slope[a]
            value[n, s] = total


# --- self-collision ----------------------------------------------------------------


@njit(cache=True, nogil=True)
def _pair_terms(T, C, L, active, rf, ri, margin, kept, F):
    """Sum of the potentials of all sphere pairs of the link pairs, and the forces they make.

    Links with a force are marked active; forces of all others are left as they are.
    """
    n = ri[1]
    ro = ri[17] + 3 * n
    bo = ri[18]
    total = 0.0
    active[:] = False
    for pair in range(ri[3]):
        a = ri[ri[10] + 2 * pair]
        b = ri[ri[10] + 2 * pair + 1]
        room = margin + kept - rf[ri[21] + 1 + pair]
        x = L[a, 0] - L[b, 0]
        y = L[a, 1] - L[b, 1]
        z = L[a, 2] - L[b, 2]
        reach = rf[bo + 4 * a + 3] + rf[bo + 4 * b + 3] + room
        if reach <= 0.0 or x * x + y * y + z * z >= reach * reach:
            continue
        for link in (a, b):
            if not active[link]:
                active[link] = True
                place_link(link, T, rf, ri, C)
                for s in range(ri[ri[9] + 4 * link + 1], ri[ri[9] + 4 * link + 2]):
                    F[0, s] = 0.0
                    F[1, s] = 0.0
                    F[2, s] = 0.0
        for s in range(ri[ri[9] + 4 * a + 1], ri[ri[9] + 4 * a + 2]):
            x = C[0, s] - L[b, 0]
            y = C[1, s] - L[b, 1]
            z = C[2, s] - L[b, 2]
            reach = rf[ro + s] + rf[bo + 4 * b + 3] + room
            if reach <= 0.0 or x * x + y * y + z * z >= reach * reach:
                continue
            px = C[0, s]
            py = C[1, s]
            pz = C[2, s]
            own = rf[ro + s] + room
            t0 = ri[ri[9] + 4 * b + 1]
            t1 = ri[ri[9] + 4 * b + 2]
            near = 0  # counted first: a loop without branches is vectorised
            for t in range(t0, t1):
                x = px - C[0, t]
                y = py - C[1, t]
                z = pz - C[2, t]
                reach = own + rf[ro + t]
                near += x * x + y * y + z * z < reach * reach
            if near == 0:
                continue
            for t in range(t0, t1):
                x = px - C[0, t]
                y = py - C[1, t]
                z = pz - C[2, t]
                square = x * x + y * y + z * z + _SHORT * _SHORT
                reach = own + rf[ro + t]
                if reach <= 0.0 or square >= reach * reach:
                    continue
                far = math.sqrt(square)
                value, steep = _hinge(far - (reach - margin), margin)
                total += value
                steep /= far
                F[0, s] += steep * x
                F[1, s] += steep * y
                F[2, s] += steep * z
                F[0, t] -= steep * x
                F[1, t] -= steep * y
                F[2, t] -= steep * z
    return total


@njit(cache=True, nogil=True)
def self_collision(Q, delta, parts, rf, ri, margin, kept, grad):
    """Cost of links near each other of one trajectory; adds its gradient to grad (T, dof)."""
    n = ri[1]
    T = np.empty((ri[0], 12))
    C = np.empty((3, n))
    L = np.empty((ri[2], 3))
    F = np.zeros((3, n))
    active = np.zeros(ri[2], np.bool_)
    W = np.empty((ri[0], 6))
    tau = np.empty(ri[4])
    q = np.empty(ri[4])
    total = 0.0
    edges = len(parts)
    for e in range(edges + 1):
        count = parts[e] if e < edges else 1
        for k in range(count):
            fraction = k / count
            for j in range(ri[4]):
                q[j] = Q[e, j]
                if k > 0:
                    q[j] += fraction * delta[e, j]
            _frames(q, rf, ri, T, L)
            value = _pair_terms(T, C, L, active, rf, ri, margin, kept, F)
            if value > 0.0:
                w = _weight(parts, e, k)
                total += w * value
                _joint_gradient(T, C, F, active, rf, ri, W, tau)
                for j in range(ri[4]):
                    tau[j] *= w
                _add(tau, e, fraction, grad)
    return total


# --- draws -------------------------------------------------------------------------


@njit(cache=True, nogil=True, inline="always")
def _taps(v, n, index, weight, steep):
    """The three nodes of a quadratic B-spline along one axis, their weights and slopes."""
    i = min(int(v + 0.5), n - 1)
    t = v - i
    index[0] = max(i - 1, 0)
    index[1] = i
    index[2] = min(i + 1, n - 1)
    weight[0] = 0.5 * (0.5 - t) * (0.5 - t)
    weight[1] = 0.75 - t * t
    weight[2] = 0.5 * (0.5 + t) * (0.5 + t)
    steep[0] = t - 0.5
    steep[1] = -2.0 * t
    steep[2] = t + 0.5


@njit(cache=True, nogil=True)
def _draw_distances(V, rule, index, weight, unit, out):
    """Spline of every draw's signed distance, metres."""
    out[:] = 0.0
    for a in range(3):
        for b in range(3):
            across = unit * weight[0, a] * weight[1, b]
            for c in range(3):
                w = across * weight[2, c]
                row = V[rule, index[0, a], index[1, b], index[2, c]]
                for s in range(len(out)):
                    out[s] += w * row[s]


@njit(cache=True, nogil=True)
def _draw_slope(V, rule, index, weight, steep, unit, share, slope):
    """Slope of the sum over draws of share times distance."""
    slope[:] = 0.0
    for a in range(3):
        for b in range(3):
            for c in range(3):
                row = V[rule, index[0, a], index[1, b], index[2, c]]
                total = 0.0
                for s in range(len(share)):
                    total += share[s] * row[s]
                total *= unit
                slope[0] += steep[0, a] * weight[1, b] * weight[2, c] * total
                slope[1] += weight[0, a] * steep[1, b] * weight[2, c] * total
                slope[2] += weight[0, a] * weight[1, b] * steep[2, c] * total


@njit(cache=True, nogil=True)
def _near_draws(centers, rules, grown, E, grid, top, reach, rows):
    """Fill rows (n, 2) with (sample, sphere) where any draw may count; how many there are."""
    found = 0
    for i in range(centers.shape[0]):
        for s in range(centers.shape[1]):
            x = (centers[i, s, 0] - grid[0]) / grid[3]
            y = (centers[i, s, 1] - grid[1]) / grid[3]
            z = (centers[i, s, 2] - grid[2]) / grid[3]
            if x < 0.0 or y < 0.0 or z < 0.0 or x > top[0] or y > top[1] or z > top[2]:
                continue
            if E[rules[s], int(x) >> 2, int(y) >> 2, int(z) >> 2] < grown[s] + reach:
                if len(rows):
                    rows[found, 0] = i
                    rows[found, 1] = s
                found += 1
    return found


@njit(cache=True, nogil=True)
def _near_certain(centers, rules, grown, radii, V, E, wf, reach, which, depth, slopes):
    """Fill, per contact with what is certain, (sample, sphere), depth and its slope; count."""
    found = 0
    kept = len(depth) > 0
    slope = np.empty(3)
    for i in range(centers.shape[0]):
        for s in range(centers.shape[1]):
            x = centers[i, s, 0]
            y = centers[i, s, 1]
            z = centers[i, s, 2]
            if _may_be_below(V, E, rules[s], wf, x, y, z, grown[s] + reach):
                if kept:
                    value = _distance(V, rules[s], wf, wf[3], wf[4] > 0.0, x, y, z, slope)
                    which[found, 0] = i
                    which[found, 1] = s
                    depth[found] = grown[s] - value
                    for a in range(3):
                        slopes[found, a] = -slope[a]
                found += 1
            for p in range(int(wf[5])):
                o = 8 + 4 * p
                value = wf[o] * x + wf[o + 1] * y + wf[o + 2] * z - wf[o + 3]
                if value < radii[s] + reach:
                    if kept:
                        which[found, 0] = i
                        which[found, 1] = s
                        depth[found] = radii[s] - value
                        for a in range(3):
                            slopes[found, a] = -wf[o + a]
                    found += 1
    return found


@njit(cache=True, nogil=True)
def risk(
    centers, rules, grown, radii, D, DE, grid, unit, V, E, wf, any_certain, tau, cut, force
):  # fmt: skip
    """Minus log of the share of draws that survive one trajectory; fills force (n, s, 3).

    centers (n, s, 3): of the spheres at all samples. D (g, x, y, z, S) int16: signed distances
    of every draw in steps of `unit` metres; DE: least of any draw per block, metres; grid:
    origin, spacing. V, E, wf: what is certain, as for `clearance`; planes use radii.
    With depth m, a contact adds exp(m / tau) (1 - exp(-(m + cut) / tau))^2 to the odds of every
    draw it concerns, nothing for m <= -cut; a draw survives with probability 1 / (1 + odds).
    """
    S = D.shape[4]
    top = np.empty(3)
    for a in range(3):
        top[a] = D.shape[a + 1] - 1.0
    none = np.empty((0, 2), np.int64)
    count = _near_draws(centers, rules, grown, DE, grid, top, cut, none)
    rows = np.empty((count, 2), np.int64)
    if count:
        _near_draws(centers, rules, grown, DE, grid, top, cut, rows)
    sure = 0
    if any_certain:
        sure = _near_certain(
            centers, rules, grown, radii, V, E, wf, cut, none, np.empty(0), np.empty((0, 3))
        )
    which = np.empty((sure, 2), np.int64)
    hit = np.empty(sure)
    slopes = np.empty((sure, 3))
    if sure:
        _near_certain(centers, rules, grown, radii, V, E, wf, cut, which, hit, slopes)

    index = np.empty((3, 3), np.int64)
    weight = np.empty((3, 3))
    steep = np.empty((3, 3))
    depth = np.empty((count, S))
    shift = np.zeros(S)
    highest = 0.0
    for c in range(sure):
        highest = max(highest, hit[c] / tau)
    shift[:] = highest
    for n in range(count):
        s = rows[n, 1]
        for a in range(3):
            v = (centers[rows[n, 0], s, a] - grid[a]) / grid[3]
            _taps(v, D.shape[a + 1], index[a], weight[a], steep[a])
        _draw_distances(D, rules[s], index, weight, unit, depth[n])
        for d in range(S):
            depth[n, d] = grown[s] - depth[n, d]
            shift[d] = max(shift[d], depth[n, d] / tau)
    odds = np.zeros(S)
    for n in range(count):
        for d in range(S):
            m = depth[n, d]
            if m > -cut:
                odds[d] += math.exp(m / tau - shift[d]) * (1.0 - math.exp(-(m + cut) / tau)) ** 2
    for c in range(sure):
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
    for n in range(count):
        s = rows[n, 1]
        strong = 0.0
        for d in range(S):
            m = depth[n, d]
            pull[d] = 0.0
            if m > -cut:
                fall = 1.0 - math.exp(-2.0 * (m + cut) / tau)
                pull[d] = share[d] * math.exp(m / tau - shift[d]) * fall
                strong = max(strong, pull[d])
        if strong == 0.0:
            continue
        for a in range(3):
            v = (centers[rows[n, 0], s, a] - grid[a]) / grid[3]
            _taps(v, D.shape[a + 1], index[a], weight[a], steep[a])
        _draw_slope(D, rules[s], index, weight, steep, unit / grid[3], pull, slope)
        for a in range(3):
            force[rows[n, 0], s, a] -= slope[a]
    for c in range(sure):
        if hit[c] <= -cut:
            continue
        fall = 1.0 - math.exp(-2.0 * (hit[c] + cut) / tau)
        strong = 0.0
        for d in range(S):
            strong += share[d] * math.exp(hit[c] / tau - shift[d])
        for a in range(3):
            force[which[c, 0], which[c, 1], a] += fall * strong * slopes[c, a]
    return lowest - math.log(total / S)
