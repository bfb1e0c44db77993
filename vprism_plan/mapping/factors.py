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
from vprism_plan._threads import run_chunked
from vprism_plan.errors import MapError
from vprism_plan.mapping.features import FeatureSpace

_BLOCK = 96  # hinges per block column: wide enough for fast products, narrow for the envelope
_NOT_POSITIVE = "a posterior precision is not positive definite; lower the prior variance"


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


def dense(space: FeatureSpace, data: Float[np.ndarray, " e"]) -> Float[np.ndarray, "m m"]:
    """Return a symmetric matrix, dense; zeros outside the envelope."""
    lower = _lower(space, data)
    return lower + np.tril(lower, -1).T


def _lower(space: FeatureSpace, data: Float[np.ndarray, " e"]) -> Float[np.ndarray, "m m"]:
    out = np.zeros((space.size, space.size))
    kernels.unpack(data, space.row_first, space.base, out)
    return out


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


def _factor_in_place(matrix: torch.Tensor, columns: list[tuple[int, int, int]]) -> float:
    """Replace a matrix by its Cholesky factor inside the envelope; return the log determinant.

    Only lower triangles count.
    """
    log_determinant = 0.0
    bias = matrix.shape[0] - 1
    for start, stop, reach in columns:
        own, below = slice(start, stop), slice(stop, reach)
        diagonal, info = torch.linalg.cholesky_ex(matrix[own, own])
        if int(info) != 0:
            raise MapError(_NOT_POSITIVE)
        matrix[own, own] = diagonal
        log_determinant += 2.0 * float(torch.log(torch.diagonal(diagonal)).sum())
        panel = torch.cat([matrix[below, own], matrix[bias:, own]])
        panel = torch.linalg.solve_triangular(diagonal.T, panel, upper=True, left=False)
        under, arrow = panel[:-1], panel[-1]
        matrix[below, own], matrix[bias, own] = under, arrow
        for first in range(stop, reach, _BLOCK):  # the lower triangle only
            rows, part = slice(first, reach), slice(first, min(first + _BLOCK, reach))
            matrix[rows, part].addmm_(
                under[first - stop :], under[first - stop : part.stop - stop].T, alpha=-1.0
            )
        matrix[bias, below] -= under @ arrow
        matrix[bias, bias] -= arrow @ arrow
    pivot = float(matrix[bias, bias])
    if not pivot > 0.0:
        raise MapError(_NOT_POSITIVE)
    matrix[bias, bias] = pivot**0.5
    return log_determinant + float(np.log(pivot))


def _solve_in_place(
    factor: torch.Tensor, vectors: torch.Tensor, columns: list[tuple[int, int, int]], halves: int
) -> None:
    """Replace b by the solution of L^T x = b (halves = 1), or of L L^T x = b (halves = 2)."""
    bias = factor.shape[0] - 1
    if halves == 2:
        for start, stop, reach in columns:
            own, below = slice(start, stop), slice(stop, reach)
            solved = torch.linalg.solve_triangular(factor[own, own], vectors[own], upper=False)
            vectors[own] = solved
            vectors[below] -= factor[below, own] @ solved
            vectors[bias:] -= factor[bias:, own] @ solved
        vectors[bias] /= factor[bias, bias]
    vectors[bias] /= factor[bias, bias]
    for start, stop, reach in reversed(columns):
        own, below = slice(start, stop), slice(stop, reach)
        rest = vectors[own] - factor[below, own].T @ vectors[below]
        rest -= factor[bias:, own].T @ vectors[bias:]
        vectors[own] = torch.linalg.solve_triangular(factor[own, own].T, rest, upper=True)


def _invert_in_place(matrix: torch.Tensor, columns: list[tuple[int, int, int]]) -> None:
    """Replace a Cholesky factor by the inverse inside the envelope, both triangles.

    Entries outside the envelope end as garbage.
    """
    bias = matrix.shape[0] - 1
    matrix[bias, bias] = matrix[bias, bias] ** -2
    for start, stop, reach in reversed(columns):
        own, below = slice(start, stop), slice(stop, reach)
        diagonal = matrix[own, own].clone()
        panel = torch.cat([matrix[below, own], matrix[bias:, own]])
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


def inverse(
    space: FeatureSpace, precision: Float[np.ndarray, " e"], information: Float[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " e"], float]:
    """Return mean, covariance and log determinant of a precision; information is precision times
    mean."""
    columns = _block_columns(space)
    matrix = torch.from_numpy(_lower(space, precision))
    log_determinant = _factor_in_place(matrix, columns)
    mean = torch.from_numpy(information.copy())
    _solve_in_place(matrix, mean[:, None], columns, 2)
    _invert_in_place(matrix, columns)
    covariance = np.empty_like(precision)
    kernels.pack(matrix.numpy(), space.row_first, space.base, covariance)
    return mean.numpy(), covariance, log_determinant


def correlate(
    space: FeatureSpace, precision: Float[np.ndarray, " e"], noise: Float[np.ndarray, "m n"]
) -> Float[np.ndarray, "m n"]:
    """Turn white noise into draws with the covariance that belongs to a precision (and mean 0).

    The precision is L L^T, so L^-T noise has the covariance (L L^T)^-1.
    """
    columns = _block_columns(space)
    factor = torch.from_numpy(_lower(space, precision))
    _factor_in_place(factor, columns)
    draws = torch.from_numpy(noise.copy())
    _solve_in_place(factor, draws, columns, 1)
    return draws.numpy()
