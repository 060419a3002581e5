"""Linear algebra of normal equations whose unknowns differ in scale by many powers of ten.

Every matrix is scaled to a unit diagonal before it is factorised. NumPy only: importing SciPy
would cost the daemon 20 MB.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array, Mask


MAD_TO_SD = 1.4826
"""Ratio of a normal distribution's standard deviation to its median absolute deviation."""
MEDIAN_CHI2 = 2.0 * math.log(2.0)
"""Median of χ² with the two degrees of freedom of an image point."""


def median_variance(squares: Array) -> float:
    """Return the variance of unit weight of image points from the median of their squares."""
    return max(float(np.median(squares)) / MEDIAN_CHI2, 1e-12)


def median_known(values: Array, axis: int = 0) -> Array:
    """Return the median along an axis, NaN ignored; NaN where all values are NaN.

    numpy's warning of the latter is avoided: to ignore warnings is not safe between threads.
    """
    ordered = np.sort(values, axis=axis)  # NaN go to the end
    count = (~np.isnan(ordered)).sum(axis=axis, keepdims=True)
    low, high = np.maximum(count - 1, 0) // 2, np.minimum(count // 2, ordered.shape[axis] - 1)
    sides = (np.take_along_axis(ordered, at, axis) for at in (low, high))
    return np.asarray(0.5 * sum(sides)).squeeze(axis)


def unit_diagonal(N: Array, ridge: float = 0.0) -> tuple[Array, Array]:
    """Scale matrices (..., p, p) to a unit diagonal; return them and the factors (..., p).

    ridge: added to the unit diagonal, so that undetermined unknowns stay near 0; an unknown without
    any weight then gets weight 1.
    """
    diagonal = np.diagonal(N, axis1=-2, axis2=-1)
    scale: Array = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    scaled = N * scale[..., :, None] * scale[..., None, :]
    if ridge:
        np.einsum("...ii->...i", scaled)[...] += ridge + (diagonal <= 0)
    return scaled, scale


def scaled_inverse(N: Array, ridge: float = 0.0) -> Array:
    """Invert one symmetric matrix (p, p). Raises numpy.linalg.LinAlgError if singular.

    ridge: as in `unit_diagonal`.
    """
    scaled, scale = unit_diagonal(N, ridge)
    inverse: Array = np.linalg.inv(scaled) * np.outer(scale, scale)
    return 0.5 * (inverse + inverse.T)


def scaled_solve(N: Array, b: Array, ridge: float = 0.0) -> Array:
    """Solve N x = b for one or stacked symmetric matrices (..., p, p), b (..., p) or (..., p, k).

    ridge: as in `unit_diagonal`.
    """
    scaled, scale = unit_diagonal(N, ridge)
    if b.ndim < N.ndim:
        return scale * np.linalg.solve(scaled, (scale * b)[..., None])[..., 0]
    return scale[..., None] * np.linalg.solve(scaled, scale[..., None] * b)


def explained(N: Array, b: Array, ridge: float = 0.0) -> Array:
    """Return the χ² that the unknowns explain: bᵀN⁻¹b, for N and b as in `scaled_solve`."""
    return np.asarray(np.sum(b * scaled_solve(N, b, ridge), axis=-1 if b.ndim < N.ndim else -2))


def eliminate(N: Array, b: Array, kept: int) -> tuple[Array, Array]:
    """Reduce normal equations (p, p), (p,) to their first `kept` unknowns."""
    beside = N[:kept, kept:]
    X = scaled_solve(N[kept:, kept:], np.column_stack([beside.T, b[kept:]]), 1e-12)
    return N[:kept, :kept] - beside @ X[:, :kept], b[:kept] - beside @ X[:, kept]


def orthonormal_combinations(N: Array, least: float = 1e-6) -> tuple[Array, Mask]:
    """Find combinations W (p, p) of unknowns that are orthonormal under a normal matrix N (p, p).

    Returns W and a mask (p,) of the columns that N determines: those whose eigenvalue exceeds
    `least` times the median one.
    """
    size, U = np.linalg.eigh(N)
    good = size > least * np.median(size)
    return U / np.sqrt(np.where(good, size, 1.0)), good


