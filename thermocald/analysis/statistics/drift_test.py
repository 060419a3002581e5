"""Is there drift, beyond noise of whatever size and memory?

Both tests look at the cosine transform of the series, whose coefficients are nearly independent
with the noise's spectrum as variances. Noise is first-order autoregressive plus white, spectrum
σ² (a·s(φ) + 1 - a), with φ up to 0.995.

*Drift* asks whether the slow part (periods longer than two windows) is larger than the fast part,
continued to low frequencies, allows: an F-test for each noise model. The size σ is taken from the
fast part, so noise beyond the stated standard deviations is not drift. *Excess* asks whether the
series varies more than its stated standard deviations explain, whatever its memory.

No noise model is chosen: the largest p-value over all models counts, each combined with how well
the model describes the fast part (`noise_models`). The tests therefore reject in at most the stated
fraction of driftless series.

Sources: Whittle (1953), Estimation and information in stationary time series; Müller and Watson
(2017), Low-frequency econometrics (inference from low-frequency cosine weights).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.statistics.noise_models import (
    MODELS,
    Frequencies,
    largest_p_value,
)

if TYPE_CHECKING:
    from thermocald.arrays import Array

_LEAST_VALUES = 8
_FIRST_BAND = 4  # low frequencies of the first band; the next have four times as many
_WIDENING = 4
_LEAST_FAST = 4
_JUMP = 6.0  # sd of the increments; noise never does that
_NORMAL_MEDIAN = 0.6745  # of |x| of a standard normal x
_MEDIAN_SD = 1.5  # times 1/√n: relative sd of that median over third differences of white noise
_NOTHING = 1e-200  # variance of a series that does not scatter at all


@dataclass(frozen=True, slots=True)
class DriftTest:
    """One p-value for the whole series, without windows.

    p_value: of no drift, that is of noise of any size and memory; p_excess: of no variation beyond
    the stated sds, whatever the memory; variance_ratio: variance of the series over its mean
    squared sd; noise_ratio, sd_noise_ratio: scatter between neighbouring epochs over the stated
    sds; epochs: how many were used.
    """

    p_value: float
    p_excess: float
    variance_ratio: float
    noise_ratio: float
    sd_noise_ratio: float
    epochs: int


@dataclass(frozen=True, eq=False)
class _Spectrum:
    """Squared cosine coefficients, pooled: sums (m,), at which frequencies.

    first (k,): the coefficients themselves, of those frequencies that are not pooled.
    """

    power: Array
    at: Frequencies
    first: Array

    @property
    def count(self) -> Array:
        return self.at.count


def drift_test(
    values: Array,
    sds: Array,
    redundancy: Array,
    window: int = 31,
    times: Array | None = None,
) -> DriftTest | None:
    """Test a series for drift, and for variation beyond its standard deviations.

    values, sds (n,): parameter and its standard deviations, finite, in order of time; redundancy
    (n,): degrees of freedom of each standard deviation; window: epochs, what changes more slowly
    than two of them is slow; times (n,): evenly spaced by default; noise forgets in a gap. None for
    fewer than 8 epochs or constant values.
    """
    n = len(values)
    if n < _LEAST_VALUES or not np.ptp(values) > 0:
        return None
    # By one sd for all: those of single epochs fluctuate, and a large drift would with them.
    standardised = (values - values.mean()) / np.sqrt(np.mean(sds**2))
    standardised = _without_spikes(standardised)
    calm = _without_jumps(standardised)
    at = Frequencies.of(n, times)
    whole, fast = _spectrum(standardised, at), _spectrum(calm, at)
    bands = _bands(n, window, whole)
    trend = _trend(at, np.arange(n, dtype=float) if times is None else times, len(fast.first))
    results = [_slow_against_fast(whole, fast, trend, band) for band in bands]
    noise_ratio, sd_noise_ratio = _noise(values, sds)
    mean_square = float(np.mean(sds**2))
    return DriftTest(
        min(1.0, len(bands) * min(results)),
        _excess(whole, fast, bands[0], float(np.sum(redundancy))),
        float(np.var(values, ddof=1)) / mean_square,
        noise_ratio,
        sd_noise_ratio,
        n,
    )


def _scale_of_steps(steps: Array) -> tuple[float, float]:
    """Median of the increments and their robust standard deviation."""
    middle = float(np.median(steps))
    return middle, 1.4826 * float(np.median(np.abs(steps - middle)))


def _without_spikes(y: Array) -> Array:
    """The series with single epochs that contradict both neighbours set between them: no drift."""
    out = y.copy()
    # the middle one of three neighbours
    between = np.minimum(y[:-2], y[1:-1])
    np.maximum(between, np.minimum(np.maximum(y[:-2], y[1:-1]), y[2:]), out=between)
    _, scale = _scale_of_steps(np.diff(y))
    inner = out[1:-1]
    spike = np.abs(inner - between) > _JUMP * scale
    inner[spike] = between[spike]
    return out


def _without_jumps(y: Array) -> Array:
    """The series with its sudden steps taken out: they would pass as noise with a memory."""
    steps = np.diff(y)
    middle, scale = _scale_of_steps(steps)
    calm = np.where(np.abs(steps - middle) > _JUMP * scale, middle, steps)
    return np.concatenate([[0.0], np.cumsum(calm)])


def _spectrum(y: Array, at: Frequencies) -> _Spectrum:
    coefficients = at.coefficients(y)
    single = int(np.argmax(at.count > 1)) if at.count[-1] > 1 else len(at.count)
    return _Spectrum(at.sums(coefficients**2), at, coefficients[:single].copy())


def _bands(n: int, window: int, spectrum: _Spectrum) -> list[int]:
    """Ends of the slow bands, as positions in the pooled spectrum; at least one."""
    most = max(2, n // window)
    ends = [min(_FIRST_BAND, most)]
    while ends[-1] * _WIDENING <= most:
        ends.append(ends[-1] * _WIDENING)
    reached = np.cumsum(spectrum.count)
    return [int(np.searchsorted(reached, end)) + 1 for end in ends]


def _slow_against_fast(whole: _Spectrum, fast: _Spectrum, trend: Array, band: int) -> float:
    """p-value of the slow band, continued from the fast one."""
    from scipy.stats import f

    models = whole.at.spectra(*MODELS)
    high = _without_trend(fast, trend, band)
    degrees = float(fast.count[band:].sum()) - 2.0
    if degrees < _LEAST_FAST:
        return 1.0
    size = np.maximum((high / models[:, band:]).sum(axis=1) / degrees, _NOTHING)
    deviance = degrees * np.log(size)
    deviance = deviance + np.log(models[:, band:]) @ fast.count[band:]
    slow = float(whole.count[:band].sum())
    ratio = (whole.power[:band] / models[:, :band]).sum(axis=1) / slow / size
    return largest_p_value(np.asarray(f.sf(ratio, slow, degrees)), deviance)


def _without_trend(fast: _Spectrum, trend: Array, band: int) -> Array:
    """Power of the fast part without what a trend leaks into it.

    Cosines end flat; a drift that does not is a line and a parabola more, which are taken out.
    """
    power = fast.power[band:].copy()
    high = fast.first[band:]
    if len(high) > 2:
        basis, _ = np.linalg.qr(trend[band:])
        power[: len(high)] = (high - basis @ (basis.T @ high)) ** 2
    return power


def _trend(at: Frequencies, times: Array, count: int) -> Array:
    """The first coefficients (count, 2) of a line and a parabola over times (n,)."""
    t = 2.0 * (times - times[0]) / max(float(times[-1] - times[0]), 1e-9) - 1.0
    return np.stack([at.coefficients(t**k)[:count] for k in (1, 2)], axis=1)


def _excess(whole: _Spectrum, fast: _Spectrum, band: int, redundancy: float) -> float:
    """p-value of the variance of the standardised series, which the sds say is 1."""
    from scipy.stats import f

    models = whole.at.spectra(*MODELS)
    deviance = (fast.power[band:] / models[:, band:]).sum(axis=1)
    deviance = deviance + np.log(models[:, band:]) @ fast.count[band:]
    # A sum of squares of unequal variances: Satterthwaite's degrees of freedom.
    expected = models @ whole.count
    degrees = expected**2 / (models**2 @ whole.count)
    return largest_p_value(
        np.asarray(f.sf(whole.power.sum() / expected, degrees, max(redundancy, 1.0))), deviance
    )


def _noise(values: Array, sds: Array) -> tuple[float, float]:
    """Scatter between neighbours over the stated sds, and its sd.

    From third differences, to which a drift of a thousand sds adds nothing, by their median.
    """
    third = np.abs(np.diff(values, n=3)) / sds[1:-2]
    ratio = float(np.median(third)) / (_NORMAL_MEDIAN * np.sqrt(20.0))
    return ratio, ratio * _MEDIAN_SD / float(np.sqrt(len(third)))
