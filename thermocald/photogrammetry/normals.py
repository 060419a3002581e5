"""Normal equations of many epochs at one common linearisation point.

A static camera sees the same field in every epoch, so the partial derivatives are one array for the
whole series and each epoch differs only in its weights and residuals. All normal matrices are then
one matrix product: (epochs × targets) · (targets × products of partials). Everything that follows
(series adjustment, filter, discovery) works on these sums.

Source: Luhmann et al. (2014), section 2.4.4; the reduction of common unknowns as Mikhail and
Ackermann (1976), Observations and Least Squares, chapter 10.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.photogrammetry.camera_model import partials, project

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray

    from thermocald.photogrammetry.camera_model import Sensor
    from thermocald.photogrammetry.testfield import Observations, TestField

    Array = NDArray[np.float64]

__all__ = [
    "ObservationGrid",
    "Partials",
    "linearise",
    "normal_matrices",
    "right_hand_sides",
    "same_rows",
    "series_residuals",
    "sums_of_squares",
]

_UPPER = np.triu_indices(16)
_CHUNK = 64  # epochs compared at a time, in the processor's cache
_CHUNK_POINTS = 10_000  # projected at a time, in the processor's cache


@dataclass(frozen=True, eq=False)
class ObservationGrid:
    """The observations of many epochs on one grid of epochs × targets of the test field.

    points (E, T, 2) px, NaN where a target was not observed; weights (E, T, 3) px⁻²: the elements
    xx, yy, xy of each point's inverse covariance, 0 where it was not observed or is rejected.
    """

    points: Array
    weights: Array

    @classmethod
    def from_observations(
        cls, field: TestField, epochs: Sequence[Observations | None]
    ) -> ObservationGrid:
        """Lay the epochs' observations out; an epoch that is None stays empty."""
        points = np.full((len(epochs), len(field), 2), np.nan)
        weights = np.zeros((len(epochs), len(field), 3))
        present = [(e, obs) for e, obs in enumerate(epochs) if obs is not None and len(obs)]
        if present:
            counts = [len(obs) for _, obs in present]
            flat = np.repeat([e * len(field) for e, _ in present], counts)
            flat += np.concatenate([obs.targets for _, obs in present])
            variance = np.concatenate([obs.sigmas for _, obs in present]) ** 2
            points.reshape(-1, 2)[flat] = np.concatenate([obs.points for _, obs in present])
            inverse = np.zeros((len(flat), 3))
            if all(obs.covariances is None for _, obs in present):
                np.divide(1.0, variance, out=inverse[:, :2])
            else:
                xy = np.concatenate(
                    [
                        np.zeros(len(o)) if o.covariances is None else o.covariances
                        for _, o in present
                    ]
                )
                determinant = variance[:, 0] * variance[:, 1] - xy**2
                inverse[:, :2] = variance[:, ::-1] / determinant[:, None]
                inverse[:, 2] = -xy / determinant
            weights.reshape(-1, 3)[flat] = inverse
        return cls(points, weights)

    @property
    def observed(self) -> NDArray[np.bool_]:
        """(E, T): what takes part."""
        return self.weights[..., 0] > 0

    def targets(self, columns: NDArray[np.int64]) -> ObservationGrid:
        """Some of the targets."""
        if len(columns) == self.points.shape[1]:
            return self
        return ObservationGrid(self.points[:, columns], self.weights[:, columns])

    def reject(self, mask: NDArray[np.bool_]) -> ObservationGrid:
        """A copy in which the observations of a mask (E, T) have no weight."""
        weights = self.weights.copy()
        weights[mask] = 0.0
        return ObservationGrid(self.points, weights)


@dataclass(frozen=True, eq=False)
class Partials:
    """The linearisation: iop (10,), eop (6,), predicted (T, 2) px, A (T, 2, 16), B (T, 2, 3)."""

    iop: Array
    eop: Array
    predicted: Array
    A: Array
    B: Array


