"""The dependence of a parameter on the temperature: correlation, significance, and slope.

Pearson's r is tested with the t-test, as in the reference (Elias et al. 2020, section 4.3), which
counts every epoch as independent, and with a test that holds for noise with a memory. The fit of
the slope includes the thermometer's noise. p-values are corrected for the number of parameters by
Holm's method.

Noise with a memory determines the standard deviation of a slope and the effective number of values.
The residuals of a straight line are modelled as first-order autoregressive plus white noise,
correlation at lag k = a·phi^k. Each model of a grid gives a slope by generalised least squares with
its variance; the models are weighted by their restricted likelihood in the cosine domain (Whittle's
approximation), which costs one cosine transform. The standard deviation is that of the mixture
about the stated slope: it contains the variance of each model and the differences between them.

A short series does not decide between models, so their prior weights matter. They were chosen by
simulation such that errors are about as large as the standard deviations. Over 150 epochs of a
warm-up, or of heating and cooling, their ratio is 0.9 for white noise, 0.9 to 1.0 for phi = 0.9,
1.0 to 1.2 for phi = 0.97 on white noise of equal size; in all cases tried with phi up to 0.97 it is
between 0.65 and 1.35. If the memory exceeds a seventh of the series, the standard deviation is an
order of magnitude (1.3 to 1.5 for phi = 0.99); if that is likely, `too_short` is set.

The reference (section 4.1) tests whether a parameter varies more than its standard deviations
explain: it compares the two-sided moving variance over n consecutive measurements with the moving
average of their squared standard deviations by an F-test at each epoch, and states the fraction of
epochs at which it succeeds. Neighbouring windows share n-1 of n measurements, so these tests are
not independent and their fraction has no p-value; `noise_models` gives one for the whole series.
For the correlations of the interior orientation it uses the median of every coefficient over all
epochs and both series, and calls their scatter the noise of the coefficients (section 4.3).

Sources: Whittle (1953), Estimation and information in stationary time series; Harville (1974),
Biometrika 61, 383-385, for the restricted likelihood; Pyper & Peterman (1998), Can. J. Fish. Aquat.
Sci. 55, 2127-2140, for the effective sample size; for a straight line with noise in both
coordinates York, D.; Evensen, N. M.; López Martínez, M.; De Basabe Delgado,
J. (2004): Unified equations for the slope, intercept, and standard errors of the best straight
line. Am. J. Phys. 72, 367-375, for uncorrelated errors. With equal weights this is Deming's line.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations_with_replacement
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from thermocald.analysis.statistics.noise_models import (
    MODELS,
    Frequencies,
    grid,
    largest_p_value,
    mixtures,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import ArrayLike, NDArray

    from thermocald.arrays import Array, Mask


_COLOURED = (0.15, 0.3, 0.5, 0.7, 0.85, 1.0)
_WHITE = 0.3
_LIKELY = (
    (1.0, 1.0, 0.22), (1.0, 5.0, 0.07), (1.0, 12.0, 0.01), (1.0, 30.0, 0.02),
    (0.5, 5.0, 0.14), (0.3, 30.0, 0.03), (0.7, 41.0, 0.14),
)  # fmt: skip
"""Coloured part, memory in epochs, prior weight; the other models share the remaining weight."""
_SHORTEST, _LONGEST = 0.6, 200.0  # epochs of memory; a longer series has memories up to its length
_MEMORIES = 12
_NEIGHBOURS = 5
_ABOVE_NOISE = 6.0  # mean power of so many frequencies of x over the variance of its noise
_LONG_MEMORY = 0.15  # fraction of the series


@lru_cache(maxsize=8)
def _models(longest: float) -> tuple[Array, Array, Array, Array]:
    """Return φ, coloured part, memory and prior weight (g,) of the models."""
    memories = np.geomspace(_SHORTEST, longest, _MEMORIES)
    tau, coloured = grid(memories, _COLOURED)
    rest = 1.0 - _WHITE - sum(weight for *_, weight in _LIKELY)
    fading = np.maximum(tau, _SHORTEST) ** -0.3  # longer memories are less probable
    weight = np.where(tau > 0, rest * fading / fading[1:].sum(), _WHITE)
    tau = np.append(tau, [m for _, m, _ in _LIKELY])
    coloured = np.append(coloured, [a for a, *_ in _LIKELY])
    weight = np.append(weight, [w for *_, w in _LIKELY])
    phi = np.where(tau > 0, np.exp(-1.0 / np.maximum(tau, 1e-9)), 0.0)
    return phi, coloured, tau, weight


def slope_noise(
    y: Array, x: Array, slope: float, sd_x: float = 0.0, times: Array | None = None
) -> tuple[float, float, float, bool]:
    """Return the sd of the `slope` of a straight line through x, y (n,), from the noise about it.

    Values are finite, n ≥ 4; sd_x: noise of x; times (n,): evenly spaced by default; the noise
    decorrelates in a gap as between epochs. Also returns the equivalent number of independent
    values, the correlation of the noise of neighbouring epochs, and whether its memory is so long
    compared to the series that the sd is only an order of magnitude.
    """
    n = len(y)
    at = Frequencies.of(n, times)
    u, r = at.coefficients(x), at.coefficients(y - slope * x)
    # frequencies at which x is only noise do not determine the slope
    power = u * u
    around = np.convolve(power, np.full(_NEIGHBOURS, 1.0 / _NEIGHBOURS), "same")[: len(u)]
    known = around >= _ABOVE_NOISE * sd_x**2
    if not np.sum(power[known] - sd_x**2) > 0:
        known[:] = True
    whole = at.sums(np.where(known, power, 0.0))
    uu = whole - at.sums(np.where(known, sd_x**2, 0.0))
    ur = at.sums(np.where(known, u * r + slope * sd_x**2, 0.0))
    rr = at.sums(r * r)
    phi, coloured, tau, prior = _models(max(_LONGEST, float(n)))
    spectrum = at.spectra(mixtures(phi, coloured))
    chance = at.sums(np.where(known, 2.0 * sd_x**4, 0.0))
    product, information, left, deviance = _regressed(at, spectrum, uu, ur, rr, chance)
    plausible = prior * np.exp(-0.5 * (deviance - deviance.min()))
    plausible /= plausible.sum()
    freedom = max(len(r) - 3, 1)
    off = product / information
    variance = float(plausible @ (left / freedom / information + off**2))
    # geometric: models that a short series cannot exclude would dominate an arithmetic mean
    inflation = np.exp(plausible @ np.log(spectrum @ whole / whole.sum()))
    return (
        float(np.sqrt(variance)),
        n / max(1.0, float(inflation)),
        float(plausible @ (phi * coloured)),
        bool(plausible[tau > _LONG_MEMORY * n].sum() > 0.5),
    )


def _regressed(
    at: Frequencies, spectrum: Array, uu: Array, ur: Array, rr: Array, chance: Array | float = 0.0
) -> tuple[Array, Array, Array, Array]:
    """Regress r on u by generalised least squares under each noise model (g,).

    spectrum (g, m): of the models; uu, ur, rr (m,): sums of squares and products of the
    coefficients of u and r; chance (m,): variances of uu if u is only noise, whose sd the
    information is at least. Returns the weighted product of u and r, the information on the slope
    (their ratio is the slope), the residuals' weighted squares, and -2 log restricted likelihood.
    """
    weight = 1.0 / spectrum
    least = np.sqrt(np.sum(weight**2 * chance, axis=1))
    information = np.maximum(weight @ uu, np.maximum(least, np.finfo(float).tiny))
    product = weight @ ur
    left = np.maximum(weight @ rr - product**2 / information, np.finfo(float).tiny)
    degrees = float(at.count.sum()) - 1.0
    deviance = degrees * np.log(left) + np.log(spectrum) @ at.count + np.log(information)
    return product, information, left, deviance


_ITERATIONS = 100
_CONVERGED = 1e-7  # fraction of the slope's standard deviation


def fit_straight_line(
    x: Array, y: Array, sd_x: ArrayLike, sd_y: ArrayLike
) -> tuple[float, float, float]:
    """Fit a straight line to x, y (n,) with standard deviations of both, scalars or (n,).

    Returns the slope, its sd (from the stated sds, not scaled), and the chi-square of the residuals
    with n - 2 degrees of freedom.
    """
    var_x = np.square(np.asarray(sd_x, dtype=float))
    var_y = np.square(np.asarray(sd_y, dtype=float))
    # about the means: an intercept far outside the data would cost digits of the slope
    u0, v0 = x - float(np.mean(x)), y - float(np.mean(y))
    slope = float(np.dot(u0, v0) / np.dot(u0, u0))
    for _ in range(_ITERATIONS):
        weight = np.broadcast_to(1.0 / (var_y + slope**2 * var_x), x.shape)
        total = float(np.sum(weight))
        xb, yb = float(np.dot(weight, u0)) / total, float(np.dot(weight, v0)) / total
        u, v = u0 - xb, v0 - yb
        beta = (u * var_y + slope * v * var_x) * weight
        weighted = weight * beta
        previous, slope = slope, float(np.dot(weighted, v) / np.dot(weighted, u))
        if abs(slope - previous) <= _CONVERGED / np.sqrt(float(np.dot(weight, u * u))):
            break
    weight = np.broadcast_to(1.0 / (var_y + slope**2 * var_x), x.shape)
    adjusted = beta + xb
    middle = float(np.dot(weight, adjusted)) / total
    sd_slope = float(1.0 / np.sqrt(np.dot(weight, (adjusted - middle) ** 2)))
    residual = v0 - yb - (u0 - xb) * slope
    return slope, sd_slope, float(np.dot(weight, residual**2))


_CHANCE = 0.01
_UNUSUAL = 3.0  # times the median sd of an epoch
_FEW = 30  # fewer epochs do not show their own noise


@dataclass(frozen=True, slots=True)
class Dependence:
    """The dependence of a parameter on a temperature; slope in parameter units per K.

    p_naive counts all n epochs as independent; p_value holds for any autocorrelation of the noise;
    n_effective: equivalent number of independent epochs; sd_slope includes thermometer noise, the
    adjustments' sds, scatter beyond both and autocorrelation; misfit: scatter over that expected
    from both noises; too_short: the memory of the noise is so long that sd_slope is only an order
    of magnitude; p_naive_holm, p_holm: p_naive, p_value corrected for the number of parameters, NaN
    if not corrected.
    """

    JSON: ClassVar = {
        "lag_one": "residual_lag_one", "p_value": "p", "misfit": "scatter_over_noise",
    }  # fmt: skip

    n: int
    r: float
    p_naive: float
    n_effective: float
    lag_one: float
    p_value: float
    slope: float
    sd_slope: float
    misfit: float
    too_short: bool
    p_naive_holm: float = float("nan")
    p_holm: float = float("nan")


def slope_p_value(values: Array, temperature: Array, times: Array | None = None) -> float:
    """Return the two-sided p-value of no linear dependence, for noise of any memory.

    It is the largest over the noise models of the t-test of a slope by generalised least squares.
    times (n,): evenly spaced by default.
    """
    from scipy.special import stdtr

    at = Frequencies.of(len(values), times)
    v, u = at.coefficients(values), at.coefficients(temperature)
    product, information, left, deviance = _regressed(
        at, at.spectra(MODELS), at.sums(u * u), at.sums(u * v), at.sums(v * v)
    )
    degrees = len(v) - 1
    p = 2 * stdtr(degrees, -np.abs(product) / np.sqrt(information * left / degrees))
    return largest_p_value(np.asarray(p), deviance)


def dependence(
    values: Array, sds: Array, temperature: Array, temperature_sd: float, times: Array | None = None
) -> Dependence:
    """Estimate correlation and slope of values (n,) with sds (n,) on temperature (n,) °C.

    All are finite and in order of time; temperature_sd: noise of the thermometer, K; times (n,) s:
    evenly spaced by default; noise decorrelates in a gap. Raises ValueError for fewer than 4
    epochs, or if values or temperature are constant.
    """
    from scipy.special import chdtri, stdtr

    n = len(values)
    if n < 4 or not np.ptp(values) > 0 or not np.ptp(temperature) > 0:
        raise ValueError("a dependence needs four epochs, values and a temperature that vary")
    x, y = temperature - temperature.mean(), values - values.mean()
    r = _pearson(x, y)
    size = abs(r) * np.sqrt((n - 2) / (1 - r * r)) if abs(r) < 1.0 else np.inf

    slope, sd_slope, square = fit_straight_line(temperature, values, temperature_sd, sds)
    misfit = float(np.sqrt(square / (n - 2)))
    if square > chdtri(n - 2, _CHANCE):
        # scatter about the line is the parameter's, not the thermometer's; only if significant, as
        # a smaller weight of the thermometer's noise flattens the line
        unexplained = (misfit**2 - 1) * float(
            np.mean(np.square(sds)) + (slope * temperature_sd) ** 2
        )
        scatter = np.sqrt(np.square(sds) + unexplained)
        slope, sd_slope, _ = fit_straight_line(temperature, values, temperature_sd, scatter)
    # an epoch with few targets does not show the noise of the others
    usual: Mask = sds <= _UNUSUAL * float(np.median(sds))
    those = usual if np.ptp(temperature[usual]) > 0 else np.ones(n, dtype=bool)
    sd_noise, n_effective, lag_one, too_short = slope_noise(
        values[those], temperature[those], slope, temperature_sd,
        None if times is None else times[those],
    )  # fmt: skip
    return Dependence(
        n,
        r,
        float(2 * stdtr(n - 2, -size)),
        n_effective,
        lag_one,
        slope_p_value(values, temperature, times),
        slope,
        sd_noise if n >= _FEW else max(sd_noise, sd_slope),
        misfit,
        too_short,
    )


def holm(p_values: Sequence[float]) -> list[float]:
    """Correct p-values for their number by Holm's step-down method (1979)."""
    p = np.asarray(p_values, dtype=float)
    order = np.argsort(p, kind="stable")
    stepped = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    corrected = np.empty_like(p)
    corrected[order] = np.minimum(stepped, 1.0)
    return list(map(float, corrected))


