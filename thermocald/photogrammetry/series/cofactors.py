"""Cofactors: the inverses of normal matrices, of many small ones and of one large."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.series.normals import chunks

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

__all__ = ["among_all", "cofactors", "inverse_of_determined", "root_of"]


def cofactors(N: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Inverse of each matrix (E, p, p), and which could be inverted (E,); the others get units.

    Each is scaled to a unit diagonal before, as the parameters differ by ten orders.
    """
    inverse, good = np.empty(N.shape), np.empty(len(N), dtype=bool)
    for part in chunks(len(N), N.shape[-1] ** 2):
        inverse[part], good[part] = _inverses(N[part])
    return inverse, good


def _inverses(N: Array) -> tuple[Array, NDArray[np.bool_]]:
    p = N.shape[-1]
    diagonal = np.diagonal(N, axis1=1, axis2=2)
    good = np.asarray((diagonal > 0).all(axis=1))
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


def inverse_of_determined(N: Array) -> Array:
    """Inverse of one matrix, by the parameters that it determines."""
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


def root_of(Q: Array) -> Array:
    """A root of a covariance, Q = root · rootᵀ."""
    try:
        triangle: Array = np.linalg.cholesky(Q).astype(np.float64, copy=False)
    except np.linalg.LinAlgError:  # only semi-definite
        values, vectors = np.linalg.eigh(Q)
        triangle = vectors * np.sqrt(np.clip(values, 0.0, None))
    return triangle


def among_all(Q: Array, own: NDArray[np.int64]) -> Array:
    """Matrices (E, p, p) of some parameters as those of all (E, 16, 16), 0 for the others."""
    whole = np.zeros((len(Q), 16, 16))
    runs = np.split(np.arange(len(own)), np.flatnonzero(np.diff(own) > 1) + 1)
    for rows in runs:
        for columns in runs:
            a, b = (
                slice(own[rows[0]], own[rows[-1]] + 1),
                slice(own[columns[0]], own[columns[-1]] + 1),
            )
            whole[:, a, b] = Q[:, rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return whole
