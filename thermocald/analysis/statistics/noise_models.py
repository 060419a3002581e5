"""Models of a series' noise: first-order autoregressive plus white, in the cosine domain.

The coefficients of the cosine transform of a stationary series are nearly independent, with its
spectrum as variances (Whittle's approximation); a likelihood costs one transform. Of long series
the high frequencies, which hold nothing of the slow noise, are pooled, and the last epochs are left
out, a few of ten thousand, where that makes a length with small factors: the transform of a year of
prime length takes 400 MB.

A test that must hold whatever the noise is takes the largest p-value over the models (Berger and
Boos 1994, J. Am. Stat. Assoc. 89, 1012-1016). Models that the data exclude should not count: the
p-value of each is combined, by Fisher's method, with the model's own likelihood ratio.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from thermocald.arrays import Array

# Beyond this many low frequencies, which carry the slow correlation, neighbours are pooled.
_SINGLE_FREQUENCIES = 2000
_POOLED_FREQUENCIES = 1000
_ANY_LENGTH = 200_000  # epochs: up to here a transform is cheap whatever their number
_SMALL_PRIMES = (2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31)

_PHI = (0.2, 0.4, 0.6, 0.75, 0.85, 0.92, 0.95, 0.97, 0.985, 0.995)
_COLOURED = (0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 1.0)


def grid(phi: ArrayLike, coloured: ArrayLike) -> tuple[Array, Array]:
    """All pairs of φ and a (g,), and before them white noise (0, 0)."""
    phis, parts = (g.ravel() for g in np.meshgrid(phi, coloured))
    return np.append(0.0, phis), np.append(0.0, parts)


_GAP = 3.0  # usual intervals between neighbours: a longer one ends a stretch
_TYPICAL_PHI = 0.97

MODELS = grid(_PHI, _COLOURED)
"""φ (g,) and the coloured part a (g,) of the models that tests run through."""


def spectra(frequency: Array, phi: Array, coloured: Array) -> Array:
    """Spectra (g, m) of unit variance at frequencies (m,) rad, correlation a φᵏ at lag k > 0."""
    phi, coloured = phi[:, None], coloured[:, None]
    shape = (1 - phi**2) / (1 + phi**2 - 2 * phi * np.cos(frequency))
    return np.asarray(coloured * shape + (1 - coloured))


@dataclass(frozen=True, eq=False)
class Frequencies:
    """The cosine coefficients of a series with gaps, pooled at high frequencies, lowest first.

    pieces: the rows of each stretch without a gap; contrasts (K - 1, K): orthonormal combinations
    of the stretches' scaled means; pauses (K, K): from the end of one to the begin of another, in
    intervals; order: of the coefficients by frequency; starts (m,): the first coefficient of each
    pool; count (m,): how many; mean (m,) rad, 0 for a contrast.
    """

    pieces: tuple[slice, ...]
    contrasts: Array
    pauses: Array
    order: NDArray[np.int64] | None
    starts: NDArray[np.int64]
    count: Array
    mean: Array

    @classmethod
    def of(cls, n: int, times: Array | None = None) -> Frequencies:
        """The frequencies of n values at times (n,), evenly spaced by default."""
        pieces, pauses = _pieces(n, times)
        lengths = [p.stop - p.start for p in pieces]
        each = [np.arange(1, size) / size for size in lengths]
        K = len(pieces)
        if K == 1:
            order, m = None, lengths[0] - 1
            own = np.zeros(0)
        else:
            own = np.concatenate([np.zeros(K - 1), *each])
            order, m = np.argsort(own, kind="stable"), len(own)
        if m <= _SINGLE_FREQUENCIES + _POOLED_FREQUENCIES:
            starts = np.arange(m)
        else:
            edges = np.geomspace(_SINGLE_FREQUENCIES, m, _POOLED_FREQUENCIES + 1)[:-1].astype(int)
            starts = np.concatenate([np.arange(_SINGLE_FREQUENCIES), np.unique(edges)])
        count = np.diff(starts, append=m).astype(float)
        if order is None:
            mean = np.pi * (starts + (count + 1) / 2) / (m + 1)
        else:
            mean = np.pi * np.add.reduceat(own[order], starts) / count
        found = cls(pieces, np.zeros((0, K)), pauses, order, starts, count, mean)
        if K == 1:
            return found
        # orthonormal, orthogonal to a constant, and independent for noise with a long memory
        root = np.sqrt(np.array(lengths) / sum(lengths))
        flat = np.linalg.svd(root[None])[2][1:]
        slow = found.means_covariance(_TYPICAL_PHI, 1.0)
        return replace(found, contrasts=np.linalg.eigh(flat @ slow @ flat.T)[1].T @ flat)

    def means_covariance(self, phi: float, coloured: float) -> Array:
        """Covariance (K, K) of the stretches' means, times √length, of noise of unit variance."""
        size = np.array([p.stop - p.start for p in self.pieces], dtype=float)
        phi = min(phi, 1.0 - 1e-9)
        geometric = (1.0 - phi**size) / (1.0 - phi)
        own = (size * (1 + phi) - 2 * phi * geometric) / (1.0 - phi) / size
        scaled = geometric / np.sqrt(size)
        between = scaled[:, None] * scaled[None] * phi**self.pauses
        np.fill_diagonal(between, own)
        return np.asarray(coloured * between + (1 - coloured) * np.eye(len(size)))

    def coefficients(self, y: Array) -> Array:
        """Orthonormal coefficients of a series about its mean, without the constant one."""
        if self.order is None:
            return cosines(y)
        sizes = np.array([p.stop - p.start for p in self.pieces])
        means = np.array([y[p].mean() for p in self.pieces])
        slow = self.contrasts @ (means * np.sqrt(sizes))
        every = np.concatenate([slow, *(cosines(y[p]) for p in self.pieces)])
        return np.asarray(every[self.order])

    def sums(self, power: Array) -> Array:
        """Sums (m,) of something per coefficient."""
        return power if len(self.starts) == len(power) else np.add.reduceat(power, self.starts)

    def spectra(self, phi: Array, coloured: Array) -> Array:
        """Mean variances (g, m) of the coefficients of noise of unit variance."""
        out = spectra(self.mean, phi, coloured)
        for k, (one, part) in enumerate(zip(phi, coloured, strict=True)):
            if len(self.contrasts):
                C = self.contrasts
                out[k, : len(C)] = np.einsum("ij,jk,ik->i", C, self.means_covariance(one, part), C)
        return out


