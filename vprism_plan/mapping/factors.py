# SPDX-License-Identifier: BSD-3-Clause
"""Cholesky factors of envelope matrices, and the part of the inverse inside the envelope.

A factor stays inside the envelope, and so does all of the inverse that is ever asked
for: products of features of one point. Both are computed block column by block column
(right-looking Cholesky down, Takahashi's recurrence up), with the bias as an arrow, for
about 2 M b^2 multiply-adds with b the mean width of the envelope, where dense factor and
inverse take M^3 / 2.

Classes are independent, so each is factorised by one thread with a single-threaded
LAPACK (torch's). A LAPACK that splits one factorisation over threads spins on its
barriers: on two busy cores that was measured 100 times slower for 1200 hinges.
"""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float

from vprism_plan._kernels import mapping as kernels
from vprism_plan._threads import run_chunked, worker_count
from vprism_plan.errors import MapError
from vprism_plan.mapping.features import FeatureSpace

_BLOCK = 128  # hinges per block column: wide enough for fast products, narrow for the envelope
_NOT_POSITIVE = (
    "the posterior precision of class {} is not positive definite; lower the prior variance"
)


def run_per_class(work: Callable[[int], None], classes: int) -> None:
    """Call `work(k)` for every class, in threads in which torch uses one thread each."""
    before = torch.get_num_threads()

    def chunk(piece: slice) -> None:
        torch.set_num_threads(1)
        for k in range(piece.start, piece.stop):
            work(k)

    try:
        run_chunked(chunk, classes, 1)
    finally:
        torch.set_num_threads(before)


def dense_class(
    space: FeatureSpace, data: Float[np.ndarray, "e k"], k: int
) -> Float[np.ndarray, "m m"]:
    """Return class k's symmetric matrix, dense; zeros outside the envelope."""
    out = np.zeros((space.size, space.size))
    kernels.unpack(data, k, space.row_first, space.base, out)
    return out


def _cholesky(space: FeatureSpace, precision: Float[np.ndarray, "e k"], k: int) -> torch.Tensor:
    return _factor_block(torch.from_numpy(dense_class(space, precision, k)), k)


def _block_columns(space: FeatureSpace) -> list[tuple[int, int, int]]:
    """Cut the hinges into block columns (start, stop, reach).

    Rows stop..reach are all that couple to the column's hinges, the bias aside.
    """
    hinges = space.size - 1
    # A row reaches back at least as far as every later row does, so that the rows under
    # a block are one range; sorted hinges make this nearly true as they are.
    first = np.minimum.accumulate(space.row_first[:hinges][::-1])[::-1]
    columns = []
    for start in range(0, hinges, _BLOCK):
        stop = min(start + _BLOCK, hinges)
        columns.append((start, stop, max(stop, int(np.searchsorted(first, stop)))))
    return columns


