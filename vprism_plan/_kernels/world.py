# SPDX-License-Identifier: BSD-3-Clause
"""Compiled kernels of the world: distance transforms, guesses, visibility, field queries.

Every kernel releases the GIL and works on a slice of preallocated outputs, so a
thread pool can run it in pieces. A kernel calls only kernels of this file.
"""

import math

import numpy as np

from vprism_plan._kernels.jit import njit

# Larger than any squared distance in lattice units that a grid can hold.
FAR = np.int32(2**30)

# What views say of a cell; of several views the smallest code holds. PARTLY: some of it
# may be occluded and the rest unobserved.
FREE, OCCLUDED, PARTLY, UNOBSERVED = np.uint8(0), np.uint8(1), np.uint8(2), np.uint8(3)
# Outside the image, where there is nothing to refine; reaching behind the camera.
_OUTSIDE, _BEHIND = np.uint8(4), np.uint8(5)


# --- Exact distance from a coarse lattice to marked nodes of a finer one ------------
# Felzenszwalb & Huttenlocher, "Distance Transforms of Sampled Functions" (2012): one
# pass per axis, each the lower envelope of parabolas. Sources and targets may lie on
# different lattices: only the evaluation of the envelope knows about the targets.


@njit(cache=True, nogil=True)
def edt_pass_z(labels, first, step, out_d, out_l, start, stop):
    """Squared distance along z from every target to the nearest marked node of its row."""
    ny, nz = labels.shape[1], labels.shape[2]
    nt = out_d.shape[2]
    before = np.empty(nz, np.int64)
    after = np.empty(nz, np.int64)
    for x in range(start, stop):
        for y in range(ny):
            last = -1
            for z in range(nz):
                if labels[x, y, z] != 0:
                    last = z
                before[z] = last
            if last < 0:
                for t in range(nt):
                    out_d[x, y, t] = FAR
                    out_l[x, y, t] = 0
                continue
            nxt = -1
            for z in range(nz - 1, -1, -1):
                if labels[x, y, z] != 0:
                    nxt = z
                after[z] = nxt
            for t in range(nt):
                pos = first + step * t
                at = min(max(pos, 0), nz - 1)
                a, b = before[at], after[at]
                if a < 0 or (b >= 0 and abs(b - pos) < abs(pos - a)):
                    a = b
                out_d[x, y, t] = (pos - a) * (pos - a)
                out_l[x, y, t] = labels[x, y, a]


@njit(cache=True, nogil=True)
def _envelope(column, n, where, bound):
    """Lower envelope of column[q] + (t - q)^2; returns the number of its parabolas."""
    k = -1
    for q in range(n):
        f = column[q]
        if f >= FAR:
            continue
        s = -np.inf
        while k >= 0:
            p = where[k]
            s = ((f + q * q) - (column[p] + p * p)) / (2.0 * (q - p))
            if s > bound[k]:
                break
            k -= 1
        k += 1
        where[k] = q
        bound[k] = s if k > 0 else -np.inf
    return k + 1


@njit(cache=True, nogil=True)
def edt_pass_y(d, labels, first, step, out_d, out_l, start, stop):
    """Add the y axis to the squared distances of `edt_pass_z`."""
    ny, nz = d.shape[1], d.shape[2]
    nt = out_d.shape[1]
    column = np.empty(ny, np.int64)
    where = np.empty(ny, np.int64)
    bound = np.empty(ny, np.float64)
    for x in range(start, stop):
        for z in range(nz):
            for y in range(ny):
                column[y] = d[x, y, z]
            n = _envelope(column, ny, where, bound)
            k = 0
            for t in range(nt):
                if n == 0:
                    out_d[x, t, z] = FAR
                    out_l[x, t, z] = 0
                    continue
                pos = first + step * t
                while k + 1 < n and bound[k + 1] < pos:
                    k += 1
                q = where[k]
                out_d[x, t, z] = column[q] + (pos - q) * (pos - q)
                out_l[x, t, z] = labels[x, q, z]


