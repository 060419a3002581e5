"""The absolute test: does a model leave smooth trajectories in any parameter?

An improvement is not honesty: a flexible surrogate improves M1 and even M2. What tells it from the
cause is what it leaves. Cosines of growing order are offered to every independent combination of
the camera's parameters, under the same covariance as the fit, in each series by itself.

Source: the smooth goodness-of-fit test of Neyman (1937), Skandinavisk Aktuarietidskrift 20,
149-199, in the parameters of the camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.reduction.fit import HypothesisFitter
    from thermocald.reduction.hypothesis import Fit

__all__ = ["Adequacy", "examine"]

ORDERS = 14
# a smooth misfit below this is not worth a name: a tenth of what targets are measured to
NEGLIGIBLE_PX = 0.004


@dataclass(frozen=True, eq=False)
class Adequacy:
    """What a model leaves in one series.

    scores (ORDERS, D): unit normal where nothing is left; amplitudes (ORDERS, P): of the
    trajectories in px-scaled columns, which take the rest up; directions (P, D): combinations of
    px-scaled columns; excess: χ² beyond its expectation; significance: in standard deviations;
    misfit_px: RMS over image coordinates of the smooth rest.
    """

    scores: Array
    amplitudes: Array
    directions: Array
    trajectories: Array
    excess: float
    significance: float
    misfit_px: float

    @property
    def adequate(self) -> bool:
        """Nothing significant is left, or nothing that matters."""
        return self.significance < 6.0 or self.misfit_px < NEGLIGIBLE_PX


def cosines(times: Array, orders: int) -> Array:
    """Smooth trajectories (orders, E) over a series, order 1 being half a wave."""
    u = (times - times[0]) / max(float(times[-1] - times[0]), 1e-9)
    rows: Array = np.cos(np.pi * np.arange(1, orders + 1)[:, None] * u[None])
    rows -= rows.mean(axis=1, keepdims=True)
    return rows


def examine(fitter: HypothesisFitter, fit: Fit, series: int) -> Adequacy:
    """Test one series."""
    evidence, weighting = fitter.series[series], fit.weightings[series]
    C, V, index = fit.designs[series]
    x = fit.coefficients[index]
    size, U = np.linalg.eigh(evidence.N.mean(axis=0))
    keep = size > 1e-4 * np.median(size)
    directions = U[:, keep] / np.sqrt(size[keep])
    trajectories = cosines(evidence.times, ORDERS)
    A, c, B = weighting.scan(trajectories[:, :, None], directions, (C, V))
    rest = c - B @ x
    scores = np.zeros(rest.shape)
    amplitudes = np.zeros((ORDERS, len(directions)))
    for j in range(ORDERS):
        # whitened, so that directions that share the thermometer's error count once
        L = np.linalg.cholesky(A[j] + 1e-9 * np.eye(len(A[j])) * np.trace(A[j]) / len(A[j]))
        scores[j] = np.linalg.solve(L, rest[j])
        amplitudes[j] = directions @ np.linalg.solve(L.T, scores[j])
    total = float(np.sum(scores**2))
    free = scores.size
    excess = max(total - free, 0.0)
    coordinates = 2.0 * float(evidence.n.sum())
    return Adequacy(
        scores,
        amplitudes,
        directions,
        trajectories,
        excess,
        (total - free) / np.sqrt(2.0 * free),
        evidence.sigma_px * float(np.sqrt(excess * evidence.correlation / coordinates)),
    )
