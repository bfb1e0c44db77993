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
def _stamp(corner, size, plane, first, step, reach, along, out):
    """Lower out (nx, ny, nz) float32, at nodes first + step (i, j, k), to the squared distance from
    what lies in a cell and under its plane, n . (x - corner) <= c; all in lattice steps. along
    (2, nz) is room to work in."""
    lo, hi = np.empty(3, np.int64), np.empty(3, np.int64)
    for a in range(3):
        lo[a] = max(-((first[a] + reach - corner[a]) // step), 0)
        hi[a] = min((corner[a] + size + reach - first[a]) // step + 1, out.shape[a])
    edge, zero = np.float32(size), np.float32(0.0)
    most = np.float32(reach * reach)
    n = max(hi[2] - lo[2], 0)
    beside, under = along[0, :n], along[1, :n]
    for k in range(n):
        z = np.float32(first[2] + step * (lo[2] + k) - corner[2])
        beside[k] = max(-z, z - edge, zero) ** 2
        under[k] = plane[2] * z - plane[3]
    for i in range(lo[0], hi[0]):
        x = np.float32(first[0] + step * i - corner[0])
        dx = max(-x, x - edge, zero) ** 2
        for j in range(lo[1], hi[1]):
            y = np.float32(first[1] + step * j - corner[1])
            d = dx + max(-y, y - edge, zero) ** 2
            if d <= most:
                p = plane[0] * x + plane[1] * y
                row = out[i, j, lo[2] : lo[2] + n]
                for k in range(n):
                    over = p + under[k]
                    over = over if over > zero else zero
                    far = d + beside[k]
                    over *= over
                    far = far if far > over else over
                    row[k] = far if far < row[k] else row[k]


@njit(cache=True, nogil=True)
def stamp_cells(index, size, planes, first, step, reach, out):
    """`_stamp` of cells up to `reach` away."""
    along = np.empty((2, out.shape[2]), np.float32)
    for n in range(len(index)):
        _stamp(index[n], size, planes[n], first, step, reach, along, out)


@njit(cache=True, nogil=True)
def stamp_blocks(index, size, planes, first, step, reach, rows, out):
    """The same for blocks of which each has a row (-1 for none): out (row, n, n, n), where the last
    nodes of a block are the first of the next one."""
    side = step * (out.shape[1] - 1)
    at, lo, hi = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3, np.int64)
    along = np.empty((2, out.shape[3]), np.float32)
    for n in range(len(index)):
        for a in range(3):
            lo[a] = max((index[n, a] - reach - first[a] - 1) // side, 0)
            hi[a] = min((index[n, a] + size + reach - first[a]) // side + 1, rows.shape[a])
        for i in range(lo[0], hi[0]):
            for j in range(lo[1], hi[1]):
                for k in range(lo[2], hi[2]):
                    if rows[i, j, k] >= 0:
                        at[0], at[1], at[2] = i, j, k
                        for a in range(3):
                            at[a] = first[a] + side * at[a]
                        box = out[rows[i, j, k]]
                        _stamp(index[n], size, planes[n], at, step, reach, along, box)


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
def _inside(grid, pose, center, half):
    """How far a cube reaches into a grid from its side, in steps: all of it, and any of it."""
    whole, some = np.inf, np.inf
    for axis in range(3):
        last = grid.shape[axis] - 1.0
        at = _along(pose, axis, center)
        reach = half * (abs(pose[axis, 0]) + abs(pose[axis, 1]) + abs(pose[axis, 2]))
        whole = min(whole, at - reach, last - at - reach)
        some = min(some, at + reach, last - at + reach)
    return whole, some


@njit(cache=True, nogil=True)
def _extremes(grid, pose, center, half):
    """Least and greatest of the nodes around a cube."""
    first = np.empty(3, np.int64)
    final = np.empty(3, np.int64)
    for axis in range(3):
        last = grid.shape[axis] - 1.0
        at = _along(pose, axis, center)
        reach = half * (abs(pose[axis, 0]) + abs(pose[axis, 1]) + abs(pose[axis, 2]))
        first[axis] = int(min(max(math.floor(at - reach), 0.0), last))
        final[axis] = int(min(max(math.ceil(at + reach), 0.0), last))
    low, high = np.inf, -np.inf
    for i in range(first[0], final[0] + 1):
        for j in range(first[1], final[1] + 1):
            for k in range(first[2], final[2] + 1):
                low, high = min(low, grid[i, j, k]), max(high, grid[i, j, k])
    return low, high


@njit(cache=True, nogil=True)
def _around(center, half, poses, grids, node_pose, elsewhere, fade, empty, of, ends):
    """Bounds of what `guesses` are made of in a cube, of each object c: of (C, 4) the least and
    greatest of its own grid, if it reaches into that, and how far all of it and any of it do; ends
    (2,) are those outside of own grids. Returns whether it reaches into any."""
    deepest, nearest = -np.inf, -np.inf
    for c in range(len(grids)):
        of[c, 2], of[c, 3] = _inside(grids[c], poses[c], center, half)
        if of[c, 3] > 0.0:
            of[c, 0], of[c, 1] = _extremes(grids[c], poses[c], center, half)
        deepest, nearest = max(deepest, of[c, 2]), max(nearest, of[c, 3])
    low = high = 0.0
    if deepest < fade:
        low, high = _extremes(elsewhere, node_pose, center, half)
        low, high = low - empty, high - empty
    least = 1.0 - min(max(deepest / fade, 0.0), 1.0)
    most = 1.0 - min(max(nearest / fade, 0.0), 1.0)
    ends[0] = empty + min(least * low, most * low)
    ends[1] = empty + max(least * high, most * high)
    return nearest > 0.0


@njit(cache=True, nogil=True, inline="always")
def _either(of, ends, fade):
    """Bounds of an object's logit, from what `_around` says."""
    if of[3] <= 0.0:
        return ends[0], ends[1]
    if of[2] >= fade:
        return of[0], of[1]
    return min(of[0], ends[0]), max(of[1], ends[1])


@njit(cache=True, nogil=True)
def guess_bounds(
    centers, half, poses, grids, node_pose, elsewhere, fade, empty, low, high, start, stop
):  # fmt: skip
    """Bounds of the objects' logits of `guesses` in cubes: low and high (n, C)."""
    ends, of = np.empty(2), np.empty((len(grids), 4))
    for i in range(start, stop):
        _around(centers[i], half, poses, grids, node_pose, elsewhere, fade, empty, of, ends)
        for c in range(len(grids)):
            low[i, c], high[i, c] = _either(of[c], ends, fade)


@njit(cache=True, nogil=True, inline="always")
def _shared(grid, p, fade, other):
    """Value of a grid at an index p (3,), fading into another value at its sides if `fade` > 0."""
    share = 1.0
    for axis in range(3 if fade > 0.0 else 0):
        share = min(share, p[axis] / fade, (grid.shape[axis] - 1.0 - p[axis]) / fade)
    return other + max(share, 0.0) * (_trilinear(grid, p[0], p[1], p[2]) - other)


@njit(cache=True, nogil=True)
def _off_plane(grid, pose, center, half, fade, other):
    """How far a grid that fades into another value may lie over what is linear between the corners
    of a cube, but for products: of the box around the cube, between whose faces and the nodes'
    planes grids are trilinear and, away from edges, shares linear."""
    at, reach, slope, p = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    knots = np.empty((3, 2 * grid.shape[0] + 4))
    count = np.empty(3, np.int64)
    for axis in range(3):
        at[axis] = _along(pose, axis, center)
        reach[axis] = half * (abs(pose[axis, 0]) + abs(pose[axis, 1]) + abs(pose[axis, 2]))
        knots[axis, 0] = at[axis] - reach[axis]
        n = 1
        for knot in range(math.ceil(knots[axis, 0]), math.ceil(at[axis] + reach[axis])):
            knots[axis, n] = knot
            n += 1
        knots[axis, n] = at[axis] + reach[axis]
        count[axis] = n + 1
    for axis in range(3):
        p[:] = at
        p[axis] = at[axis] + reach[axis]
        above = _shared(grid, p, fade, other)
        p[axis] = at[axis] - reach[axis]
        slope[axis] = (above - _shared(grid, p, fade, other)) / (2.0 * reach[axis])
    least, most = np.inf, -np.inf
    for i in range(count[0]):
        p[0] = knots[0, i]
        for j in range(count[1]):
            p[1] = knots[1, j]
            for k in range(count[2]):
                p[2] = knots[2, k]
                off = _shared(grid, p, fade, other)
                off -= slope[0] * p[0] + slope[1] * p[1] + slope[2] * p[2]
                least, most = min(least, off), max(most, off)
    return most - least


@njit(cache=True, nogil=True)
def _beside_edge(grid, pose, center, half, fade):
    """Whether a cube is where a grid fades towards two of its sides."""
    sides = 0
    for axis in range(3):
        at, last = _along(pose, axis, center), grid.shape[axis] - 1.0
        reach = half * (abs(pose[axis, 0]) + abs(pose[axis, 1]) + abs(pose[axis, 2]))
        if min(at, last - at) - reach < fade:
            sides += 1
    return sides > 1


@njit(cache=True, nogil=True)
def guess_bulges(
    centers, half, poses, grids, node_pose, elsewhere, fade, empty, shares, need, out, start, stop
):  # fmt: skip
    """How far log-odds in a cube may lie over, and under, what is linear between its corners, since
    the logits of `guesses` do: out (n, 2), exact only where more than need (n,). The objects have
    shares (n, C) in what is occupied, and log-odds are the logarithm of a sum over them."""
    C = len(grids)
    ends, of = np.empty(2), np.empty((C, 4))
    least, most = np.empty(C), np.empty(C)
    nodes, at = np.empty((27, 3)), np.empty((27, 1 + C))
    for i in range(start, stop):
        inside = _around(
            centers[i], half, poses, grids, node_pose, elsewhere, fade, empty, of, ends
        )
        total = 0.0
        for c in range(C):
            least[c], most[c] = _either(of[c], ends, fade)
            total += shares[i, c] * math.exp(most[c] - least[c])
        out[i] = math.log(max(total, 1.0))
        if out[i, 0] <= need[i]:
            continue
        known = False
        outside = ends[1] - ends[0]
        if outside > 0.0 and not inside:
            outside = _off_plane(elsewhere, node_pose, centers[i], half, 0.0, 0.0)
        up, down = 0.0, 0.0
        for c in range(C):
            over = under = most[c] - least[c]
            if shares[i, c] * (math.exp(over) - 1.0) > 0.01:
                found = outside
                if of[c, 3] > 0.0:
                    other = 0.5 * (ends[0] + ends[1])
                    found = _off_plane(grids[c], poses[c], centers[i], half, fade, other)
                if of[c, 2] < fade:
                    if not known:
                        known = True
                        for k in range(27):
                            nodes[k, 0] = centers[i, 0] + half * (k // 9 - 1)
                            nodes[k, 1] = centers[i, 1] + half * (k // 3 % 3 - 1)
                            nodes[k, 2] = centers[i, 2] + half * (k % 3 - 1)
                        guesses(nodes, poses, grids, node_pose, elsewhere, fade, empty, at, 0, 27)
                    over, under = most[c] - at[:, 1 + c].min(), at[:, 1 + c].max() - least[c]
                if of[c, 3] > 0.0 and of[c, 2] < fade:
                    low, high = max(of[c, 2], 0.0) / fade, min(of[c, 3] / fade, 1.0)
                    found += (1.0 - low) * (ends[1] - ends[0])
                    found += 0.25 * (high - low) * (of[c, 1] - of[c, 0])
                    if _beside_edge(grids[c], poses[c], centers[i], half, fade):
                        found += (high - low) * max(of[c, 1] - ends[0], ends[1] - of[c, 0])
                over, under = min(over, found), min(under, found)
            up += shares[i, c] * math.exp(over)
            down += shares[i, c] * math.exp(under)
        out[i, 0], out[i, 1] = math.log(max(up, 1.0)), math.log(max(down, 1.0))


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
def _inside_bound(gx, gy, gz, spacing, distance, unit, least):
    """Lower bound of the signed distance at a point g of the grid box, in its steps.

    Distances are in `unit`s of metres; the second rule goes by nodes farther than `least`.
    The squared distance to any set, less |x|^2, is a minimum of linear functions,
    hence concave; the trilinear weights write x as a mean of the cell's corners, so
    by Jensen d(x)^2 >= sum_i w_i d_i^2 - sum_i w_i |x_i - x|^2. Where that says
    nothing (next to or inside the set), the signed distance still changes by at
    most the way travelled: d(x) >= d_i - |x - x_i|.
    """
    nx, ny, nz = distance.shape
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
                d = max(unit * distance[i + a, j + b, k + c], 0.0)
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
                d = unit * distance[i + a, j + b, k + c]
                if d > least:
                    best = max(best, d - way)
    if square > 0.0:
        best = max(best, math.sqrt(square))
    return best


@njit(cache=True, nogil=True)
def lower_bounds(points, origin, spacing, distance, rows, near, unit, solid, out, start, stop):
    """Lower bound of the signed distance at points anywhere.

    Every obstacle o lies in the grid box. Outside of it, with c the nearest point of
    the box: |x - o|^2 >= |x - c|^2 + |c - o|^2, as for any convex set, hence
    d(x) >= hypot(|x - c|, d(c)). `solid`: everything outside is an obstacle too. `near`: distances
    at nodes four times as close, in `unit`s of metres, of blocks of 4 x 4 x 4 cells near a
    surface, `rows` which; 0 also inside, so those say nothing of a depth.
    """
    c = np.empty(3)
    for i in range(start, stop):
        away = 0.0
        for a in range(3):
            p = points[i, a]
            c[a] = min(max(p, origin[a]), origin[a] + spacing * (distance.shape[a] - 1))
            away += (p - c[a]) * (p - c[a])
            c[a] = (c[a] - origin[a]) / spacing
        if away > 0.0 and solid:
            out[i] = -math.sqrt(away)
            continue
        bound = _inside_bound(c[0], c[1], c[2], spacing, distance, 1.0, -np.inf)
        if near.shape[0] > 0:
            x, y, z = int(c[0]) >> 2, int(c[1]) >> 2, int(c[2]) >> 2
            row = rows[x, y, z]
            if row >= 0:
                c *= 4.0
                x, y, z = c[0] - 16 * x, c[1] - 16 * y, c[2] - 16 * z
                fine = _inside_bound(x, y, z, 0.25 * spacing, near[row], unit, 0.0)
                bound = max(bound, fine)
        if away > 0.0:
            bound = math.sqrt(away + max(bound, 0.0) ** 2)
        # Rounding of the sums above stays far below a nanometre.
        out[i] = bound - 1e-9
