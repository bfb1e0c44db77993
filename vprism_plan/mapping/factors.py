# SPDX-License-Identifier: BSD-3-Clause
"""Cholesky factors of envelope matrices, and the part of the inverse inside the envelope."""

import numpy as np
from jaxtyping import Float
from scipy.linalg import lapack

from vprism_plan._kernels import mapping as kernels
from vprism_plan.errors import MapError
from vprism_plan.mapping.features import FeatureSpace


def dense_class(
    space: FeatureSpace, data: Float[np.ndarray, "e k"], k: int
) -> Float[np.ndarray, "m m"]:
    """Return class k's symmetric matrix as a dense Fortran-ordered array."""
    out = np.empty((space.size, space.size))
    whole = np.array([0, space.size])
    kernels.unpack_block(data, k, space.row_first, space.base, whole, whole, out)
    return out.T


def cholesky(matrix: Float[np.ndarray, "m m"]) -> Float[np.ndarray, "m m"]:
    """Return the lower Cholesky factor; MapError if the matrix is not positive definite."""
    factor, info = lapack.dpotrf(matrix, lower=1, clean=1, overwrite_a=0)
    if info != 0:
        raise MapError(
            f"the posterior precision is not positive definite (pivot {info}); lower the "
            "prior variance"
        )
    return factor


def invert_class(
    space: FeatureSpace,
    precision: Float[np.ndarray, "e k"],
    information: Float[np.ndarray, "m k"],
    k: int,
    mean: Float[np.ndarray, "m k"],
    covariance: Float[np.ndarray, "e k"],
) -> float:
    """Fill column k of `mean` and `covariance` from the precision; return its log determinant."""
    factor = cholesky(dense_class(space, precision, k))
    solution, _ = lapack.dpotrs(factor, information[:, k], lower=1)
    mean[:, k] = solution
    log_determinant = 2.0 * float(np.log(np.diag(factor)).sum())
    inverse, _ = lapack.dpotri(factor, lower=1, overwrite_c=1)
    whole = np.array([0, space.size])
    # dpotri fills the lower triangle of a Fortran array: its transpose is C-ordered, so
    # the copy below is one pass.
    lower = np.ascontiguousarray(inverse)
    kernels.pack_block(lower, k, space.row_first, space.base, whole, whole, covariance)
    return log_determinant
