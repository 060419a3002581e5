"""Noise with a memory: the standard deviation of a slope, and how many values a series is worth.

The residuals of a straight line are modelled as first-order autoregressive plus white noise,
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

Sources: Whittle (1953), Estimation and information in stationary time series; Harville (1974),
Biometrika 61, 383-385, for the restricted likelihood; Pyper & Peterman (1998), Can. J. Fish. Aquat.
Sci. 55, 2127-2140, for the effective sample size.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.statistics.noise_models import Frequencies, grid

if TYPE_CHECKING:
    from thermocald.arrays import Array

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
    """What the noise of a series makes of the slope on `x`.

    sd: of the slope; n: values; n_effective: independent values that determine it as well;
    lag_one: correlation of the noise of neighbouring epochs; memory: epochs after which the
    correlated part has fallen to 1/e; too_short: the memory is so long against the series that the
    sd is an order of magnitude only.
    """

    sd: float
    n: int
    n_effective: float
    lag_one: float
    memory: float
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
    unknown = around < min(_ABOVE_NOISE * sd_x**2, float(around.max()))
    del around
    uu, ur = power, u  # in their place: of a year of epochs every array counts
    uu -= sd_x**2
    uu[unknown] = 0.0
    ur *= r
    ur += slope * sd_x**2
    ur[unknown] = 0.0
    r *= r
    uu, ur, rr = at.sums(uu), at.sums(ur), at.sums(r)
    phi, coloured, tau, prior = _models(max(_LONGEST, float(n)))
    spectrum = at.spectra(phi, coloured)

    weight = 1.0 / spectrum
    information = np.maximum(weight @ uu, np.finfo(float).tiny)
    off = weight @ ur / information
    degrees = len(r) - 1
    residual = np.maximum(weight @ rr - off**2 * information, np.finfo(float).tiny)
    deviance = degrees * np.log(residual) + np.log(spectrum) @ at.count + np.log(information)
    plausible = prior * np.exp(-0.5 * (deviance - deviance.min()))
    plausible /= plausible.sum()
    freedom = max(degrees - 2, 1)
    variance = float(plausible @ (residual / freedom / information + off**2))
    # Geometric: models that a short series cannot exclude would rule an arithmetic mean.
    inflation = np.exp(plausible @ np.log(spectrum @ uu / uu.sum()))
    best = int(np.argmax(plausible))
    return SlopeNoise(
        float(np.sqrt(variance)),
        n,
        n / max(1.0, float(inflation)),
        float(plausible @ (phi * coloured)),
        float(tau[best]),
        bool(plausible[tau > _LONG_MEMORY * n].sum() > 0.5),
    )
