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

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from thermocald.arrays import Array

__all__ = ["MODELS", "Frequencies", "cosines", "largest_p_value", "spectra"]

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


MODELS = grid(_PHI, _COLOURED)
"""φ (g,) and the coloured part a (g,) of the models that tests run through."""


def spectra(frequency: Array, phi: Array, coloured: Array) -> Array:
    """Spectra (g, m) of unit variance at frequencies (m,) rad, correlation a φᵏ at lag k > 0."""
    phi, coloured = phi[:, None], coloured[:, None]
    shape = (1 - phi**2) / (1 + phi**2 - 2 * phi * np.cos(frequency))
    return np.asarray(coloured * shape + (1 - coloured))


@dataclass(frozen=True, eq=False)
class Frequencies:
    """The frequencies of the coefficients of n epochs, neighbours at high frequencies pooled.

    starts (m,): the first coefficient of each; count (m,): how many; mean (m,) rad.
    """

    starts: NDArray[np.int64]
    count: Array
    mean: Array

    @classmethod
    def of(cls, coefficients: int) -> Frequencies:
        """The frequencies of so many coefficients without the constant one, as of `cosines`."""
        m = coefficients
        if m <= _SINGLE_FREQUENCIES + _POOLED_FREQUENCIES:
            starts = np.arange(m)
        else:
            edges = np.geomspace(_SINGLE_FREQUENCIES, m, _POOLED_FREQUENCIES + 1)[:-1].astype(int)
            starts = np.concatenate([np.arange(_SINGLE_FREQUENCIES), np.unique(edges)])
        count = np.diff(starts, append=m).astype(float)
        return cls(starts, count, np.pi * (starts + (count + 1) / 2) / (m + 1))

    def sums(self, power: Array) -> Array:
        """Sums (m,) of something per coefficient."""
        return power if len(self.starts) == len(power) else np.add.reduceat(power, self.starts)


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
