"""What belongs to a series of a known model: the phases of its cycles, its events.

All constants are the model's; an amplitude keeps its size, and an event its own height and time.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.thermal.terms import event_worth
from thermocald.photogrammetry.linalg import scaled_solve
from thermocald.physics import catalogue
from thermocald.thermal.fit import HypothesisFitter
from thermocald.thermal.hypothesis import BASE, Term, make_candidate, make_known_term
from thermocald.thermal.scan import Scanner
from thermocald.thermal.series import COLUMNS

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.physics.model import ModelEffect, ThermalModel
    from thermocald.thermal.hypothesis import Fit
    from thermocald.thermal.series import ReducedSeries

__all__ = ["with_own"]

_ROUNDS = 3  # phases and events look for each other


def with_own(model: ThermalModel, series: ReducedSeries) -> ThermalModel:
    """The model with the phases and events of a series; its T₀ and reference are the model's."""
    listed = {e.name: e for e in model.effects if catalogue.get(e.name).seen_in == "trajectory"}
    own = [e for e in listed if Term(e).is_separate]
    if not own:
        return model
    fitter = HypothesisFitter([series])
    for e in own:
        if catalogue.get(e).is_event:
            listed[e] = _nothing(listed[e])
    for _ in range(_ROUNDS):
        for name in own:
            find = _phase if catalogue.get(name).is_periodic else _event
            listed[name] = find(fitter, model, listed, name)
    return replace(model, effects=tuple(listed.get(e.name, e) for e in model.effects))


def _nothing(effect: ModelEffect) -> ModelEffect:
    """An event that did not happen."""
    return replace(
        effect, values={**effect.values, **dict.fromkeys(catalogue.get(effect.name).linear, 0.0)}
    )


def _known(
    fitter: HypothesisFitter, model: ThermalModel, listed: dict[str, ModelEffect]
) -> tuple[Fit, Array]:
    """A fit of some effects, and their coefficients as the model has them, px-scaled."""
    fit = fitter.fit([make_known_term(e.name, e.values, 1) for e in listed.values()])
    scale = fitter.series[0].scale
    x = fit.coefficients.copy()
    for block in fit.blocks:
        units = np.array([scale[COLUMNS.index(p)] for p in block.parameters])
        if block.term < 0:
            x[block.start : block.stop] = [model.rates.get(p, 0.0) for p in BASE] * units
            continue
        effect = listed[fit.terms[block.term].effect]
        kind = catalogue.get(effect.name)
        names = {kind.column(n): n for n in kind.linear}
        weights = np.array([kind.weights(effect.values, names[p]) for p in block.parameters])
        x[block.start : block.stop] = (weights * units[:, None]).T.ravel()
    return fit, x


def _phase(
    fitter: HypothesisFitter, model: ThermalModel, listed: dict[str, ModelEffect], name: str
) -> ModelEffect:
    """A cycle with the phase that fits best, its amplitude as it is."""
    fit, x = _known(fitter, model, listed)
    block = next(b for b in fit.blocks if b.term >= 0 and fit.terms[b.term].effect == name)
    reduced, index = fit.reduced[0], fit.designs[0][2]
    inside = (index >= block.start) & (index < block.stop)
    A = reduced.A[np.ix_(inside, inside)]
    right = reduced.c[inside] - reduced.A[np.ix_(inside, ~inside)] @ x[index[~inside]]
    pair = x[block.start : block.stop].reshape(2, -1)
    key = next(k for k in listed[name].values if k in catalogue.get(name).fresh)
    phase = float(listed[name].values[key])
    amplitude = pair[0] * np.cos(phase) + pair[1] * np.sin(phase)
    angles = np.linspace(-np.pi, np.pi, 1440, endpoint=False)
    sides = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    trial = (sides[:, :, None] * amplitude).reshape(len(angles), -1)
    cost = np.einsum("ai,ij,aj->a", trial, A, trial) - 2.0 * trial @ right
    best = float(angles[int(np.argmin(cost))])
    return replace(listed[name], values={**listed[name].values, key: best})


def _event(
    fitter: HypothesisFitter, model: ThermalModel, listed: dict[str, ModelEffect], name: str
) -> ModelEffect:
    """An event where it explains most, or none."""
    fit, x = _known(fitter, model, {n: e for n, e in listed.items() if n != name})
    effect, kind = listed[name], catalogue.get(name)
    linear = tuple(n for n in kind.linear if n in effect.values)
    candidate = make_candidate(kind, linear, fitter.series)
    directions = np.eye(len(COLUMNS))[:, [COLUMNS.index(p) for p in candidate.parameters]]
    C, V, index = fit.designs[0]
    stack = Scanner(fitter).stack(candidate, 0, fit)
    A, c, B = fit.weightings[0].scan(stack, directions, (C, V))
    rest = c - B @ x[index]
    heights = scaled_solve(A, rest, 1e-9)
    gain = np.einsum("gi,gi->g", rest, heights)
    best = int(np.argmax(gain))
    series = fitter.series[0]
    if gain[best] <= event_worth(series, len(linear)):
        return _nothing(effect)
    units = series.scale[[COLUMNS.index(p) for p in candidate.parameters]]
    values = dict(zip(linear, (heights[best] / units).tolist(), strict=True))
    time = float(0.5 * (series.times[best] + series.times[best + 1]))
    return replace(effect, values={**effect.values, **values, candidate.name: time})
