"""Neighbouring epochs resemble each other: how many independent values a series is worth.

The residuals of a straight line are modelled as first-order autoregressive plus white noise,
correlation at lag k = a·phi^k. Both are integrated over a grid, weighted by the restricted
likelihood in the cosine domain (Whittle's approximation), which costs one cosine transform; plug-in
estimates of the autocorrelation would be biased low in short series, and the p-values with them.

Sources: Whittle (1953), Estimation and information in stationary time series; Bartlett (1935) and
Pyper & Peterman (1998), Can. J. Fish. Aquat. Sci. 55, 2127-2140, for the effective sample size.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.statistics.noise_models import grid, pooled, spectra

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

__all__ = ["Autocorrelation", "noise_autocorrelation"]

_PHI = (0.2, 0.4, 0.6, 0.75, 0.85, 0.92, 0.96, 0.985, 0.995)
_COLOURED = (0.1, 0.2, 0.35, 0.5, 0.75, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class Autocorrelation:
    """Autocorrelation a·phi^k of a series' noise at lag k epochs.

    n: values; n_effective: independent values that determine a slope on `x` as well; phi, coloured:
    the most likely phi and a (0 ≤ a ≤ 1, the rest is white).
    """

    n: int
    n_effective: float
    phi: float
    coloured: float

    @property
    def lag_one(self) -> float:
        """Correlation of neighbouring epochs."""
        return self.phi * self.coloured


def noise_autocorrelation(
    y: Array, x: Array | None = None, *, fitted: bool = False
) -> Autocorrelation:
    """Autocorrelation of y (n,) about its mean, or about its straight line on x (n,).

    Finite values, evenly spaced; n ≥ 4; fitted: y is what an estimated line on x left already.
    Without x, `n_effective` is that of the mean. Gaps
    must be closed up by the caller: values on both sides of a gap then count as neighbours.
    """
    from scipy.fft import dct

    n = len(y)
    v = dct(y - y.mean(), norm="ortho")[1:]
    frequency = np.pi * np.arange(1, n) / n
    u = np.zeros_like(v) if x is None else dct(x - x.mean(), norm="ortho")[1:]
    count, frequency, uu, uv, vv = pooled(frequency, u * u, u * v, v * v)
    phi, coloured = grid(_PHI, _COLOURED)
    spectrum = spectra(frequency, phi, coloured)

    weight = 1.0 / spectrum
    residual = weight @ vv
    degrees = n - 1
    restricted = np.log(spectrum) @ count
    if x is not None:
        information = weight @ uu
        degrees -= 1
        restricted = restricted + np.log(information)
        if not fitted:
            residual = residual - (weight @ uv) ** 2 / information
    deviance = degrees * np.log(np.maximum(residual, np.finfo(float).tiny)) + restricted
    plausible = np.exp(-0.5 * (deviance - deviance.min()))
    plausible[0] *= len(plausible) - 1  # white noise is as likely beforehand as all others together
    plausible /= plausible.sum()
    if x is None:
        # The mean's variance is the spectrum at frequency zero.
        inflation = coloured * (1 + phi) / (1 - phi) + 1 - coloured
    else:
        inflation = spectrum @ uu / uu.sum()
    # Geometric: models that a short series cannot exclude would rule an arithmetic mean.
    best = int(np.argmin(deviance))
    return Autocorrelation(
        n,
        n / max(1.0, float(np.exp(plausible @ np.log(inflation)))),
        float(phi[best]),
        float(coloured[best]),
    )
