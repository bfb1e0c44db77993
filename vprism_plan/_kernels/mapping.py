# SPDX-License-Identifier: BSD-3-Clause
"""Compiled inner loops of the map: sampling, sparse features, Gram blocks, predictions.

Symmetric matrices live in an *envelope*: row i of the lower triangle is stored from
its first column to the diagonal, so entry (i, j) is `data[base[i] + j]`, one addition
away. The bias is the last row and column. Every class has hinges and matrices of its own.
Points come in *blocks* of neighbours that share one list of hinges; a hinge out of a point's
reach has the feature value 0 exactly, so a result does not depend on which points share its
block.
"""

import math

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from vprism_plan._kernels.jit import njit

BLOCK = 16  # points per block at most; also the width, padded with zeros, of its features
_LANES = 8  # doubles per vector; two vectors hold a block
_PARTS = BLOCK // _LANES


# ---------------------------------------------------------------- vector loops
# The compiler does not keep accumulators in registers across a loop over array memory,
# which costs a factor of four here. These two loops are therefore spelled out: all
# arguments are addresses and counts, `_ROWS` rows of a matrix are handled per call, and
# each of the 16 points of a block is one vector lane, so no sum depends on its neighbours.
_VECTOR = ir.VectorType(ir.DoubleType(), _LANES)
_ROWS = 4  # rows that share one pass over the features


def _at(builder, address, offset, kind):
    """Pointer of the given type, `offset` doubles after an integer address."""
    size = ir.Constant(offset.type, 8)
    return builder.inttoptr(builder.add(address, builder.mul(offset, size)), kind.as_pointer())


def _load_parts(builder, address, offset):
    parts = []
    for part in range(_PARTS):
        at = builder.add(offset, ir.Constant(offset.type, part * _LANES))
        parts.append(builder.load(_at(builder, address, at, _VECTOR), align=8))
    return parts


def _fused(builder, a, b, c):
    kind = ir.FunctionType(_VECTOR, [_VECTOR] * 3)
    name = f"llvm.fmuladd.v{_LANES}f64"
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), [a, b, c])


def _spread(builder, scalar):
    """Vector with the scalar in every lane."""
    index = ir.Constant(ir.IntType(32), 0)
    one = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), scalar, index)
    mask = ir.Constant(ir.VectorType(ir.IntType(32), _LANES), [0] * _LANES)
    return builder.shuffle_vector(one, one, mask)


def _load_entries(builder, entries, rows, whole):
    """Where each of some rows starts in its matrix, from an array of int64."""
    return [
        builder.load(_at(builder, entries, ir.Constant(whole, row), whole)) for row in range(rows)
    ]


def _make_row_products(rows):
    """out[r, p] = sum_j matrix[entries[r] + own[j]] phi[j, p], first <= j < last."""

    @intrinsic
    def row_products(typingctx, matrix, entries, own, first, last, phi, out):
        def codegen(context, builder, signature, args):
            matrix, entries, own, first, last, phi, out = args
            whole = first.type
            starts = _load_entries(builder, entries, rows, whole)
            before = builder.block
            loop = builder.append_basic_block("row_loop")
            done = builder.append_basic_block("row_done")
            zero = ir.Constant(_VECTOR, [0.0] * _LANES)
            builder.cbranch(builder.icmp_signed("<", first, last), loop, done)
            builder.position_at_end(loop)
            j = builder.phi(whole)
            j.add_incoming(first, before)
            sums = [builder.phi(_VECTOR) for _ in range(rows * _PARTS)]
            column = builder.load(_at(builder, own, j, whole))
            values = _load_parts(builder, phi, builder.mul(j, ir.Constant(whole, BLOCK)))
            updated = []
            for r in range(rows):
                place = builder.add(starts[r], column)
                scalar = builder.load(_at(builder, matrix, place, ir.DoubleType()))
                spread = _spread(builder, scalar)
                for part in range(_PARTS):
                    total = sums[r * _PARTS + part]
                    updated.append(_fused(builder, spread, values[part], total))
            following = builder.add(j, ir.Constant(whole, 1))
            builder.cbranch(builder.icmp_signed("<", following, last), loop, done)
            j.add_incoming(following, loop)
            for total, new in zip(sums, updated, strict=True):
                total.add_incoming(zero, before)
                total.add_incoming(new, loop)
            builder.position_at_end(done)
            results = [builder.phi(_VECTOR) for _ in sums]
            for result, new in zip(results, updated, strict=True):
                result.add_incoming(zero, before)
                result.add_incoming(new, loop)
            for index, result in enumerate(results):
                at = ir.Constant(whole, index * _LANES)
                builder.store(result, _at(builder, out, at, _VECTOR), align=8)
            return context.get_dummy_value()

        return types.void(*[types.intp] * 7), codegen

    return row_products


