"""Models of a series' noise, and tests of drift that hold for noise of any size and memory.

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

Sources: Whittle (1953), Estimation and information in stationary time series; Berger and Boos
(1994), J. Am. Stat. Assoc. 89, 1012-1016; Müller and Watson (2017), Low-frequency econometrics
(inference from low-frequency cosine weights).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from thermocald.photogrammetry.linalg import mad_sd

if TYPE_CHECKING:
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
    # single epochs that contradict both neighbours are no drift
    between = np.median([standardised[:-2], standardised[1:-1], standardised[2:]], axis=0)
    between = np.pad(between, 1, mode="edge")
    spike = _few_far(standardised - between, np.diff(standardised))
    standardised[spike] = between[spike]
    # sudden steps would count as noise with a memory; many of them are noise itself, of few
    # distinct values: rounded, or alternating
    steps = np.diff(standardised)
    middle = np.median(steps)
    calm = np.where(_few_far(steps - middle, steps), middle, steps)
    calm = np.concatenate([[0.0], np.cumsum(calm)])
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
        _slow_against_fast(power, fast_power, (fast[:single], trend), at, spectra, band)
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


def _bands(n: int, window: int, at: Frequencies) -> list[int]:
    """Return the ends of the slow bands, as positions in the pooled spectrum; at least one."""
    most = max(2, n // window)
    ends = [min(_FIRST_BAND, most)]
    while ends[-1] * _WIDENING <= most:
        ends.append(ends[-1] * _WIDENING)
    reached = np.cumsum(at.count)
    return [int(np.searchsorted(reached, end)) + 1 for end in ends]


def _slow_against_fast(
    power: Array, fast: Array, single: tuple[Array, Array], at: Frequencies, models: Array,
    band: int,
) -> float:  # fmt: skip
    """Return the p-value of the slow band, predicted from the fast one under models (g, m).

    power, fast (m,): of the series, and of the series without jumps; single (k,), (k, 2): the
    coefficients of the latter and of a line and a parabola at the frequencies that are not pooled.
    """
    from scipy.special import fdtrc

    degrees = float(at.count[band:].sum()) - 2.0
    if degrees < _LEAST_FAST:
        return 1.0
    # cosines end flat, but a drift need not: what leaks of a line and a parabola is removed
    high, (own, trend) = fast[band:].copy(), (part[band:] for part in single)
    if len(own) > 2:
        basis, _ = np.linalg.qr(trend)
        high[: len(own)] = (own - basis @ (basis.T @ own)) ** 2
    size = np.maximum((high / models[:, band:]).sum(axis=1) / degrees, _NOTHING)
    deviance = degrees * np.log(size) + np.log(models[:, band:]) @ at.count[band:]
    slow = float(at.count[:band].sum())
    ratio = (power[:band] / models[:, :band]).sum(axis=1) / slow / size
    return largest_p_value(np.asarray(fdtrc(slow, degrees, ratio)), deviance)


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
