"""Invert symmetric positive matrices whose rows have units from metres to s²."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.linalg import lapack

from swath.georef.arrays import FloatArray


def scales(matrix: FloatArray) -> FloatArray:
    """Return the factors (n,) of rows and columns that give a unit diagonal."""
    diagonal = np.diag(matrix)
    found: FloatArray = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    return found


def inverted(matrix: FloatArray) -> FloatArray:
    """Return the inverse (n, n), by Cholesky decomposition of the matrix scaled to unit diagonal.

    Raises:
        LinAlgError: the matrix is not positive definite.
    """
    if not len(matrix):
        return matrix
    scale = scales(matrix)
    routines: Any = lapack
    factor, failed = routines.dpotrf(matrix * np.outer(scale, scale), lower=1, clean=1, overwrite_a=1)
    if not failed:
        lower, failed = routines.dpotri(factor, lower=1, overwrite_c=1)
    if failed or not np.isfinite(np.diag(lower)).all():
        raise np.linalg.LinAlgError("not positive definite")
    whole: FloatArray = np.tril(lower, -1)
    whole += whole.T
    whole[np.diag_indices(len(whole))] = np.diag(lower)
    whole *= np.outer(scale, scale)
    return whole
