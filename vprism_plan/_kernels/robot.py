# SPDX-License-Identifier: BSD-3-Clause
"""Compiled kinematics: where the frames and the spheres of a packed robot are.

`vprism_plan.collision.packing` fills the layout:

robot floats `rf`, robot integers `ri`:
    ri[0:8]   = n_frames, n_spheres, n_links, n_pairs, dof, 0, 0, 0
    ri[8:16]  = offsets into ri of: frame ints (parent, kind, q index), link ints
                (frame, first sphere, end sphere, rule), pairs (a, b), continuous flags
    ri[16:24] = offsets into rf of: frame floats (R 9, t 3, multiplier, offset), spheres
                (all x, all y, all z, all radii), link bounding spheres (x, y, z,
                radius), limits (lower, upper), reach table (n_frames, n_links), self margin
                and, per pair, the padding of both links, which their gap does not count

Frame 0 is the base; every other frame moves about or along its own z axis. A link's
rule says which of the fields it is checked against; -1: none (it stands on the world).
"""

import numpy as np

from vprism_plan._kernels.jit import njit


@njit(cache=True, nogil=True, inline="always")
def fk_frames(q, rf, ri, T):
    """Fill T (n_frames, 12) with the world pose of every frame: R row-major, then t."""
    n_frames = ri[0]
    fi = ri[8]
    ff = ri[16]
    for k in range(12):
        T[0, k] = rf[ff + k]
    for i in range(1, n_frames):
        p = ri[fi + 3 * i]
        kind = ri[fi + 3 * i + 1]
        o = ff + 14 * i
        value = rf[o + 12] * q[ri[fi + 3 * i + 2]] + rf[o + 13]
        ox = rf[o + 9]
        oy = rf[o + 10]
        oz = rf[o + 11]
        if kind == 1:
            s = np.sin(value)
            c = np.cos(value)
        else:
            s = 0.0
            c = 1.0
        for r in range(3):
            a = T[p, 3 * r]
            b = T[p, 3 * r + 1]
            d = T[p, 3 * r + 2]
            x = a * rf[o] + b * rf[o + 3] + d * rf[o + 6]
            y = a * rf[o + 1] + b * rf[o + 4] + d * rf[o + 7]
            z = a * rf[o + 2] + b * rf[o + 5] + d * rf[o + 8]
            T[i, 3 * r] = c * x + s * y
            T[i, 3 * r + 1] = c * y - s * x
            T[i, 3 * r + 2] = z
            t = T[p, 9 + r] + a * ox + b * oy + d * oz
            if kind == 2:
                t += z * value
            T[i, 9 + r] = t


@njit(cache=True, nogil=True, inline="always")
def place_link(link, T, rf, ri, C):
    """Fill the columns of C (3, n_spheres) that hold a link's world sphere centres."""
    li = ri[9] + 4 * link
    f = ri[li]
    n = ri[1]
    xo = ri[17]
    yo = xo + n
    zo = yo + n
    for row in range(3):
        a = T[f, 3 * row]
        b = T[f, 3 * row + 1]
        c = T[f, 3 * row + 2]
        t = T[f, 9 + row]
        for s in range(ri[li + 1], ri[li + 2]):
            C[row, s] = a * rf[xo + s] + b * rf[yo + s] + c * rf[zo + s] + t


@njit(cache=True, nogil=True)
def place_spheres(q, rf, ri, C):
    """Fill C (3, n_spheres) with world sphere centres: the kinematics twin."""
    T = np.empty((ri[0], 12))
    fk_frames(q, rf, ri, T)
    for link in range(ri[2]):
        place_link(link, T, rf, ri, C)


@njit(cache=True, nogil=True)
def place_spheres_batch(Q, rf, ri, C):
    """Fill C (n, 3, n_spheres) for configurations Q (n, dof)."""
    for n in range(Q.shape[0]):
        place_spheres(Q[n], rf, ri, C[n])
