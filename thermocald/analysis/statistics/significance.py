"""Drift of a series, and its dependence on the temperature, in noise with a memory.

Noise is a sum of first-order autoregressive parts: white noise plus one part with φ up to 0.995, or
white plus flicker noise, 1/f to 1/f^1.6, whose parts have logarithmically spaced memories (van der
Ziel 1950, Physica 16). The coefficients of the cosine transform of a stationary series are nearly
independent, with its spectrum as variances (Whittle's approximation), so a likelihood costs one
transform. In long series the high frequencies, which do not contain slow noise, are pooled. The
last epochs, a few of ten thousand, are left out if that gives a length with small factors: the
transform of a year of prime length takes 400 MB.

*Drift*: is the slow part (periods longer than two windows) larger than the fast part, continued to
low frequencies, allows? This is an F-test for each noise model. The size σ is estimated from the
fast part, so noise beyond the stated standard deviations is not drift. *Excess*: does the series
vary more than its stated standard deviations explain, whatever its memory?

A test that has to hold for any noise uses the largest p-value over the models. Models that the data
exclude should not count, so the p-value of each is combined, by Fisher's method, with the model's
likelihood ratio. The tests therefore reject at most the stated fraction of series without drift.

*Dependence*: Pearson's r is tested with the t-test, as in the reference (Elias et al. 2020, section
4.3), which counts every epoch as independent, and with a test that holds for noise with a memory.
The fit of the slope includes the thermometer's noise. p-values are corrected for the number of
parameters by Holm's method.

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
not independent and their fraction has no p-value; `drift_test` gives one for the whole series.
For the correlations of the interior orientation it uses the median of every coefficient over all
epochs and both series, and calls their scatter the noise of the coefficients (section 4.3).

Sources: Whittle (1953), Estimation and information in stationary time series; Berger and Boos
(1994), J. Am. Stat. Assoc. 89, 1012-1016; Müller and Watson (2017), Low-frequency econometrics
(inference from low-frequency cosine weights); Harville (1974), Biometrika 61, 383-385, for the
restricted likelihood; Pyper & Peterman (1998), Can. J. Fish. Aquat. Sci. 55, 2127-2140, for the
effective sample size; for a straight line with noise in both coordinates York, D.; Evensen, N. M.;
López Martínez, M.; De Basabe Delgado, J. (2004): Unified equations for the slope, intercept, and
standard errors of the best straight line. Am. J. Phys. 72, 367-375, for uncorrelated errors. With
equal weights this is Deming's line.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations_with_replacement
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from thermocald.photogrammetry.linalg import mad_sd, unit_diagonal

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import ArrayLike, NDArray

    from thermocald.arrays import Array, Mask


# beyond this many low frequencies, which contain the slow noise, neighbours are pooled
_SINGLE_FREQUENCIES = 2000
_POOLED_FREQUENCIES = 1000
_ANY_LENGTH = 200_000  # epochs: up to here a transform of any length is cheap
_SMALL_PRIMES = 2 * 3 * 5 * 7 * 11 * 13 * 17 * 19 * 23 * 29 * 31

_PHI = (0.2, 0.4, 0.6, 0.75, 0.85, 0.92, 0.95, 0.97, 0.985, 0.995)
_COLOURED = (0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 1.0)


_FLICKER = (1.0, 1.3, 1.6)  # exponents of 1/f
_MEMORIES = 0.4 * 3.0 ** np.arange(10)  # of the parts of flicker noise, in epochs

_GAP = 3.0  # an interval that is longer by this factor than usual is a gap, which ends a stretch
_TYPICAL_PHI = 0.97


NoiseModels = tuple["Array", "Array"]
"""Noise models of unit variance: φ (P,) of the parts, and their shares (g, P) of the variance."""


def mixtures(phi: Array, coloured: Array) -> NoiseModels:
    """Return models of white noise plus a coloured part of the variance (g,) with φ (g,)."""
    parts, column = np.unique(np.append(0.0, phi), return_inverse=True)
    shares = np.zeros((len(phi), len(parts)))
    shares[:, column[0]] = 1.0 - coloured
    shares[np.arange(len(phi)), column[1:]] += coloured
    return parts, shares


def grid(first: ArrayLike, coloured: ArrayLike) -> tuple[Array, Array]:
    """Return all pairs of two lists, preceded by white noise (0, 0)."""
    firsts, parts = (g.ravel() for g in np.meshgrid(first, coloured))
    return np.append(0.0, firsts), np.append(0.0, parts)


def _models() -> NoiseModels:
    """Return white noise with autoregressive, and with flicker noise, in several proportions."""
    phi, mixed = mixtures(*grid(_PHI, _COLOURED))
    shape = np.array([_MEMORIES ** (a - 1.0) for a in _FLICKER])
    shape /= shape.sum(axis=1, keepdims=True)
    coloured = np.tile(_COLOURED, len(_FLICKER))
    shares = coloured[:, None] * np.repeat(shape, len(_COLOURED), axis=0)
    shares = np.column_stack([1.0 - coloured, shares])
    both = np.zeros(np.add(mixed.shape, shares.shape))
    both[: len(mixed), : len(phi)], both[len(mixed) :, len(phi) :] = mixed, shares
    return np.concatenate([phi, [0.0], np.exp(-1.0 / _MEMORIES)]), both


MODELS = _models()
"""The noise models of the tests."""


@dataclass(frozen=True, eq=False)
class Frequencies:
    """The frequencies of a series with gaps, lowest first, pooled at the high ones.

    pieces: rows of each stretch without a gap; contrasts (K - 1, K): orthonormal combinations of
    the stretches' scaled means; pauses (K, K): between the end of one and the beginning of another,
    in intervals; order: of the coefficients by frequency; starts, count (m,): first coefficient and
    size of each pool; mean (m,): its mean frequency, rad, 0 for a contrast.
    """

    pieces: tuple[slice, ...]
    contrasts: Array
    pauses: Array
    order: NDArray[np.int64] | slice
    starts: NDArray[np.int64]
    count: Array
    mean: Array

    @classmethod
    def of(cls, n: int, times: Array | None = None) -> Frequencies:
        """Return the frequencies of n values at times (n,), evenly spaced by default."""
        pieces, pauses = _pieces(n, times)
        each = [np.arange(1, p.stop - p.start) / (p.stop - p.start) for p in pieces]
        K = len(pieces)
        own = np.concatenate([np.zeros(K - 1), *each])
        order = slice(None) if K == 1 else np.argsort(own, kind="stable")
        m = len(own)
        if m <= _SINGLE_FREQUENCIES + _POOLED_FREQUENCIES:
            starts = np.arange(m)
        else:
            edges = np.geomspace(_SINGLE_FREQUENCIES, m, _POOLED_FREQUENCIES + 1)[:-1].astype(int)
            starts = np.concatenate([np.arange(_SINGLE_FREQUENCIES), np.unique(edges)])
        count = np.diff(starts, append=m).astype(float)
        mean = np.pi * np.add.reduceat(own[order], starts) / count
        found = cls(pieces, np.zeros((0, K)), pauses, order, starts, count, mean)
        # orthonormal, orthogonal to a constant, and independent for noise with a long memory
        root = np.sqrt(found.lengths / found.lengths.sum())
        flat = np.linalg.svd(root[None])[2][1:]
        slow = found.means_covariance(_TYPICAL_PHI)
        return replace(found, contrasts=np.linalg.eigh(flat @ slow @ flat.T)[1].T @ flat)

    @property
    def lengths(self) -> Array:
        """The numbers of values (K,) of the stretches."""
        return np.array([p.stop - p.start for p in self.pieces], dtype=float)

    def means_covariance(self, phi: float) -> Array:
        """Return the covariance (K, K) of the stretches' means times √length, for unit variance."""
        size = self.lengths
        geometric = (1.0 - phi**size) / (1.0 - phi)
        own = (size * (1 + phi) - 2 * phi * geometric) / (1.0 - phi) / size
        scaled = geometric / np.sqrt(size)
        between = scaled[:, None] * scaled[None] * phi**self.pauses
        np.fill_diagonal(between, own)
        return np.asarray(between)

    def coefficients(self, y: Array) -> Array:
        """Return the orthonormal coefficients of a series about its mean, without the constant."""
        means = np.array([y[p].mean() for p in self.pieces])
        slow = self.contrasts @ (means * np.sqrt(self.lengths))
        every = np.concatenate([slow, *(cosines(y[p]) for p in self.pieces)])
        return np.asarray(every[self.order])

    def sums(self, power: Array) -> Array:
        """Sum values per coefficient over the pools (m,)."""
        return power if len(self.starts) == len(power) else np.add.reduceat(power, self.starts)

    def spectra(self, models: NoiseModels) -> Array:
        """Return the mean variances (g, m) of the coefficients for models of unit variance."""
        (phis, shares), phi = models, models[0][:, None]
        parts = (1 - phi**2) / (1 + phi**2 - 2 * phi * np.cos(self.mean))
        for part, one in zip(parts, phis.tolist(), strict=True):
            slow = self.means_covariance(one)
            part[: len(slow) - 1] = np.diag(self.contrasts @ slow @ self.contrasts.T)
        return np.asarray(shares @ parts)


