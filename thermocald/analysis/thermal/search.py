"""Where an effect's non-linear parameters fit best, over their whole range.

A grid of trials, each one step of the fit with the variances held. What belongs to a series (an
event, a phase) is looked for in that series alone.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.analysis.thermal.fit import ModelFit
from thermocald.analysis.thermal.state import FitState, is_event, own_of, unknowns_of
from thermocald.simulation import effects

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from thermocald.analysis.thermal.series import ModelSeries
    from thermocald.simulation.model import ModelEffect

    Array = NDArray[np.float64]

__all__ = ["frame_interval", "search_effect", "search_own"]

_GRID = 33  # trial values of a non-linear parameter
_PHASES = 8
_INSTANTS = 60  # of an event, before it is looked at frame by frame
_SEARCHED = 2  # series in which they are tried


def search_effect(series: Sequence[ModelSeries], state: FitState, whole: bool = True) -> FitState:
    """The state with the last effect's non-linear parameters where they fit best.

    whole: otherwise what all series share stays, and what belongs to each is looked for alone.
    """
    effect = state.model.effects[-1]
    spans = [float(np.ptp(s.history.temperature())) for s in series]
    most = np.argsort(spans)[::-1].tolist()
    if whole and not is_event(effect):
        # a phase is of one series: more than one would multiply the trials
        some = sorted(most[: 1 if own_of(effect) else _SEARCHED])
        fit = ModelFit([series[k] for k in some])
        before = replace(state.model, effects=state.model.effects[:-1])
        part = fit.solve(replace(state, model=before).of_some(some))
        part = _searched(fit, replace(part, model=replace(part.model, effects=state.model.effects)))
        listed = (*state.model.effects[:-1], part.model.effects[-1])
        state = replace(state, model=replace(state.model, effects=listed))
    if own_of(effect):
        for k, s in enumerate(series):
            state = search_own(s, state, k)
    return state


def search_own(series: ModelSeries, state: FitState, k: int, free: bool = True) -> FitState:
    """The state with what belongs to series k of the last effect: a phase, or an event.

    free: whether the drifts that all series share may move meanwhile. An event that is not there
    gets the height 0, which is held.
    """
    effect = state.model.effects[-1]
    part = state.of_some([k])
    if not free:
        part = replace(part, fixed=part.fixed | part.drifts)
    fit = ModelFit([series])
    if not is_event(effect):
        # half a turn of the phase is a sign of the amplitude, which all series share
        sizes = frozenset(f"{effect.name}.{n}" for n in unknowns_of(effect))
        part = fit.solve(replace(part, fixed=part.fixed | sizes))
        phases = np.linspace(-np.pi, np.pi, _PHASES, endpoint=False)
        _, values = _best(fit, part, [{"phase": float(v)} for v in phases])
        return state.with_own(k, {f"{effect.name}.phase": float(values["phase"])})
    nothing = {f"{effect.name}.{n}": 0.0 for n in own_of(effect)}
    still = _with_values(part, dict.fromkeys(own_of(effect), 0.0))
    still = fit.solve(replace(still, fixed=part.fixed | set(nothing)))
    without, _ = _best(fit, still, [{}])
    frames = np.unique(series.history.times)
    instants = 0.5 * (frames[1:] + frames[:-1])
    stride = max(len(instants) // _INSTANTS, 1)
    _, values = _best(fit, part, [{"time": float(t)} for t in instants[::stride]])
    near = np.abs(instants - values["time"]) <= stride * frame_interval(frames)
    cost, values = _best(fit, part, [{"time": float(t)} for t in instants[near]])
    heights = {f"{effect.name}.{n}": float(values[n]) for n in own_of(effect)}
    # Bayesian information of the heights and the instant, and every instant was a trial
    worth = (len(heights) + 1) * np.log(2.0 * series.count.sum()) + 2.0 * np.log(len(instants))
    happened = without - cost > worth
    if not happened:
        heights = nothing
        state = replace(state, fixed=state.fixed | {f"{n}@{k}" for n in nothing})
    own = {**heights, f"{effect.name}.time": float(values["time"])}
    return state.with_own(k, own)


def _searched(fit: ModelFit, state: FitState) -> FitState:
    """Try the last effect's non-linear parameters over their range, keep what fits best."""
    effect = state.model.effects[-1]
    kind = effects.get(effect.name)
    trials: list[dict[str, float]] = [{}]
    for key, p in kind.nonlinear.items():
        if p.text or key == "phase" or f"{effect.name}.{key}" in state.fixed:
            continue
        grid = _grid(fit.series, key, p.low, p.high, p.log)
        trials = [{**t, key: float(value)} for t in trials for value in grid]
    if "phase" in kind.nonlinear:
        trials = [
            {**t, "phase": phase, kind.usual[0]: 1e-9} for t in trials for phase in (0.0, np.pi / 2)
        ]
    if len(trials) == 1:
        return state
    _, values = _best(fit, state, trials)
    return _with_values(state, values)


def _best(
    fit: ModelFit, state: FitState, trials: Sequence[Mapping[str, float]]
) -> tuple[float, dict[str, Any]]:
    """The trial values of the last effect that fit best in one step: their cost, all its values."""
    effect = state.model.effects[-1]
    variance, sds = fit.variance, list(fit.error_sds)
    held = frozenset(f"{effect.name}.{key}" for key in effects.get(effect.name).nonlinear)
    best, chosen = np.inf, dict(effect.values)
    for trial in trials:
        tried = _with_values(replace(state, fixed=state.fixed | held), trial)
        fit.variance, fit.error_sds = variance, list(sds)
        step, _ = fit.step(tried)
        # what is left with the variances held: comparable between trials
        if fit.cost < best:
            best, chosen = fit.cost, dict(tried.moved(step).of_series(0).effects[-1].values)
    fit.variance, fit.error_sds = variance, list(sds)
    return best, chosen


def _with_values(state: FitState, values: Mapping[str, Any]) -> FitState:
    """The state with other values of the last effect, in all its series."""
    effect = state.model.effects[-1]
    changed: ModelEffect = replace(effect, values={**effect.values, **values})
    own = tuple({n: v for n, v in o.items() if n.split(".")[0] != effect.name} for o in state.own)
    listed = (*state.model.effects[:-1], changed)
    return replace(state, model=replace(state.model, effects=listed), own=own)


def frame_interval(times: Array) -> float:
    """The usual time between two frames, s."""
    steps = np.diff(np.unique(times))
    return float(np.median(steps[steps > 1e-3]))


def _grid(series: Sequence[ModelSeries], key: str, low: float, high: float, log: bool) -> Array:
    times = np.concatenate([s.history.times for s in series])
    temperatures = np.concatenate([s.history.temperature() for s in series])
    if key == "T_k":
        low, high = np.quantile(temperatures, [0.05, 0.95])
    if key == "half_width":
        high = min(high, 0.5 * float(np.ptp(temperatures)))
    if key == "P":
        span = float(np.ptp(times))
        # equal steps in frequency, fine enough that no period is jumped over
        frequencies = np.arange(1.5 / span, 1.0 / (2.2 * frame_interval(times)), 0.4 / span)
        return np.asarray(1.0 / frequencies)
    if key == "tau":
        high = min(high, float(np.ptp(times)))
    grid: Array = np.geomspace(low, high, _GRID) if log else np.linspace(low, high, 2 * _GRID)
    return grid
