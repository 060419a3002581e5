"""Linear algebra of normal equations whose unknowns differ in scale by many powers of ten.

Every matrix is scaled to a unit diagonal before it is factorised. NumPy only: importing SciPy's
would cost the daemon 20 MB.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array

__all__ = [
    "MAD_TO_SD",
    "correlation_matrix",
    "diagonal_scale",
    "inverse_of_determined",
    "mad_sd",
    "root_of",
    "scaled_inverse",
    "scaled_solve",
    "stacked_inverses",
    "symmetric_power",
]

MAD_TO_SD = 1.4826
"""Median absolute deviation of a normal distribution to its standard deviation."""


def diagonal_scale(N: Array) -> Array:
    """Factors (..., p) that scale matrices (..., p, p) to a unit diagonal; 1 where that is ≤ 0."""
    diagonal = np.diagonal(N, axis1=-2, axis2=-1)
    scale: Array = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    return scale


def scaled_inverse(N: Array) -> Array:
    """Inverse of one symmetric matrix (p, p). Raises numpy.linalg.LinAlgError if singular."""
    scale = diagonal_scale(N)
    both = np.outer(scale, scale)
    inverse: Array = np.linalg.inv(N * both) * both
    return 0.5 * (inverse + inverse.T)


def scaled_solve(N: Array, b: Array, ridge: float = 0.0) -> Array:
    """Solution of N x = b for one or stacked symmetric matrices (..., p, p), b (..., p).

    ridge: added to the unit diagonal, so that undetermined unknowns stay near 0.
    """
    scale = diagonal_scale(N)
    scaled = N * scale[..., :, None] * scale[..., None, :]
    if ridge:
        scaled = scaled + ridge * np.eye(N.shape[-1])
    x: Array = scale * np.linalg.solve(scaled, (scale * b)[..., None])[..., 0]
    return x


def inverse_of_determined(N: Array) -> Array:
    """Inverse of one matrix, restricted to the combinations of unknowns that it determines."""
    if len(N) == 0:
        return N
    scale = 1.0 / np.sqrt(np.clip(np.diag(N), 1e-300, None))
    both = np.outer(scale, scale)
    try:
        factor = np.linalg.cholesky(N * both)
        if factor.diagonal().min() > 1e-6:
            triangle = np.linalg.inv(factor)
            regular: Array = (triangle.T @ triangle) * both
            return regular
    except np.linalg.LinAlgError:
        pass
    inverse: Array = np.linalg.pinv(N * both, rcond=1e-13, hermitian=True) * both
    return inverse


def stacked_inverses(N: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Inverse of each symmetric matrix (E, p, p), and which could be inverted (E,).

    Those that could not are unit matrices.
    """
    p = N.shape[-1]
    diagonal = np.diagonal(N, axis1=1, axis2=2)
    good = np.asarray((diagonal > 0).all(axis=1) & np.isfinite(diagonal).all(axis=1))
    scale = 1.0 / np.sqrt(np.where(good[:, None], diagonal, 1.0))
    both = scale[:, :, None] * scale[:, None, :]
    scaled = N * both
    scaled[~good] = np.eye(p)
    try:
        inverse = np.linalg.inv(scaled)
    except np.linalg.LinAlgError:
        singular = np.linalg.eigvalsh(scaled)[:, 0] < 1e-13
        scaled[singular] = np.eye(p)
        inverse = np.linalg.inv(scaled)
        good &= ~singular
    left = np.diagonal(inverse, axis1=1, axis2=2)
    good &= ((left > 0) & (left < 1e13)).all(axis=1)
    symmetric = np.asarray(inverse + np.swapaxes(inverse, 1, 2), dtype=np.float64)
    symmetric *= both
    symmetric *= 0.5
    symmetric[~good] = np.eye(p)
    return symmetric, good


def root_of(Q: Array) -> Array:
    """A root of a covariance (p, p), Q = root · rootᵀ."""
    try:
        triangle: Array = np.linalg.cholesky(Q).astype(np.float64, copy=False)
    except np.linalg.LinAlgError:  # only semi-definite
        triangle = symmetric_power(Q, 0.5)
    return triangle


def symmetric_power(Q: Array, exponent: float, floor: float = 0.0) -> Array:
    """A power of one symmetric matrix (p, p), its eigenvalues clipped to at least `floor`."""
    values, vectors = np.linalg.eigh(Q)
    power: Array = (vectors * np.clip(values, floor, None) ** exponent) @ vectors.T
    return power


def correlation_matrix(covariance: Array) -> Array:
    """Correlation coefficients (p, p); 0 where a variance is not positive."""
    variance = np.diag(covariance)
    scale = 1.0 / np.sqrt(np.where(variance > 0, variance, np.inf))
    r: Array = covariance * np.outer(scale, scale)
    return r


def mad_sd(values: Array, axis: int | None = None) -> Any:
    """Standard deviation from the median absolute value, NaN ignored, as residuals have mean 0."""
    return MAD_TO_SD * np.nanmedian(np.abs(values), axis=axis)
