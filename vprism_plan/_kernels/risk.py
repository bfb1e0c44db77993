# SPDX-License-Identifier: BSD-3-Clause
"""Compiled loops over posterior draws: which voxels are occupied in which draw, and how far.

One draw of the weights is one possible world. All tables keep the S draws innermost,
so that every loop over them runs on vectors. Distances are in voxels.

An occupied voxel stands for the ball around its centre that reaches to the draw's surface,
which lies between voxels: see `_depths`.

Tables (see `vprism_plan.world.posterior_worlds`):
    owner_row (nx, ny, nz) int32: a row of `owners`, or -1 - q where every draw is free, at
        log-odds of -q / ODDS.
    owners (rows, S) uint8: 0 free, k the object class that occupies the voxel in the draw.
    odds (rows, S) int8: log-odds of being occupied, times ODDS.
    distance_row (g, ex, ey, ez) int32: row of `rows` per contact rule g; FREE beyond the
        reach of anything that any draw occupies, UNBAKED until somebody asks.
    rows (rows, S) uint8: DEEP - 1 to 0 in occupied voxels, by the radius of their balls, up to
        one voxel; else DEEP + floor(scale * distance to the nearest occupied voxel centre), or
        NOTHING beyond the reach. lowest (rows,): over the draws.
"""

import numpy as np

from vprism_plan._kernels.jit import njit
from vprism_plan._kernels.mapping import _near_box as near_box

FREE = np.int32(-2)
UNBAKED = np.int32(-1)
NOTHING = np.uint8(255)
DEEP = 16  # steps per voxel of the depth of an occupied one
ODDS = 12.0  # steps of the log-odds per nat
MOST_ODDS = 127
BLOCK = 16  # edge of the blocks that are drawn and baked at once, voxels
_STEP_RIM = np.float32(1e-3)  # of a step; what rounding may add to a whole number of them
_FAR = np.uint16(40000)  # above any squared distance within reach, and twice that still fits


@njit(cache=True, nogil=True)
def draw_voxels(
    points, hinges, cell_start, cell_items, grid_lower, cell, shape, radius, gamma,
    prior, own, weights, used, doubt_lower, doubts, apart, most, owners, odds, start, stop,
):  # fmt: skip
    """Which object occupies the points start..stop in each draw, and the log-odds of that: owners
    and odds (n, S).

    Logits are prior (n, K), and the features times weights (M, K, S), of which those not in used
    (M, K) are 0; where own (n,), thresholds are taken from those of being empty (`_doubt`). A
    point's bits do not depend on the others. Single precision: off by some 1e-6 nats.
    """
    n_features, n_classes, n_draws = weights.shape
    near = np.empty(n_features, np.int64)
    mine = np.empty(n_features, np.int64)
    phi = np.empty(n_features, np.float32)
    feature = np.empty(n_features, np.float32)
    logits = np.empty((n_classes, n_draws), np.float32)
    weight = np.empty(8)
    for i in range(start, stop):
        count = near_box(
            points[i], points[i], hinges, cell_start, cell_items, grid_lower, cell, shape, radius,
            near,
        )  # fmt: skip
        for u in range(count):
            away = 0.0
            for a in range(3):
                away += (points[i, a] - hinges[near[u], a]) ** 2
            phi[u] = np.exp(-gamma * away)
        for k in range(n_classes):
            row, bias = logits[k], weights[n_features - 1, k]
            for s in range(n_draws):
                row[s] = np.float32(prior[i, k]) + bias[s]
            some = 0
            for u in range(count):
                if used[near[u], k]:
                    mine[some], feature[some] = near[u], phi[u]
                    some += 1
            for u in range(some, some + -some % 4):  # four at a time: sums stay in registers
                mine[u], feature[u] = n_features - 1, 0.0
            for u in range(0, some, 4):
                w0, w1 = weights[mine[u], k], weights[mine[u + 1], k]
                w2, w3 = weights[mine[u + 2], k], weights[mine[u + 3], k]
                f0, f1, f2, f3 = feature[u], feature[u + 1], feature[u + 2], feature[u + 3]
                for s in range(n_draws):
                    row[s] += (f0 * w0[s] + f1 * w1[s]) + (f2 * w2[s] + f3 * w3[s])
        if own[i]:
            _doubt(points[i], doubt_lower, doubts, apart, most, weight, logits[0])
        classify(logits, owners[i], odds[i])


