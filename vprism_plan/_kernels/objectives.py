# SPDX-License-Identifier: BSD-3-Clause
"""Compiled loops behind planners' objectives: what a robot risks along a straight motion.

Coarser than the kernels that verdicts rest on (`risk`), and never milder: an objective is
asked about hundreds of motions where a checker is asked about one. Most of a motion is far from
anything uncertain and is passed over in strides.

The robot (`rf`, `ri`) is packed as in `vprism_plan._kernels.robot`, the draws' tables are those of
`vprism_plan._kernels.risk`.
"""

import numpy as np

from vprism_plan._kernels.checking import MAX_TURN, motion_rates, turned_by
from vprism_plan._kernels.jit import njit
from vprism_plan._kernels.risk import mark_ball, touch_ball
from vprism_plan._kernels.robot import fk_frames


@njit(cache=True, nogil=True)
def plan_steps(qa, qb, rf, ri, spacing, delta, link_rate):
    """Fill delta (dof,), qb - qa, and link_rate as `motion_rates` does.

    Returns the number of steps, so that in one no centre moves more than `spacing` and the
    joints turn by at most half a radian together; the largest of the rates; the whole turn.
    """
    delta[:] = qb - qa
    motion_rates(delta, rf, ri, link_rate, np.empty(ri[3]))
    turned = turned_by(delta, rf, ri)
    farthest = 0.0
    for link in range(ri[2]):
        farthest = max(farthest, link_rate[link])
    steps = max(int(np.ceil(farthest / spacing)), int(np.ceil(turned / MAX_TURN)))
    return steps, farthest, turned


@njit(cache=True, nogil=True, inline="always")
def _voxel(T, f, x, y, z, spacing):
    """A point of a frame in the world, voxels."""
    return (
        (T[f, 0] * x + T[f, 1] * y + T[f, 2] * z + T[f, 9]) / spacing,
        (T[f, 3] * x + T[f, 4] * y + T[f, 5] * z + T[f, 10]) / spacing,
        (T[f, 6] * x + T[f, 7] * y + T[f, 8] * z + T[f, 11]) / spacing,
    )


@njit(cache=True, nogil=True, inline="always")
def _away(gx, gy, gz, possible, corner):
    """Lower bound of the distance from a point to anything uncertain, voxels.

    possible (x, y, z): distances at voxel centres from index `corner` on. Everything
    uncertain lies inside that box, so a point outside is at least as far as its projection.
    """
    gx = min(max(gx - corner[0], 0.0), possible.shape[0] - 1.0)
    gy = min(max(gy - corner[1], 0.0), possible.shape[1] - 1.0)
    gz = min(max(gz - corner[2], 0.0), possible.shape[2] - 1.0)
    x, y, z = int(gx + 0.5), int(gy + 0.5), int(gz + 0.5)
    off = np.sqrt((gx - x) ** 2 + (gy - y) ** 2 + (gz - z) ** 2)
    return possible[x, y, z] - off


@njit(cache=True, nogil=True)
def _read_field(gx, gy, gz, ball, field, corner, directions, peak):
    """Mean, or largest, value of a field at some points of a ball (voxels), 0 outside it."""
    nx, ny, nz = field.shape
    result = 0.0
    for d in range(directions.shape[0]):
        x = int(np.floor(gx - corner[0] + ball * directions[d, 0] + 0.5))
        y = int(np.floor(gy - corner[1] + ball * directions[d, 1] + 0.5))
        z = int(np.floor(gz - corner[2] + ball * directions[d, 2] + 0.5))
        if 0 <= x < nx and 0 <= y < ny and 0 <= z < nz:
            value = field[x, y, z]
            result = max(result, value) if peak else result + value
    return result if peak else result / directions.shape[0]


