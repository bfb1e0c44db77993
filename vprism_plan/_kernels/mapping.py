# SPDX-License-Identifier: BSD-3-Clause
"""Compiled inner loops of the map: sampling, sparse features, Gram blocks, predictions.

Symmetric matrices live in an *envelope*: row i of the lower triangle is stored from
its first column to the diagonal, so entry (i, j) of class k is `data[base[i] + j, k]`,
one addition away. The bias is the last row and column. Points come in *blocks* of
neighbours that share one list of hinges; a hinge out of a point's reach has the feature
value 0 exactly, so a result does not depend on which points share its block.
"""

import math

import numpy as np
from numba import njit

BLOCK = 64  # points per block at most: scratch arrays then stay in the first-level cache


# ---------------------------------------------------------------- negative samples
@njit(cache=True, nogil=True, fastmath=False)
def ray_strata(points, origin, centers, radius, step):
    """First stratum and number of strata of every ray that may pass near a centre."""
    n = len(points)
    first = np.zeros(n, np.int64)
    count = np.zeros(n, np.int64)
    for r in range(n):
        dx = points[r, 0] - origin[0]
        dy = points[r, 1] - origin[1]
        dz = points[r, 2] - origin[2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        if length <= 0.0:
            continue
        near = np.inf
        far = -np.inf
        for c in range(len(centers)):
            cx = centers[c, 0] - origin[0]
            cy = centers[c, 1] - origin[1]
            cz = centers[c, 2] - origin[2]
            along = (cx * dx + cy * dy + cz * dz) / length
            half = radius * radius - (cx * cx + cy * cy + cz * cz - along * along)
            if half <= 0.0:
                continue
            half = math.sqrt(half)
            near = min(near, along - half)
            far = max(far, along + half)
        near = max(near, 0.0)
        far = min(far, length)
        if near >= far:
            continue
        first[r] = int(near / step)
        count[r] = int(far / step) - first[r] + 1
    return first, count


@njit(cache=True, nogil=True, fastmath=False)
def ray_samples(points, origin, centers, radius, step, first, count, uniform):
    """One sample per stratum, and whether it is near a centre."""
    total = 0
    for r in range(len(points)):
        total += count[r]
    samples = np.zeros((total, 3))
    keep = np.zeros(total, np.bool_)
    m = 0
    for r in range(len(points)):
        dx = points[r, 0] - origin[0]
        dy = points[r, 1] - origin[1]
        dz = points[r, 2] - origin[2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        for s in range(count[r]):
            start = (first[r] + s) * step
            stop = min(start + step, length)
            if stop > start:
                t = (start + uniform[r, s] * (stop - start)) / length
                x = origin[0] + t * dx
                y = origin[1] + t * dy
                z = origin[2] + t * dz
                samples[m, 0] = x
                samples[m, 1] = y
                samples[m, 2] = z
                for c in range(len(centers)):
                    ax = x - centers[c, 0]
                    ay = y - centers[c, 1]
                    az = z - centers[c, 2]
                    if ax * ax + ay * ay + az * az <= radius * radius:
                        keep[m] = True
                        break
            m += 1
    return samples, keep


# ---------------------------------------------------------------- hinges near a block
@njit(cache=True, nogil=True, fastmath=False)
def _near_box(lower, upper, hinges, cell_start, cell_items, grid_lower, cell, shape, radius, out):
    """Write the sorted indices of the hinges within `radius` of a box; return how many."""
    first = np.empty(3, np.int64)
    last = np.empty(3, np.int64)
    for a in range(3):
        low = math.floor((lower[a] - radius - grid_lower[a]) / cell)
        high = math.floor((upper[a] + radius - grid_lower[a]) / cell)
        if high < 0.0 or low >= shape[a]:
            return 0
        first[a] = int(max(low, 0.0))
        last[a] = int(min(high, shape[a] - 1.0))
    reach = radius * radius
    n = 0
    for ix in range(first[0], last[0] + 1):
        for iy in range(first[1], last[1] + 1):
            row = (ix * shape[1] + iy) * shape[2]
            # Cells along z are consecutive, so the whole column is one range of items.
            for item in range(cell_start[row + first[2]], cell_start[row + last[2] + 1]):
                h = cell_items[item]
                square = 0.0
                for a in range(3):
                    x = hinges[h, a]
                    gap = max(lower[a] - x, x - upper[a], 0.0)
                    square += gap * gap
                if square < reach:
                    out[n] = h
                    n += 1
    out[:n].sort()
    return n


@njit(cache=True, nogil=True, fastmath=False)
def _block_box(points, order, start, stop, lower, upper):
    for a in range(3):
        lower[a] = np.inf
        upper[a] = -np.inf
    for p in range(start, stop):
        for a in range(3):
            x = points[order[p], a]
            lower[a] = min(lower[a], x)
            upper[a] = max(upper[a], x)


@njit(cache=True, nogil=True, fastmath=False)
def _fill_features(points, order, start, stop, hinges, near, n, gamma, reach, phi):
    """phi[u, p] for the hinges `near[:n]`, and row n for the bias."""
    for u in range(n):
        h = near[u]
        hx = hinges[h, 0]
        hy = hinges[h, 1]
        hz = hinges[h, 2]
        for p in range(start, stop):
            q = order[p]
            dx = points[q, 0] - hx
            dy = points[q, 1] - hy
            dz = points[q, 2] - hz
            square = dx * dx + dy * dy + dz * dz
            phi[u, p - start] = math.exp(-gamma * square) if square < reach else 0.0
    for p in range(stop - start):
        phi[n, p] = 1.0
    near[n] = len(hinges)


@njit(cache=True, nogil=True, fastmath=False)
def count_neighbours(
    points, order, block_start, lo, hi, hinges,
    cell_start, cell_items, grid_lower, cell, shape, radius, out,
):  # fmt: skip
    """Number of hinges near each of the blocks lo..hi."""
    near = np.empty(len(hinges) + 1, np.int64)
    lower = np.empty(3)
    upper = np.empty(3)
    for b in range(lo, hi):
        _block_box(points, order, block_start[b], block_start[b + 1], lower, upper)
        out[b] = _near_box(
            lower, upper, hinges, cell_start, cell_items, grid_lower, cell, shape, radius, near
        )


@njit(cache=True, nogil=True, fastmath=False)
def block_features(
    points, order, block_start, lo, hi, hinges,
    cell_start, cell_items, grid_lower, cell, shape, radius, gamma, reach,
    near_start, phi_start, near_out, phi_out,
):  # fmt: skip
    """Hinge lists and feature matrices (hinge-major) of the blocks lo..hi, bias last."""
    near = np.empty(len(hinges) + 1, np.int64)
    lower = np.empty(3)
    upper = np.empty(3)
    for b in range(lo, hi):
        start = block_start[b]
        stop = block_start[b + 1]
        _block_box(points, order, start, stop, lower, upper)
        n = _near_box(
            lower, upper, hinges, cell_start, cell_items, grid_lower, cell, shape, radius, near
        )
        size = stop - start
        phi = phi_out[phi_start[b] : phi_start[b + 1]].reshape(n + 1, size)
        _fill_features(points, order, start, stop, hinges, near, n, gamma, reach, phi)
        near_out[near_start[b] : near_start[b] + n + 1] = near[: n + 1]


# ---------------------------------------------------------------- learning
@njit(cache=True, nogil=True, fastmath=False)
def gram_rows(
    block_start, near_start, phi_start, near, phi_all, weights, row_first, base, lo, hi, out
):
    """Add sum_p weights[p, k] phi_i phi_j to the envelope rows lo..hi, all classes at once.

    Rows are owned by the caller, so threads need no locks and the order of every sum
    is that of the points, whatever the number of threads.
    """
    K = weights.shape[1]
    scaled = np.empty((BLOCK, K))
    for b in range(len(block_start) - 1):
        start = block_start[b]
        size = block_start[b + 1] - start
        own = near[near_start[b] : near_start[b + 1]]
        phi = phi_all[phi_start[b] : phi_start[b + 1]].reshape(len(own), size)
        first = np.searchsorted(own, lo)
        last = np.searchsorted(own, hi)
        for i in range(first, last):
            row = own[i]
            left = row_first[row]
            used = 0
            for p in range(size):
                f = phi[i, p]
                if f != 0.0:
                    used += 1
                for k in range(K):
                    scaled[p, k] = weights[start + p, k] * f
            if used == 0:
                continue
            for j in range(i + 1):
                column = own[j]
                if column < left:
                    continue
                entry = base[row] + column
                for p in range(size):
                    f = phi[j, p]
                    if f != 0.0:
                        for k in range(K):
                            out[entry, k] += f * scaled[p, k]


@njit(cache=True, nogil=True, fastmath=False)
def feature_sums(block_start, near_start, phi_start, near, phi_all, weights, out):
    """out[h, k] += sum_p weights[p, k] phi_h(p)."""
    K = weights.shape[1]
    for b in range(len(block_start) - 1):
        start = block_start[b]
        size = block_start[b + 1] - start
        own = near[near_start[b] : near_start[b + 1]]
        phi = phi_all[phi_start[b] : phi_start[b + 1]].reshape(len(own), size)
        for i in range(len(own)):
            for p in range(size):
                f = phi[i, p]
                if f != 0.0:
                    for k in range(K):
                        out[own[i], k] += f * weights[start + p, k]


@njit(cache=True, nogil=True, fastmath=False)
def _block_moments(own, n, phi, size, mean, cov, row_first, base, partial, m_out, v_out):
    """Mean and variance (K, size) of the logits of one block; `partial` is scratch."""
    K = mean.shape[1]
    for k in range(K):
        for p in range(size):
            m_out[k, p] = 0.0
            v_out[k, p] = 0.0
    for i in range(n):
        row = own[i]
        left = row_first[row]
        for k in range(K):
            for p in range(size):
                partial[k, p] = 0.0
        for j in range(i):
            column = own[j]
            if column < left:
                continue  # too far apart for any point to see both
            entry = base[row] + column
            for k in range(K):
                s = cov[entry, k]
                for p in range(size):
                    partial[k, p] += s * phi[j, p]
        diagonal = base[row] + row
        for k in range(K):
            s = cov[diagonal, k]
            w = mean[row, k]
            for p in range(size):
                f = phi[i, p]
                v_out[k, p] += f * (s * f + 2.0 * partial[k, p])
                m_out[k, p] += w * f
    for k in range(K):
        for p in range(size):
            v_out[k, p] = max(v_out[k, p], 0.0)


@njit(cache=True, nogil=True, fastmath=False)
def stored_moments(
    block_start, lo, hi, near_start, phi_start, near, phi_all, mean, cov, row_first, base,
    mean_out, var_out,
):  # fmt: skip
    """Logit moments (points, K) of the blocks lo..hi whose features are stored."""
    K = mean.shape[1]
    partial = np.empty((K, BLOCK))
    m = np.empty((K, BLOCK))
    v = np.empty((K, BLOCK))
    for b in range(lo, hi):
        start = block_start[b]
        size = block_start[b + 1] - start
        own = near[near_start[b] : near_start[b + 1]]
        phi = phi_all[phi_start[b] : phi_start[b + 1]].reshape(len(own), size)
        _block_moments(own, len(own), phi, size, mean, cov, row_first, base, partial, m, v)
        for p in range(size):
            for k in range(K):
                mean_out[start + p, k] = m[k, p]
                var_out[start + p, k] = v[k, p]


# ---------------------------------------------------------------- prediction
@njit(cache=True, nogil=True, fastmath=False)
def point_moments(
    points, order, block_start, lo, hi, hinges,
    cell_start, cell_items, grid_lower, cell, shape, radius, gamma, reach,
    mean, cov, row_first, base, mean_out, var_out, support_out,
):  # fmt: skip
    """Logit moments and kernel mass of the points of blocks lo..hi."""
    K = mean.shape[1]
    near = np.empty(len(hinges) + 1, np.int64)
    lower = np.empty(3)
    upper = np.empty(3)
    phi = np.empty((len(hinges) + 1, BLOCK))
    partial = np.empty((K, BLOCK))
    m = np.empty((K, BLOCK))
    v = np.empty((K, BLOCK))
    for b in range(lo, hi):
        start = block_start[b]
        stop = block_start[b + 1]
        size = stop - start
        _block_box(points, order, start, stop, lower, upper)
        n = _near_box(
            lower, upper, hinges, cell_start, cell_items, grid_lower, cell, shape, radius, near
        )
        _fill_features(points, order, start, stop, hinges, near, n, gamma, reach, phi)
        _block_moments(near, n + 1, phi, size, mean, cov, row_first, base, partial, m, v)
        for p in range(size):
            q = order[start + p]
            total = 0.0
            for u in range(n):
                total += phi[u, p]
            support_out[q] = total
            for k in range(K):
                mean_out[q, k] = m[k, p]
                var_out[q, k] = v[k, p]


@njit(cache=True, nogil=True, fastmath=False)
def point_jacobians(
    points, lo, hi, hinges,
    cell_start, cell_items, grid_lower, cell, shape, radius, gamma, reach,
    mean, cov, row_first, base, mean_out, var_out, support_out,
    mean_grad, var_grad, support_grad,
):  # fmt: skip
    """Moments of the points lo..hi with their gradients: (n, K, 3), (n, K, 3), (n, 3)."""
    K = mean.shape[1]
    near = np.empty(len(hinges) + 1, np.int64)
    active = np.empty(len(hinges) + 1, np.int64)
    phi = np.empty(len(hinges) + 1)
    slope = np.zeros((len(hinges) + 1, 3))
    product = np.empty((len(hinges) + 1, K))
    for q in range(lo, hi):
        n = _near_box(
            points[q], points[q], hinges, cell_start, cell_items, grid_lower, cell, shape,
            radius, near,
        )  # fmt: skip
        count = 0
        support_out[q] = 0.0
        for a in range(3):
            support_grad[q, a] = 0.0
        for u in range(n):
            square = 0.0
            for a in range(3):
                square += (points[q, a] - hinges[near[u], a]) ** 2
            if square >= reach:
                continue
            f = math.exp(-gamma * square)
            active[count] = near[u]
            phi[count] = f
            support_out[q] += f
            for a in range(3):
                g = -2.0 * gamma * (points[q, a] - hinges[near[u], a]) * f
                slope[count, a] = g
                support_grad[q, a] += g
            count += 1
        active[count] = len(hinges)
        phi[count] = 1.0
        for a in range(3):
            slope[count, a] = 0.0
        for i in range(count + 1):
            for k in range(K):
                product[i, k] = 0.0
        for i in range(count + 1):
            row = active[i]
            for j in range(i):
                entry = base[row] + active[j]
                for k in range(K):
                    s = cov[entry, k]
                    product[i, k] += s * phi[j]
                    product[j, k] += s * phi[i]
            for k in range(K):
                product[i, k] += cov[base[row] + row, k] * phi[i]
        for k in range(K):
            m = 0.0
            v = 0.0
            for a in range(3):
                mean_grad[q, k, a] = 0.0
                var_grad[q, k, a] = 0.0
            for i in range(count + 1):
                m += mean[active[i], k] * phi[i]
                v += product[i, k] * phi[i]
                for a in range(3):
                    mean_grad[q, k, a] += mean[active[i], k] * slope[i, a]
                    var_grad[q, k, a] += 2.0 * product[i, k] * slope[i, a]
            mean_out[q, k] = m
            var_out[q, k] = max(v, 0.0)


@njit(cache=True, nogil=True, fastmath=False)
def normalised_log_odds(mean, var, lo, hi, limit, out):
    """log(P(occupied) / P(empty)) of rows lo..hi, cut off at +-limit.

    With u_ki = (m_k - m_i) / sqrt(1 + pi/8 (v_k + v_i)), the approximation of Daunizeau
    is q_k = 1 / (1 + sum_{i != k} exp(-u_ki)); the odds need no normalisation.
    """
    K = mean.shape[1]
    scores = np.empty(K)
    for r in range(lo, hi):
        for k in range(K):
            largest = 0.0
            for i in range(K):
                u = (mean[r, i] - mean[r, k]) / math.sqrt(
                    1.0 + math.pi / 8.0 * (var[r, k] + var[r, i])
                )
                largest = max(largest, u)
            total = 0.0
            for i in range(K):
                u = (mean[r, i] - mean[r, k]) / math.sqrt(
                    1.0 + math.pi / 8.0 * (var[r, k] + var[r, i])
                )
                total += math.exp(u - largest)
            scores[k] = -(largest + math.log(total))
        top = scores[1]
        for k in range(2, K):
            top = max(top, scores[k])
        total = 0.0
        for k in range(1, K):
            total += math.exp(scores[k] - top)
        odds = top + math.log(total) - scores[0]
        out[r] = min(max(odds, -limit), limit)


# ---------------------------------------------------------------- envelopes
@njit(cache=True, nogil=True, fastmath=False)
def unpack_block(data, k, row_first, base, rows, columns, out):
    """Dense block [rows[0]:rows[1], columns[0]:columns[1]] of class k's lower triangle.

    Entries above the diagonal are mirrored, entries outside the envelope are 0.
    """
    for i in range(rows[0], rows[1]):
        for j in range(columns[0], columns[1]):
            r = max(i, j)
            c = min(i, j)
            value = data[base[r] + c, k] if c >= row_first[r] else 0.0
            out[i - rows[0], j - columns[0]] = value


@njit(cache=True, nogil=True, fastmath=False)
def pack_block(block, k, row_first, base, rows, columns, data):
    """Write the lower triangle of a dense block back into class k's envelope."""
    for i in range(rows[0], rows[1]):
        first = max(columns[0], row_first[i])
        last = min(columns[1], i + 1)
        for j in range(first, last):
            data[base[i] + j, k] = block[i - rows[0], j - columns[0]]


@njit(cache=True, nogil=True, fastmath=False)
def envelope_product(data, row_first, base, vectors, out):
    """out = A x for every class: data (E, K), vectors and out (M, K)."""
    M, K = vectors.shape
    for i in range(M):
        for k in range(K):
            out[i, k] = 0.0
    for i in range(M):
        for j in range(row_first[i], i):
            entry = base[i] + j
            for k in range(K):
                out[i, k] += data[entry, k] * vectors[j, k]
                out[j, k] += data[entry, k] * vectors[i, k]
        for k in range(K):
            out[i, k] += data[base[i] + i, k] * vectors[i, k]


@njit(cache=True, nogil=True, fastmath=False)
def envelope_inner(a, b, row_first, base, out):
    """out[k] = trace(A_k B_k) of two symmetric envelopes."""
    K = a.shape[1]
    for k in range(K):
        out[k] = 0.0
    for i in range(len(base)):
        for j in range(row_first[i], i):
            entry = base[i] + j
            for k in range(K):
                out[k] += 2.0 * a[entry, k] * b[entry, k]
        for k in range(K):
            out[k] += a[base[i] + i, k] * b[base[i] + i, k]
