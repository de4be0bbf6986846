"""Linear algebra of the filter: small Cholesky factors, whitening, updates by one observed component at a time.

Observations of up to three components are whitened by the Cholesky factor of their covariance, so that their components
are independent with variance 1 and can be taken one by one (Bierman 1977, II.4), each in Joseph's form, which stays
symmetric and positive whatever the rounding.
"""

from __future__ import annotations

import math

from swath.georef.arrays import FloatArray
from swath.georef.compiled import jit_cached, jit_inline


@jit_inline
def factorise(matrix: FloatArray, m: int) -> bool:
    """Replace the first m rows by their lower Cholesky factor; return False, with the rows spoilt, if not positive."""
    for j in range(m):
        for i in range(j, m):
            value = matrix[i, j]
            for k in range(j):
                value -= matrix[i, k] * matrix[j, k]
            if i == j:
                if not value > 0.0:
                    return False
                matrix[j, j] = math.sqrt(value)
            else:
                matrix[i, j] = value / matrix[j, j]
    return True


@jit_inline
def whiten(factor: FloatArray, vector: FloatArray, m: int) -> None:
    """Whiten a vector: vector ← L⁻¹ vector."""
    for i in range(m):
        value = vector[i]
        for k in range(i):
            value -= factor[i, k] * vector[k]
        vector[i] = value / factor[i, i]


@jit_inline
def whiten_rows(factor: FloatArray, rows: FloatArray, m: int) -> None:
    """Whiten rows: rows (m, n) ← L⁻¹ rows."""
    for i in range(m):
        for k in range(i):
            for j in range(rows.shape[1]):
                rows[i, j] -= factor[i, k] * rows[k, j]
        for j in range(rows.shape[1]):
            rows[i, j] /= factor[i, i]


@jit_cached
def innovation_covariance(p: FloatArray, rows: FloatArray, noise: FloatArray, m: int, s: FloatArray) -> None:
    """Compute s ← H P Hᵀ + R of the first m rows; p: (n, n), rows: (3, n), noise, s: (3, 3)."""
    n = len(p)
    for i in range(m):
        for j in range(i + 1):
            s[i, j] = noise[i, j]
        for a in range(n):
            if rows[i, a] != 0.0:
                for j in range(i + 1):
                    value = 0.0
                    for b in range(n):
                        value += p[a, b] * rows[j, b]
                    s[i, j] += rows[i, a] * value
        for j in range(i):
            s[j, i] = s[i, j]


@jit_cached
def take_component(
    p: FloatArray, h: FloatArray, innovation: float, error: FloatArray, gain: FloatArray
) -> tuple[float, float]:
    """Take one observed component of variance 1; P and the error estimate so far change.

    Args:
        p: (n, n).
        h: (n,).
        innovation: before this epoch's components.
        error: (n,) estimate from the components before, added to.
        gain: (n,) is filled.

    Returns:
        The component's innovation and 1, both over the innovation's variance.
    """
    n = len(p)
    variance = 1.0
    rest = innovation
    for i in range(n):
        value = 0.0
        for j in range(n):
            value += p[i, j] * h[j]
        gain[i] = value
        variance += h[i] * value
        rest -= h[i] * error[i]
    for i in range(n):
        gain[i] /= variance
        error[i] += gain[i] * rest
    joseph(p, h, gain, variance)
    return rest / variance, 1.0 / variance


@jit_inline
def joseph(p: FloatArray, h: FloatArray, gain: FloatArray, variance: float) -> None:
    """Update P ← (I − K h) P (I − K h)ᵀ + K Kᵀ, with P hᵀ = K · variance known."""
    n = len(p)
    for i in range(n):
        seen = 0.0  # ((I − K h) P hᵀ)ᵢ
        for j in range(n):
            p[i, j] -= gain[i] * (variance * gain[j])
            seen += p[i, j] * h[j]
        rest = gain[i] - seen
        for j in range(n):
            p[i, j] += rest * gain[j]
    for i in range(n):
        for j in range(i):
            p[i, j] = p[j, i] = 0.5 * (p[i, j] + p[j, i])