@njit(cache=True, nogil=True, inline="always")
def _rounded_down(value):
    """The nearest float32 that is not above a value."""
    single = np.float32(value)
    if single > value:
        single = np.nextafter(single, np.float32(-np.inf))
    return single


@njit(cache=True, nogil=True)
def edt_layers(labels, first_y, first_z, step, out_d, out_l, start, stop):
    """Squared distance within each of the layers start..stop, along z and y."""
    d = np.empty((1, labels.shape[1], out_d.shape[2]), np.int32)
    near = np.empty(d.shape, np.uint8)
    for x in range(start, stop):
        own = slice(x, x + 1)
        edt_pass_z(labels[own], first_z, step, d, near, 0, 1)
        edt_pass_y(d, near, first_y, step, out_d[own], out_l[own], 0, 1)


@njit(cache=True, nogil=True)
def edt_pass_x(d, labels, first, step, unit, out_d, out_l, start, stop):
    """Add the x axis to the squared distances of `edt_layers`, and write the distances, rounded
    down, for lattice steps of length `unit`; slices run over y."""
    nx, nz = d.shape[0], d.shape[2]
    nt = out_d.shape[0]
    column = np.empty(nx, np.int64)
    where = np.empty(nx, np.int64)
    bound = np.empty(nx, np.float64)
    for y in range(start, stop):
        for z in range(nz):
            for x in range(nx):
                column[x] = d[x, y, z]
            n = _envelope(column, nx, where, bound)
            k = 0
            for t in range(nt):
                if n == 0:
                    out_d[t, y, z] = np.inf
                    out_l[t, y, z] = 0
                    continue
                pos = first + step * t
                while k + 1 < n and bound[k + 1] < pos:
                    k += 1
                q = where[k]
                out_d[t, y, z] = _rounded_down(unit * math.sqrt(column[q] + (pos - q) * (pos - q)))
                out_l[t, y, z] = labels[q, y, z]


@njit(cache=True, nogil=True)
def round_down(values, out):
    """out (n,) float32: the nearest that is not above each value (n,)."""
    for i in range(values.size):
        out[i] = _rounded_down(values[i])


@njit(cache=True, nogil=True)
def fill_blocks(lattice, starts, labels, size):
    """Write labels[i] into the (size + 1)^3 nodes of the block that begins at starts[i]."""
    for i in range(starts.shape[0]):
        x, y, z = starts[i, 0], starts[i, 1], starts[i, 2]
        lattice[x : x + size + 1, y : y + size + 1, z : z + size + 1] = labels[i]


@njit(cache=True, nogil=True)
def mark_boxes(points, half, origin, spacing, label, lattice):
    """Mark the corners of every cell that the cube points[i] +- half[i] touches."""
    shape = lattice.shape
    for i in range(points.shape[0]):
        lo = np.empty(3, np.int64)
        hi = np.empty(3, np.int64)
        inside = True
        for a in range(3):
            lo[a] = math.floor((points[i, a] - half[i] - origin[a]) / spacing)
            hi[a] = math.floor((points[i, a] + half[i] - origin[a]) / spacing) + 1
            if hi[a] < 0 or lo[a] > shape[a] - 1:
                inside = False
            lo[a] = max(lo[a], 0)
            hi[a] = min(hi[a], shape[a] - 1)
        if not inside:
            continue
        for x in range(lo[0], hi[0] + 1):
            for y in range(lo[1], hi[1] + 1):
                for z in range(lo[2], hi[2] + 1):
                    lattice[x, y, z] = label


@njit(cache=True, nogil=True)
def mark_corners(status, marks, nodes, start, stop):
    """nodes (x + 1, y + 1, z + 1): the largest mark of the cells around each, by the status of
    the cells (x, y, z); in layers start to stop."""
    nx, ny, nz = status.shape
    column = np.zeros(nz + 2, np.uint8)
    for i in range(start, stop):
        for j in range(ny + 1):
            column[:] = 0
            for a in range(max(i - 1, 0), min(i + 1, nx)):
                for b in range(max(j - 1, 0), min(j + 1, ny)):
                    for k in range(nz):
                        column[k + 1] = max(column[k + 1], marks[status[a, b, k]])
            for k in range(nz + 1):
                nodes[i, j, k] = max(column[k], column[k + 1])