@njit(cache=True, nogil=True)
def sweep_draws(
    qa, delta, steps, link_rate, turned, rf, ri, radii, tables, possible, corner, spacing,
    distance_row, rows, lowest, first, scale, reach, counts, touched, wanted,
):  # fmt: skip
    """Upper bounds of the draws that a straight motion touches: counts (steps + 1,) at each
    sample, touched (S,) anywhere on it. Returns how many balls met an unbaked voxel.

    radii (m,) metres; tables (m,) the table of each sphere, -1 = not checked; possible,
    corner: see `_away`; spacing: edge of a voxel, metres. Spheres grow by what covers the
    way to the neighbouring samples, as in `checking.place_path`. wanted: the blocks to bake;
    the rest means nothing where something is missing.
    """
    n_draws = rows.shape[1]
    T = np.empty((ri[0], 12))
    q = np.empty(ri[4])
    here = np.empty(n_draws, np.uint8)
    hit, sure = np.empty(n_draws, np.uint8), np.empty(n_draws, np.uint8)
    touched[:] = 0
    counts[:] = 0
    missing = 0
    ns = ri[1]
    parts = max(steps, 1)
    k = 0
    while k <= steps:
        for j in range(ri[4]):
            q[j] = qa[j] + (k / parts) * delta[j]
        fk_frames(q, rf, ri, T)
        here[:] = 0
        stride = parts + 1.0
        for link in range(ri[2]):
            li = ri[9] + 4 * link
            begin = ri[li + 1]
            end = ri[li + 2]
            if begin == end or tables[begin] < 0:
                continue
            step = link_rate[link] / parts
            bend = 0.25 * (turned / parts) * step
            f = ri[li]
            bo = ri[18] + 4 * link
            # The bounding sphere first, then sphere by sphere.
            gx, gy, gz = _voxel(T, f, rf[bo], rf[bo + 1], rf[bo + 2], spacing)
            grown = bend + 0.5 * step
            clear = _away(gx, gy, gz, possible, corner) - (rf[bo + 3] + grown) / spacing - 1.0
            if clear <= 2.0:
                clear = 1e9
                for s in range(begin, end):
                    x, y, z = rf[ri[17] + s], rf[ri[17] + ns + s], rf[ri[17] + 2 * ns + s]
                    gx, gy, gz = _voxel(T, f, x, y, z, spacing)
                    r = radii[s]
                    ball = (np.sqrt(r * r + 0.25 * step * step) + bend) / spacing
                    free = _away(gx, gy, gz, possible, corner) - ball - 1.0
                    clear = min(clear, free)
                    if free > 0.0:
                        continue
                    gx, gy, gz = gx - first[0], gy - first[1], gz - first[2]
                    found = touch_ball(
                        gx, gy, gz, ball, tables[s], distance_row, rows, lowest, scale, reach,
                        hit, sure,
                    )  # fmt: skip
                    if found < 0:
                        missing += 1
                        mark_ball(gx, gy, gz, ball, tables[s], wanted)
                    elif found > 0:
                        for w in range(n_draws):
                            here[w] |= hit[w]
            if clear <= 0.0:
                stride = 0.0
            elif clear * spacing < stride * step:
                stride = clear * spacing / step
        if stride < 1.0:
            total = 0
            for s in range(n_draws):
                total += here[s]
                touched[s] |= here[s]
            counts[k] = total
        k += max(int(stride), 1)
    return missing


@njit(cache=True, nogil=True)
def sweep_field(
    qa, delta, steps, link_rate, rf, ri, radii, weights, possible, corner, spacing,
    field, field_corner, directions, peak, values,
):  # fmt: skip
    """Fill values (steps + 1,): at each sample of a straight motion the weighted sum, over the
    spheres, of a field's mean (or peak) in the sphere.

    weights (m,), 0 = left out; field (nx, ny, nz) at voxel centres from index field_corner
    on; directions (d, 3) points of the unit ball. The rest as in `sweep_draws`.
    """
    T = np.empty((ri[0], 12))
    q = np.empty(ri[4])
    values[:] = 0.0
    ns = ri[1]
    parts = max(steps, 1)
    k = 0
    while k <= steps:
        for j in range(ri[4]):
            q[j] = qa[j] + (k / parts) * delta[j]
        fk_frames(q, rf, ri, T)
        total = 0.0
        stride = parts + 1.0
        for link in range(ri[2]):
            li = ri[9] + 4 * link
            begin = ri[li + 1]
            end = ri[li + 2]
            if begin == end or weights[begin] == 0.0:
                continue
            f = ri[li]
            clear = 1e9
            for s in range(begin, end):
                x, y, z = rf[ri[17] + s], rf[ri[17] + ns + s], rf[ri[17] + 2 * ns + s]
                gx, gy, gz = _voxel(T, f, x, y, z, spacing)
                ball = radii[s] / spacing
                free = _away(gx, gy, gz, possible, corner) - ball - 0.87
                clear = min(clear, free)
                if free <= 0.0:
                    total += weights[s] * _read_field(
                        gx, gy, gz, ball, field, field_corner, directions, peak
                    )
            step = link_rate[link] / parts
            if clear <= 0.0:
                stride = 0.0
            elif clear * spacing < stride * step:
                stride = clear * spacing / step
        values[k] = total
        k += max(int(stride), 1)