@njit(cache=True, nogil=True)
def _doubt(point, lower, doubts, apart, most, weight, row):
    """Take from row (S,) a logistic number each: standard normal ones (nx, ny, nz, S) at nodes
    `apart`, linear between them and scaled back to variance 1, made logistic, within +-most.

    logit(Phi(g)) is 1.5976 g + 0.07057 g^3 to within 0.00014 in Phi (Bowling et al., "A logistic
    approximation to the cumulative normal distribution", 2009).
    """
    x, y, z = (point - lower) / apart
    i, j, k = int(x), int(y), int(z)
    square = 0.0
    for corner in range(8):
        weight[corner] = x - i if corner & 4 else 1.0 - (x - i)
        weight[corner] *= y - j if corner & 2 else 1.0 - (y - j)
        weight[corner] *= z - k if corner & 1 else 1.0 - (z - k)
        square += weight[corner] ** 2
    normal = np.zeros(row.size, np.float32)
    for corner in range(8):
        node = doubts[i + (corner >> 2), j + (corner >> 1 & 1), k + (corner & 1)]
        share = np.float32(weight[corner] / np.sqrt(square))
        for s in range(row.size):
            normal[s] += share * node[s]
    bound = np.float32(most)
    for s in range(row.size):
        g = normal[s]
        logistic = g * (np.float32(1.5976) + np.float32(0.07057) * g * g)
        row[s] -= min(max(logistic, -bound), bound)


@njit(cache=True, nogil=True)
def classify(logits, owners, odds):
    """Which object occupies a voxel in each draw: owners (S,), from logits (K, S), and the
    log-odds of that, odds (S,).

    Occupied where 1 - softmax(z)_0 > 1/2, which is sum_{k >= 1} exp(z_k - z_0) > 1; by
    the likeliest object.
    """
    n_classes, n_draws = logits.shape
    best, total = logits[1].copy(), np.zeros(n_draws, np.float32)
    owners[:] = 1
    for k in range(2, n_classes):
        row = logits[k]
        for s in range(n_draws):
            if row[s] > best[s]:
                owners[s] = k
            best[s] = max(best[s], row[s])
    if n_classes > 2:
        for k in range(1, n_classes):
            for s in range(n_draws):
                total[s] += np.exp(logits[k, s] - best[s])
    for s in range(n_draws):
        gap = best[s] - logits[0, s]
        if n_classes > 2 and abs(gap) * ODDS < MOST_ODDS:
            gap += np.log(total[s])
        steps = min(max(np.rint(abs(gap) * ODDS), 1.0), MOST_ODDS)
        odds[s] = steps if gap > 0.0 else -steps
        if gap <= 0.0:
            owners[s] = 0


@njit(cache=True, nogil=True)
def stand(places, cylinders, owner, owners, odds, start, stop):
    """Give what is free at the places (n, 3) start..stop in a world to the cylinders (m, 5) there.

    Places: two coordinates along the support surface, height; cylinders: world, middle, radius,
    top."""
    for i in range(start, stop):
        u, v, height = places[i]
        for c in range(len(cylinders)):
            du, dv = u - cylinders[c, 1], v - cylinders[c, 2]
            if du * du + dv * dv <= cylinders[c, 3] ** 2 and height <= cylinders[c, 4]:
                s = int(cylinders[c, 0])
                if owners[i, s] == 0:
                    owners[i, s], odds[i, s] = owner, MOST_ODDS


@njit(cache=True, nogil=True, inline="always")
def _steeper(row, beside, owners, odds, counts, steepest):
    """Raise steepest (S,) to 1 / t, where t is the way, voxels, from occupied voxel `row` to the
    surface on the way to its neighbour `beside`; nothing if that one is occupied, too."""
    if beside < 0:
        other = np.float32(-1 - beside)
        for s in range(steepest.size):
            mine = max(np.float32(odds[row, s]), np.float32(1.0))
            steepest[s] = max(steepest[s], (mine + other) / mine)
    else:
        for s in range(steepest.size):
            mine = max(np.float32(odds[row, s]), np.float32(1.0))
            # The surface between an object that counts and one that does not is half way.
            other = -np.float32(odds[beside, s])
            if owners[beside, s] != 0:
                other = np.float32(-1e9) if counts[owners[beside, s]] else mine
            steepest[s] = max(steepest[s], (mine + other) / mine)