def _pieces(n: int, times: Array | None) -> tuple[tuple[slice, ...], Array]:
    """Return the stretches between gaps, and the pauses (K, K) between them in intervals."""
    t = np.arange(float(n)) if times is None else times
    steps = np.diff(t)
    usual = float(np.median(steps)) if n > 1 else 0.0
    gap = (steps > _GAP * usual) & (usual > 0)
    if not gap.any():
        return (slice(0, _with_small_factors(n)),), np.zeros((1, 1))
    interval = float(steps[~gap].mean())  # the median is no gap
    at = np.flatnonzero(gap) + 1
    first, last = np.append(0, at), np.append(at, n)
    pauses = np.maximum(t[first][None] - t[last - 1][:, None], 0.0) / interval
    pauses = np.maximum(pauses, pauses.T)
    lengths = [_with_small_factors(int(k - i)) for i, k in zip(first, last, strict=True)]
    return tuple(slice(int(i), int(i) + m) for i, m in zip(first, lengths, strict=True)), pauses


def cosines(y: Array) -> Array:
    """Return the orthonormal cosine coefficients of a series (n,), without the constant one.

    There are n - 1, or fewer if a long series is cut to a length with small factors.
    """
    from scipy.fft import dct

    y = y[: _with_small_factors(len(y))]
    return np.asarray(dct(y - y.mean(), norm="ortho", overwrite_x=True)[1:])


