# SPDX-License-Identifier: BSD-3-Clause
"""Cholesky factors of envelope matrices, and the part of the inverse inside the envelope.

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
    factor, info = torch.linalg.cholesky_ex(torch.from_numpy(dense_class(space, precision, k)))
    if int(info) != 0:
        raise MapError(
            f"the posterior precision of class {k} is not positive definite (pivot {int(info)}); "
            "lower the prior variance"
        )
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

    # Inverses are packed a group of classes at a time: entries of one envelope position
    # are neighbours in memory, and threads must not write into the same cache lines.
    group = max(1, min(classes, worker_count(), 8))
    for start in range(0, classes, group):
        own = range(start, min(classes, start + group))
        inverses = np.empty((len(own), space.size, space.size))

        def work(index: int, start: int = start, inverses: np.ndarray = inverses) -> None:
            k = start + index
            factor = _cholesky(space, precision, k)
            vector = torch.from_numpy(np.ascontiguousarray(information[:, k]))[:, None]
            mean[:, k] = torch.cholesky_solve(vector, factor)[:, 0].numpy()
            log_determinant[k] = 2.0 * float(torch.log(torch.diagonal(factor)).sum())
            inverses[index] = torch.cholesky_inverse(factor).numpy()

        run_per_class(work, len(own))
        kernels.pack(inverses, start, space.row_first, space.base, covariance)
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