@njit(cache=True, nogil=True)
def _depths(x, y, z, owner_row, owners, odds, counts, steepest, squares, out):
    """Replace the entries of out (S,) in draws that occupy a voxel: DEEP - the depth in steps.

    The surface crosses the axes through the voxel where the log-odds, linear between centres,
    are 0, nearest at ways t_x, t_y, t_z; the plane through these points is 1 / sqrt(sum 1 / t^2)
    away. Depths are rounded up, at most one voxel.
    """
    row = owner_row[x, y, z]
    squares[:] = 0.0
    for axis in range(3):
        steepest[:] = 0.0
        for way in (-1, 1):
            a = x + (way if axis == 0 else 0)
            b = y + (way if axis == 1 else 0)
            c = z + (way if axis == 2 else 0)
            inside = 0 <= a < owner_row.shape[0] and 0 <= b < owner_row.shape[1]
            inside = inside and 0 <= c < owner_row.shape[2]
            beside = owner_row[a, b, c] if inside else -1 - MOST_ODDS
            _steeper(row, beside, owners, odds, counts, steepest)
        for s in range(squares.size):
            squares[s] += steepest[s] * steepest[s]
    for s in range(squares.size):
        if counts[owners[row, s]]:
            steps = DEEP / np.sqrt(max(squares[s], np.float32(1.0)))
            out[s] = np.uint8(DEEP - np.ceil(steps - _STEP_RIM))


@njit(cache=True, nogil=True)
def bake_block(owner_row, owners, odds, counts, cx, cy, cz, reach, lut, wanted, out):
    """Distance from every wanted voxel of a block to the nearest occupied one, per draw, and
    depth in occupied ones.

    Exact Euclidean, one pass per axis over a halo of `reach` voxels, without what is farther than
    that along the axes before.

    owner_row, owners, odds: which draw occupies what; voxels outside the array are free.
    counts (256,): whether an object class counts as occupied.
    cx, cy, cz: first voxel of the block in `owner_row`; may lie outside.
    lut: squared distance to what is stored. wanted (B, B, B): row of `out`, or -1.
    """
    n_draws = owners.shape[1]
    wide, limit = BLOCK + 2 * reach, (reach + 1) ** 2
    gap = np.zeros(wide, np.int64)  # squared distance of a layer from the block
    for i in range(reach):
        gap[i] = gap[wide - 1 - i] = (reach - i) ** 2
    along_z = np.empty((BLOCK, n_draws), np.uint16)  # of one column: stays in the cache
    along_y = np.empty((wide, BLOCK, BLOCK, n_draws), np.uint16)
    any_y = np.zeros(wide, np.bool_)
    solid = np.empty(n_draws, np.uint16)
    for i in range(wide):
        x = cx - reach + i
        if x < 0 or x >= owner_row.shape[0]:
            continue
        for j in range(wide):
            y = cy - reach + j
            if y < 0 or y >= owner_row.shape[1] or gap[i] + gap[j] >= limit:
                continue
            some = False
            ball = int(np.sqrt(limit - 1 - gap[i] - gap[j]))
            for z in range(max(cz - ball, 0), min(cz + BLOCK + ball, owner_row.shape[2])):
                row = owner_row[x, y, z]
                if row < 0:
                    continue
                if not some:
                    some = True
                    along_z[:] = _FAR
                for s in range(n_draws):
                    solid[s] = np.uint16(0) if counts[owners[row, s]] else _FAR
                for k in range(max(z - cz - ball, 0), min(z - cz + ball + 1, BLOCK)):
                    away = np.uint16((z - cz - k) ** 2)
                    best = along_z[k]
                    for s in range(n_draws):
                        best[s] = min(best[s], np.uint16(solid[s] + away))
            if not some:
                continue
            if not any_y[i]:
                any_y[i] = True
                along_y[i] = _FAR
            ball = int(np.sqrt(limit - 1 - gap[i]))
            for b in range(max(j - reach - ball, 0), min(j - reach + ball + 1, BLOCK)):
                away = np.uint16((j - reach - b) ** 2)
                for k in range(BLOCK):
                    best = along_y[i, b, k]
                    column = along_z[k]
                    for s in range(n_draws):
                        best[s] = min(best[s], np.uint16(column[s] + away))
    total = np.empty(n_draws, np.uint16)
    steepest, squares = np.empty(n_draws, np.float32), np.empty(n_draws, np.float32)
    for b in range(BLOCK):
        for k in range(BLOCK):
            for a in range(BLOCK):  # innermost: what it reads of `along_y` stays in the cache
                row = wanted[a, b, k]
                if row < 0:
                    continue
                total[:] = _FAR
                for i in range(a, a + 2 * reach + 1):
                    if any_y[i]:
                        away = np.uint16((i - reach - a) ** 2)
                        column = along_y[i, b, k]
                        for s in range(n_draws):
                            total[s] = min(total[s], np.uint16(column[s] + away))
                for s in range(n_draws):
                    out[row, s] = lut[min(total[s], lut.size - 1)]
                x, y, z = cx + a, cy + b, cz + k
                inside = 0 <= x < owner_row.shape[0] and 0 <= y < owner_row.shape[1]
                if inside and 0 <= z < owner_row.shape[2] and owner_row[x, y, z] >= 0:
                    _depths(x, y, z, owner_row, owners, odds, counts, steepest, squares, out[row])