@njit(cache=True, nogil=True)
def mark_cells_within(balls, origin, spacing, marked):
    """Mark every cell that lies wholly in one of the balls (x, y, z, radius)."""
    diagonal = 0.5 * math.sqrt(3.0)  # from a cell's middle to its corner, in cells
    shape = marked.shape
    for i in range(balls.shape[0]):
        reach = balls[i, 3] / spacing - diagonal
        if reach < 0.0:
            continue
        lo = np.empty(3, np.int64)
        hi = np.empty(3, np.int64)
        middle = np.empty(3)
        for a in range(3):
            middle[a] = (balls[i, a] - origin[a]) / spacing - 0.5
            lo[a] = min(max(math.ceil(middle[a] - reach), 0), shape[a])
            hi[a] = min(max(math.floor(middle[a] + reach) + 1, 0), shape[a])
        for x in range(lo[0], hi[0]):
            dx = (x - middle[0]) ** 2
            for y in range(lo[1], hi[1]):
                dy = dx + (y - middle[1]) ** 2
                for z in range(lo[2], hi[2]):
                    if dy + (z - middle[2]) ** 2 <= reach * reach:
                        marked[x, y, z] = True


# --- Guesses: grids in places of their own -------------------------------------------


@njit(cache=True, nogil=True, inline="always")
def _along(pose, axis, point):
    """One coordinate of a point (3,) after pose (3, 4)."""
    x, y, z = point[0], point[1], point[2]
    return pose[axis, 0] * x + pose[axis, 1] * y + pose[axis, 2] * z + pose[axis, 3]


@njit(cache=True, nogil=True)
def _trilinear(grid, x, y, z):
    """Value of a grid at an index; its border goes on for ever."""
    nx, ny, nz = grid.shape
    x, y, z = min(max(x, 0.0), nx - 1.0), min(max(y, 0.0), ny - 1.0), min(max(z, 0.0), nz - 1.0)
    i, j, k = int(x), int(y), int(z)
    u, v, w = x - i, y - j, z - k
    a, b, c = min(i + 1, nx - 1), min(j + 1, ny - 1), min(k + 1, nz - 1)
    low = (1.0 - v) * ((1.0 - w) * grid[i, j, k] + w * grid[i, j, c])
    low += v * ((1.0 - w) * grid[i, b, k] + w * grid[i, b, c])
    high = (1.0 - v) * ((1.0 - w) * grid[a, j, k] + w * grid[a, j, c])
    high += v * ((1.0 - w) * grid[a, b, k] + w * grid[a, b, c])
    return (1.0 - u) * low + u * high


@njit(cache=True, nogil=True)
def guesses(points, poses, grids, node_pose, elsewhere, fade, empty, out, start, stop):
    """`PriorField.logits` of the points start..stop: out (n, K); `empty` where nothing is."""
    C, last = len(grids), grids.shape[1] - 1.0
    at = np.empty((C, 3))
    share = np.empty(C)
    for i in range(start, stop):
        covered = 0.0
        for c in range(C):
            inside = np.inf
            for axis in range(3):
                at[c, axis] = _along(poses[c], axis, points[i])
                inside = min(inside, at[c, axis], last - at[c, axis])
            share[c] = min(max(inside / fade, 0.0), 1.0)
            covered = max(covered, share[c])
        x = _along(node_pose, 0, points[i])
        y = _along(node_pose, 1, points[i])
        z = _along(node_pose, 2, points[i])
        other = _trilinear(elsewhere, x, y, z)
        other += covered * (empty - other)
        out[i, 0] = 0.0
        for c in range(C):
            out[i, 1 + c] = other
            if share[c] > 0.0:
                own = _trilinear(grids[c], at[c, 0], at[c, 1], at[c, 2])
                out[i, 1 + c] += share[c] * (own - other)


