"""The level of a thermal model: its interior orientation at T₀ and each series' orientation.

The drifts say nothing of it and are taken off: every target's mean over a series, compared with
the model's projection, is adjusted for the interior orientation that all series share and one
exterior orientation of each. The affinity is held, as it can hardly be separated from the rest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera.camera_model import (
    IOP_NAMES,
    ExteriorOrientation,
    InteriorOrientation,
    project,
)
from thermocald.photogrammetry.linalg import inverse_of_determined
from thermocald.photogrammetry.series.normals import chunks, linearise

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.physics.model import Prediction, ThermalModel
    from thermocald.thermal.series import ReducedSeries

__all__ = ["FREE_INTERIOR", "Level", "estimate_level", "series_means"]

FREE_INTERIOR = ("c", "x0", "y0", "A1", "A2", "A3", "B1", "B2")
"""The interior orientation at T₀ that is estimated; the affinity is held."""

_FREE = [IOP_NAMES.index(n) for n in FREE_INTERIOR]
_ITERATIONS = 8


@dataclass(frozen=True, eq=False)
class Level:
    """interior at T₀, exteriors of the series; field (8 + 6 S, 8 + 6 S): the covariance that the
    test field's coordinates give them, in the order FREE_INTERIOR, then EOP_NAMES of each series.
    """

    interior: InteriorOrientation
    exteriors: tuple[ExteriorOrientation, ...]
    field: Array


def series_means(
    series: ReducedSeries, prediction: Prediction
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Weighted mean of measured minus predicted (T, 2) px, its weights (T, 2), who moved (T,).

    Of targets that move, what was before counts.
    """
    T = len(series.source.field)
    total, weight = np.zeros((T, 2)), np.zeros((T, 2))
    moved = np.zeros(T, dtype=bool)
    use = series.weights[..., :2]
    for d in prediction.displacements:
        moved[d.rows] = True
        if d.active.any():
            use = use.copy()
            use[np.ix_(d.active, d.rows)] = 0.0
    points = series.source.grid.points
    for part in chunks(*points.shape[:2]):
        w = use[part]
        left = np.where(w > 0, points[part] - projected(series, prediction, part), 0.0)
        total += np.einsum("etc,etc->tc", w, left)
        weight += w.sum(axis=0)
    return total / np.where(weight > 0, weight, 1.0), weight, moved


def projected(series: ReducedSeries, prediction: Prediction, part: slice) -> Array:
    """The model's image points (e, T, 2) px of some epochs."""
    still = series.source.field.points
    points = prediction.points(still, part) if prediction.moves_points else still
    return project(series.source.sensor, prediction.iop[part], prediction.eop[part], points)


def estimate_level(
    series: Sequence[ReducedSeries], models: Sequence[ThermalModel], interior: bool = True
) -> Level:
    """Gauss-Newton on the targets' means; models: one per series, with a start.

    interior: whether the interior orientation is estimated too, or the series' orientation alone.
    """
    n = len(_FREE) if interior else 0
    shared = models[0].interior.as_array()
    eops = []
    for m in models:
        assert m.exterior is not None
        eops.append(m.exterior.as_array())
    size = n + 6 * len(series)
    field = series[0].source.field
    inverse, lever = np.zeros((size, size)), np.zeros((size, field.points.size))
    for _ in range(_ITERATIONS):
        M, g = np.zeros((size, size)), np.zeros(size)
        lever[:] = 0.0
        for k, (s, m) in enumerate(zip(series, models, strict=True)):
            now = replace(
                m,
                interior=InteriorOrientation.from_array(shared),
                exterior=ExteriorOrientation.from_array(eops[k]),
            )
            prediction = now.predict(s.history, s.source.field)
            mean, weight, _ = series_means(s, prediction)
            at = linearise(s.source.sensor, s.source.field, prediction.iop.mean(axis=0), eops[k])
            columns = np.concatenate([np.arange(n), n + 6 * k + np.arange(6)])
            A = at.A[:, :, [*(_FREE if interior else []), *range(10, 16)]]
            PA = A * weight[..., None]
            M[np.ix_(columns, columns)] += np.einsum("tci,tcj->ij", PA, A)
            g[columns] += np.einsum("tci,tc->i", PA, mean)
            lever[columns] += np.einsum("tci,tcx->itx", PA, at.B).reshape(len(columns), -1)
        inverse = inverse_of_determined(M)
        step = inverse @ g
        shared[_FREE[:n]] += step[:n]
        eops = [e + d for e, d in zip(eops, step[n:].reshape(-1, 6), strict=True)]
        if step @ M @ step < 1e-4:  # a hundredth of a standard deviation
            break
    moved = inverse @ (lever * field.sigmas.ravel())
    return Level(
        InteriorOrientation.from_array(shared),
        tuple(ExteriorOrientation.from_array(e) for e in eops),
        moved @ moved.T,
    )