def _make_gram_products(rows):
    """matrix[entries[r] + own[j]] += sum_p scaled[r, p] phi[j, p], first <= j < last."""

    @intrinsic
    def gram_products(typingctx, matrix, entries, own, first, last, phi, scaled):
        def codegen(context, builder, signature, args):
            matrix, entries, own, first, last, phi, scaled = args
            whole = first.type
            double = ir.DoubleType()
            starts = _load_entries(builder, entries, rows, whole)
            weights = [
                _load_parts(builder, scaled, ir.Constant(whole, r * BLOCK)) for r in range(rows)
            ]
            add_all = cgutils.get_or_insert_function(
                builder.module,
                ir.FunctionType(double, [double, _VECTOR]),
                f"llvm.vector.reduce.fadd.v{_LANES}f64",
            )
            with cgutils.for_range_slice(
                builder, first, last, ir.Constant(whole, 1), intp=whole
            ) as (j, _):
                column = builder.load(_at(builder, own, j, whole))
                values = _load_parts(builder, phi, builder.mul(j, ir.Constant(whole, BLOCK)))
                for r in range(rows):
                    total = builder.fmul(weights[r][0], values[0])
                    for part in range(1, _PARTS):
                        total = _fused(builder, weights[r][part], values[part], total)
                    # "reassoc" lets the lanes be added as a tree: a fixed order all the same.
                    one = builder.call(
                        add_all, [ir.Constant(double, 0.0), total], fastmath=("reassoc",)
                    )
                    place = _at(builder, matrix, builder.add(starts[r], column), double)
                    builder.store(builder.fadd(builder.load(place), one), place)
            return context.get_dummy_value()

        return types.void(*[types.intp] * 7), codegen

    return gram_products


_row_products_4, _row_products_1 = map(_make_row_products, (_ROWS, 1))
_gram_products_4, _gram_products_1 = map(_make_gram_products, (_ROWS, 1))


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


# ---------------------------------------------------------------- blocks of near points
# numpy's sort, searchsorted and assignment of slices take three seconds to compile.
@njit(cache=True, nogil=True, fastmath=False)
def _sort(values, n):
    """Sort the first n values in place (Shell's sort)."""
    gap = 1
    while gap < n // 3:
        gap = 3 * gap + 1
    while gap > 0:
        for i in range(gap, n):
            value = values[i]
            j = i
            while j >= gap and values[j - gap] > value:
                values[j] = values[j - gap]
                j -= gap
            values[j] = value
        gap //= 3


@njit(cache=True, nogil=True, fastmath=False)
def _first_from(values, least):
    """Index of the first of some sorted values that is not below the least."""
    low = 0
    high = len(values)
    while low < high:
        middle = (low + high) // 2
        if values[middle] < least:
            low = middle + 1
        else:
            high = middle
    return low