def linearise(sensor: Sensor, field: TestField, iop: ArrayLike, eop: ArrayLike) -> Partials:
    """The partial derivatives of all targets at one point; targets out of sight get zeros."""
    i, e = np.asarray(iop, dtype=float), np.asarray(eop, dtype=float)
    predicted, A, B = partials(sensor, i, e, field.points)
    seen = np.isfinite(predicted[:, 0])
    A[~seen], B[~seen] = 0.0, 0.0
    return Partials(i, e, predicted, A, B)


def normal_matrices(weights: Array, A: Array) -> Array:
    """Σ Aᵀ P A of every epoch: weights (E, T, 3), A (T, 2, 16) → (E, 16, 16)."""
    E = len(weights)
    k = A.shape[-1]
    rows, columns = _UPPER if k == 16 else np.triu_indices(k)
    ax, ay = A[:, 0], A[:, 1]
    xx, yy = ax[:, rows] * ax[:, columns], ay[:, rows] * ay[:, columns]
    if np.array_equal(weights[..., 0], weights[..., 1]):
        flat = weights[..., 0] @ (xx + yy)
    else:
        flat = weights[..., 0] @ xx + weights[..., 1] @ yy
    if np.any(weights[..., 2]):
        flat += weights[..., 2] @ (ax[:, rows] * ay[:, columns] + ay[:, rows] * ax[:, columns])
    N = np.empty((E, k, k))
    N[:, rows, columns] = flat
    N[:, columns, rows] = flat
    return N


def same_rows(*arrays: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Which rows of arrays (E, ...) are the same: representatives (M,), and whose each is (E,).

    Epochs that see the same targets with the same weights have the same normal matrix.
    """
    E = len(arrays[0])
    flat = [array.reshape(E, -1) for array in arrays]
    rng = np.random.default_rng(0)
    mark = np.sum([part @ rng.random(part.shape[1]) for part in flat], axis=0)
    _, first, of = np.unique(mark, return_index=True, return_inverse=True)
    each = np.arange(E)
    if 2 * len(first) > E:
        return each, each
    for start in range(0, E, _CHUNK):
        rows = slice(start, start + _CHUNK)
        like = first if len(first) == 1 else first[of[rows]]
        if not all(np.all(part[rows] == part[like]) for part in flat):
            return each, each
    return first, of


def right_hand_sides(weights: Array, residuals: Array, A: Array) -> Array:
    """Aᵀ P l (E, k) of every epoch; NaN residuals must have weight 0."""
    Pl = _weighted(weights, residuals)
    b: Array = Pl.reshape(len(Pl), -1) @ A.reshape(-1, A.shape[-1])
    return b


def sums_of_squares(weights: Array, residuals: Array) -> Array:
    """vᵀ P v (E,) of every epoch; NaN residuals must have weight 0."""
    flat = (_weighted(weights, residuals) * residuals).reshape(len(residuals), -1)
    total: Array = flat.sum(axis=1)
    # only where targets were not observed: a look at all of them would cost as much as the sum
    return np.nan_to_num(flat).sum(axis=1) if np.isnan(total).any() else total


def _weighted(weights: Array, residuals: Array) -> Array:
    """P v (E, T, 2) of every point, 0 where the weight is."""
    out = np.empty_like(residuals)
    correlated = np.any(weights[..., 2])
    for k in range(2):
        np.multiply(weights[..., k], residuals[..., k], out=out[..., k])
        if correlated:
            out[..., k] += weights[..., 2] * residuals[..., 1 - k]
    unused = weights[..., 0] == 0
    if unused.any():
        out[unused] = 0.0
    return out


def series_residuals(
    sensor: Sensor, grid: ObservationGrid, field_points: Array, values: Array
) -> Array:
    """Measured minus predicted (E, T, 2) px at each epoch's own parameters (E, 16)."""
    out = np.empty_like(grid.points)
    chunk = max(_CHUNK_POINTS // max(len(field_points), 1), 1)
    for start in range(0, len(values), chunk):
        part = slice(start, start + chunk)
        predicted = project(sensor, values[part, :10], values[part, 10:], field_points)
        np.subtract(grid.points[part], predicted, out=out[part])
    return out