# What a ball may be found to touch: nothing, what `hit` says, or nobody knows yet.
_NOTHING, _SOME, _UNKNOWN = 0, 1, -1
_RIM = 1e-9  # voxels; a centre on the rim of a ball is in it, however it rounds


@njit(cache=True, nogil=True, inline="always")
def _may_touch(gx, gy, gz, need, table, distance_row, rows, lowest, scale, reach, hit):
    """Bits of the draws that no node of the cell around a ball proves free of it.

    An occupied voxel's centre x is within `need` of c only if every node v of the cell around c has
    |v - x| <= need + |c - v|. Fills hit (S,) only if the answer is `_SOME`.
    """
    _, ex, ey, ez = distance_row.shape
    if not (0.0 <= gx <= ex - 1.0 and 0.0 <= gy <= ey - 1.0 and 0.0 <= gz <= ez - 1.0):
        return _NOTHING
    # The nearest node answers for most balls.
    x = int(gx + 0.5)
    y = int(gy + 0.5)
    z = int(gz + 0.5)
    row = distance_row[table, x, y, z]
    if row < 0:
        return _UNKNOWN if row == UNBAKED else _NOTHING
    away = need + np.sqrt((gx - x) ** 2 + (gy - y) ** 2 + (gz - z) ** 2)
    if away < reach and lowest[row] > np.uint8(DEEP + away * scale):
        return _NOTHING
    hit[:] = 1
    for corner in range(8):
        x = min(int(gx), ex - 2) + (corner >> 2)
        y = min(int(gy), ey - 2) + ((corner >> 1) & 1)
        z = min(int(gz), ez - 2) + (corner & 1)
        row = distance_row[table, x, y, z]
        if row < 0:
            return _UNKNOWN if row == UNBAKED else _NOTHING
        away = need + np.sqrt((gx - x) ** 2 + (gy - y) ** 2 + (gz - z) ** 2)
        if away < reach:  # the table knows no farther: never "free" for that
            limit = np.uint8(DEEP + away * scale)
            if lowest[row] > limit:
                return _NOTHING
            values = rows[row]
            for s in range(hit.size):
                hit[s] &= np.uint8(values[s] <= limit)
    return _SOME


@njit(cache=True, nogil=True, inline="always")
def _must_touch(gx, gy, gz, ball, table, distance_row, rows, scale, sure):
    """Bits of the draws that some node of the cell proves to touch: |v - x| + |c - v| <= ball."""
    _, ex, ey, ez = distance_row.shape
    sure[:] = 0
    for corner in range(8):
        x = min(int(gx), ex - 2) + (corner >> 2)
        y = min(int(gy), ey - 2) + ((corner >> 1) & 1)
        z = min(int(gz), ez - 2) + (corner & 1)
        left = ball - np.sqrt((gx - x) ** 2 + (gy - y) ** 2 + (gz - z) ** 2)
        if left >= 0.0:
            values = rows[distance_row[table, x, y, z]]
            # A stored distance is rounded down by less than one step.
            bound = np.uint8(min(DEEP - 1 + int(left * scale), 254))
            for s in range(sure.size):
                sure[s] |= np.uint8(values[s] <= bound)