@njit(cache=True, nogil=True)
def _extremes(grid, pose, center, half, ends):
    """Least and greatest of the nodes around a cube, ends (2,), and how far it reaches into the
    grid from its side, in steps: all of it, and any of it."""
    first = np.empty(3, np.int64)
    final = np.empty(3, np.int64)
    whole, some = np.inf, np.inf
    for axis in range(3):
        last = grid.shape[axis] - 1.0
        at = _along(pose, axis, center)
        reach = half * (abs(pose[axis, 0]) + abs(pose[axis, 1]) + abs(pose[axis, 2]))
        whole = min(whole, at - reach, last - at - reach)
        some = min(some, at + reach, last - at + reach)
        first[axis] = int(min(max(math.floor(at - reach), 0.0), last))
        final[axis] = int(min(max(math.ceil(at + reach), 0.0), last))
    ends[0], ends[1] = np.inf, -np.inf
    for i in range(first[0], final[0] + 1):
        for j in range(first[1], final[1] + 1):
            for k in range(first[2], final[2] + 1):
                ends[0] = min(ends[0], grid[i, j, k])
                ends[1] = max(ends[1], grid[i, j, k])
    return whole, some


@njit(cache=True, nogil=True)
def guess_bounds(
    centers, half, poses, grids, node_pose, elsewhere, fade, empty, low, high, start, stop
):  # fmt: skip
    """Bounds of the objects' logits of `guesses` in cubes: low and high (n, C)."""
    C = len(grids)
    ends = np.empty(2)
    whole, some = np.empty(C), np.empty(C)
    for i in range(start, stop):
        deepest, nearest = -np.inf, -np.inf
        for c in range(C):
            whole[c], some[c] = _extremes(grids[c], poses[c], centers[i], half, ends)
            low[i, c], high[i, c] = ends
            deepest, nearest = max(deepest, whole[c]), max(nearest, some[c])
        _extremes(elsewhere, node_pose, centers[i], half, ends)
        other_low = empty if nearest > 0.0 else ends[0]
        other_high = empty if deepest >= fade else ends[1]
        for c in range(C):
            if some[c] <= 0.0:
                low[i, c], high[i, c] = other_low, other_high
            elif whole[c] < fade:
                low[i, c] = min(low[i, c], other_low)
                high[i, c] = max(high[i, c], other_high)


@njit(cache=True, nogil=True)
def widen(guess, where, low, high, least, most, start, stop):
    """Change log-odds least and most (n, c) by the most that any logit may differ from guess
    (m, K) at where (n, c), if it is anywhere within low and high (n, C)."""
    for i in range(start, stop):
        for c in range(where.shape[1]):
            down, up = -np.inf, -np.inf
            for k in range(low.shape[1]):
                own = guess[where[i, c], 1 + k]
                down, up = max(down, own - low[i, k]), max(up, high[i, k] - own)
            least[i, c] -= down
            most[i, c] += up


# --- Visibility ---------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _window_min(tables, u0, u1, v0, v1):
    """Minimum over rows v0..v1 and columns u0..u1 (inclusive) of the sparse tables."""
    side = min(u1 - u0, v1 - v0) + 1
    k = 0
    while k + 1 < tables.shape[0] and (2 << k) <= side:
        k += 1
    size = 1 << k
    table = tables[k]
    best = np.float32(np.inf)
    v = v0
    while True:
        row = min(v, v1 - size + 1)
        u = u0
        while True:
            column = min(u, u1 - size + 1)
            best = min(best, table[row, column])
            if column == u1 - size + 1:
                break
            u += size
        if row == v1 - size + 1:
            break
        v += size
    return best


