"""What a fitted model leaves: the absolute test of a fit, and what it does to the covariance.

The noise of image and thermometer is known without the model: from what a free camera per epoch
leaves, and from the readings' own roughness. Smooth trajectories that are left beyond it are an
effect that the model lacks. Its time series is known as far as it was not absorbed: taken as a
random time series with the power that it has in each order of cosines, it is carried into the
unknowns, and into the interior orientation that the model predicts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.photogrammetry.linalg import inverse_of_determined
from thermocald.reduction.adequacy import examine

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.reduction.adequacy import Adequacy
    from thermocald.reduction.fit import HypothesisFitter
    from thermocald.reduction.hypothesis import Fit

__all__ = ["Missing", "missing"]

# of the image noise: a rest that is significant but smaller widens the covariance, and leaves the
# 95 % bands what they say
_MATERIAL = 0.2
_FEWEST = 30  # epochs of a series below which no trajectory of 14 orders can be examined


@dataclass(frozen=True, eq=False)
class Missing:
    """What a model leaves over in its series.

    found: whether an effect is missing; misfit_px: RMS of the smooth rest, the worst series';
    significance: in standard deviations; unknowns (K + L, K + L), parameters (8, 8): what it adds
    to the covariance of the fit's unknowns and of the interior orientation, px-scaled.
    """

    found: bool
    misfit_px: float
    significance: float
    unknowns: Array
    parameters: Array

    def as_mapping(self) -> dict[str, Any]:
        """As the evidence of a model file has it."""
        return {
            "effect_missing": self.found,
            "misfit_px": round(float(self.misfit_px), 5),
            "significance_sigmas": round(float(self.significance), 1),
        }


def missing(fitter: HypothesisFitter, fit: Fit, free: list[int]) -> Missing:
    """Test every series; free: columns of the interior orientation that take the rest up."""
    size = len(fit.covariance)
    unknowns, parameters = np.zeros((size, size)), np.zeros((len(free), len(free)))
    found, misfit, significance = False, 0.0, 0.0
    for s, e in enumerate(fitter.series):
        if int((e.n > 0).sum()) < _FEWEST:
            continue
        a = examine(fitter, fit, s)
        misfit = max(misfit, a.misfit_px)
        significance = max(significance, a.significance)
        if a.adequate:
            continue
        found = found or a.misfit_px > _MATERIAL * e.sigma_px
        power = _power(a)
        unknowns += _carried(fitter, fit, s, a, power)
        N = e.N.mean(axis=0)
        taken = inverse_of_determined(N[np.ix_(free, free)]) @ N[free] @ a.directions
        half = np.mean(a.trajectories**2, axis=1)
        parameters += taken @ np.einsum("j,jde->de", half, power) @ taken.T / len(fitter.series)
    return Missing(found, misfit, significance, unknowns, parameters)


def _power(a: Adequacy) -> Array:
    """Second moments (ORDERS, D, D) of the rest's amplitudes along the directions.

    An order that the fit has absorbed is as strong as its stronger neighbour.
    """
    along = a.amplitudes @ np.linalg.pinv(a.directions).T
    own = np.sum(along**2, axis=1)
    strongest = np.array([max(own[max(j - 1, 0) : j + 2]) for j in range(len(own))])
    ratio = strongest / np.maximum(own, 1e-300)
    shape = along[int(np.argmax(own))]
    power = np.einsum("j,jd,je->jde", np.minimum(ratio, 4.0), along, along)
    rest = strongest - np.minimum(ratio, 4.0) * own
    total: Array = power + np.einsum("j,d,e->jde", rest / (shape @ shape), shape, shape)
    return total


def _carried(fitter: HypothesisFitter, fit: Fit, series: int, a: Adequacy, power: Array) -> Array:
    """What the rest of one series may have done to the fit's unknowns (K + L, K + L)."""
    C, V, index = fit.designs[series]
    dC, dV, mapping = fitter.derivatives(fit, list(fit.searched), series)
    base = (np.hstack([C, dC]), np.hstack([V, dV]))
    _, _, B = fit.weightings[series].scan(a.trajectories[:, :, None], a.directions, base)
    size, K = len(fit.covariance), len(fit.coefficients)
    T = np.zeros((B.shape[2], size))
    T[np.arange(C.shape[1]), index] = 1.0
    T[C.shape[1] :, K:] = mapping
    lever = fit.covariance @ np.einsum("jdr,rk->jkd", B, T)
    total: Array = np.einsum("jkd,jde,jle->kl", lever, power, lever)
    return total
