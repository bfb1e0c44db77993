# SPDX-License-Identifier: BSD-3-Clause
"""Compiled loops over posterior draws: which voxels are occupied in which draw, and how far.

One draw of the weights is one possible world. All tables keep the S draws innermost,
so that every loop over them runs on vectors. Distances are in voxels.

Tables (see `vprism_plan.world.posterior_worlds`):
    owner_row (nx, ny, nz) int32: -1 where every draw is free, else a row of `owners`.
    owners (rows, S) uint8: 0 free, k the object class that occupies the voxel in the draw.
    distance_row (g, ex, ey, ez) int32: row of `rows` per contact rule g; FREE beyond the
        reach of anything that any draw occupies, UNBAKED until somebody asks.
    rows (rows, S) uint8: floor(scale * distance to the nearest occupied voxel centre), or
        NOTHING beyond the reach. lowest, highest (rows,): over the draws.
"""

import numpy as np
from numba import njit

FREE = np.int32(-2)
UNBAKED = np.int32(-1)
NOTHING = np.uint8(255)
BLOCK = 16  # edge of the blocks that are drawn and baked at once, voxels
_FAR = np.uint16(40000)  # above any squared distance within reach, and twice that still fits


@njit(cache=True, nogil=True)
def classify(logits, n_draws, n_classes, out):
    """Which object occupies each voxel in each draw: out (n, S), from logits (n, S * K).

    Occupied where 1 - softmax(z)_0 > 1/2, which is sum_{k >= 1} exp(z_k - z_0) > 1; by
    the likeliest object.
    """
    for i in range(logits.shape[0]):
        for s in range(n_draws):
            o = s * n_classes
            empty = logits[i, o]
            best = 1
            for k in range(2, n_classes):
                if logits[i, o + k] > logits[i, o + best]:
                    best = k
            gap = logits[i, o + best] - empty
            occupied = gap > 0.0
            if not occupied and n_classes > 2:
                total = 0.0
                for k in range(1, n_classes):
                    total += np.exp(logits[i, o + k] - empty)
                occupied = total > 1.0
            out[i, s] = best if occupied else 0


@njit(cache=True, nogil=True)
def bake_block(owner_row, owners, counts, cx, cy, cz, reach, lut, wanted, out):
    """Distance from every wanted voxel of a block to the nearest occupied one, per draw.

    Exact Euclidean, one pass per axis over a halo of `reach` voxels.

    owner_row, owners: which draw occupies what; voxels outside the array are free.
    counts (256,): whether an object class counts as occupied.
    cx, cy, cz: first voxel of the block in `owner_row`; may lie outside.
    lut: squared distance to what is stored. wanted (B, B, B): row of `out`, or -1.
    """
    n_draws = owners.shape[1]
    wide = BLOCK + 2 * reach
    along_z = np.empty((wide, wide, BLOCK, n_draws), np.uint16)
    some = np.zeros((wide, wide), np.bool_)
    solid = np.empty(n_draws, np.uint16)
    for i in range(wide):
        x = cx - reach + i
        if x < 0 or x >= owner_row.shape[0]:
            continue
        for j in range(wide):
            y = cy - reach + j
            if y < 0 or y >= owner_row.shape[1]:
                continue
            for z in range(max(cz - reach, 0), min(cz + BLOCK + reach, owner_row.shape[2])):
                row = owner_row[x, y, z]
                if row < 0:
                    continue
                if not some[i, j]:
                    some[i, j] = True
                    along_z[i, j] = _FAR
                for s in range(n_draws):
                    solid[s] = np.uint16(0) if counts[owners[row, s]] else _FAR
                low = max(z - cz - reach, 0)
                high = min(z - cz + reach + 1, BLOCK)
                for k in range(low, high):
                    away = np.uint16((z - cz - k) ** 2)
                    best = along_z[i, j, k]
                    for s in range(n_draws):
                        best[s] = min(best[s], np.uint16(solid[s] + away))
    along_y = np.empty((wide, BLOCK, BLOCK, n_draws), np.uint16)
    any_y = np.zeros(wide, np.bool_)
    for i in range(wide):
        for j in range(wide):
            if some[i, j]:
                if not any_y[i]:
                    any_y[i] = True
                    along_y[i] = _FAR
                for b in range(max(j - 2 * reach, 0), min(j + 1, BLOCK)):
                    away = np.uint16((j - reach - b) ** 2)
                    for k in range(BLOCK):
                        best = along_y[i, b, k]
                        column = along_z[i, j, k]
                        for s in range(n_draws):
                            best[s] = min(best[s], np.uint16(column[s] + away))
    total = np.empty(n_draws, np.uint16)
    for a in range(BLOCK):
        for b in range(BLOCK):
            for k in range(BLOCK):
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