@njit(cache=True, nogil=True, inline="always")
def _look(gx, gy, gz, ball, table, distance_row, rows, lowest, sure):
    """Add to sure (S,) the draws in which an occupied voxel in the outer shell of a ball, or
    around it, reaches into it.

    What lies deeper than two voxels in a ball is known from the nodes: they are less than
    0.87 voxels off its centre. Returns `_UNKNOWN` at an unbaked voxel.
    """
    _, ex, ey, ez = distance_row.shape
    need = ball + 1.0
    outer = (need + _RIM) ** 2
    inner = max(ball - 2.0, 0.0) ** 2
    for x in range(max(int(np.ceil(gx - need)), 0), min(int(gx + need) + 1, ex)):
        for y in range(max(int(np.ceil(gy - need)), 0), min(int(gy + need) + 1, ey)):
            flat = (gx - x) ** 2 + (gy - y) ** 2
            if flat > outer:
                continue
            for z in range(max(int(np.ceil(gz - need)), 0), min(int(gz + need) + 1, ez)):
                away = flat + (gz - z) ** 2
                if inner <= away <= outer:
                    row = distance_row[table, x, y, z]
                    if row == UNBAKED:
                        return _UNKNOWN
                    if row < 0:
                        continue
                    short = max(np.sqrt(away) - ball - _RIM, 0.0)
                    bound = np.uint8(min(DEEP * (1.0 - short), DEEP - 1.0))
                    if lowest[row] <= bound:
                        values = rows[row]
                        for s in range(sure.size):
                            sure[s] |= np.uint8(values[s] <= bound)
    return _SOME


@njit(cache=True, nogil=True)
def touch_ball(
    gx, gy, gz, ball, table, distance_row, rows, lowest, scale, reach, hit, sure
):  # fmt: skip
    """In which draws a ball touches something; fills hit (S,) only if the answer is `_SOME`.

    gx, gy, gz: centre, in voxels of the table. ball: radius in voxels; what counts is an
    occupied voxel's centre within ball + its depth, which is at most 1. Exact: what the
    distances at the nodes around leave open is looked up voxel by voxel.
    """
    need = ball + 1.0
    found = _may_touch(gx, gy, gz, need, table, distance_row, rows, lowest, scale, reach, hit)
    if found == _SOME:
        _must_touch(gx, gy, gz, ball, table, distance_row, rows, scale, sure)
        open_draws = 0
        for s in range(hit.size):
            open_draws += hit[s] & (1 - sure[s])
        if open_draws > 0:
            found = _look(gx, gy, gz, ball, table, distance_row, rows, lowest, sure)
            if need >= reach:
                sure[:] = 1  # farther than the table knows: never "free"
        for s in range(hit.size):
            hit[s] = sure[s]
    return found


