"""How a parameter depends on the temperature: correlation, its significance, and the slope.

Pearson's r with the t-test as the reference has it (Elias et al. 2020, section 4.3), which counts
every epoch as independent, and alongside it a test that holds for noise with a memory. The slope is
fitted with the thermometer's noise counted. p-values are corrected for the number of parameters by
Holm's method.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.statistics.autocorrelation import slope_noise
from thermocald.analysis.statistics.noise_models import (
    MODELS,
    Frequencies,
    largest_p_value,
)
from thermocald.analysis.statistics.straight_line import fit_straight_line

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.arrays import Array, Mask

_LEAST_EFFECTIVE = 3.0
_CHANCE = 0.01
_UNUSUAL = 3.0  # times the median sd of an epoch
_FEW = 30  # epochs: fewer do not show their own noise


@dataclass(frozen=True, slots=True)
class Dependence:
    """One parameter against one temperature; slope in parameter units per K.

    p_naive counts all n epochs as independent; p_value holds whatever the autocorrelation of the
    noise; n_effective: independent values that the epochs are worth; sd_slope holds thermometer
    noise, the adjustments' sds, scatter beyond both and autocorrelation; misfit: scatter over what
    the two noises explain; too_short: the noise remembers so much of the series that sd_slope is an
    order of magnitude only.
    """

    n: int
    r: float
    p_naive: float
    n_effective: float
    lag_one: float
    p_value: float
    slope: float
    sd_slope: float
    misfit: float
    too_short: bool = False


def pearson_p_value(r: float, n: float) -> float:
    """Two-sided p-value of Pearson's r by the t-test with n - 2 degrees of freedom."""
    from scipy.stats import t

    if n < _LEAST_EFFECTIVE:
        return 1.0
    if abs(r) >= 1.0:
        return 0.0
    return float(2 * t.sf(abs(r) * np.sqrt((n - 2) / (1 - r * r)), n - 2))


def slope_p_value(values: Array, temperature: Array, times: Array | None = None) -> float:
    """Two-sided p-value of no linear dependence, whatever the memory of the noise.

    times (n,): evenly spaced by default. The t-test of the slope by generalised least squares, its
    largest p-value over the noise models.
    """
    from scipy.stats import t

    at = Frequencies.of(len(values), times)
    v, u = at.coefficients(values), at.coefficients(temperature)
    vv, uv, uu = at.sums(v * v), at.sums(u * v), at.sums(u * u)
    spectrum = at.spectra(*MODELS)
    weight = 1.0 / spectrum
    information, product = weight @ uu, weight @ uv
    left = np.maximum(weight @ vv - product**2 / information, np.finfo(float).tiny)
    degrees = len(v) - 1
    deviance = degrees * np.log(left) + np.log(spectrum) @ at.count + np.log(information)
    p = 2 * t.sf(np.abs(product) / np.sqrt(information * left / degrees), degrees)
    return largest_p_value(np.asarray(p), deviance)


def dependence(
    values: Array, sds: Array, temperature: Array, temperature_sd: float, times: Array | None = None
) -> Dependence:
    """Correlation and slope of values (n,) with sds (n,) on temperature (n,) °C.

    All finite, in order of time; temperature_sd: noise of the thermometer, K; times (n,) s, evenly
    spaced by default: noise forgets in a gap. Raises ValueError for
    fewer than 4 epochs, or where values or temperature are constant.
    """
    from scipy.stats import chi2

    n = len(values)
    if n < 4 or not np.ptp(values) > 0 or not np.ptp(temperature) > 0:
        raise ValueError("a dependence needs four epochs, values and a temperature that vary")
    x, y = temperature - temperature.mean(), values - values.mean()
    r = float(np.clip(np.dot(x, y) / np.sqrt(np.dot(x, x) * np.dot(y, y)), -1.0, 1.0))
    del x, y  # of a year of epochs every array counts

    line = fit_straight_line(temperature, values, temperature_sd, sds)
    misfit = line.misfit
    if line.chi2 > chi2.isf(_CHANCE, line.degrees):
        # What the line does not explain is scatter of the parameter, not of the thermometer. Not
        # done for what is chance: weight taken from the thermometer's noise flattens the line.
        unexplained = (misfit**2 - 1) * float(
            np.mean(np.square(sds)) + (line.slope * temperature_sd) ** 2
        )
        line = fit_straight_line(
            temperature, values, temperature_sd, sds, float(np.sqrt(unexplained))
        )
    # An epoch with few targets left is no part of the noise of the others.
    usual = sds <= _UNUSUAL * float(np.median(sds))
    those: slice | Mask = usual
    if usual.all() or not np.ptp(temperature[usual]) > 0:
        those = slice(None)  # without a copy
    noise = slope_noise(
        values[those], temperature[those], line.slope, temperature_sd,
        None if times is None else times[those],
    )  # fmt: skip
    sd_slope = noise.sd if n >= _FEW else max(noise.sd, line.sd_slope)
    return Dependence(
        n,
        r,
        pearson_p_value(r, n),
        noise.n_effective,
        noise.lag_one,
        slope_p_value(values, temperature, times),
        line.slope,
        sd_slope,
        misfit,
        noise.too_short,
    )


def holm(p_values: Sequence[float]) -> list[float]:
    """p-values corrected for their number: Holm (1979), step-down."""
    p = np.asarray(p_values, dtype=float)
    order = np.argsort(p, kind="stable")
    stepped = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    corrected = np.empty_like(p)
    corrected[order] = np.minimum(stepped, 1.0)
    return [float(v) for v in corrected]


def correlation_matrix(columns: Sequence[Array]) -> Array:
    """Pearson's r of each column (n,) with each (k, k); NaN for constant columns.

    Epochs where either value is NaN are left out pair by pair.
    """
    k = len(columns)
    matrix = np.full((k, k), np.nan)
    finite = [np.isfinite(column) for column in columns]
    whole = [bool(f.all()) and np.ptp(c) > 0 for f, c in zip(finite, columns, strict=True)]
    for i in range(k):
        for j in range(i, k):
            a, b = columns[i], columns[j]
            if not (whole[i] and whole[j]):
                both = finite[i] & finite[j]
                a, b = a[both], b[both]
                if len(a) < 3 or not (np.ptp(a) > 0 and np.ptp(b) > 0):
                    continue
            a, b = a - a.mean(), b - b.mean()
            r = np.dot(a, b) / np.sqrt(np.dot(a, a) * np.dot(b, b))
            matrix[i, j] = matrix[j, i] = np.clip(r, -1.0, 1.0)
    return matrix
