"""Fit of a thermal model: one adjustment over all image points of all series of a camera.

The effects of the model are the terms of a hypothesis that is fitted as discovery fits it
(`thermal.fit`): rates and coefficients by generalised least squares, non-linear parameters by
Gauss-Newton. The thermometers' errors, one per reading, are propagated through each effect's own
operator and eliminated. Their size is estimated from the roughness of the readings, the image noise
from the residuals of a free camera per epoch, so neither absorbs what the model lacks.

The residuals are tested against both (`examine_rest`). If an effect is missing, the covariance is
widened by its possible influence on the unknowns, and the result states it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.analysis.thermal.level import estimate_step
from thermocald.analysis.thermal.result import build_camera
from thermocald.errors import DataError
from thermocald.physics import catalogue
from thermocald.thermal.fit import HypothesisFitter, choose_distortion
from thermocald.thermal.hypothesis import BASE, Term, make_candidate, targets_of
from thermocald.thermal.movement import add_jumps_to_noise
from thermocald.thermal.noise import (
    calibrate_thermometers,
    estimate_noise_slope,
    sharpen_trajectories,
    weight_slow_noise,
)
from thermocald.thermal.reduce import reweight, without_targets
from thermocald.thermal.scan import Scanner, remove_curvature
from thermocald.thermal.series import in_blocks

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from thermocald.analysis.thermal.thermal_camera import ThermalCamera
    from thermocald.physics.model import Distortion, ModelEffect
    from thermocald.thermal.hypothesis import Fit
    from thermocald.thermal.series import ReducedSeries

_EVENT_MARGIN = 16.0  # χ² that an event has to explain beyond what a search finds by chance


def fit_thermal_model(
    series: Sequence[ReducedSeries],
    listed: Sequence[ModelEffect] = (),
    T0: float | None = None,
    search: bool = True,
    fixed: Sequence[str] = (),
    priors: Mapping[str, tuple[float, float]] | None = None,
    distortion: Distortion | None = None,
) -> ThermalCamera:
    """Fit the base model and some effects to all series of a camera together.

    listed: effects with initial values; with `search`, their non-linear parameters are first
    searched over their whole range (an event always is); fixed: names such as `thermal_lag.tau`
    that keep their initial values; priors: {such a name: (value, sd)}; T0 °C: by default the mean
    temperature; distortion: what it follows, by default what the series show. Raises DataError for
    series of different cameras, resolutions or reference thermometers, or of one temperature.
    """
    _check(series, listed)
    temperatures = np.concatenate([s.history.temperature() for s in series])
    reference = round(float(temperatures.mean()), 1) if T0 is None else T0
    scale = series[0].scale
    basis, sure = (distortion, None) if distortion else choose_distortion(series)
    others = [
        replace(s.in_basis(basis).rescaled(scale), history=replace(s.history, T0=reference))
        for s in series
    ]
    index = series[0].source.field.index
    rows = [index[t] for t in targets_of(listed) if t in index]
    if rows:
        others = [without_targets(s, np.array(rows)) for s in others]
    growth = None
    if any(catalogue.get(e.name).seen_in == "noise" for e in listed):
        growth = estimate_noise_slope(others)
        others = [reweight(s, n) for s, n in zip(others, growth.noise, strict=True)]
    fitter, fit = _fit_hypothesis(others, listed, search, frozenset(fixed), dict(priors or {}))
    moved = [estimate_step(s, np.array(rows)) for s in others] if rows else []
    return build_camera(fitter, fit, others, listed, growth, moved, sure)


def _fit_hypothesis(
    series: Sequence[ReducedSeries],
    listed: Sequence[ModelEffect],
    search: bool,
    held: frozenset[str],
    priors: dict[str, tuple[float, float]],
) -> tuple[HypothesisFitter, Fit]:
    """Fit the hypothesis of all effects that act on trajectories."""
    ready = [in_blocks(weight_slow_noise(s)) for s in calibrate_thermometers(series)]
    fitter = HypothesisFitter(ready)
    fitter.held, fitter.priors = held, priors
    fit = fitter.fit(())
    for effect in listed:
        if catalogue.get(effect.name).seen_in == "trajectory":
            fit = fitter.fit((*fit.terms, make_term(fitter, fit, effect, search)))
    fit = fitter.refine(fit, 20, least_squares=True)
    terms = without_chance_events(fitter, fit)
    if terms != fit.terms:
        fit = fitter.refine(fitter.fit(terms), 20, least_squares=True)
    for again in (sharpen_trajectories, sharpen_trajectories, remove_curvature, add_jumps_to_noise):
        fit = fitter.refine_in(again(fitter, fit), fit)
    return fitter, fit


def _check(series: Sequence[ReducedSeries], listed: Sequence[ModelEffect]) -> None:
    """Raise DataError for series that one model cannot be fitted to."""
    if not series:
        raise DataError("there is no series to fit a model to")
    first = series[0].source
    for reduced in series:
        s = reduced.source
        if s.camera != first.camera:
            raise DataError(
                f"{s.name} is of camera {s.camera}, {first.name} of {first.camera}: a thermal "
                "model belongs to one camera"
            )
        if s.sensor != first.sensor:
            raise DataError(
                f"{s.name} has {s.sensor.width}×{s.sensor.height} px of "
                f"{s.sensor.pixel_pitch:g} mm, {first.name} {first.sensor.width}×"
                f"{first.sensor.height} px of {first.sensor.pixel_pitch:g} mm: fit series of one "
                "resolution; a model is scaled to another when it is used"
            )
        if reduced.history.reference != series[0].history.reference:
            raise DataError(
                f"{s.name}: the reference temperature is {reduced.history.reference!r}, in "
                f"{first.name} it is {series[0].history.reference!r}; put the same one first"
            )
    span = max(float(np.ptp(s.history.temperature())) for s in series)
    if span < 1.0:
        raise DataError(
            f"the temperature changes by only {span:.2f} K: heat the camera by several kelvin"
        )
    moved = targets_of(listed)
    for e in listed:
        if catalogue.get(e.name).seen_in == "targets" and not any(
            t in first.field.index for t in moved
        ):
            raise DataError(
                f"{e.name}: none of the targets {', '.join(moved) or '(none)'} is in the test field"
            )


def make_term(fitter: HypothesisFitter, fit: Fit, effect: ModelEffect, search: bool) -> Term:
    """Return an effect as a term to add to a fitted hypothesis.

    search: search its non-linear parameters over their whole range, except those in `fitter.held`;
    the time of an event is always searched, in each series.
    """
    kind = catalogue.get(effect.name)
    given = tuple(n for n in kind.linear if n in effect.values) or kind.usual
    names = BASE if kind.is_drive else given
    text = {k: effect.values[k] for k, p in kind.nonlinear.items() if p.text and k in effect.values}
    numbers = {
        k: float(effect.values[k])
        for k, p in kind.nonlinear.items()
        if k in effect.values and not p.text and k not in kind.fresh
    }
    held = {k: v for k, v in numbers.items() if f"{effect.name}.{k}" in fitter.held}
    candidate = make_candidate(kind, names, fitter.series, (*text.items(), *held.items()))
    if kind.is_event:
        found = Scanner(fitter).scan(candidate, fit)
        fresh: list[tuple[tuple[str, Any], ...] | None] = []
        for s, gains in enumerate(found.events):
            best = int(np.argmax(gains))
            least = event_threshold(fitter.series[s], found.coefficients)
            time = float(fitter.series[s].times[best + 1])
            fresh.append(((candidate.name, time),) if gains[best] > least else None)
        return Term(effect.name, candidate.parameters, candidate.fixed, tuple(fresh))
    if search and candidate.name:
        found = Scanner(fitter).scan(candidate, fit)
        return candidate.term(float(candidate.grid[found.best]), len(fitter.series))
    return Term(effect.name, candidate.parameters, (*text.items(), *numbers.items()))


def event_threshold(series: ReducedSeries, coefficients: int) -> float:
    """Return the χ² that an event has to explain, given its coefficients and the times tried."""
    n = max(int((series.n > 0).sum()), 2)
    return float((coefficients + 2) * np.log(n) + _EVENT_MARGIN)


def without_chance_events(fitter: HypothesisFitter, fit: Fit) -> tuple[Term, ...]:
    """Return a fit's terms without events that explain no more than chance beside the others."""
    terms = list(fit.terms)
    for block in fit.blocks:
        if block.term < 0 or not terms[block.term].kind.is_event or block.series is None:
            continue
        place = slice(block.start, block.stop)
        heights, cofactor = fit.coefficients[place], fit.covariance[place, place]
        gain = float(heights @ np.linalg.solve(cofactor, heights))
        if gain <= event_threshold(fitter.series[block.series], len(heights)):
            fresh = list(terms[block.term].fresh)
            fresh[block.series] = None
            terms[block.term] = replace(terms[block.term], fresh=tuple(fresh))
    return tuple(terms)