def pearson_matrix(columns: Sequence[Array]) -> Array:
    """Return Pearson's r (k, k) of all pairs of columns (n,); NaN for constant columns.

    For each pair, epochs with a NaN in either column are left out.
    """
    k = len(columns)
    matrix = np.full((k, k), np.nan)
    finite = [np.isfinite(column) for column in columns]
    for i, j in combinations_with_replacement(range(k), 2):
        both = finite[i] & finite[j]
        a, b = columns[i][both], columns[j][both]
        if len(a) > 2 and np.ptp(a) > 0 and np.ptp(b) > 0:
            matrix[i, j] = matrix[j, i] = _pearson(a - a.mean(), b - b.mean())
    return matrix


def _pearson(x: Array, y: Array) -> float:
    """Return the correlation of two columns (n,) of mean 0."""
    return float(np.clip(np.dot(x, y) / np.sqrt(np.dot(x, x) * np.dot(y, y)), -1.0, 1.0))


_CHUNK = 1 << 15
# a window that lasts this much longer than n regular measurements has a gap
_STRETCH = 1.5


def moving(values: Array, window: int, statistic: Callable[..., Any], **options: int) -> Array:
    """Return a statistic (n - window + 1,) of every `window` consecutive values of (n,).

    statistic: np.mean, or np.var with its options.
    """
    if len(values) < window:
        return np.empty(0)
    views = np.lib.stride_tricks.sliding_window_view(values, window)
    # in chunks: running sums would lose digits if the drift is large compared to the noise
    parts = (views[start : start + _CHUNK] for start in range(0, len(views), _CHUNK))
    return np.concatenate([statistic(part, axis=1, **options) for part in parts])