@njit(cache=True, nogil=True)
def _span(center, half, near, far):
    """Range of x / z over a box with x in center +- half and z in [near, far]."""
    low = center - half
    high = center + half
    low = low / far if low > 0 else low / near
    high = high / near if high > 0 else high / far
    return low, high


@njit(cache=True, nogil=True)
def _classify(px, py, pz, half, camera, optics, reach, holes):
    """What one view says of the cube (px, py, pz) +- half.

    camera (3, 4): world to camera. optics: fx, fy, cx, cy. reach: sparse minimum
    tables of depth plus tolerance, infinite where there is no return. holes: the
    same with 0 where there is no return and 1 elsewhere.
    """
    x = camera[0, 0] * px + camera[0, 1] * py + camera[0, 2] * pz + camera[0, 3]
    y = camera[1, 0] * px + camera[1, 1] * py + camera[1, 2] * pz + camera[1, 3]
    z = camera[2, 0] * px + camera[2, 1] * py + camera[2, 2] * pz + camera[2, 3]
    hx = half * (abs(camera[0, 0]) + abs(camera[0, 1]) + abs(camera[0, 2]))
    hy = half * (abs(camera[1, 0]) + abs(camera[1, 1]) + abs(camera[1, 2]))
    hz = half * (abs(camera[2, 0]) + abs(camera[2, 1]) + abs(camera[2, 2]))
    near, far = z - hz, z + hz
    if far <= 0.0:
        return _OUTSIDE
    if near <= 1e-6:
        return _BEHIND
    rows, columns = reach.shape[1], reach.shape[2]
    low, high = _span(x, hx, near, far)
    u0 = math.floor(optics[0] * low + optics[2])
    u1 = math.ceil(optics[0] * high + optics[2])
    low, high = _span(y, hy, near, far)
    v0 = math.floor(optics[1] * low + optics[3])
    v1 = math.ceil(optics[1] * high + optics[3])
    if u1 < 0 or v1 < 0 or u0 > columns - 1 or v0 > rows - 1:
        return _OUTSIDE
    complete = u0 >= 0 and v0 >= 0 and u1 < columns and v1 < rows
    u0, v0 = max(u0, 0), max(v0, 0)
    u1, v1 = min(u1, columns - 1), min(v1, rows - 1)
    complete = complete and _window_min(holes, u0, u1, v0, v1) > 0
    if far > _window_min(reach, u0, u1, v0, v1):
        return OCCLUDED if complete else PARTLY
    return FREE if complete else UNOBSERVED


@njit(cache=True, nogil=True)
def classify_cells(origin, spacing, camera, optics, reach, holes, status, start, stop):
    """Lower status to what this view says of each cell.

    Slices run over blocks of 8 cells along x: a block that is wholly free or wholly
    outside the image needs no look at its cells.
    """
    block = 8
    nx, ny, nz = status.shape
    for bx in range(start, stop):
        x0, x1 = bx * block, min((bx + 1) * block, nx)
        for y0 in range(0, ny, block):
            y1 = min(y0 + block, ny)
            for z0 in range(0, nz, block):
                z1 = min(z0 + block, nz)
                side = 0.5 * block * spacing
                code = _classify(
                    origin[0] + spacing * x0 + side,
                    origin[1] + spacing * y0 + side,
                    origin[2] + spacing * z0 + side,
                    side,
                    camera,
                    optics,
                    reach,
                    holes,
                )
                if code == _OUTSIDE:
                    continue
                if code == FREE:
                    status[x0:x1, y0:y1, z0:z1] = FREE
                    continue
                for x in range(x0, x1):
                    for y in range(y0, y1):
                        for z in range(z0, z1):
                            if status[x, y, z] == FREE:
                                continue
                            code = _classify(
                                origin[0] + spacing * (x + 0.5),
                                origin[1] + spacing * (y + 0.5),
                                origin[2] + spacing * (z + 0.5),
                                0.5 * spacing,
                                camera,
                                optics,
                                reach,
                                holes,
                            )
                            status[x, y, z] = min(status[x, y, z], code)


