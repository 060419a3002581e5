"""Cofactors of many epochs: inverses of their normal matrices, laid out by parameter."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.linalg import stacked_inverses
from thermocald.photogrammetry.series.normals import chunks

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array

__all__ = ["among_all", "cofactors"]


def cofactors(N: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Inverse of each matrix (E, p, p), and which could be inverted (E,); the others get units."""
    inverse, good = np.empty(N.shape), np.empty(len(N), dtype=bool)
    for part in chunks(len(N), N.shape[-1] ** 2):
        inverse[part], good[part] = stacked_inverses(N[part])
    return inverse, good


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
