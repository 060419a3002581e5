"""What a fitted model leaves: the absolute test of a fit, and what it does to the covariance.

The noise of image and thermometer is known without the model: from what a free camera per epoch
leaves, and from the readings' own roughness. Smooth trajectories that are left beyond it are an
effect that the model lacks. Its time series is known as far as it was not absorbed: taken as a
random time series with the power that it has in each order of cosines, it is carried into the
unknowns, and into the interior orientation that the model predicts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.photogrammetry.linalg import inverse_of_determined
from thermocald.thermal.scan import examine

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.thermal.fit import HypothesisFitter
    from thermocald.thermal.hypothesis import Fit
    from thermocald.thermal.scan import Adequacy

__all__ = ["Missing", "missing"]

# of the image noise: a rest that is significant but smaller widens the covariance, and leaves the
# 95 % bands what they say
_MATERIAL = 0.2
_FEWEST = 30  # epochs, of one series or of the short ones together, that a test needs
_FEWEST_TO_CARRY = 6  # epochs whose rest can be carried into the covariance, tested or not


@dataclass(frozen=True, eq=False)
class Missing:
    """What a model leaves over in its series.

    found: whether an effect is missing, None where a series was not examined and no other misses
    one; misfit_px: RMS of the smooth rest, the worst series'; significance: in standard deviations;
    unknowns (K + L, K + L), parameters (8, 8): what it adds to the covariance of the fit's unknowns
    and of the interior orientation, px-scaled; left_over: what the worst series leaves, in noise.
    """

    found: bool | None
    misfit_px: float
    significance: float
    unknowns: Array
    parameters: Array
    left_over: float = 1.0

    def as_mapping(self) -> dict[str, Any]:
        """As the evidence of a model file has it."""
        return {
            "effect_missing": self.found,
            "misfit_px": round(float(self.misfit_px), 5),
            "significance_sigmas": round(float(self.significance), 1),
            "not_examined": None if self.found is not None else f"fewer than {_FEWEST} epochs",
            "left_over_in_noise": round(float(self.left_over), 3),
        }


def missing(fitter: HypothesisFitter, fit: Fit, free: list[int]) -> Missing:
    """Test every series, the short ones together; free: columns of the interior orientation that
    take the rest up.
    """
    size = len(fit.covariance)
    unknowns, parameters = np.zeros((size, size)), np.zeros((len(free), len(free)))
    found, misfit, significance = False, 0.0, 0.0
    epochs = [int((e.n > 0).sum()) for e in fitter.series]
    tests = {
        s: examine(fitter, fit, s) for s, count in enumerate(epochs) if count >= _FEWEST_TO_CARRY
    }
    short = [s for s in tests if epochs[s] < _FEWEST]
    together = _together([tests[s] for s in short])
    examined = sum(epochs[s] for s in short) >= _FEWEST
    for s, alone in tests.items():
        a = replace(alone, significance=together) if s in short else alone
        e = fitter.series[s]
        misfit = max(misfit, a.misfit_px)
        significance = max(significance, a.significance)
        if a.adequate:
            continue
        found = found or (a.misfit_px > _MATERIAL * e.sigma_px and (examined or s not in short))
        power = _power(a)
        unknowns += _carried(fitter, fit, s, a, power)
        N = e.N.mean(axis=0)
        taken = inverse_of_determined(N[np.ix_(free, free)]) @ N[free] @ a.directions
        half = np.mean(a.trajectories**2, axis=1)
        parameters += taken @ np.einsum("j,jde->de", half, power) @ taken.T / len(fitter.series)
    unseen = min(epochs) < _FEWEST and (not examined or min(epochs) < _FEWEST_TO_CARRY)
    return Missing(
        None if unseen and not found else found, misfit, significance, unknowns, parameters
    )


def _together(tests: list[Adequacy]) -> float:
    """The significance of several tests as one, in standard deviations."""
    free = sum(a.scores.size for a in tests)
    total = sum(float(np.sum(a.scores**2)) for a in tests)
    return (total - free) / float(np.sqrt(2.0 * free)) if free else 0.0


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
