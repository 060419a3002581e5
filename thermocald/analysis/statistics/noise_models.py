"""Models of a series' noise: first-order autoregressive plus white, in the cosine domain.

The coefficients of the cosine transform of a stationary series are nearly independent, with its
spectrum as variances (Whittle's approximation); a likelihood costs one transform. Of long series
the high frequencies, which hold nothing of the slow noise, are pooled.

A test that must hold whatever the noise is takes the largest p-value over the models (Berger and
Boos 1994, J. Am. Stat. Assoc. 89, 1012-1016). Models that the data exclude should not count: the
p-value of each is combined, by Fisher's method, with the model's own likelihood ratio.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from thermocald.arrays import Array

__all__ = ["MODELS", "largest_p_value", "pooled", "spectra"]

# Beyond this many low frequencies, which carry the slow correlation, neighbours are pooled.
_SINGLE_FREQUENCIES = 2000
_POOLED_FREQUENCIES = 1000

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


def pooled(frequency: Array, *power: Array) -> tuple[Array, ...]:
    """Counts, mean frequencies and sums of `power`, neighbours at high frequencies pooled."""
    m = len(frequency)
    if m <= _SINGLE_FREQUENCIES + _POOLED_FREQUENCIES:
        return (np.ones(m), frequency, *power)
    edges = np.geomspace(_SINGLE_FREQUENCIES, m, _POOLED_FREQUENCIES + 1)[:-1].astype(int)
    starts = np.concatenate([np.arange(_SINGLE_FREQUENCIES), np.unique(edges)])
    count = np.diff(starts, append=m).astype(float)
    sums = [np.add.reduceat(p, starts) for p in (frequency, *power)]
    return (count, sums[0] / count, *sums[1:])


def largest_p_value(p: Array, deviance: Array) -> float:
    """The largest combined p-value over the models.

    p (g,): of the test under each model; deviance (g,): -2 log likelihood of each.
    """
    product = p * np.exp(-0.5 * (deviance - deviance.min()))
    log = np.log(np.maximum(product, np.finfo(float).tiny))
    return float(np.max(np.where(product > 0, product * (1 - log), 0.0)))
