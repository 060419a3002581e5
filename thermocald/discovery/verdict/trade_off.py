"""Constants that trade off: two time constants of which the data determine the sum alone.

Two lags of the same size do the same to first order; each by itself is then known to be a time
constant and no more, while their sum is as well determined as one lag alone would be.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.photogrammetry.linalg import inverse_of_determined
from thermocald.simulation.effects.parameter import spoken

if TYPE_CHECKING:
    from thermocald.reduction.fit import HypothesisFitter
    from thermocald.reduction.hypothesis import Fit

__all__ = ["TradeOff", "not_separable"]

LOOSE = 0.5
"""Share of a time constant that its standard deviation exceeds where it is not determined."""


@dataclass(frozen=True)
class TradeOff:
    """names: of two time constants; value, sd s: of their sum."""

    names: tuple[str, str]
    value: float
    sd: float

    @property
    def sentence(self) -> str:
        """What is added to a statement."""
        total = spoken({"value": self.value, "sd": self.sd, "unit": "s"})
        return f"; the time constants are not separable, their sum is {total}"

    def as_json(self) -> dict[str, Any]:
        """For the evidence of the effect."""
        return {"parameters": list(self.names), "sum": self.value, "sd": self.sd, "unit": "s"}


def not_separable(fitter: HypothesisFitter, fit: Fit, number: int) -> TradeOff | None:
    """Two time constants of a term that M1 does not separate; None where it does.

    The standard deviation is that of the one where the other is held, which is that of their sum.
    """
    term, K = fit.terms[number], len(fit.coefficients)
    loose = []
    for place, (owner, name) in enumerate(fit.searched, K):
        value = float(dict(fit.terms[owner].nonlinear)[name])
        sd = float(np.sqrt(fit.covariance[place, place]))
        is_time = term.kind.nonlinear[name].unit == "s" if owner == number else False
        if is_time and not sd <= LOOSE * abs(value):
            loose.append((place, name, value))
    if len(loose) != 2:
        return None
    (one, first, a), (two, second, b) = loose
    A, _, _ = fitter.normal_equations(fit, only=[0])
    kept = np.delete(np.arange(len(A)), two)
    Q = inverse_of_determined(A[np.ix_(kept, kept)])
    sd = float(np.sqrt(Q[kept.tolist().index(one), kept.tolist().index(one)]))
    return TradeOff((first, second), a + b, sd)