@njit(cache=True, nogil=True, fastmath=False)
def morton_keys(points, lower, edge):
    """Interleaved bits of every point's cell: points with near keys are near each other."""
    keys = np.empty(len(points), np.int64)
    for p in range(len(points)):
        key = 0
        for a in range(3):
            cell = int((points[p, a] - lower[a]) / edge)
            cell = min(max(cell, 0), 0x1FFFFF)
            # Spread 21 bits, two zeros between each.
            cell = (cell | cell << 32) & 0x1F00000000FFFF
            cell = (cell | cell << 16) & 0x1F0000FF0000FF
            cell = (cell | cell << 8) & 0x100F00F00F00F00F
            cell = (cell | cell << 4) & 0x10C30C30C30C30C3
            cell = (cell | cell << 2) & 0x1249249249249249
            key |= cell << a
        keys[p] = key
    return keys


@njit(cache=True, nogil=True, fastmath=False)
def cut_blocks(points, order, extent):
    """Starts of blocks of at most BLOCK points, none wider than `extent`; ends with n."""
    n = len(order)
    starts = np.empty(n + 1, np.int64)
    count = 0
    lower = np.empty(3)
    upper = np.empty(3)
    begin = 0
    for p in range(n):
        wide = False
        for a in range(3):
            x = points[order[p], a]
            if p > begin:
                wide |= max(upper[a], x) - min(lower[a], x) > extent
        if p == begin or wide or p - begin == BLOCK:
            begin = p
            starts[count] = p
            count += 1
            for a in range(3):
                lower[a] = points[order[p], a]
                upper[a] = lower[a]
        for a in range(3):
            x = points[order[p], a]
            lower[a] = min(lower[a], x)
            upper[a] = max(upper[a], x)
    starts[count] = n
    return starts[: count + 1].copy()


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
    _sort(out, n)
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


_EXP_STEPS = 32
_EXP_LAST = 32 * _EXP_STEPS
_EXP_TABLE = np.exp(-np.arange(_EXP_LAST + 1) / _EXP_STEPS)


@njit(cache=True, nogil=True, fastmath=False)
def _fill_features(points, order, start, stop, hinges, near, n, gamma, reach, phi):
    """phi[u, p] for the hinges `near[:n]`, and row n for the bias; zeros beyond the points.

    exp(-t) is a table entry times a polynomial of degree 6 in the rest |r| <= 1/64, whose
    error is below one rounding; unlike a call of exp, the compiler can vectorise it.
    """
    x = np.full(BLOCK, np.inf)
    y = np.zeros(BLOCK)
    z = np.zeros(BLOCK)
    for p in range(stop - start):
        q = order[start + p]
        x[p] = points[q, 0]
        y[p] = points[q, 1]
        z[p] = points[q, 2]
    table = gamma * reach < _EXP_LAST / _EXP_STEPS
    for u in range(n):
        h = near[u]
        hx = hinges[h, 0]
        hy = hinges[h, 1]
        hz = hinges[h, 2]
        for p in range(BLOCK):
            square = (x[p] - hx) ** 2 + (y[p] - hy) ** 2 + (z[p] - hz) ** 2
            inside = square < reach
            t = gamma * square if inside else 0.0
            if table:
                i = int(t * _EXP_STEPS + 0.5)
                r = i * (1.0 / _EXP_STEPS) - t
                e = 1.0 / 24.0 + r * (1.0 / 120.0 + r * (1.0 / 720.0))
                e = 1.0 + r * (1.0 + r * (0.5 + r * (1.0 / 6.0 + r * e)))
                e *= _EXP_TABLE[i]
            else:
                e = math.exp(-t)
            phi[u, p] = e if inside else 0.0
    for p in range(BLOCK):
        phi[n, p] = 1.0 if p < stop - start else 0.0
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
    near_start, near_out, phi_out,
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
        phi = phi_out[near_start[b] : near_start[b] + n + 1]
        _fill_features(points, order, start, stop, hinges, near, n, gamma, reach, phi)
        for u in range(n + 1):
            near_out[near_start[b] + u] = near[u]