# What a ball may be found to touch: nothing, what `hit` says, everything, or nobody knows yet.
_NOTHING, _SOME, _ALL, _UNKNOWN = 0, 1, 2, -1


@njit(cache=True, nogil=True, inline="always")
def _touch_ball(  # noqa: PLR0911 (each return is a proof)
    gx, gy, gz, ball, table, distance_row, rows, lowest, highest, scale, reach, hit
):  # fmt: skip
    """In which draws a ball touches something; fills hit (S,) only if the answer is `_SOME`.

    gx, gy, gz: centre, in voxels of the table. ball: radius in voxels; every occupied voxel
    counts as the ball inscribed in it.

    A voxel centre x is within b = ball + 1/2 of c only if every node v of the cell around c
    has |v - x| <= b + |c - v|: the draws for which no node proves the contrary touch.
    """
    _, ex, ey, ez = distance_row.shape
    if not (0.0 <= gx <= ex - 1.0 and 0.0 <= gy <= ey - 1.0 and 0.0 <= gz <= ez - 1.0):
        return _NOTHING
    x = min(int(gx), ex - 2)
    y = min(int(gy), ey - 2)
    z = min(int(gz), ez - 2)
    need = ball + 0.5
    # The nearest node answers for most balls.
    nx = int(gx + 0.5)
    ny = int(gy + 0.5)
    nz = int(gz + 0.5)
    row = distance_row[table, nx, ny, nz]
    if row < 0:
        return _UNKNOWN if row == UNBAKED else _NOTHING
    away = need + np.sqrt((gx - nx) ** 2 + (gy - ny) ** 2 + (gz - nz) ** 2)
    if away >= reach:
        return _ALL  # farther than the table knows: never "free"
    if lowest[row] > np.uint8(away * scale):
        return _NOTHING
    every = True
    for corner in range(8):
        i = x + (corner >> 2)
        j = y + ((corner >> 1) & 1)
        k = z + (corner & 1)
        row = distance_row[table, i, j, k]
        if row < 0:
            return _UNKNOWN if row == UNBAKED else _NOTHING
        away = need + np.sqrt((gx - i) ** 2 + (gy - j) ** 2 + (gz - k) ** 2)
        if away >= reach:
            continue
        limit = np.uint8(away * scale)
        if highest[row] <= limit:
            continue
        if lowest[row] > limit:
            return _NOTHING
        values = rows[row]
        if every:
            every = False
            for s in range(hit.size):
                hit[s] = np.uint8(values[s] <= limit)
        else:
            for s in range(hit.size):
                hit[s] &= np.uint8(values[s] <= limit)
    return _ALL if every else _SOME


