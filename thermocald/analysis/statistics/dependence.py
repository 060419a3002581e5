"""The dependence of a parameter on the temperature: correlation, significance, and slope.

Pearson's r with the t-test as the reference has it (Elias et al. 2020, section 4.3), which counts
every epoch as independent, and alongside it a test that holds for noise with a memory. The slope is
fitted with the thermometer's noise counted. p-values are corrected for the number of parameters by
Holm's method.

Noise with a memory decides the standard deviation of a slope, and how many values a series is
worth. The residuals of a straight line are modelled as first-order autoregressive plus white noise,
correlation at lag k = a·phi^k. Each model of a grid gives a slope by generalised least squares with
its variance; the models are weighted by their restricted likelihood in the cosine domain (Whittle's
approximation), which costs one cosine transform. The standard deviation is that of the mixture
about the slope that is stated: it holds what each model says and how much the models disagree.

A short series does not decide between models, so their weights beforehand matter. They were chosen
by simulation such that errors are about as large as the standard deviations. Over 150 epochs of a
warm-up, or of heating and cooling, they are 0.9 of it for white noise, 0.9 to 1.0 for phi = 0.9,
1.0 to 1.2 for phi = 0.97 on white noise of equal size; all that was tried with phi up to 0.97 lies
between 0.65 and 1.35. Noise whose memory is more than a seventh of the series leaves an order of
magnitude (1.3 to 1.5 for phi = 0.99); where that is likely, `too_short` is set.

Whether a parameter's variation is larger than its standard deviations explain the reference
(section 4.1) asks with the two-sided moving variance over n consecutive measurements and the moving
average of their squared standard deviations, by an F-test at each epoch, and gives the fraction of
epochs at which it succeeds. Neighbouring windows have n-1 of n measurements in common, so these
tests are not independent and their fraction has no p-value; `noise_models` gives one for the whole
series. Of the correlations of the interior orientation it takes (section 4.3) the median of every
coefficient over all epochs and both series, and calls their scatter the noise of the coefficients.

Sources: Whittle (1953), Estimation and information in stationary time series; Harville (1974),
Biometrika 61, 383-385, for the restricted likelihood; Pyper & Peterman (1998), Can. J. Fish. Aquat.
Sci. 55, 2127-2140, for the effective sample size; for a straight line through points whose both
coordinates are measured with noise York, D.; Evensen, N. M.; López Martínez, M.; De Basabe Delgado,
J. (2004): Unified equations for the slope, intercept, and standard errors of the best straight
line. Am. J. Phys. 72, 367-375, for uncorrelated errors. With equal weights this is Deming's line.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
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
"""Coloured part, memory in epochs, weight beforehand; the others have what is left."""
_SHORTEST, _LONGEST = 0.6, 200.0  # epochs of memory; longer series have longer ones
_MEMORIES = 12
_NEIGHBOURS = 5
_ABOVE_NOISE = 6.0  # mean power of that many frequencies of x over the variance of its noise
_LONG_MEMORY = 0.15  # of the series


@dataclass(frozen=True, slots=True, eq=False)
class SlopeNoise:
    """The noise of a series and what it makes of the slope on `x`.

    sd: of the slope; n_effective: independent values that determine it as well; lag_one:
    correlation of the noise of neighbouring epochs; too_short: the memory is so long against the
    series that the sd is an order of magnitude only.
    """

    sd: float
    n_effective: float
    lag_one: float
    too_short: bool


@lru_cache(maxsize=8)
def _models(longest: float) -> tuple[Array, Array, Array, Array]:
    """φ, coloured part, memory and weight beforehand (g,) of the models."""
    memories = np.geomspace(_SHORTEST, longest, _MEMORIES)
    tau, coloured = grid(memories, _COLOURED)
    rest = 1.0 - _WHITE - sum(weight for *_, weight in _LIKELY)
    fading = np.maximum(tau, _SHORTEST) ** -0.3  # the longer, the rarer
    weight = np.where(tau > 0, rest * fading / fading[1:].sum(), _WHITE)
    tau = np.append(tau, [m for _, m, _ in _LIKELY])
    coloured = np.append(coloured, [a for a, *_ in _LIKELY])
    weight = np.append(weight, [w for *_, w in _LIKELY])
    phi = np.where(tau > 0, np.exp(-1.0 / np.maximum(tau, 1e-9)), 0.0)
    return phi, coloured, tau, weight


def slope_noise(
    y: Array, x: Array, slope: float, sd_x: float = 0.0, times: Array | None = None
) -> SlopeNoise:
    """The standard deviation of `slope`, a straight line's through x, y (n,), and its noise.

    Finite values; n ≥ 4; sd_x: noise of x; times (n,): evenly spaced by default; the noise forgets
    in a gap as it does between epochs.
    """
    n = len(y)
    at = Frequencies.of(n, times)
    u, r = at.coefficients(x), at.coefficients(y - slope * x)
    # Frequencies at which x is its own noise say nothing of the slope.
    power = u * u
    around = np.convolve(power, np.full(_NEIGHBOURS, 1.0 / _NEIGHBOURS), "same")[: len(u)]
    known = around >= min(_ABOVE_NOISE * sd_x**2, float(around.max()))
    uu = at.sums(np.where(known, power - sd_x**2, 0.0))
    ur = at.sums(np.where(known, u * r + slope * sd_x**2, 0.0))
    rr = at.sums(r * r)
    phi, coloured, tau, prior = _models(max(_LONGEST, float(n)))
    spectrum = at.spectra(mixtures(phi, coloured))
    product, information, left, deviance = _regressed(at, spectrum, uu, ur, rr)
    plausible = prior * np.exp(-0.5 * (deviance - deviance.min()))
    plausible /= plausible.sum()
    freedom = max(len(r) - 3, 1)
    off = product / information
    variance = float(plausible @ (left / freedom / information + off**2))
    # Geometric: models that a short series cannot exclude would rule an arithmetic mean.
    inflation = np.exp(plausible @ np.log(spectrum @ uu / uu.sum()))
    return SlopeNoise(
        float(np.sqrt(variance)),
        n / max(1.0, float(inflation)),
        float(plausible @ (phi * coloured)),
        bool(plausible[tau > _LONG_MEMORY * n].sum() > 0.5),
    )


def _regressed(
    at: Frequencies, spectrum: Array, uu: Array, ur: Array, rr: Array
) -> tuple[Array, Array, Array, Array]:
    """Regress r on u by generalised least squares under each model of the noise (g,).

    spectrum (g, m): the models'; uu, ur, rr (m,): sums of squares and products of the coefficients
    of u and r. Returns the weighted product with r, the information on the slope, which is their
    ratio, the squares that the line leaves, and -2 log restricted likelihood.
    """
    weight = 1.0 / spectrum
    information = np.maximum(weight @ uu, np.finfo(float).tiny)
    product = weight @ ur
    left = np.maximum(weight @ rr - product**2 / information, np.finfo(float).tiny)
    degrees = float(at.count.sum()) - 1.0
    deviance = degrees * np.log(left) + np.log(spectrum) @ at.count + np.log(information)
    return product, information, left, deviance


_ITERATIONS = 100
_CONVERGED = 1e-7  # of the slope's standard deviation


def fit_straight_line(
    x: Array, y: Array, sd_x: ArrayLike, sd_y: ArrayLike, extra_variance_y: float = 0.0
) -> tuple[float, float, float]:
    """Best straight line through x, y (n,) with standard deviations of both, scalars or (n,).

    extra_variance_y: scatter of y about the line that neither sd explains. Returns the slope, its
    sd (that of the stated sds, not scaled), and chi-square of the residuals with n - 2 degrees of
    freedom. Raises ValueError for fewer than 3 points or constant x.
    """
    if len(x) < 3 or not np.ptp(x) > 0:
        raise ValueError("a straight line needs three points and x that varies")
    var_x = np.square(np.asarray(sd_x, dtype=float))
    var_y = np.square(np.asarray(sd_y, dtype=float)) + extra_variance_y
    # About the means: the intercept far outside the data would cost the digits of the slope.
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
_FEW = 30  # epochs: fewer do not show their own noise


@dataclass(frozen=True, slots=True)
class Dependence:
    """One parameter against one temperature; slope in parameter units per K.

    p_naive counts all n epochs as independent; p_value holds whatever the autocorrelation of the
    noise; n_effective: independent values that the epochs are worth; sd_slope holds thermometer
    noise, the adjustments' sds, scatter beyond both and autocorrelation; misfit: scatter over what
    the two noises explain; too_short: the noise remembers so much of the series that sd_slope is an
    order of magnitude only; p_naive_holm, p_holm: p_naive, p_value corrected for the number of
    parameters, NaN where there is one.
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
    """Two-sided p-value of no linear dependence, whatever the memory of the noise.

    times (n,): evenly spaced by default. The t-test of the slope by generalised least squares, its
    largest p-value over the noise models.
    """
    from scipy.stats import t

    at = Frequencies.of(len(values), times)
    v, u = at.coefficients(values), at.coefficients(temperature)
    product, information, left, deviance = _regressed(
        at, at.spectra(MODELS), at.sums(u * u), at.sums(u * v), at.sums(v * v)
    )
    degrees = len(v) - 1
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
    from scipy.stats import chi2, t

    n = len(values)
    if n < 4 or not np.ptp(values) > 0 or not np.ptp(temperature) > 0:
        raise ValueError("a dependence needs four epochs, values and a temperature that vary")
    x, y = temperature - temperature.mean(), values - values.mean()
    r = float(np.clip(np.dot(x, y) / np.sqrt(np.dot(x, x) * np.dot(y, y)), -1.0, 1.0))
    size = abs(r) * np.sqrt((n - 2) / (1 - r * r)) if abs(r) < 1.0 else np.inf

    slope, sd_slope, square = fit_straight_line(temperature, values, temperature_sd, sds)
    misfit = float(np.sqrt(square / (n - 2)))
    if square > chi2.isf(_CHANCE, n - 2):
        # What the line does not explain is scatter of the parameter, not of the thermometer. Not
        # done for what is chance: weight taken from the thermometer's noise flattens the line.
        unexplained = (misfit**2 - 1) * float(
            np.mean(np.square(sds)) + (slope * temperature_sd) ** 2
        )
        slope, sd_slope, _ = fit_straight_line(
            temperature, values, temperature_sd, sds, unexplained
        )
    # An epoch with few targets left is no part of the noise of the others.
    usual = sds <= _UNUSUAL * float(np.median(sds))
    those: slice | Mask = usual
    if usual.all() or not np.ptp(temperature[usual]) > 0:
        those = slice(None)  # without a copy
    noise = slope_noise(
        values[those], temperature[those], slope, temperature_sd,
        None if times is None else times[those],
    )  # fmt: skip
    return Dependence(
        n,
        r,
        float(2 * t.sf(size, n - 2)),
        noise.n_effective,
        noise.lag_one,
        slope_p_value(values, temperature, times),
        slope,
        noise.sd if n >= _FEW else max(noise.sd, sd_slope),
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


_CHUNK = 1 << 15
# A window is broken by gaps when it lasts this much longer than n regular measurements.
_STRETCH = 1.5


def moving(values: Array, window: int, statistic: Callable[..., Any], **options: int) -> Array:
    """Return a statistic of `window` consecutive values (n,) → (n - window + 1,).

    statistic: np.mean, or np.var and its options.
    """
    if len(values) < window:
        return np.empty(0)
    views = np.lib.stride_tricks.sliding_window_view(values, window)
    # In chunks: running sums would cancel where the drift is large against the noise.
    parts = (views[start : start + _CHUNK] for start in range(0, len(views), _CHUNK))
    return np.concatenate([statistic(part, axis=1, **options) for part in parts])


def unbroken_windows(time_s: Array, window: int) -> NDArray[np.int64]:
    """First indices of the windows of consecutive measurements that no gap breaks."""
    n = len(time_s)
    if n < window:
        return np.empty(0, dtype=np.int64)
    interval = float(np.median(np.diff(time_s)))
    span = time_s[window - 1 :] - time_s[: n - window + 1]
    return np.flatnonzero(span <= _STRETCH * (window - 1) * interval)


def moving_f_test(
    values: Array, sds: Array, redundancy: Array, time_s: Array, window: int, alpha: float
) -> tuple[NDArray[np.int64], Array, Array, NDArray[np.int32]]:
    """The reference's F-test at every epoch.

    values, sds (n,): parameter and its standard deviations, finite; redundancy (n,): degrees of
    freedom of each standard deviation (those of its adjustment); time_s (n,): finds gaps; window:
    odd number of measurements; alpha: level of the one-sided test. The squared standard deviations
    of a window carry the sum of its redundancies as degrees of freedom. Returns the epochs (m,)
    that are window centres; (m,) ratios of the moving variance over the moving mean of the squared
    standard deviations; the critical ratios, above which the variance is significantly the greater
    one; the degrees of freedom of the mean squared standard deviations.
    """
    from scipy.stats import f

    if window < 3 or window % 2 == 0:
        raise ValueError(f"the window must be an odd number of at least 3, not {window}")
    starts = unbroken_windows(time_s, window)
    degrees = np.rint(moving(redundancy, window, np.mean)[starts] * window)
    degrees_sd = np.maximum(degrees, 0).astype(np.int32)
    # one quantile for every number of degrees that occurs, looked up
    different = np.flatnonzero(np.bincount(degrees_sd))
    quantiles = np.zeros(int(different.max(initial=0)) + 1)
    quantiles[different] = f.isf(alpha, window - 1, np.maximum(different, 1.0))
    variance, mean = moving(values, window, np.var, ddof=1), moving(sds**2, window, np.mean)
    ratio = variance[starts] / mean[starts]
    return starts + window // 2, ratio, quantiles[degrees_sd], degrees_sd


@dataclass(frozen=True, eq=False)
class IopCorrelations:
    """Median (10, 10) and noise (10, 10) of the coefficients; 0 where a parameter is held fixed.

    noise: standard deviation of a coefficient over the epochs, within its series; largest: the
    largest deviation from the median; epochs: how many matrices were used.
    """

    JSON: ClassVar = {"largest": "largest_deviation"}

    median: Array
    noise: Array
    largest: Array
    epochs: int


def correlations_of(covariances: Array) -> Array:
    """Covariances (n, k, k) → correlations; 0 for parameters held fixed, 1 on the diagonal."""
    sd = np.sqrt(np.diagonal(covariances, axis1=-2, axis2=-1))
    inverse = np.divide(1.0, sd, out=np.zeros_like(sd), where=sd > 0)
    r = covariances * inverse[..., :, None] * inverse[..., None, :]
    k = r.shape[-1]
    r[..., np.arange(k), np.arange(k)] = 1.0
    return np.asarray(np.clip(r, -1.0, 1.0))


def median_correlations(series: list[Array]) -> IopCorrelations | None:
    """Medians over the correlation matrices (n_i, k, k) of several series, None without any."""
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