@lru_cache(maxsize=64)
def _with_small_factors(n: int) -> int:
    """Return the largest number up to n without a prime factor above 31; a small n itself."""
    while n > _ANY_LENGTH and pow(_SMALL_PRIMES, n.bit_length(), n):  # 0 if they divide n to 1
        n -= 1
    return n


def largest_p_value(p: Array, deviance: Array) -> float:
    """Return the largest combined p-value over the models.

    p (g,): of the test under each model; deviance (g,): -2 log likelihood of each.
    """
    product = p * np.exp(-0.5 * (deviance - deviance.min()))
    log = np.log(np.maximum(product, np.finfo(float).tiny))
    return float(np.max(np.where(product > 0, product * (1 - log), 0.0)))


_LEAST_VALUES = 8
_FIRST_BAND = 4  # low frequencies of the first band; each further one has four times as many
_WIDENING = 4
_LEAST_FAST = 4
_JUMP = 6.0  # sds of the increments, which noise does not reach
_MOST_JUMPS = 0.1  # of the epochs
_NORMAL_MEDIAN = 0.6745  # of |x| of a standard normal x
_MEDIAN_SD = 1.5  # times 1/√n: relative sd of that median for third differences of white noise
_NOTHING = 1e-200  # stands for the variance of a series without scatter


