"""Targets that a user says have moved: when, and by how much, against the camera of the others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.linalg import inverse_of_determined

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.thermal.series import ReducedSeries

__all__ = ["Moved", "moved_targets"]

_GROSS = 6.0  # standard deviations from the neighbours in time
_WINDOW = 9
_MARGIN = 16.0  # χ² beyond what a search may find by chance


@dataclass(frozen=True, eq=False)
class Moved:
    """time s and its sd; vector (3,) mm with covariance, zeros where nothing moved."""

    time: float
    sd_time: float
    vector: Array
    covariance: Array


def moved_targets(others: ReducedSeries, rows: NDArray[np.int64]) -> Moved:
    """A step of some targets by one vector; others: the series reduced without them.

    What the rays cannot see stays 0 and has no variance.
    """
    grid = others.source.grid
    left = grid.points[:, rows] - others.at.predicted[rows]
    left = left - np.einsum("ek,tik->eti", others.values, others.columns[rows])
    seen = (grid.weights[:, rows, 0] > 0) & (others.n > 0)[:, None]
    left[~seen] = np.nan
    sd = others.sigma_px
    half = _WINDOW // 2
    padded = np.pad(left, ((half, half), (0, 0), (0, 0)), constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, _WINDOW, axis=0)
    some = np.isfinite(windows).any(axis=-1)
    near = np.zeros(left.shape)
    near[some] = np.nanmedian(windows[some], axis=-1)
    seen &= (np.abs(np.nan_to_num(left - near)) < _GROSS * sd).all(axis=2)
    v = np.where(seen[..., None], left, 0.0)
    before = np.cumsum(seen, axis=0)[:-1].astype(float)
    after = seen.sum(axis=0) - before
    sums = np.cumsum(v, axis=0)
    step = (sums[-1] - sums[:-1]) / np.maximum(after, 1)[..., None]
    step = step - sums[:-1] / np.maximum(before, 1)[..., None]
    weight = before * after / np.maximum(before + after, 1) / sd**2
    B = others.at.B[rows]
    N = np.einsum("et,tci,tcj->eij", weight, B, B)
    g = np.einsum("et,tci,etc->ei", weight, B, step)
    vectors = np.einsum("eij,ej->ei", np.linalg.pinv(N, rcond=1e-9, hermitian=True), g)
    gain = np.einsum("ei,ei->e", g, vectors)
    best = int(np.argmax(gain))
    t = others.times
    time, width = 0.5 * (t[best] + t[best + 1]), t[best + 1] - t[best]
    sd_time = float(width / np.sqrt(12.0))
    if gain[best] < 5 * np.log(len(t)) + _MARGIN:
        return Moved(float(time), sd_time, np.zeros(3), np.zeros((3, 3)))
    return Moved(float(time), sd_time, vectors[best], inverse_of_determined(N[best]))