@njit(cache=True, nogil=True)
def classify_points(points, camera, optics, reach, holes, status, start, stop):
    """Lower status to what this view says of each point."""
    for i in range(start, stop):
        code = _classify(
            points[i, 0], points[i, 1], points[i, 2], 0.0, camera, optics, reach, holes
        )
        status[i] = min(status[i], code)


@njit(cache=True, nogil=True)
def clear_below(normal, offset, origin, spacing, status, start, stop):
    """Call every cell that lies wholly under the plane free: the half-space has it."""
    extent = 0.5 * spacing * (abs(normal[0]) + abs(normal[1]) + abs(normal[2]))
    for x in range(start, stop):
        px = normal[0] * (origin[0] + spacing * (x + 0.5))
        for y in range(status.shape[1]):
            py = normal[1] * (origin[1] + spacing * (y + 0.5))
            for z in range(status.shape[2]):
                pz = normal[2] * (origin[2] + spacing * (z + 0.5))
                if px + py + pz + extent <= offset:
                    status[x, y, z] = FREE


# --- Queries ------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _inside_bound(px, py, pz, origin, spacing, distance):
    """Lower bound of the signed distance at a point of the grid box.

    The squared distance to any set, less |x|^2, is a minimum of linear functions,
    hence concave; the trilinear weights write x as a mean of the cell's corners, so
    by Jensen d(x)^2 >= sum_i w_i d_i^2 - sum_i w_i |x_i - x|^2. Where that says
    nothing (next to or inside the set), the signed distance still changes by at
    most the way travelled: d(x) >= d_i - |x - x_i|.
    """
    nx, ny, nz = distance.shape
    gx = (px - origin[0]) / spacing
    gy = (py - origin[1]) / spacing
    gz = (pz - origin[2]) / spacing
    i = min(max(math.floor(gx), 0), nx - 2)
    j = min(max(math.floor(gy), 0), ny - 2)
    k = min(max(math.floor(gz), 0), nz - 2)
    fx, fy, fz = gx - i, gy - j, gz - k
    square = 0.0
    for a in range(2):
        wa = fx if a else 1.0 - fx
        for b in range(2):
            wb = wa * (fy if b else 1.0 - fy)
            for c in range(2):
                d = max(float(distance[i + a, j + b, k + c]), 0.0)
                square += wb * (fz if c else 1.0 - fz) * d * d
    spread = fx * (1.0 - fx) + fy * (1.0 - fy) + fz * (1.0 - fz)
    square -= spread * spacing * spacing
    best = -np.inf
    for a in range(2):
        da = fx - a
        for b in range(2):
            db = fy - b
            for c in range(2):
                dc = fz - c
                way = spacing * math.sqrt(da * da + db * db + dc * dc)
                best = max(best, float(distance[i + a, j + b, k + c]) - way)
    if square > 0.0:
        best = max(best, math.sqrt(square))
    return best


@njit(cache=True, nogil=True)
def lower_bounds(points, origin, spacing, distance, solid, out, start, stop):
    """Lower bound of the signed distance at points anywhere.

    Every obstacle o lies in the grid box. Outside of it, with c the nearest point of
    the box: |x - o|^2 >= |x - c|^2 + |c - o|^2, as for any convex set, hence
    d(x) >= hypot(|x - c|, d(c)). `solid`: everything outside is an obstacle too.
    """
    c = np.empty(3)
    for i in range(start, stop):
        away = 0.0
        for a in range(3):
            p = points[i, a]
            c[a] = min(max(p, origin[a]), origin[a] + spacing * (distance.shape[a] - 1))
            away += (p - c[a]) * (p - c[a])
        if away > 0.0 and solid:
            out[i] = -math.sqrt(away)
            continue
        bound = _inside_bound(c[0], c[1], c[2], origin, spacing, distance)
        if away > 0.0:
            bound = math.sqrt(away + max(bound, 0.0) ** 2)
        # Rounding of the sums above stays far below a nanometre.
        out[i] = bound - 1e-9