# ---------------------------------------------------------------- learning
@njit(cache=True, nogil=True, fastmath=False)
def gram_rows(block_start, near_start, near, phi_all, weights, row_first, base, lo, hi, out):
    """Add sum_p weights[p] phi_i phi_j to the envelope rows lo..hi.

    Rows are owned by the caller, so threads need no locks and the order of every sum
    is that of the points, whatever the number of threads.
    """
    scaled = np.zeros((_ROWS, BLOCK))
    entries = np.empty(_ROWS, np.int64)
    own_first = np.empty(_ROWS, np.int64)
    to, entry_at, scaled_at = out.ctypes.data, entries.ctypes.data, scaled.ctypes.data
    for b in range(len(block_start) - 1):
        start = block_start[b]
        size = block_start[b + 1] - start
        own = near[near_start[b] : near_start[b + 1]]
        phi = phi_all[near_start[b] : near_start[b + 1]]
        first = _first_from(own, lo)
        last = _first_from(own, hi)
        scaled[:, size:] = 0.0
        columns = own.ctypes.data
        values = phi.ctypes.data
        i = first
        while i < last:
            rows = _ROWS if i + _ROWS <= last else 1
            begin = 0
            for r in range(rows):
                row = own[i + r]
                entries[r] = base[row]
                # Hinges before the envelope are too far apart for any point to see both.
                own_first[r] = _first_from(own, row_first[row])
                begin = max(begin, own_first[r])
                for p in range(size):
                    scaled[r, p] = weights[start + p] * phi[i + r, p]
            begin = i if rows == 1 else min(begin, i)
            if rows > 1:
                _gram_products_4(to, entry_at, columns, begin, i, values, scaled_at)
            # What the rows do not share: entries before `begin`, and their own triangle.
            for r in range(rows):
                one, by = entry_at + 8 * r, scaled_at + 8 * BLOCK * r
                _gram_products_1(to, one, columns, own_first[r], begin, values, by)
                at = max(own_first[r], i)
                _gram_products_1(to, one, columns, at, i + r + 1, values, by)
            i += rows


@njit(cache=True, nogil=True, fastmath=False)
def feature_sums(block_start, near_start, near, phi_all, weights, out):
    """out[h] += sum_p weights[p] phi_h(p)."""
    for b in range(len(block_start) - 1):
        start = block_start[b]
        size = block_start[b + 1] - start
        for u in range(near_start[b], near_start[b + 1]):
            total = 0.0
            for p in range(size):
                total += phi_all[u, p] * weights[start + p]
            out[near[u]] += total


@njit(cache=True, nogil=True, fastmath=False)
def _block_moments(own, phi, mean, cov, row_first, base, partial, m_out, v_out):
    """Mean and variance (BLOCK,) of the logits of one block; `partial` (4, BLOCK) is scratch."""
    entries = np.empty(_ROWS, np.int64)
    m_out[:] = 0.0
    v_out[:] = 0.0
    n = len(own)
    i = 0
    while i < n:
        # The last row, the bias's, reaches farther back than any other.
        rows = _ROWS if i + _ROWS < n else 1
        begin = n
        for r in range(rows):
            row = own[i + r]
            entries[r] = base[row]
            begin = min(begin, _first_from(own, row_first[row]))
        # Of a pair outside the envelope some other finite entry is read: no point sees both
        # hinges, so that it is multiplied by 0 here or below.
        if rows == 1:
            _row_products_1(
                cov.ctypes.data, entries.ctypes.data, own.ctypes.data, begin, i,
                phi.ctypes.data, partial.ctypes.data,
            )  # fmt: skip
        else:
            _row_products_4(
                cov.ctypes.data, entries.ctypes.data, own.ctypes.data, begin, i,
                phi.ctypes.data, partial.ctypes.data,
            )  # fmt: skip
        for r in range(rows):
            row = own[i + r]
            for j in range(i, i + r):
                s = cov[base[row] + own[j]]
                for p in range(BLOCK):
                    partial[r, p] += s * phi[j, p]
            s = cov[base[row] + row]
            w = mean[row]
            for p in range(BLOCK):
                f = phi[i + r, p]
                v_out[p] += f * (s * f + 2.0 * partial[r, p])
                m_out[p] += w * f
        i += rows
    for p in range(BLOCK):
        v_out[p] = max(v_out[p], 0.0)


