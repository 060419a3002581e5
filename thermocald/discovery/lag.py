"""A lag of the thermometer behind the camera, which is an alternative to effects and no effect.

If a thermometer follows the camera with a lag τ, all that follows the camera's temperature follows
T + τ dT/dt of the readings T.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from thermocald.discovery import criteria
from thermocald.discovery.search import list_candidates
from thermocald.numbers import enumerated
from thermocald.physics import catalogue
from thermocald.physics.effect import say_estimate
from thermocald.physics.formula import Proportional
from thermocald.thermal.fit import HypothesisFitter

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from thermocald.arrays import Array
    from thermocald.discovery.search import Solution
    from thermocald.thermal.hypothesis import Fit, Term
    from thermocald.thermal.series import ReducedSeries

_LAGS_S = np.geomspace(2.0, 600.0, 11)  # trial values for a thermometer's lag
_NEAR = np.array([0.5, 1.0, 2.0])  # the same, as multiples of an estimate
_TURNS = 4  # estimates of it, each beside the effects found with the one before
_SAME = 0.02  # share of a lag by which a further estimate may change it
_BESIDE = 2  # effects beside a lag of the thermometer
_SURE = 3.0  # least lag of a thermometer, in its standard deviations
_UNLIKE = 0.01  # probability below which the gradients are not one lag times the rates


class Late(NamedTuple):
    """A lag of the thermometer, s, by how much it scores worse, and the effects beside it."""

    tau: float
    worse: float
    names: tuple[str, ...]

    def describe(self, instead: Sequence[str]) -> dict[str, Any]:
        """Describe it as an alternative to some effects, none if nothing else explains the data."""
        replaced = enumerated([n for n in instead if n not in self.names])
        said = f"which fits better: it explains {replaced} by one number"
        if not instead:
            said = f"which with {enumerated(self.names)} reproduces the data"
        beside = [n for n in self.names if n not in instead]
        return describe_lag(self.tau, self.worse, f"about {self.tau:.0f} s, {said}", *beside)


def lagging_thermometer(fit: Fit, number: int) -> dict[str, Any] | None:
    """Return a lag of the thermometer as an alternative to a thermal gradient; None if it is none.

    A thermometer that follows the camera with a lag τ reads T - τ dT/dt. Every parameter that
    drifts with T then has a gradient of τ times its rate, which a bent mount has only by chance.
    """
    from scipy.special import chdtri

    term = fit.terms[number]
    base = next(b for b in fit.blocks if b.term < 0)
    own = next((b for b in fit.blocks if b.term == number), None)
    if not term.kind.follows_rate or own is None or len(own.parameters) < 2:
        return None
    if not set(own.parameters) <= set(base.parameters):
        return None
    a = np.arange(own.start, own.stop)
    r = base.start + np.array([base.parameters.index(p) for p in own.parameters])
    gradients, rates = fit.coefficients[a], fit.coefficients[r]
    tau = float(gradients @ rates / (rates @ rates))
    for _ in range(5):
        J = np.zeros((len(a), len(fit.covariance)))
        J[np.arange(len(a)), a], J[np.arange(len(a)), r] = 1.0, -tau
        weight = np.linalg.inv(J @ fit.covariance @ J.T)
        information = float(rates @ weight @ rates)
        tau = float(rates @ weight @ gradients) / information
    left = gradients - tau * rates
    off = float(left @ weight @ left)
    sd = information**-0.5
    if tau < _SURE * sd or off > chdtri(len(a) - 1, _UNLIKE):
        return None
    said = say_estimate({"value": tau, "sd": sd, "unit": "s"})
    return describe_lag(tau, off, f"{said}: it explains {', '.join(own.parameters)} by one number")


def describe_lag(tau: float, worse: float, said: str, *beside: str) -> dict[str, Any]:
    """Describe a lag of the thermometer, τ s, as an alternative, with effects beside it."""
    return {
        "effect": "+".join(["lagging_thermometer", *beside]),
        "score_difference": worse,
        "values": {"tau": tau},
        "statement": f"the thermometer lags behind the camera by {said}",
        "experiment": "put a small, fast thermometer beside the present one and record again: a "
        "lag of the thermometer disappears, any other cause remains",
    }


def search_behind_lag(
    found: Solution,
    known: int,
    search_in: Callable[[Sequence[ReducedSeries]], tuple[Solution, bool]],
) -> Late | None:
    """Find a lag of the thermometer and few effects that explain the series; None if none do.

    All that drifts with the temperature follows T + τ dT/dt then, which gives τ at first.
    known: number of effects in the model; search_in: searches for effects in series, and tells
    whether they are adequate.
    """
    series = found.fitter.series
    drifts = {
        c.effect: c.term(None, len(series))
        for c in list_candidates(series)
        if isinstance(c.kind, Proportional) and not c.fixed
    }
    terms = (*drifts.values(), *(t for t in found.terms if t.effect not in drifts))
    trials, before = _LAGS_S, np.inf
    for _ in range(_TURNS):
        terms = tuple(t for t in terms if not (t.kind.follows_rate or t.kind.delay))
        objective, tau = _estimate_lag(series, terms, trials)
        if np.isinf(before) and objective > _fit_behind(series, terms, 0.0).objective:
            return None
        late, adequate = search_in([_lead_readings(e, tau) for e in series])
        names, worse = late.names[known:], late.score - found.score
        if worse > -criteria.BAND or not names:
            return None
        few = len(names) <= _BESIDE
        if adequate and few and abs(tau - before) < _SAME * tau:
            return Late(tau, worse, names)
        terms, trials, before = late.terms, tau * _NEAR, tau
    return None


def _estimate_lag(
    series: Sequence[ReducedSeries], terms: Sequence[Term], trials: Array
) -> tuple[float, float]:
    """Estimate the thermometer's lag beside some effects, near the best of some `trials`, s.

    Returns -2 log L and the lag.
    """
    from scipy.optimize import minimize_scalar

    at = int(np.argmin([_fit_behind(series, terms, t).objective for t in trials[1:-1]]))
    best = minimize_scalar(
        lambda t: _fit_behind(series, terms, t).objective, bounds=trials[[at, at + 2]],
        method="bounded", options={"xatol": 0.005 * trials[at + 1], "maxiter": 14},
    )  # fmt: skip
    return float(best.fun), float(best.x)


def _fit_behind(series: Sequence[ReducedSeries], terms: Sequence[Term], tau: float) -> Fit:
    """Fit effects in the temperature that a thermometer with the lag τ s has read."""
    fitter = HypothesisFitter([_lead_readings(e, tau) for e in series])
    return fitter.refine(fitter.fit(terms), max_iterations=8)


def _lead_readings(e: ReducedSeries, tau: float) -> ReducedSeries:
    """Return the series with the temperature that a thermometer with the lag τ s has read."""
    from scipy.sparse import csr_array, diags_array, eye_array

    history, channel = e.history, e.history.reference
    rate, here = catalogue.find(lambda k: k.follows_rate), history.at(history.reading_times)
    change = tau * rate.signal(here)[:, 0]
    instrument = e.thermometers[channel]
    mixing = (eye_array(len(change)) + tau * rate.sensitivity(here)) @ instrument.mixing
    sign = np.where(mixing.diagonal() < 0.0, -1.0, 1.0)  # a knot with an own error has it positive
    late = replace(
        instrument,
        trajectory=instrument.trajectory + change,
        deviation=instrument.deviation * sign,
        mixing=csr_array(mixing @ diags_array(sign)),
    )
    return replace(
        e,
        history=replace(history, readings={
            **history.readings, channel: history.readings[channel] + change
        }),
        thermometers={**e.thermometers, channel: late},
    )  # fmt: skip
