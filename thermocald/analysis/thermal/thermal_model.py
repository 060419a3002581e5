"""Fitting a thermal model: one adjustment over all image points of all series of a camera.

The effects of the model are the terms of a hypothesis that is fitted as discovery fits it
(`reduction.fit`): rates and coefficients by generalised least squares, non-linear parameters by
Gauss-Newton, the thermometers' errors, one per reading, carried through each effect's own operator
and eliminated. Their size is the readings' own roughness, and that of the image noise what a free
camera per epoch leaves: neither can take for itself what the model lacks.

What the model leaves is tested against these two (`examine_rest`). Where an effect is missing, the
covariance is widened by what it may have done to the unknowns, and the result says so.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.thermal.level import moved_targets
from thermocald.analysis.thermal.result import fitted_camera
from thermocald.analysis.thermal.terms import term_of, without_chance_events
from thermocald.errors import DataError
from thermocald.physics import catalogue
from thermocald.thermal.fit import HypothesisFitter, choose_distortion
from thermocald.thermal.movement import add_jumps_to_noise
from thermocald.thermal.noise import (
    calibrate_thermometers,
    estimate_noise_slope,
    sharpen_trajectories,
    weight_slow_noise,
)
from thermocald.thermal.reduce import reweight, without_targets
from thermocald.thermal.scan import remove_curvature
from thermocald.thermal.series import in_blocks

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from thermocald.analysis.thermal.thermal_camera import ThermalCamera
    from thermocald.physics.model import Distortion, ModelEffect
    from thermocald.thermal.hypothesis import Fit
    from thermocald.thermal.series import ReducedSeries


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

    listed: effects with start values; with `search` their non-linear parameters are looked for over
    their whole range first (an event always is); fixed: names such as `thermal_lag.tau` that keep
    their start values; priors: {such a name: (value, sd) known beforehand}; T0 °C: by default the
    mean temperature; distortion: what it follows, by default as the series have it. Raises
    DataError for series of different cameras, or of one temperature.
    """
    checked = _checked(series, listed)
    temperatures = np.concatenate([s.history.temperature() for s in checked])
    reference = round(float(temperatures.mean()), 1) if T0 is None else T0
    scale = checked[0].scale
    basis, sure = (distortion, None) if distortion else choose_distortion(checked)
    checked = [
        replace(s.in_basis(basis).rescaled(scale), history=replace(s.history, T0=reference))
        for s in checked
    ]
    index = checked[0].source.field.index
    rows = [index[t] for t in targets_of(listed) if t in index]
    others = [without_targets(s, np.array(rows)) for s in checked] if rows else checked
    growth = None
    if any(catalogue.get(e.name).seen_in == "noise" for e in listed):
        growth = estimate_noise_slope(others)
        others = [reweight(s, n) for s, n in zip(others, growth.noise, strict=True)]
    fitter, fit = _fitted(others, listed, search, frozenset(fixed), dict(priors or {}))
    moved = [moved_targets(s, np.array(rows)) for s in others] if rows else []
    return fitted_camera(fitter, fit, others, listed, growth, moved, sure)


def targets_of(listed: Sequence[ModelEffect]) -> tuple[str, ...]:
    """The targets that effects name as moving."""
    names: list[str] = []
    for effect in listed:
        targets = effect.values.get("targets", ())
        names += [targets] if isinstance(targets, str) else list(targets)
    return tuple(names)


def _fitted(
    series: Sequence[ReducedSeries],
    listed: Sequence[ModelEffect],
    search: bool,
    held: frozenset[str],
    priors: dict[str, tuple[float, float]],
) -> tuple[HypothesisFitter, Fit]:
    """The hypothesis of all effects that act on trajectories, fitted."""
    ready = [in_blocks(weight_slow_noise(s)) for s in calibrate_thermometers(series)]
    fitter = HypothesisFitter(ready)
    fitter.held, fitter.priors = held, priors
    fit = fitter.fit(())
    for effect in listed:
        if catalogue.get(effect.name).seen_in == "trajectory":
            fit = fitter.fit((*fit.terms, term_of(fitter, fit, effect, search)))
    fit = fitter.refine(fit, max_iterations=20)
    terms = without_chance_events(fitter, fit)
    if terms != fit.terms:
        fit = fitter.refine(fitter.fit(terms), max_iterations=20)
    for again in (sharpen_trajectories, sharpen_trajectories, remove_curvature, add_jumps_to_noise):
        better = again(fitter, fit)
        if better is not None:
            fitter = HypothesisFitter(better)
            fitter.held, fitter.priors = held, priors
            fit = fitter.refine(fitter.fit(fit.terms, fit.coefficients), max_iterations=20)
    return fitter, fit


def _checked(
    series: Sequence[ReducedSeries], listed: Sequence[ModelEffect]
) -> Sequence[ReducedSeries]:
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
            f"the temperature changes by {span:.2f} K only: heat the camera by several kelvin"
        )
    moved = targets_of(listed)
    for e in listed:
        if catalogue.get(e.name).seen_in == "targets" and not any(
            t in first.field.index for t in moved
        ):
            raise DataError(
                f"{e.name}: none of the targets {', '.join(moved) or '(none)'} is in the test field"
            )
    return series