@njit(cache=True, nogil=True, fastmath=False)
def stored_moments(
    block_start, near_start, near, phi_all, lo, hi, mean, cov, row_first, base, k,
    mean_out, var_out,
):  # fmt: skip
    """Logit moments of class k, column k of (points, K), in blocks lo..hi with stored features."""
    partial = np.empty((_ROWS, BLOCK))
    m = np.empty(BLOCK)
    v = np.empty(BLOCK)
    for b in range(lo, hi):
        start = block_start[b]
        own = near[near_start[b] : near_start[b + 1]]
        phi = phi_all[near_start[b] : near_start[b + 1]]
        _block_moments(own, phi, mean, cov, row_first, base, partial, m, v)
        for p in range(block_start[b + 1] - start):
            mean_out[start + p, k] = m[p]
            var_out[start + p, k] = v[p]


# ---------------------------------------------------------------- prediction
@njit(cache=True, nogil=True, fastmath=False)
def point_moments(
    points, order, block_start, lo, hi, hinges,
    cell_start, cell_items, grid_lower, cell, shape, radius, gamma, reach,
    mean, cov, row_first, base, k, mean_out, var_out, support_out,
):  # fmt: skip
    """Logit moments of class k, and the mass of its kernels, at the points of blocks lo..hi.

    What no hinge of the class reaches is left as it is.
    """
    near = np.empty(len(hinges) + 1, np.int64)
    lower = np.empty(3)
    upper = np.empty(3)
    phi = np.empty((len(hinges) + 1, BLOCK))
    partial = np.empty((_ROWS, BLOCK))
    m = np.empty(BLOCK)
    v = np.empty(BLOCK)
    for b in range(lo, hi):
        start = block_start[b]
        stop = block_start[b + 1]
        _block_box(points, order, start, stop, lower, upper)
        n = _near_box(
            lower, upper, hinges, cell_start, cell_items, grid_lower, cell, shape, radius, near
        )
        if n == 0:
            continue
        _fill_features(points, order, start, stop, hinges, near, n, gamma, reach, phi)
        _block_moments(near[: n + 1], phi, mean, cov, row_first, base, partial, m, v)
        for p in range(stop - start):
            q = order[start + p]
            total = 0.0
            for u in range(n):
                total += phi[u, p]
            support_out[q] = total
            mean_out[q, k] = m[p]
            var_out[q, k] = v[p]


@njit(cache=True, nogil=True, fastmath=False)
def point_jacobians(
    points, lo, hi, hinges,
    cell_start, cell_items, grid_lower, cell, shape, radius, gamma, reach,
    mean, cov, row_first, base, k, mean_out, var_out, support_out,
    mean_grad, var_grad, support_grad,
):  # fmt: skip
    """Moments of class k at the points lo..hi with their gradients: (n, K, 3), (n, K, 3), (n, 3).

    The outputs start as zeros.
    """
    near = np.empty(len(hinges) + 1, np.int64)
    active = np.empty(len(hinges) + 1, np.int64)
    phi = np.empty(len(hinges) + 1)
    slope = np.zeros((len(hinges) + 1, 3))
    product = np.empty(len(hinges) + 1)
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
            row = active[i]
            product[i] = cov[base[row] + row] * phi[i]
            for j in range(i):
                s = cov[base[row] + active[j]]
                product[i] += s * phi[j]
                product[j] += s * phi[i]
        m = 0.0
        v = 0.0
        for i in range(count + 1):
            m += mean[active[i]] * phi[i]
            v += product[i] * phi[i]
            for a in range(3):
                mean_grad[q, k, a] += mean[active[i]] * slope[i, a]
                var_grad[q, k, a] += 2.0 * product[i] * slope[i, a]
        mean_out[q, k] = m
        var_out[q, k] = max(v, 0.0)


