"""The noise of grey values: its variance as a straight line in the grey value.

A sensor's variance grows with the light (photon noise) over a floor (reading and quantisation):
var(g) = floor + gain·g. Both are estimated from the residuals of a frame's own fits.

Source: EMVA standard 1288, release 4.0, section 2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["NoiseModel", "estimate_noise"]

_QUANTISATION = 1 / 12
_CUT = 4.0  # robust standard deviations beyond which a residual is not noise
_CUT_LOSS = 0.9989  # variance left of a normal distribution cut at 4 sd
_FEWEST = 200
_ENOUGH = 8_000
_BINS = 6


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """var(g) = floor + gain·g, DN² and DN."""

    floor: float
    gain: float = 0.0

    def variance(
        self, grey: NDArray[np.floating[Any]] | np.floating[Any]
    ) -> NDArray[np.floating[Any]]:
        """Variance in DN² at grey values, never below what quantisation leaves."""
        v: NDArray[np.floating[Any]] = np.maximum(self.floor + self.gain * grey, _QUANTISATION)
        return v

    def scaled(self, factor: float) -> NoiseModel:
        """The same with every variance times a factor."""
        return NoiseModel(self.floor * factor, self.gain * factor)


def estimate_noise(
    grey: NDArray[np.floating[Any]], residuals: NDArray[np.floating[Any]], unknowns: int = 0
) -> NoiseModel:
    """From grey values and residuals (n,) DN of fits that had so many unknowns in all.

    Gross residuals are cut. The line goes through the variances of bins of equal count, weighted
    by their own precision, twice; a constant where the grey values say no more.
    """
    freedom = np.sqrt(max(len(residuals) - unknowns, 1) / max(len(residuals), 1))
    thin = max(len(residuals) // _ENOUGH, 1)
    grey, residuals = grey[::thin].astype(float), residuals[::thin].astype(float) / freedom
    sd = 1.4826 * float(np.median(np.abs(residuals))) if len(residuals) else 0.0
    sd = max(sd, np.sqrt(_QUANTISATION))
    good = np.abs(residuals) < 2 * _CUT * sd
    g, r2 = grey[good], residuals[good] ** 2
    if len(g) < _FEWEST:
        return NoiseModel(max(float(r2.mean()) if len(g) else sd * sd, _QUANTISATION))
    edges = [len(g) * k // _BINS for k in range(1, _BINS)]
    bins = np.split(np.argpartition(g, edges), edges)
    x = np.array([g[b].mean() for b in bins])
    v = np.empty(_BINS)
    for i, b in enumerate(bins):
        scale = 2.1981 * np.median(r2[b])  # median of chi-square with one degree of freedom
        kept = r2[b][r2[b] < _CUT**2 * max(scale, _QUANTISATION)]
        v[i] = kept.mean() / _CUT_LOSS
    if np.ptp(x) < 20:
        return NoiseModel(max(float(v.mean()), _QUANTISATION))
    line = v
    for _ in range(2):
        weight = 1 / np.maximum(line, _QUANTISATION)
        gain, floor = np.polyfit(x, v, 1, w=weight)
        line = floor + gain * x
    if gain < 0 or floor + gain * x[0] < _QUANTISATION:
        return NoiseModel(max(float(v.mean()), _QUANTISATION))
    return NoiseModel(float(floor), float(gain))