def _pieces(n: int, times: Array | None) -> tuple[tuple[slice, ...], Array]:
    """The stretches between gaps, and the pauses (K, K) between them in intervals."""
    whole = (slice(0, _with_small_factors(n)),)
    if times is None or n < 3:
        return whole, np.zeros((1, 1))
    t = times
    steps = np.diff(t)
    usual = float(np.median(steps))
    at = np.flatnonzero(steps > _GAP * usual) + 1
    if not len(at) or not usual > 0:
        return whole, np.zeros((1, 1))
    inside = np.ones(n - 1, dtype=bool)
    inside[at - 1] = False
    interval = float(steps[inside].mean()) if inside.any() else usual
    first, last = np.append(0, at), np.append(at, n)
    pauses = np.maximum(t[first][None] - t[last - 1][:, None], 0.0) / interval
    pauses = np.maximum(pauses, pauses.T)
    lengths = [_with_small_factors(int(k - i)) for i, k in zip(first, last, strict=True)]
    return tuple(slice(int(i), int(i) + m) for i, m in zip(first, lengths, strict=True)), pauses


def cosines(y: Array) -> Array:
    """Orthonormal cosine coefficients of a series (n,) about its mean, without the constant one.

    n - 1 of them, fewer where a long series is cut to a length with small factors.
    """
    from scipy.fft import dct

    y = y[: _with_small_factors(len(y))]
    return np.asarray(dct(y - y.mean(), norm="ortho", overwrite_x=True)[1:])


@lru_cache(maxsize=64)
def _with_small_factors(n: int) -> int:
    """The largest number up to n without a prime factor above 31; n itself where it is small."""
    if n <= _ANY_LENGTH:
        return n
    return next(m for m in range(n, 0, -1) if _is_product(m))


def _is_product(m: int) -> bool:
    for prime in _SMALL_PRIMES:
        while m % prime == 0:
            m //= prime
    return m == 1


def largest_p_value(p: Array, deviance: Array) -> float:
    """The largest combined p-value over the models.

    p (g,): of the test under each model; deviance (g,): -2 log likelihood of each.
    """
    product = p * np.exp(-0.5 * (deviance - deviance.min()))
    log = np.log(np.maximum(product, np.finfo(float).tiny))
    return float(np.max(np.where(product > 0, product * (1 - log), 0.0)))