@dataclass(frozen=True, slots=True)
class DriftTest:
    """The test of drift of a whole series, without windows.

    p_value: of no drift, that is of noise of any size and memory; p_excess: of no variation beyond
    the stated sds, whatever the memory; variance_ratio: variance of the series over its mean
    squared sd; noise_ratio, sd_noise_ratio: scatter between neighbouring epochs over the stated
    sds; epochs: number used; p_holm, p_excess_holm: the p-values corrected for the number of
    parameters, NaN if not corrected.
    """

    JSON: ClassVar = {"p_value": "p"}

    p_value: float
    p_excess: float
    variance_ratio: float
    noise_ratio: float
    sd_noise_ratio: float
    epochs: int
    p_holm: float = float("nan")
    p_excess_holm: float = float("nan")


def drift_test(
    values: Array,
    sds: Array,
    redundancy: Array,
    window: int = 31,
    times: Array | None = None,
) -> DriftTest | None:
    """Test a series for drift, and for variation beyond its standard deviations.

    values, sds (n,): parameter and its standard deviations, finite, in order of time; redundancy
    (n,): degrees of freedom of each standard deviation; window: epochs; changes slower than two
    windows are slow; times (n,): evenly spaced by default; noise decorrelates in a gap. Returns
    None for fewer than 8 epochs or constant values.
    """
    n = len(values)
    if n < _LEAST_VALUES or not np.ptp(values) > 0:
        return None
    # one sd for all: those of single epochs fluctuate, and so would a large drift over them
    standardised = (values - values.mean()) / np.sqrt(np.mean(sds**2))
    standardised = _without_spikes(standardised)
    calm = _without_jumps(standardised)
    at = Frequencies.of(n, times)
    whole, fast = at.coefficients(standardised), at.coefficients(calm)
    power = at.sums(whole**2)
    single = int(np.argmax(at.count > 1)) if at.count[-1] > 1 else len(at.count)
    bands = _bands(n, window, at)
    # the low-frequency coefficients of a line and a parabola
    t = np.arange(n, dtype=float) if times is None else times
    t = 2.0 * (t - t[0]) / max(float(t[-1] - t[0]), 1e-9) - 1.0
    trend = np.stack([at.coefficients(t**k)[:single] for k in (1, 2)], axis=1)
    spectra = at.spectra(MODELS)
    fast_power = at.sums(fast**2)
    results = [
        _slow_against_fast(
            power, _without_trend(fast_power, fast[:single], trend, band), at, spectra, band
        )
        for band in bands
    ]
    # the median of third differences, which a drift of a thousand sds does not change
    third = np.abs(np.diff(values, n=3)) / sds[1:-2]
    noise_ratio = float(np.median(third)) / (_NORMAL_MEDIAN * np.sqrt(20.0))
    mean_square = float(np.mean(sds**2))
    return DriftTest(
        min(1.0, len(bands) * min(results)),
        _excess(power, fast_power, at, spectra, bands[0], float(np.sum(redundancy))),
        float(np.var(values, ddof=1)) / mean_square,
        noise_ratio,
        noise_ratio * _MEDIAN_SD / float(np.sqrt(len(third))),
        n,
    )


def _few_far(distance: Array, steps: Array) -> Mask:
    """Mark distances (m,) that are large for the scatter of a series' increments (n - 1,).

    None is marked if there are many: then they are noise.
    """
    far: Mask = np.abs(distance) > _JUMP * mad_sd(steps - np.median(steps))
    return far if far.sum() <= _MOST_JUMPS * (len(steps) + 1) else np.zeros_like(far)