@njit(cache=True, nogil=True, inline="always")
def _mark_cell(gx, gy, gz, table, distance_row, wanted):
    """Mark the blocks of the unbaked nodes of a cell."""
    _, ex, ey, ez = distance_row.shape
    x = min(int(gx), ex - 2)
    y = min(int(gy), ey - 2)
    z = min(int(gz), ez - 2)
    for corner in range(8):
        i = x + (corner >> 2)
        j = y + ((corner >> 1) & 1)
        k = z + (corner & 1)
        if distance_row[table, i, j, k] == UNBAKED:
            wanted[table, i // BLOCK, j // BLOCK, k // BLOCK] = True


@njit(cache=True, nogil=True)
def touch(
    C, slack, radii, tables, distance_row, rows, lowest, highest, first, spacing, scale, reach,
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
            found = _touch_ball(
                gx, gy, gz, ball, tables[j], distance_row, rows, lowest, highest, scale, reach, hit
            )
            if found == _SOME:
                some = True
                for s in range(n_draws):
                    here[s] |= hit[s]
            elif found == _ALL:
                some = True
                here[:] = 1
            elif found == _UNKNOWN:
                missing += 1
                _mark_cell(gx, gy, gz, tables[j], distance_row, wanted)
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
def touch_one(
    C, radii, tables, distance_row, rows, lowest, highest, first, spacing, scale, reach, touched
):
    """`touch` for one sample C (3, m) without slack: how many draws touch, or -1 if a voxel
    is unbaked. touched (S,) must be zero. Fewer arrays make a quicker call."""
    n_draws = rows.shape[1]
    hit = np.empty(n_draws, np.uint8)
    some = False
    for j in range(C.shape[1]):
        if tables[j] < 0:
            continue
        gx = C[0, j] / spacing - first[0]
        gy = C[1, j] / spacing - first[1]
        gz = C[2, j] / spacing - first[2]
        found = _touch_ball(
            gx, gy, gz, radii[j] / spacing, tables[j], distance_row, rows, lowest, highest, scale,
            reach, hit,
        )  # fmt: skip
        if found == _SOME:
            some = True
            for s in range(n_draws):
                touched[s] |= hit[s]
        elif found == _ALL:
            return n_draws
        elif found == _UNKNOWN:
            return -1
    total = 0
    if some:
        for s in range(n_draws):
            total += touched[s]
    return total


@njit(cache=True, nogil=True)
def touch_each(
    centers, radii, table, distance_row, rows, lowest, highest, first, spacing, scale, reach,
    out, wanted,
):  # fmt: skip
    """out (n, S): in which draws each ball (centers (n, 3), radii (n,)) touches something."""
    hit = np.empty(rows.shape[1], np.uint8)
    missing = 0
    for i in range(centers.shape[0]):
        gx = centers[i, 0] / spacing - first[0]
        gy = centers[i, 1] / spacing - first[1]
        gz = centers[i, 2] / spacing - first[2]
        found = _touch_ball(
            gx, gy, gz, radii[i] / spacing, table, distance_row, rows, lowest, highest, scale,
            reach, hit,
        )  # fmt: skip
        out[i] = found == _ALL
        if found == _SOME:
            for s in range(hit.size):
                out[i, s] = hit[s] != 0
        elif found == _UNKNOWN:
            missing += 1
            _mark_cell(gx, gy, gz, table, distance_row, wanted)
    return missing


@njit(cache=True, nogil=True)
def causes(
    C, slack, radii, tables, first, spacing, first_sample, counts, owner_row, owners,
    sphere, owner,
):  # fmt: skip
    """Which ball touched first in each draw, and whose voxel: sphere (S,), owner (S,).

    Of the balls at the draw's first sample, the one that reaches deepest into the occupied
    voxel nearest to it. counts (g, 256): the classes that count under each table. first (3,)
    is the first voxel of the owners. -1 and 0 where no draw touches. All must be drawn.
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
            x = C[i, 0, j] / spacing - first[0]
            y = C[i, 1, j] / spacing - first[1]
            z = C[i, 2, j] / spacing - first[2]
            ball = (radii[j] + slack[i, j]) / spacing + 0.5
            wide = ball + 2.0  # what the nodes cannot rule out lies beyond by less than this
            for a in range(max(int(x - wide), 0), min(int(x + wide) + 2, nx)):
                for b in range(max(int(y - wide), 0), min(int(y + wide) + 2, ny)):
                    flat = (a - x) ** 2 + (b - y) ** 2
                    if flat > wide * wide:
                        continue
                    for c in range(max(int(z - wide), 0), min(int(z + wide) + 2, nz)):
                        row = owner_row[a, b, c]
                        if row < 0:
                            continue
                        depth = ball - np.sqrt(flat + (c - z) ** 2)
                        if depth < -2.0:
                            continue
                        for s in mine:
                            if depth > deepest[s] and counts[tables[j], owners[row, s]]:
                                deepest[s] = depth
                                sphere[s] = j
                                owner[s] = owners[row, s]


@njit(cache=True, nogil=True)
def volume_codes(C, chosen, radii, tables, codes, origin, spacing, totals):
    """Add the balls' volume to totals (4,) by the code of the space it lies in; 3 is outside.

    C (n, 3, m): only the samples `chosen` count. Seven points per ball.
    """
    nx, ny, nz = codes.shape
    for i in chosen:
        for j in range(C.shape[2]):
            if tables[j] < 0:
                continue
            weight = radii[j] ** 3 / 7.0
            for p in range(7):
                offset = 0.0 if p == 0 else (0.6 if p % 2 else -0.6) * radii[j]
                axis = (p - 1) // 2
                x = int(np.floor((C[i, 0, j] + offset * (axis == 0) - origin[0]) / spacing + 0.5))
                y = int(np.floor((C[i, 1, j] + offset * (axis == 1) - origin[1]) / spacing + 0.5))
                z = int(np.floor((C[i, 2, j] + offset * (axis == 2) - origin[2]) / spacing + 0.5))
                if 0 <= x < nx and 0 <= y < ny and 0 <= z < nz:
                    totals[codes[x, y, z]] += weight
                else:
                    totals[3] += weight
