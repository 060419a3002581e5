"""What the distortion of a camera follows while it warms: its angles, or places in the image.

Either is the same number of unknowns. The series are asked before any hypothesis is: camera and, if
that is worth its unknowns, mount move as a straight line in the temperature and some cosines in
time, and the basis that leaves less is the camera's, where the difference is significant.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import EOP
from thermocald.photogrammetry.linalg import unit_diagonal
from thermocald.physics.model import BASES, Distortion, choose_basis

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.thermal.series import ReducedSeries

_ORDERS = 8  # of cosines over a series, with which the camera may move
_MOVING = (np.arange(3), np.r_[0:3, EOP.start : EOP.stop])  # c, x0, y0; with the mount


def choose_distortion(series: Sequence[ReducedSeries]) -> tuple[Distortion, float]:
    """Return what the distortion follows in all series of a camera together, and how sure that is
    in standard deviations.
    """
    sums = {basis: np.sum([_squares(s.in_basis(basis)) for s in series], axis=0) for basis in BASES}
    unknowns = sum(min(_ORDERS, len(s.times) // 4) + 1 for s in series)
    cost = np.minimum(*(sums[b] for b in BASES)) + 2.0 * unknowns * np.array(
        list(map(len, _MOVING))
    )
    moving = int(np.argmin(cost))
    rows = sum(int((s.n > 0).sum()) for s in series)
    free = max(rows * len(series[0].scale) - unknowns * len(_MOVING[moving]), 1)
    noise = max(float(min(sums[b][moving] for b in BASES)) / free, 1.0)
    return choose_basis({b: float(sums[b][moving]) / noise for b in BASES})


def _squares(series: ReducedSeries) -> Array:
    """Return what smooth movement leaves of a series' sum of squares, for either of `_MOVING`."""
    T = series.averaged(series.history.temperature())
    orders = np.arange(1, min(_ORDERS, len(T) // 4) + 1)
    t = (series.times - series.times[0]) / max(float(np.ptp(series.times)), 1e-9)
    smooth = np.column_stack([np.ones(len(t)), T - T.mean(), np.cos(np.pi * np.outer(t, orders))])
    products = smooth[:, :, None] * smooth[:, None, :]
    normal = np.einsum("ekl,epq->kplq", products, series.N, optimize=True)
    right = smooth.T @ series.b
    K, P = right.shape
    found = []
    for moving in _MOVING:
        chosen = np.concatenate([np.arange(P), *(k * P + moving for k in range(1, K))])
        found.append(_explained(normal.reshape(K * P, K * P), right.ravel(), chosen))
    return float(series.yy.sum()) - np.array(found)


def _explained(normal: Array, right: Array, chosen: NDArray[np.int64]) -> float:
    """Return what some unknowns explain."""
    scaled, scale = unit_diagonal(normal[np.ix_(chosen, chosen)])
    rest = right[chosen] * scale
    return float(rest @ np.linalg.lstsq(scaled, rest, rcond=1e-10)[0])