def _without_spikes(y: Array) -> Array:
    """Return the series with single epochs that contradict both neighbours replaced: no drift."""
    out = y.copy()
    between, inner = np.median([y[:-2], y[1:-1], y[2:]], axis=0), out[1:-1]
    spike = _few_far(inner - between, np.diff(y))
    inner[spike] = between[spike]
    return out


def _without_jumps(y: Array) -> Array:
    """Return the series without its sudden steps, which would count as noise with a memory.

    Many steps are noise themselves, of few distinct values: rounded, or alternating.
    """
    steps = np.diff(y)
    middle = np.median(steps)
    calm = np.where(_few_far(steps - middle, steps), middle, steps)
    return np.concatenate([[0.0], np.cumsum(calm)])


def _bands(n: int, window: int, at: Frequencies) -> list[int]:
    """Return the ends of the slow bands, as positions in the pooled spectrum; at least one."""
    most = max(2, n // window)
    ends = [min(_FIRST_BAND, most)]
    while ends[-1] * _WIDENING <= most:
        ends.append(ends[-1] * _WIDENING)
    reached = np.cumsum(at.count)
    return [int(np.searchsorted(reached, end)) + 1 for end in ends]


def _slow_against_fast(
    power: Array, high: Array, at: Frequencies, models: Array, band: int
) -> float:
    """Return the p-value of the slow band, predicted from the fast one under models (g, m).

    power (m,): of the series; high: that beyond the band, of the series without jumps.
    """
    from scipy.special import fdtrc

    degrees = float(at.count[band:].sum()) - 2.0
    if degrees < _LEAST_FAST:
        return 1.0
    size = np.maximum((high / models[:, band:]).sum(axis=1) / degrees, _NOTHING)
    deviance = degrees * np.log(size) + np.log(models[:, band:]) @ at.count[band:]
    slow = float(at.count[:band].sum())
    ratio = (power[:band] / models[:, :band]).sum(axis=1) / slow / size
    return largest_p_value(np.asarray(fdtrc(slow, degrees, ratio)), deviance)


def _without_trend(power: Array, first: Array, trend: Array, band: int) -> Array:
    """Return the power beyond a band without a trend's leakage; first (k,): single frequencies.

    Cosines end flat, but a drift need not: a line and a parabola are removed.
    """
    power, high = power[band:].copy(), first[band:]
    if len(high) > 2:
        basis, _ = np.linalg.qr(trend[band:])
        power[: len(high)] = (high - basis @ (basis.T @ high)) ** 2
    return power


def _excess(
    power: Array, fast: Array, at: Frequencies, models: Array, band: int, redundancy: float
) -> float:
    """Return the p-value of the variance of the standardised series, 1 if the sds are right."""
    from scipy.special import fdtrc

    deviance = (fast[band:] / models[:, band:]).sum(axis=1)
    deviance = deviance + np.log(models[:, band:]) @ at.count[band:]
    # a sum of squares of unequal variances: Satterthwaite's degrees of freedom
    expected = models @ at.count
    degrees = expected**2 / (models**2 @ at.count)
    return largest_p_value(
        np.asarray(fdtrc(degrees, max(redundancy, 1.0), power.sum() / expected)), deviance
    )


_SLOPE_COLOURED = (0.15, 0.3, 0.5, 0.7, 0.85, 1.0)
_WHITE = 0.3
_LIKELY = (
    (1.0, 1.0, 0.22), (1.0, 5.0, 0.07), (1.0, 12.0, 0.01), (1.0, 30.0, 0.02),
    (0.5, 5.0, 0.14), (0.3, 30.0, 0.03), (0.7, 41.0, 0.14),
)  # fmt: skip
"""Coloured part, memory in epochs, prior weight; the other models share the remaining weight."""
_SHORTEST, _LONGEST = 0.6, 200.0  # epochs of memory; a longer series has memories up to its length
_SLOPE_MEMORIES = 12
_NEIGHBOURS = 5
_ABOVE_NOISE = 6.0  # mean power of so many frequencies of x over the variance of its noise
_LONG_MEMORY = 0.15  # fraction of the series


@dataclass(frozen=True, slots=True, eq=False)
class SlopeNoise:
    """The noise of a series and its effect on the slope on `x`.

    sd: of the slope; n_effective: equivalent number of independent values; lag_one: correlation of
    the noise of neighbouring epochs; too_short: the memory is so long compared to the series that
    the sd is only an order of magnitude.
    """

    sd: float
    n_effective: float
    lag_one: float
    too_short: bool


@lru_cache(maxsize=8)
def _slope_models(longest: float) -> tuple[Array, Array, Array, Array]:
    """Return φ, coloured part, memory and prior weight (g,) of the models."""
    memories = np.geomspace(_SHORTEST, longest, _SLOPE_MEMORIES)
    tau, coloured = grid(memories, _SLOPE_COLOURED)
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
) -> SlopeNoise:
    """Estimate the noise about a straight line through x, y (n,), and the sd of its `slope`.

    Values are finite, n ≥ 4; sd_x: noise of x; times (n,): evenly spaced by default; the noise
    decorrelates in a gap as between epochs.
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
    phi, coloured, tau, prior = _slope_models(max(_LONGEST, float(n)))
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
    return SlopeNoise(
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
    x: Array, y: Array, sd_x: ArrayLike, sd_y: ArrayLike, extra_variance_y: float = 0.0
) -> tuple[float, float, float]:
    """Fit a straight line to x, y (n,) with standard deviations of both, scalars or (n,).

    extra_variance_y: scatter of y about the line that neither sd explains. Returns the slope, its
    sd (from the stated sds, not scaled), and the chi-square of the residuals with n - 2 degrees of
    freedom.
    """
    var_x = np.square(np.asarray(sd_x, dtype=float))
    var_y = np.square(np.asarray(sd_y, dtype=float)) + extra_variance_y
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
        slope, sd_slope, _ = fit_straight_line(
            temperature, values, temperature_sd, sds, unexplained
        )
    # an epoch with few targets does not show the noise of the others
    usual: Mask = sds <= _UNUSUAL * float(np.median(sds))
    those = usual if np.ptp(temperature[usual]) > 0 else np.ones(n, dtype=bool)
    noise = slope_noise(
        values[those], temperature[those], slope, temperature_sd,
        None if times is None else times[those],
    )  # fmt: skip
    return Dependence(
        n,
        r,
        float(2 * stdtr(n - 2, -size)),
        noise.n_effective,
        noise.lag_one,
        slope_p_value(values, temperature, times),
        slope,
        noise.sd if n >= _FEW else max(noise.sd, sd_slope),
        misfit,
        noise.too_short,
    )


def holm(p_values: Sequence[float]) -> list[float]:
    """Correct p-values for their number by Holm's step-down method (1979)."""
    p = np.asarray(p_values, dtype=float)
    order = np.argsort(p, kind="stable")
    stepped = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    corrected = np.empty_like(p)
    corrected[order] = np.minimum(stepped, 1.0)
    return list(map(float, corrected))


def correlation_matrix(columns: Sequence[Array]) -> Array:
    """Return Pearson's r (k, k) of all pairs of columns (n,); NaN for constant columns.

    For each pair, epochs with a NaN in either column are left out.
    """
    k = len(columns)
    matrix = np.full((k, k), np.nan)
    for i, j in combinations_with_replacement(range(k), 2):
        both = np.isfinite(columns[i]) & np.isfinite(columns[j])
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


def correlations_of(covariances: Array) -> Array:
    """Return the correlations of covariances (n, k, k); 0 for held parameters, diagonal 1."""
    r, _ = unit_diagonal(covariances)
    np.einsum("...ii->...i", r)[...] = 1.0
    return np.clip(r, -1.0, 1.0)


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