def _invert_in_place(
    matrix: torch.Tensor, vector: torch.Tensor, columns: list[tuple[int, int, int]], k: int
) -> float:
    """Replace a matrix by its inverse inside the envelope, and b by the solution of A x = b.

    Both triangles are given and returned; entries outside the envelope end as garbage.
    Returns the log determinant.
    """
    log_determinant = 0.0
    bias = matrix.shape[0] - 1
    for start, stop, reach in columns:
        own, below = slice(start, stop), slice(stop, reach)
        diagonal = _factor_block(matrix[own, own], k)
        matrix[own, own] = diagonal
        log_determinant += 2.0 * float(torch.log(torch.diagonal(diagonal)).sum())
        panel = torch.cat([matrix[below, own], matrix[bias:, own]])
        panel = torch.linalg.solve_triangular(diagonal.T, panel, upper=True, left=False)
        under, arrow = panel[:-1], panel[-1]
        matrix[below, own], matrix[bias, own] = under, arrow
        matrix[below, below].addmm_(under, under.T, alpha=-1.0)
        matrix[below, bias] -= under @ arrow
        matrix[bias, below] = matrix[below, bias]
        matrix[bias, bias] -= arrow @ arrow
        solved = torch.linalg.solve_triangular(diagonal, vector[own, None], upper=False)[:, 0]
        vector[own] = solved
        vector[below] -= under @ solved
        vector[bias] -= arrow @ solved
    pivot = float(matrix[bias, bias])
    if not pivot > 0.0:
        raise MapError(_NOT_POSITIVE.format(k))
    matrix[bias, bias] = 1.0 / pivot
    vector[bias] /= pivot
    for start, stop, reach in reversed(columns):
        own, below = slice(start, stop), slice(stop, reach)
        diagonal, under, arrow = matrix[own, own].clone(), matrix[below, own], matrix[bias, own]
        rest = vector[own] - under.T @ vector[below] - arrow * vector[bias]
        vector[own] = torch.linalg.solve_triangular(diagonal.T, rest[:, None], upper=True)[:, 0]
        panel = torch.cat([under, arrow[None]])
        panel = torch.linalg.solve_triangular(diagonal, panel, upper=False, left=False)
        under, arrow = panel[:-1], panel[-1:]
        # Z_Rj = -Z_RR X, Z_jj = (L L^T)^-1 - X^T Z_Rj, with the bias as one more row of R.
        inverse = torch.addmm(
            torch.outer(matrix[below, bias], arrow[0]), matrix[below, below], under
        ).neg_()
        to_bias = -(matrix[bias:, below] @ under + matrix[bias, bias] * arrow)
        block = torch.cholesky_inverse(diagonal) - under.T @ inverse - arrow.T @ to_bias
        matrix[own, own] = 0.5 * (block + block.T)
        matrix[below, own], matrix[own, below] = inverse, inverse.T
        matrix[bias, own] = matrix[own, bias] = to_bias[0]
    return log_determinant + float(np.log(pivot))


def _factor_block(block: torch.Tensor, k: int) -> torch.Tensor:
    factor, info = torch.linalg.cholesky_ex(block)
    if int(info) != 0:
        raise MapError(_NOT_POSITIVE.format(k))
    return factor


def invert_classes(
    space: FeatureSpace,
    precision: Float[np.ndarray, "e k"],
    information: Float[np.ndarray, "m k"],
    mean: Float[np.ndarray, "m k"],
    covariance: Float[np.ndarray, "e k"],
) -> Float[np.ndarray, " k"]:
    """Fill `mean` and `covariance` from precision and information (precision times mean).

    Returns the log determinants of the precision. Holds one dense inverse per worker.
    """
    classes = mean.shape[1]
    log_determinant = np.empty(classes)
    columns = _block_columns(space)
    # Inverses are packed a group of classes at a time: entries of one envelope position
    # are neighbours in memory, and threads must not write into the same cache lines.
    group = max(1, min(classes, worker_count(), 8))
    inverses = np.empty((group, space.size, space.size))
    for start in range(0, classes, group):
        count = min(classes, start + group) - start

        def work(index: int, start: int = start) -> None:
            k = start + index
            inverses[index] = 0.0
            kernels.unpack(precision, k, space.row_first, space.base, inverses[index])
            matrix = torch.from_numpy(inverses[index])
            vector = torch.from_numpy(information[:, k].copy())
            log_determinant[k] = _invert_in_place(matrix, vector, columns, k)
            mean[:, k] = vector.numpy()

        run_per_class(work, count)
        kernels.pack(inverses[:count], start, space.row_first, space.base, covariance)
    return log_determinant


def correlate(
    space: FeatureSpace,
    precision: Float[np.ndarray, "e k"],
    k: int,
    noise: Float[np.ndarray, "m n"],
) -> Float[np.ndarray, "m n"]:
    """Turn white noise into draws with class k's posterior covariance (and mean 0).

    The precision is L L^T, so L^-T noise has the covariance (L L^T)^-1.
    """
    out = np.empty_like(noise)

    def work(_: int) -> None:
        factor = _cholesky(space, precision, k)
        solution = torch.linalg.solve_triangular(factor.T, torch.from_numpy(noise), upper=True)
        out[:] = solution.numpy()

    run_per_class(work, 1)
    return out