def unbroken_windows(time_s: Array, window: int) -> NDArray[np.int64]:
    """Return the first indices of the windows of consecutive measurements without a gap."""
    n = len(time_s)
    if n < window:
        return np.empty(0, dtype=np.int64)
    interval = float(np.median(np.diff(time_s)))
    span = time_s[window - 1 :] - time_s[: n - window + 1]
    return np.flatnonzero(span <= _STRETCH * (window - 1) * interval)


def moving_f_test(
    values: Array, sds: Array, redundancy: Array, time_s: Array, window: int, alpha: float
) -> tuple[NDArray[np.int64], Array, Array, NDArray[np.int32]]:
    """Make the reference's F-test at every epoch.

    values, sds (n,): parameter and its standard deviations, finite; redundancy (n,): degrees of
    freedom of each standard deviation (those of its adjustment); time_s (n,): to find gaps; window:
    odd number of measurements; alpha: level of the one-sided test. The squared standard deviations
    of a window have the sum of its redundancies as degrees of freedom. Returns, each (m,), the
    epochs at window centres; the ratios of the moving variance to the moving mean of the squared
    standard deviations; the critical ratios, above which the variance is significantly greater; the
    degrees of freedom of the mean squared standard deviations.
    """
    from scipy.special import fdtri

    starts = unbroken_windows(time_s, window)
    degrees = np.rint(moving(redundancy, window, np.mean)[starts] * window)
    degrees_sd = np.maximum(degrees, 0).astype(np.int32)
    # one quantile for every number of degrees that occurs
    different = np.flatnonzero(np.bincount(degrees_sd))
    quantiles = np.zeros(int(different.max(initial=0)) + 1)
    quantiles[different] = fdtri(window - 1, np.maximum(different, 1.0), 1 - alpha)
    variance, mean = moving(values, window, np.var, ddof=1), moving(sds**2, window, np.mean)
    ratio = variance[starts] / mean[starts]
    return starts + window // 2, ratio, quantiles[degrees_sd], degrees_sd


@dataclass(frozen=True, eq=False)
class IopCorrelations:
    """The correlations of the interior orientation: median and noise (10, 10), 0 if held fixed.

    noise: standard deviation of a coefficient over the epochs, within its series; largest: the
    largest deviation from the median; epochs: number of matrices used.
    """

    JSON: ClassVar = {"largest": "largest_deviation"}

    median: Array
    noise: Array
    largest: Array
    epochs: int


def median_correlations(series: list[Array]) -> IopCorrelations | None:
    """Return medians over the correlation matrices (n_i, k, k) of series; None without any."""
    matrices = [m for m in series if len(m)]
    if not matrices:
        return None
    every = np.concatenate(matrices)
    median = np.median(every, axis=0)
    within = np.concatenate([m - m.mean(axis=0) for m in matrices])
    degrees = max(1, len(within) - len(matrices))
    noise = np.sqrt(np.sum(within**2, axis=0) / degrees)
    largest = np.max(np.abs(every - median), axis=0)
    return IopCorrelations(median, noise, largest, len(every))
