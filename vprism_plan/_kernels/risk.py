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


@njit(cache=True, nogil=True)
def touch(
    C, slack, radii, rules, distance_row, rows, lowest, highest, first, spacing, scale, reach,
    touched, counts, first_sample, wanted,
):  # fmt: skip
    """In which draws a ball of any sample touches something; returns how many voxels are unbaked.

    C (n, 3, m) centres, metres; slack (n, m) metres added to radii (m,); rules (m,) the
    contact rule of each ball, -1 = not checked. first (3,): index of the first voxel.

    A ball about c touches an occupied voxel centre x only if the voxel v nearest to c has
    |v - x| <= r + |c - v|; all voxels for which that holds count.

    touched (S,): the draws that touch anywhere, kept from call to call; counts (n,): draws
    that touch at each sample; first_sample (S,): the sample that made `touched` true.
    wanted (blocks per axis): marked where a voxel is unbaked; counts mean nothing then.
    """
    n_draws = rows.shape[1]
    _, ex, ey, ez = distance_row.shape
    here = np.empty(n_draws, np.uint8)
    missing = 0
    for i in range(C.shape[0]):
        here[:] = 0
        some = False
        for j in range(C.shape[2]):
            rule = rules[j]
            if rule < 0:
                continue
            gx = C[i, 0, j] / spacing - first[0]
            gy = C[i, 1, j] / spacing - first[1]
            gz = C[i, 2, j] / spacing - first[2]
            if not (-0.5 < gx < ex - 0.5 and -0.5 < gy < ey - 0.5 and -0.5 < gz < ez - 0.5):
                continue
            x = int(gx + 0.5)
            y = int(gy + 0.5)
            z = int(gz + 0.5)
            row = distance_row[rule, x, y, z]
            if row < 0:
                if row == UNBAKED:
                    missing += 1
                    wanted[rule, x // BLOCK, y // BLOCK, z // BLOCK] = True
                continue
            need = (radii[j] + slack[i, j]) / spacing
            need += np.sqrt((gx - x) ** 2 + (gy - y) ** 2 + (gz - z) ** 2)
            if need >= reach:
                # Farther than the table knows: never "free".
                here[:] = 1
                some = True
                continue
            limit = np.uint8(need * scale)
            if lowest[row] > limit:
                continue
            some = True
            if highest[row] <= limit:
                here[:] = 1
                continue
            values = rows[row]
            for s in range(n_draws):
                here[s] |= np.uint8(values[s] <= limit)
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
    C, radii, rules, distance_row, rows, lowest, highest, first, spacing, scale, reach, touched
):
    """`touch` for one sample C (3, m) without slack: how many draws touch, or -1 if a voxel
    is unbaked. touched (S,) must be zero. Fewer arrays make a quicker call."""
    _, ex, ey, ez = distance_row.shape
    n_draws = rows.shape[1]
    some = False
    for j in range(C.shape[1]):
        rule = rules[j]
        if rule < 0:
            continue
        gx = C[0, j] / spacing - first[0]
        gy = C[1, j] / spacing - first[1]
        gz = C[2, j] / spacing - first[2]
        if not (-0.5 < gx < ex - 0.5 and -0.5 < gy < ey - 0.5 and -0.5 < gz < ez - 0.5):
            continue
        x = int(gx + 0.5)
        y = int(gy + 0.5)
        z = int(gz + 0.5)
        row = distance_row[rule, x, y, z]
        if row < 0:
            if row == UNBAKED:
                return -1
            continue
        need = radii[j] / spacing
        need += np.sqrt((gx - x) ** 2 + (gy - y) ** 2 + (gz - z) ** 2)
        if need >= reach or highest[row] <= np.uint8(need * scale):
            touched[:] = 1
            return n_draws
        limit = np.uint8(need * scale)
        if lowest[row] > limit:
            continue
        some = True
        values = rows[row]
        for s in range(n_draws):
            touched[s] |= np.uint8(values[s] <= limit)
    total = 0
    if some:
        for s in range(n_draws):
            total += touched[s]
    return total


