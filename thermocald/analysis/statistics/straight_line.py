"""A straight line through points whose both coordinates are measured with noise.

Source: York, D.; Evensen, N. M.; López Martínez, M.; De Basabe Delgado, J. (2004): Unified
equations for the slope, intercept, and standard errors of the best straight line. Am. J. Phys. 72,
367-375, for uncorrelated errors. With equal weights this is Deming's line.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from thermocald.arrays import Array

_ITERATIONS = 100
_CONVERGED = 1e-7  # of the slope's standard deviation


@dataclass(frozen=True, slots=True)
class StraightLine:
    """y = intercept + slope·x; the sds hold for the stated sds of the points (not scaled).

    chi2: weighted square sum of the residuals; degrees: n - 2.
    """

    slope: float
    sd_slope: float
    intercept: float
    sd_intercept: float
    chi2: float
    degrees: int

    @property
    def misfit(self) -> float:
        """Scatter over stated sds (1 when they agree)."""
        return float(np.sqrt(self.chi2 / self.degrees)) if self.degrees > 0 else float("nan")


def fit_straight_line(
    x: Array, y: Array, sd_x: ArrayLike, sd_y: ArrayLike, extra_sd_y: float = 0.0
) -> StraightLine:
    """Best straight line through x, y (n,) with standard deviations of both, scalars or (n,).

    extra_sd_y: scatter of y about the line that neither sd explains, added in quadrature. Raises
    ValueError for fewer than 3 points or constant x.
    """
    n = len(x)
    if n < 3 or not np.ptp(x) > 0:
        raise ValueError("a straight line needs three points and x that varies")
    var_x = np.square(np.asarray(sd_x, dtype=float))
    var_y = np.square(np.asarray(sd_y, dtype=float)) + extra_sd_y**2
    # About the means: the intercept far outside the data would cost the digits of the slope.
    mean_x, mean_y = float(np.mean(x)), float(np.mean(y))
    u0, v0 = x - mean_x, y - mean_y
    slope = float(np.dot(u0, v0) / np.dot(u0, u0))
    for _ in range(_ITERATIONS):
        weight = np.broadcast_to(1.0 / (var_y + slope**2 * var_x), x.shape)
        total = float(np.sum(weight))
        xb, yb = float(np.dot(weight, u0)) / total, float(np.dot(weight, v0)) / total
        u, v = u0 - xb, v0 - yb
        beta = u * var_y
        beta += slope * v * var_x
        beta *= weight
        weighted = weight * beta
        previous, slope = slope, float(np.dot(weighted, v) / np.dot(weighted, u))
        del weighted, v  # of a year of epochs every array counts
        u *= u
        if abs(slope - previous) <= _CONVERGED / np.sqrt(float(np.dot(weight, u))):
            break
    del u
    weight = np.broadcast_to(1.0 / (var_y + slope**2 * var_x), x.shape)
    adjusted = beta
    adjusted += xb
    adjusted_mean = float(np.dot(weight, adjusted)) / total
    adjusted -= adjusted_mean
    adjusted *= adjusted
    sd_slope = float(1.0 / np.sqrt(np.dot(weight, adjusted)))
    del adjusted, beta
    at_zero = adjusted_mean + mean_x
    u0 -= xb
    u0 *= slope
    v0 -= yb
    v0 -= u0
    residual = v0
    residual *= residual
    return StraightLine(
        slope,
        sd_slope,
        mean_y + yb - slope * (mean_x + xb),
        float(np.hypot(1 / np.sqrt(total), at_zero * sd_slope)),
        float(np.dot(weight, residual)),
        n - 2,
    )
