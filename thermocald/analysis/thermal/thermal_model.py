"""Fit of a thermal model: one adjustment over all image points of all series of a camera.

The effects of the model are the terms of a hypothesis that is fitted as discovery fits it
(`thermal.fit`): rates and coefficients by generalised least squares, non-linear parameters by
Gauss-Newton. The thermometers' errors, one per reading, are propagated through each effect's own
operator and eliminated. Their size is estimated from the roughness of the readings, the image noise
from the residuals of a free camera per epoch, so neither absorbs what the model lacks.

The residuals are tested against both (`examine_rest`). If an effect is missing, the covariance is
widened by its possible influence on the unknowns, and the result states it.

A type is the mean of several specimens and the scatter between them. Its standard deviations are
those of one more specimen: they contain the scatter and the uncertainty of the mean. A type serves
a user who did not calibrate, and is the prior for a camera measured at few temperatures.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import stdtrit

from thermocald.analysis.statistics.random_effects import Population, population
from thermocald.analysis.thermal.prediction_test import NORMAL_95, estimate_step, predicted_error
from thermocald.analysis.thermal.result import build_camera, with_covariance
from thermocald.analysis.thermal.thermal_camera import ThermalCamera
from thermocald.errors import DataError
from thermocald.names import tell_apart
from thermocald.photogrammetry.linalg import scaled_inverse
from thermocald.physics import catalogue
from thermocald.thermal.fit import HypothesisFitter, choose_distortion
from thermocald.thermal.hypothesis import targets_of
from thermocald.thermal.movement import add_jumps_to_noise
from thermocald.thermal.noise import (
    calibrate_thermometers,
    estimate_noise_slope,
    sharpen_trajectories,
    weight_slow_noise,
)
from thermocald.thermal.reduce import reweight, without_targets
from thermocald.thermal.scan import make_term, remove_curvature, without_chance_events
from thermocald.thermal.series import in_blocks

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from thermocald.physics.model import Distortion, ModelEffect, ThermalModel
    from thermocald.thermal.hypothesis import Term
    from thermocald.thermal.series import ReducedSeries


_FEWEST, _FEW = 5, 30  # third differences of readings from which their noise was estimated
_ALIKE = 2.3  # that count as one: the correlations are -3/4, 3/10 and -1/20, and 1 + 2 Σ r² = 2.3


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
    # the hypothesis of all effects that act on trajectories
    calibrated = _allow_for_few_readings(calibrate_thermometers(others))
    ready = [in_blocks(weight_slow_noise(s)) for s in calibrated]
    fitter = HypothesisFitter(ready)
    fitter.held, fitter.priors = frozenset(fixed), dict(priors or {})
    terms: tuple[Term, ...] = ()
    for effect in listed:
        if catalogue.get(effect.name).seen_in == "trajectory":
            terms = (*terms, make_term(fitter, terms, effect, search))
    fit = fitter.refine(fitter.fit(terms), 20, least_squares=True)
    terms = without_chance_events(fitter, fit)
    if terms != fit.terms:
        fit = fitter.refine(fitter.fit(terms), 20, least_squares=True)
    for again in (sharpen_trajectories, sharpen_trajectories, remove_curvature, add_jumps_to_noise):
        fit = fitter.refine_in(again(fitter, fit), fit)
    moved = [estimate_step(s, np.array(rows)) for s in others] if rows else []
    return build_camera(fitter, fit, others, listed, growth, moved, sure)


def _allow_for_few_readings(series: list[ReducedSeries]) -> list[ReducedSeries]:
    """Return the series with a thermometer's noise by which 95 % of errors are below 1.96 sds.

    Its estimate from few readings is uncertain itself (Student's t); more epochs show it, too.
    """
    names = [e.history.reference for e in series]
    known = [e.thermometers[n] for e, n in zip(series, names, strict=True)]
    count = sum(max(int(k.real.sum()) - 3, 0) for k in known)
    if not _FEWEST <= count < _FEW:
        return series
    wider = float(stdtrit(count / _ALIKE, 0.975)) / NORMAL_95
    known = [replace(k, sd=wider * k.sd, noise=wider * k.noise) for k in known]
    return [
        replace(e, thermometers={**e.thermometers, n: k})
        for e, n, k in zip(series, names, known, strict=True)
    ]


def _check(series: Sequence[ReducedSeries], listed: Sequence[ModelEffect]) -> None:
    """Raise DataError for series that one model cannot be fitted to."""
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
                f"{s.name} has {s.sensor}, {first.name} {first.sensor}: fit series of one "
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


def fit_camera(
    series: Sequence[ReducedSeries], listed: Sequence[ModelEffect], T0: float | None
) -> ThermalCamera:
    """Fit one camera; each of several series is also predicted from a fit to the others."""
    camera = fit_thermal_model(series, listed, T0)
    model, fitted = camera.model, camera.fitted or {}
    errors = []
    for k, left_out in enumerate(series if len(series) > 1 else ()):
        rest = [s for i, s in enumerate(series) if i != k]
        others = fit_thermal_model(
            rest, model.effects, model.T0, search=False, distortion=model.distortion
        )
        errors.append(predicted_error(others.model, left_out, fitted["series"][k].thermometer_sd))
    names = tell_apart([one.name for one in fitted["series"]], [s.source.name for s in series])
    for key, found in (("series", fitted["series"]), ("prediction_test", errors)):
        fitted = {**fitted, key: [replace(f, name=n) for f, n in zip(found, names, strict=False)]}
    return replace(camera, fitted=fitted)


def fit_type(
    series: Sequence[ReducedSeries], listed: Sequence[ModelEffect], T0: float | None, name: str
) -> ThermalCamera:
    """Fit each of several cameras and return their type: the model of one more specimen."""
    cameras = list(dict.fromkeys(s.source.camera for s in series))
    if T0 is None:
        T0 = round(float(np.mean([s.history.temperature().mean() for s in series])), 1)
    own = [[s for s in series if s.source.camera == c] for c in cameras]
    distortion, _ = choose_distortion(series)
    models = [fit_thermal_model(s, listed, T0, distortion=distortion).model for s in own]
    found = type_model(models, name)
    return ThermalCamera(found, {"cameras": cameras, "series": [], "prediction_test": []})


def type_model(models: Sequence[ThermalModel], name: str) -> ThermalModel:
    """Return the type model of several cameras' models, which must share one structure and one T₀.

    Raises DataError for fewer than two models, or for models that are not alike.
    """
    if len(models) < 2:
        raise DataError("a type model needs at least two cameras")
    # an event of one camera is no property of the type
    models = [
        replace(m, effects=tuple(e for e in m.effects if not catalogue.get(e.name).is_event))
        for m in models
    ]
    first = models[0]
    for m in models[1:]:
        same = [e.name for e in m.effects] == [e.name for e in first.effects]
        same = same and m.distortion == first.distortion
        if m.sensor != first.sensor or m.T0 != first.T0 or not same:
            raise DataError(
                f"the models of {first.camera} and {m.camera} are not alike: sensor, reference "
                "temperature and effects must be the same; fit them with the same options"
            )
    names = _names(first)
    values = np.array([[m.value(n) for n in names] for m in models])
    people = population(values, np.array([m.covariance_of(names) for m in models]))
    low, high = zip(*(next(iter(m.validity.values())) for m in models if m.validity), strict=True)
    channel = next(iter(first.validity), "temperature")
    mean = with_covariance(first, names, people.mean, people.prior)
    own = {k: v for k, v in mean.sds.items() if k.split(".")[0] in ("interior", "rates")}
    return replace(
        mean,
        camera=name,
        name=f"type {name}, {len(models)} cameras",
        exterior=None,
        sds=own,
        evidence={},
        validity={channel: (max(low), min(high))} if max(low) < min(high) else first.validity,
        fitted_on=tuple({"camera": m.camera, "version": m.version} for m in models),
    )


def fit_with_type(series: Sequence[ReducedSeries], kind: ThermalModel) -> ThermalCamera:
    """Fit a camera that was measured at few temperatures, with its type as prior.

    Non-linear parameters, which few temperatures may not determine at all, have the type's values
    as priors in the adjustment; all others are shrunk towards the type afterwards. Raises
    DataError.

    `fitted["type"]` holds weights {rate or effect's parameter: fraction that comes from the type}:
    the parameter's variance over its variance among the cameras of the type. A weight is 1 if the
    recordings do not determine the parameter, so that its value and standard deviation are the
    type's, and near 0 if they determine it fully.
    """
    require_type(kind)
    sd = {e.name: e.sds for e in kind.effects}
    priors = {
        f"{e.name}.{key}": (float(value), float(sd[e.name][key]))
        for e in kind.effects
        for key, value in e.values.items()
        if key in catalogue.get(e.name).nonlinear and sd[e.name].get(key, 0.0) > 0
    }
    fixed = [
        f"{e.name}.{key}"
        for e in kind.effects
        for key in catalogue.get(e.name).nonlinear
        if f"{e.name}.{key}" not in priors
    ]
    fitted = fit_thermal_model(series, kind.effects, kind.T0, False, fixed, priors, kind.distortion)
    model = shrink_to_type(fitted.model, kind, priors)
    names = [n for n in _names(kind) if not n.startswith("interior.") and kind.sd(n) > 0]
    weights = {n: min(1.0, (model.sd(n) / kind.sd(n)) ** 2) for n in names}
    about = {"name": kind.camera, "cameras": len(kind.fitted_on), "weights": weights}
    return replace(fitted, model=model, fitted={**(fitted.fitted or {}), "type": about})


def require_type(kind: ThermalModel) -> None:
    """Raise DataError for a model that is not a type's."""
    if kind.covariance is None or len(kind.fitted_on) < 2 or not all(
        "camera" in one for one in kind.fitted_on
    ):  # fmt: skip
        raise DataError(f"{kind.name or kind.camera} is not a type model (`fit --type` writes one)")


def shrink_to_type(
    model: ThermalModel,
    kind: ThermalModel,
    priors: Mapping[str, tuple[float, float]] | None = None,
) -> ThermalModel:
    """Combine the model of a camera that was measured at few temperatures with its type.

    model: its own fit; kind: the type from `type_model`, with the same T₀ and effects; priors: the
    type's values that the fit has already used, {name: (value, sd)}. The standard deviations are
    scaled so that 95 % lie within 1.96 of them even with few specimens.
    """
    names = _names(kind)
    require_type(kind)
    if model.sensor != kind.sensor or model.T0 != kind.T0 or _names(model) != names:
        raise DataError(
            f"the model of {model.camera} and the type {kind.camera} are not alike: sensor, "
            "reference temperature and effects must be the same; fit with --t0 and --effect of "
            "the type"
        )
    n = len(kind.fitted_on)
    prior = np.array(kind.covariance)
    own = model.covariance_of(names)
    people = Population(
        np.array([kind.value(name) for name in names]),
        prior / (n + 1),
        prior * n / (n + 1),
        np.zeros_like(prior),
        n - 1.0,
    )
    free = (np.diag(own) > 0) & (np.diag(prior) > 0)
    information = np.zeros_like(prior)
    information[np.ix_(free, free)] = scaled_inverse(own[np.ix_(free, free)])
    values = np.array([model.value(name) for name in names])
    gradient = np.zeros(len(names))
    for name, (value, prior_sd) in (priors or {}).items():
        # the type must count once: the fit's prior is removed
        at = names.index(name)
        information[at, at] -= 1.0 / prior_sd**2
        gradient[at] = (values[at] - value) / prior_sd**2
        if information[at, at] <= 0:
            information[at], information[:, at], gradient[at] = 0.0, 0.0, 0.0
    new = people.posterior(values, information, gradient)
    sd = np.sqrt(np.maximum(np.diag(new.covariance), 0.0))
    wider = np.ones(len(names))
    for i in np.flatnonzero(sd > 0):
        value, low, _ = new.interval(np.eye(len(names))[i])
        wider[i] = (value - low) / (NORMAL_95 * sd[i])
    shrunk = with_covariance(model, names, new.values, new.covariance * np.outer(wider, wider))
    return replace(shrunk, evidence={**model.evidence, "shrunk_to_type": str(kind.camera)})


def _names(model: ThermalModel) -> tuple[str, ...]:
    return tuple(n for n in model.parameter_names() if not n.startswith("exterior."))