def best_level(N: Array, b: Array) -> Array:
    """Return the values (p,) that fit the normal equations (E, p, p), (E, p) of all epochs best."""
    return np.asarray(np.linalg.lstsq(N.sum(axis=0), b.sum(axis=0), rcond=1e-12)[0])


def subtract_level(N: Array, b: Array) -> Array:
    """Return right-hand sides (E, p) reduced by the epochs' common values (`best_level`)."""
    return b - N @ best_level(N, b)


def inverse_of_determined(N: Array) -> Array:
    """Invert one matrix (p, p) on the combinations of unknowns that it determines."""
    if len(N) == 0:
        return N
    scaled, scale = unit_diagonal(N)
    both = np.outer(scale, scale)
    try:
        factor = np.linalg.cholesky(scaled).astype(np.float64, copy=False)
        if factor.diagonal().min() > 1e-6:
            triangle = _inverse_of_triangle(factor)
            return (triangle.T @ triangle) * both
    except np.linalg.LinAlgError:
        pass
    return np.linalg.pinv(scaled, rcond=1e-13, hermitian=True) * both


def _inverse_of_triangle(L: Array) -> Array:
    """Invert a lower triangle (p, p) by halves, in a quarter of the time of a general inverse."""
    half = len(L) // 2
    if half < 32:
        return np.linalg.inv(L).astype(np.float64, copy=False)
    inverse = np.zeros_like(L)
    upper = inverse[:half, :half] = _inverse_of_triangle(L[:half, :half])
    lower = inverse[half:, half:] = _inverse_of_triangle(L[half:, half:])
    inverse[half:, :half] = -(lower @ L[half:, :half]) @ upper
    return inverse


def inverse_2x2(M: Array) -> Array:
    """Invert matrices (n, 2, 2) in closed form; NumPy's decompositions take ten times as long."""
    a, b, c, d = (M[:, i, k] for i in (0, 1) for k in (0, 1))
    adjugate = np.stack([d, -b, -c, a], axis=1).reshape(-1, 2, 2)
    return adjugate / (a * d - b * c)[:, None, None]


def stacked_inverses(N: Array) -> tuple[Array, Mask]:
    """Invert symmetric matrices (E, p, p); return the inverses and a mask (E,) of the regular ones.

    A singular matrix has the unit matrix as its inverse.
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
    """Return a root (p, p) of a covariance (p, p): Q = root · rootᵀ."""
    try:
        triangle: Array = np.linalg.cholesky(Q).astype(np.float64, copy=False)
    except np.linalg.LinAlgError:  # Q is only semi-definite
        triangle = symmetric_power(Q, 0.5)
    return triangle


def symmetric_power(Q: Array, exponent: float, floor: float = 0.0) -> Array:
    """Return a power of one symmetric matrix (p, p), its eigenvalues raised to at least `floor`."""
    values, vectors = np.linalg.eigh(Q)
    return np.asarray((vectors * np.clip(values, floor, None) ** exponent) @ vectors.T)


def correlations(covariances: Array) -> Array:
    """Return the correlations of covariances (..., p, p); 0 for held parameters, diagonal 1."""
    r, _ = unit_diagonal(covariances)
    np.einsum("...ii->...i", r)[...] = 1.0
    return np.clip(r, -1.0, 1.0)


def rigid_motion(points: Array) -> Array:
    """Return the derivatives (n, 3, 6) of points (n, 3) by shifts, then by rotations."""
    shifts = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    turns = np.swapaxes(np.cross(np.eye(3), points[:, None]), 1, 2)
    return np.concatenate([shifts, turns], axis=2)


def mad_sd(values: NDArray[np.floating[Any]], axis: int | None = None) -> Any:
    """Return a robust standard deviation of residuals, whose mean is 0; NaN is ignored."""
    return MAD_TO_SD * np.nanmedian(np.abs(values), axis=axis)


def chi2_quantile(p: float, dof: float | Array) -> Any:
    """Return the chi-square quantile at probability p, to 4 % for dof ≥ 6.

    By Wilson and Hilferty (1931), as scipy.stats would cost the daemon 22 MB.
    """
    from statistics import NormalDist

    z = NormalDist().inv_cdf(p)
    h = 2.0 / (9.0 * dof)
    return dof * (1.0 - h + z * np.sqrt(h)) ** 3