@njit(cache=True, nogil=True, fastmath=False)
def _log_scores(mean, var, r, gaps, scores):
    """log q_k of row r, the approximation of Daunizeau before it is normalised.

    With u_ki = (m_k - m_i) / sqrt(1 + pi/8 (v_k + v_i)): q_k = 1 / sum_i exp(-u_ki), where
    the term i = k is the 1. `gaps` (K, K) is scratch.
    """
    K = mean.shape[1]
    largest = 0.0
    for k in range(K):
        gaps[k, k] = 0.0
        for i in range(k):
            spread = math.sqrt(1.0 + math.pi / 8.0 * (var[r, k] + var[r, i]))
            u = (mean[r, i] - mean[r, k]) / spread
            gaps[k, i] = u
            gaps[i, k] = -u
            largest = max(largest, abs(u))
    if largest < 300.0:
        # Far from overflow one exponential serves both signs.
        for k in range(K):
            scores[k] = 1.0
        for k in range(K):
            for i in range(k):
                e = math.exp(gaps[k, i])
                scores[k] += e
                scores[i] += 1.0 / e
        for k in range(K):
            scores[k] = -math.log(scores[k])
        return
    for k in range(K):
        top = gaps[k, 0]
        for i in range(1, K):
            top = max(top, gaps[k, i])
        total = 0.0
        for i in range(K):
            total += math.exp(gaps[k, i] - top)
        scores[k] = -(top + math.log(total))


@njit(cache=True, nogil=True, fastmath=False)
def normalised_log_odds(mean, var, lo, hi, limit, out):
    """log(P(occupied) / P(empty)) of rows lo..hi, cut off at +-limit."""
    K = mean.shape[1]
    scores = np.empty(K)
    gaps = np.empty((K, K))
    for r in range(lo, hi):
        _log_scores(mean, var, r, gaps, scores)
        top = scores[1]
        for k in range(2, K):
            top = max(top, scores[k])
        total = 0.0
        for k in range(1, K):
            total += math.exp(scores[k] - top)
        odds = top + math.log(total) - scores[0]
        out[r] = min(max(odds, -limit), limit)


@njit(cache=True, nogil=True, fastmath=False)
def normalised_log_probabilities(mean, var, lo, hi, out):
    """log P(class) of rows lo..hi; their exponentials sum to 1."""
    K = mean.shape[1]
    scores = np.empty(K)
    gaps = np.empty((K, K))
    for r in range(lo, hi):
        _log_scores(mean, var, r, gaps, scores)
        top = scores[0]
        for k in range(1, K):
            top = max(top, scores[k])
        total = 0.0
        for k in range(K):
            total += math.exp(scores[k] - top)
        for k in range(K):
            out[r, k] = scores[k] - top - math.log(total)


# ---------------------------------------------------------------- envelopes
@njit(cache=True, nogil=True, fastmath=False)
def unpack(data, row_first, base, out):
    """The lower triangle of a matrix into the dense, zeroed `out`."""
    for i in range(len(base)):
        for j in range(row_first[i], i + 1):
            out[i, j] = data[base[i] + j]


@njit(cache=True, nogil=True, fastmath=False)
def pack(dense, row_first, base, data):
    """The lower triangle of `dense` into an envelope."""
    for i in range(len(base)):
        for j in range(row_first[i], i + 1):
            data[base[i] + j] = dense[i, j]


@njit(cache=True, nogil=True, fastmath=False)
def envelope_product(data, row_first, base, vector, out):
    """out = A x."""
    out[:] = 0.0
    for i in range(len(base)):
        for j in range(row_first[i], i):
            value = data[base[i] + j]
            out[i] += value * vector[j]
            out[j] += value * vector[i]
        out[i] += data[base[i] + i] * vector[i]


@njit(cache=True, nogil=True, fastmath=False)
def envelope_inner(a, b, row_first, base):
    """trace(A B) of two symmetric envelopes."""
    total = 0.0
    for i in range(len(base)):
        for j in range(row_first[i], i):
            total += 2.0 * a[base[i] + j] * b[base[i] + j]
        total += a[base[i] + i] * b[base[i] + i]
    return total