@njit(cache=True, nogil=True)
def touch_each(
    centers, radii, distance_row, rows, first, spacing, scale, reach, out, wanted
):  # fmt: skip
    """out (n, S): in which draws each ball (centers (n, 3), radii (n,)) touches something."""
    ex, ey, ez = distance_row.shape
    missing = 0
    for i in range(centers.shape[0]):
        out[i] = False
        gx = centers[i, 0] / spacing - first[0]
        gy = centers[i, 1] / spacing - first[1]
        gz = centers[i, 2] / spacing - first[2]
        if not (-0.5 < gx < ex - 0.5 and -0.5 < gy < ey - 0.5 and -0.5 < gz < ez - 0.5):
            continue
        x = int(gx + 0.5)
        y = int(gy + 0.5)
        z = int(gz + 0.5)
        row = distance_row[x, y, z]
        if row == UNBAKED:
            missing += 1
            wanted[x // BLOCK, y // BLOCK, z // BLOCK] = True
        if row < 0:
            continue
        need = radii[i] / spacing + np.sqrt((gx - x) ** 2 + (gy - y) ** 2 + (gz - z) ** 2)
        if need >= reach:
            out[i] = True
            continue
        limit = np.uint8(need * scale)
        for s in range(rows.shape[1]):
            out[i, s] = rows[row, s] <= limit
    return missing


@njit(cache=True, nogil=True)
def _nearest_owner(owner_row, owners, counts, s, x, y, z, low, high):
    """Object class of an occupied voxel of draw s at a distance in [low, high] from a voxel,
    the nearest one; 0 if there is none. Voxels."""
    nx, ny, nz = owner_row.shape
    wide = int(high) + 1
    best = np.inf
    found = 0
    for a in range(max(x - wide, 0), min(x + wide + 1, nx)):
        for b in range(max(y - wide, 0), min(y + wide + 1, ny)):
            flat = (a - x) ** 2 + (b - y) ** 2
            if flat > high * high:
                continue
            for c in range(max(z - wide, 0), min(z + wide + 1, nz)):
                away = flat + (c - z) ** 2
                if low * low <= away < best and away <= high * high:
                    row = owner_row[a, b, c]
                    if row >= 0 and counts[owners[row, s]]:
                        best = away
                        found = owners[row, s]
    return found


@njit(cache=True, nogil=True)
def causes(
    C, slack, radii, rules, distance_row, rows, first, spacing, scale, reach, first_sample,
    counts, owner_row, owners, owner_first, sphere, owner,
):  # fmt: skip
    """Which ball touched first in each draw, and whose voxel: sphere (S,), owner (S,).

    Of the balls that touch at the draw's first sample, the one that reaches deepest into
    what is nearest to it. counts (g, 256): the classes that count under each rule. -1 and
    0 where no draw touches. Everything asked about must be baked.
    """
    _, ex, ey, ez = distance_row.shape
    for s in range(owners.shape[1]):
        sphere[s] = -1
        owner[s] = 0
        i = first_sample[s]
        if i < 0:
            continue
        deepest = -np.inf
        for j in range(C.shape[2]):
            if rules[j] < 0:
                continue
            gx = C[i, 0, j] / spacing - first[0]
            gy = C[i, 1, j] / spacing - first[1]
            gz = C[i, 2, j] / spacing - first[2]
            if not (-0.5 < gx < ex - 0.5 and -0.5 < gy < ey - 0.5 and -0.5 < gz < ez - 0.5):
                continue
            x = int(gx + 0.5)
            y = int(gy + 0.5)
            z = int(gz + 0.5)
            row = distance_row[rules[j], x, y, z]
            if row < 0:
                continue
            need = (radii[j] + slack[i, j]) / spacing
            need += np.sqrt((gx - x) ** 2 + (gy - y) ** 2 + (gz - z) ** 2)
            value = rows[row, s]
            limit = np.uint8(need * scale) if need < reach else NOTHING
            if value > limit or need * scale - value <= deepest:
                continue
            deepest = need * scale - value
            sphere[s] = j
            high = (value + 1) / scale if value != NOTHING else reach
            owner[s] = _nearest_owner(
                owner_row, owners, counts[rules[j]], s,
                x + first[0] - owner_first[0], y + first[1] - owner_first[1],
                z + first[2] - owner_first[2], max(value / scale - 1e-9, 0.0), high,
            )  # fmt: skip


@njit(cache=True, nogil=True)
def volume_codes(C, chosen, radii, rules, codes, origin, spacing, totals):
    """Add the balls' volume to totals (4,) by the code of the space it lies in; 3 is outside.

    C (n, 3, m): only the samples `chosen` count. Seven points per ball.
    """
    nx, ny, nz = codes.shape
    for i in chosen:
        for j in range(C.shape[2]):
            if rules[j] < 0:
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