@njit(cache=True, nogil=True, inline="always")
def mark_ball(gx, gy, gz, ball, table, wanted):
    """Mark the blocks that a ball, and the cell around its centre, reach."""
    _, bx, by, bz = wanted.shape
    wide = ball + 2.0
    for i in range(max(int(gx - wide) // BLOCK, 0), min(int(gx + wide) // BLOCK + 1, bx)):
        for j in range(max(int(gy - wide) // BLOCK, 0), min(int(gy + wide) // BLOCK + 1, by)):
            for k in range(max(int(gz - wide) // BLOCK, 0), min(int(gz + wide) // BLOCK + 1, bz)):
                wanted[table, i, j, k] = True


@njit(cache=True, nogil=True)
def touch(
    C, slack, radii, tables, distance_row, rows, lowest, first, spacing, scale, reach,
    touched, counts, first_sample, wanted,
):  # fmt: skip
    """In which draws a ball of any sample touches something; returns how many balls met an
    unbaked voxel.

    C (n, 3, m) centres, metres; slack (n, m) metres added to radii (m,); tables (m,) the
    table of each ball, -1 = not checked. first (3,): index of the tables' first voxel.

    touched (S,): the draws that touch anywhere, kept from call to call; counts (n,): draws
    that touch at each sample; first_sample (S,): the sample that made `touched` true.
    wanted (blocks per axis): marked where a voxel is unbaked; counts mean nothing then.
    """
    n_draws = rows.shape[1]
    here = np.empty(n_draws, np.uint8)
    hit = np.empty(n_draws, np.uint8)
    sure = np.empty(n_draws, np.uint8)
    missing = 0
    for i in range(C.shape[0]):
        here[:] = 0
        some = False
        for j in range(C.shape[2]):
            if tables[j] < 0:
                continue
            gx = C[i, 0, j] / spacing - first[0]
            gy = C[i, 1, j] / spacing - first[1]
            gz = C[i, 2, j] / spacing - first[2]
            ball = (radii[j] + slack[i, j]) / spacing
            found = touch_ball(
                gx, gy, gz, ball, tables[j], distance_row, rows, lowest, scale, reach, hit, sure
            )
            if found == _SOME:
                some = True
                for s in range(n_draws):
                    here[s] |= hit[s]
            elif found == _UNKNOWN:
                missing += 1
                mark_ball(gx, gy, gz, ball, tables[j], wanted)
        counts[i] = 0
        if some:
            total = 0
            for s in range(n_draws):
                total += here[s]
            counts[i] = total
            for s in range(n_draws):
                if here[s] and not touched[s]:
                    touched[s] = 1
                    first_sample[s] = i
    return missing


@njit(cache=True, nogil=True)
def touch_one(C, radii, tables, distance_row, rows, lowest, first, spacing, scale, reach, touched):
    """`touch` for one sample C (3, m) without slack: how many draws touch, or -1 if a voxel
    is unbaked. touched (S,) must be zero. Fewer arrays make a quicker call."""
    n_draws = rows.shape[1]
    hit = np.empty(n_draws, np.uint8)
    sure = np.empty(n_draws, np.uint8)
    some = False
    for j in range(C.shape[1]):
        if tables[j] < 0:
            continue
        gx = C[0, j] / spacing - first[0]
        gy = C[1, j] / spacing - first[1]
        gz = C[2, j] / spacing - first[2]
        found = touch_ball(
            gx, gy, gz, radii[j] / spacing, tables[j], distance_row, rows, lowest, scale, reach,
            hit, sure,
        )  # fmt: skip
        if found == _SOME:
            some = True
            for s in range(n_draws):
                touched[s] |= hit[s]
        elif found == _UNKNOWN:
            return -1
    total = 0
    if some:
        for s in range(n_draws):
            total += touched[s]
    return total


@njit(cache=True, nogil=True)
def touch_each(
    centers, radii, table, distance_row, rows, lowest, first, spacing, scale, reach, out, wanted,
):  # fmt: skip
    """out (n, S): in which draws each ball (centers (n, 3), radii (n,)) touches something."""
    hit = np.empty(rows.shape[1], np.uint8)
    sure = np.empty(rows.shape[1], np.uint8)
    missing = 0
    for i in range(centers.shape[0]):
        gx = centers[i, 0] / spacing - first[0]
        gy = centers[i, 1] / spacing - first[1]
        gz = centers[i, 2] / spacing - first[2]
        found = touch_ball(
            gx, gy, gz, radii[i] / spacing, table, distance_row, rows, lowest, scale, reach,
            hit, sure,
        )  # fmt: skip
        out[i] = False
        if found == _SOME:
            for s in range(hit.size):
                out[i, s] = hit[s] != 0
        elif found == _UNKNOWN:
            missing += 1
            mark_ball(gx, gy, gz, radii[i] / spacing, table, wanted)
    return missing


@njit(cache=True, nogil=True)
def causes(
    C, slack, radii, tables, distance_row, rows, first, spacing, first_sample, owner_row, owners,
    halo, sphere, owner,
):  # fmt: skip
    """Which ball touched first in each draw, and whose voxel: sphere (S,), owner (S,).

    Of the balls at the draw's first sample, the one that reaches deepest into an occupied
    voxel. first (3,) is the first voxel of the tables, `halo` voxels before that of the owners.
    -1 and 0 where no draw touches. All must be baked.
    """
    nx, ny, nz = owner_row.shape
    deepest = np.full(owners.shape[1], -np.inf)
    sphere[:] = -1
    owner[:] = 0
    for i in range(C.shape[0]):
        mine = np.flatnonzero(first_sample == i)
        if mine.size == 0:
            continue
        for j in range(C.shape[2]):
            if tables[j] < 0:
                continue
            x = C[i, 0, j] / spacing - first[0] - halo
            y = C[i, 1, j] / spacing - first[1] - halo
            z = C[i, 2, j] / spacing - first[2] - halo
            ball = (radii[j] + slack[i, j]) / spacing + 2.0 * _RIM
            wide = ball + 1.0
            for a in range(max(int(x - wide), 0), min(int(x + wide) + 2, nx)):
                for b in range(max(int(y - wide), 0), min(int(y + wide) + 2, ny)):
                    flat = (a - x) ** 2 + (b - y) ** 2
                    if flat > wide * wide:
                        continue
                    for c in range(max(int(z - wide), 0), min(int(z + wide) + 2, nz)):
                        row = owner_row[a, b, c]
                        if row < 0:
                            continue
                        into = ball - np.sqrt(flat + (c - z) ** 2)
                        if into < -1.0:
                            continue
                        values = rows[distance_row[tables[j], a + halo, b + halo, c + halo]]
                        for s in mine:
                            depth = into + (DEEP - values[s]) / DEEP
                            if values[s] < DEEP and depth >= 0.0 and depth > deepest[s]:
                                deepest[s] = depth
                                sphere[s] = j
                                owner[s] = owners[row, s]
