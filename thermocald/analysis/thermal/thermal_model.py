"""Fitting a thermal model: one adjustment over all image points of all series of a camera.

Unknown are the interior orientation at T₀, its rates, the parameters of the effects, and one
exterior orientation per series. The thermometers' errors are unknown too, one per reading, with
their standard deviation as prior: carried through each effect's own operator and eliminated, they
take from the epochs what the thermometer does not know. Their size is estimated with the rest
(variance components), and so is that of the image noise.

The covariance holds image noise, thermometer noise, and the coordinates of the test field. It does
not hold what the model lacks: the test for that is a series that was left out (`predicted_error`).

Source: DESIGN ideas 2, 3 and 5.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.thermal.fit import ModelFit
from thermocald.analysis.thermal.search import frame_interval, search_effect
from thermocald.analysis.thermal.state import FitState
from thermocald.errors import DataError
from thermocald.photogrammetry.camera.camera_model import ExteriorOrientation, InteriorOrientation
from thermocald.simulation import effects
from thermocald.simulation.model import RATED, ModelEffect, ThermalModel

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from thermocald.analysis.thermal.series import ModelSeries

    Array = NDArray[np.float64]

__all__ = ["FittedModel", "SeriesFit", "fit_thermal_model", "targets_of"]


@dataclass(frozen=True, slots=True)
class SeriesFit:
    """How well one series is explained: RMS px of the image points, thermometers' noise K."""

    name: str
    epochs: int
    rms_px: float
    thermometer_sd: float


@dataclass(frozen=True, eq=False)
class FittedModel:
    """A fitted model and what the fit says about itself.

    names (p,): of the unknowns, as `ThermalModel.covariance_names` writes them, what belongs to
    series k as `exterior.X0@k`; covariance (p, p); sigma0: of the image points against their stated
    sigmas. The model's own events and phases are those of the first series.
    """

    model: ThermalModel
    names: tuple[str, ...]
    covariance: Array
    sigma0: float
    series: tuple[SeriesFit, ...]

    def sd(self, name: str) -> float:
        """The standard deviation of one unknown."""
        i = self.names.index(name)
        return float(np.sqrt(self.covariance[i, i]))


def fit_thermal_model(
    series: Sequence[ModelSeries],
    listed: Sequence[ModelEffect] = (),
    T0: float | None = None,
    search: bool = True,
    fixed: Sequence[str] = (),
) -> FittedModel:
    """Fit the base model and some effects to all series together.

    listed: effects with start values; with `search` their non-linear parameters are looked for over
    their whole range first (an instant or a phase always is); fixed: names such as
    `thermal_lag.tau` that keep their start values; T0 °C: by default the mean temperature. Raises
    DataError for series of different cameras, or of one temperature.
    """
    checked = _checked(series, listed)
    temperatures = np.concatenate([s.history.temperature() for s in checked])
    reference = round(float(temperatures.mean()), 1) if T0 is None else T0
    checked = [replace(s, history=replace(s.history, T0=reference)) for s in checked]
    model = ThermalModel(
        checked[0].camera,
        checked[0].sensor,
        reference,
        InteriorOrientation.from_array(checked[0].start[:10]),
        dict.fromkeys(RATED, 0.0),
        name=checked[0].camera,
        version=0,
    )
    state = FitState(model, tuple(s.start[10:].copy() for s in checked), frozenset(fixed))
    fit = ModelFit(checked)
    # while something is missing, a free thermometer noise would take the drift for itself
    fit.components = not listed
    state = fit.solve(state)
    for effect in listed:
        begun = replace(state.model, effects=(*state.model.effects, _started(effect)))
        state = replace(state, model=begun)
        if effects.get(effect.name).seen_in != "noise":
            state = search_effect(checked, state, search)
    if listed:
        state = fit.solve(state)
    fit.take_off_offsets(state)
    fit.components = fit.correcting = True
    state = fit.solve(state)
    if any(effects.get(e.name).seen_in == "noise" for e in listed):
        for _ in range(3):
            state = fit.defocus(state)
            fit.take_off_offsets(state)
            state = fit.solve(state)
    return _result(fit, state)


def targets_of(listed: Sequence[ModelEffect]) -> tuple[str, ...]:
    """The targets that effects name as moving."""
    names: list[str] = []
    for effect in listed:
        targets = effect.values.get("targets", ())
        names += [targets] if isinstance(targets, str) else list(targets)
    return tuple(names)


def _checked(series: Sequence[ModelSeries], listed: Sequence[ModelEffect]) -> list[ModelSeries]:
    if not series:
        raise DataError("there is no series to fit a model to")
    first = series[0]
    for s in series:
        if s.camera != first.camera:
            raise DataError(
                f"series {s.name} is of camera {s.camera}, series {first.name} of {first.camera}: "
                "a thermal model belongs to one camera"
            )
        if s.sensor != first.sensor:
            raise DataError(
                f"series {s.name} has {s.sensor.width}×{s.sensor.height} px of "
                f"{s.sensor.pixel_pitch:g} mm, series {first.name} {first.sensor.width}×"
                f"{first.sensor.height} px of {first.sensor.pixel_pitch:g} mm: fit series of one "
                "resolution; a model is scaled to another when it is used"
            )
        if s.history.reference != first.history.reference:
            raise DataError(
                f"series {s.name}: the reference temperature is {s.history.reference!r}, in series "
                f"{first.name} it is {first.history.reference!r}; put the same one first"
            )
    span = max(float(np.ptp(s.history.temperature())) for s in series)
    if span < 1.0:
        raise DataError(
            f"the temperature changes by {span:.2f} K only: heat the camera by several kelvin"
        )
    moved = targets_of(listed)
    for e in listed:
        if effects.get(e.name).seen_in == "targets" and not any(
            t in first.field.index for t in moved
        ):
            raise DataError(
                f"{e.name}: none of the targets {', '.join(moved) or '(none)'} is in the test field"
            )
    return [s.displacing(moved) if moved else s for s in series]


def _started(effect: ModelEffect) -> ModelEffect:
    """An effect with its usual coefficients, small where nothing was given."""
    kind = effects.get(effect.name)
    values = dict(effect.values)
    if kind.linear and not any(values.get(n, 0.0) for n in kind.linear):
        given = [n for n in kind.linear if n in values] or kind.usual
        values |= dict.fromkeys(given, 0.0)
    return replace(effect, values=values)


def _result(fit: ModelFit, state: FitState) -> FittedModel:
    """The model with standard deviations, the test field's coordinates included."""
    names = state.names
    covariance = fit.Q + _field_covariance(fit, state)
    sd = dict(zip(names, np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist(), strict=True))
    # what belongs to a series is the first one's in the model
    written = {n.removesuffix("@0"): n for n in names if not n.startswith("exterior.")}
    written = {short: n for short, n in written.items() if "@" not in short}
    first = state.of_series(0)
    listed = tuple(
        _with_sds(e, {short: sd[n] for short, n in written.items()}, fit.series)
        for e in first.effects
    )
    kept = [names.index(n) for n in written.values()]
    sigma = float(np.sqrt(fit.variance))
    stated = np.concatenate([s.grid.weights[s.grid.observed][:, 0] for s in fit.series])
    fits = tuple(
        SeriesFit(s.name, len(s), _rms(s, state.of_series(k)), fit.error_sds[k])
        for k, s in enumerate(fit.series)
    )
    channels = dict.fromkeys(c for s in fit.series for c in s.history.readings)
    model = replace(
        first,
        effects=listed,
        exterior=ExteriorOrientation.from_array(state.exteriors[0]),
        image_sigma=sigma / float(np.sqrt(np.median(stated))),
        sds={n: s for n, s in sd.items() if n.split(".")[0] in ("interior", "rates")},
        covariance_names=tuple(written),
        covariance=tuple(tuple(row) for row in covariance[np.ix_(kept, kept)].tolist()),
        validity={c: _span(fit.series, c) for c in channels},
        fitted_on=tuple(
            {"series": s.name, "recording": s.source, "epochs": len(s),
             "rms_px": round(f.rms_px, 5), "thermometer_sd_K": round(f.thermometer_sd, 5)}
            for s, f in zip(fit.series, fits, strict=True)
        ),
        version=1,
    )  # fmt: skip
    return FittedModel(model, tuple(names), covariance, sigma, fits)


def _field_covariance(fit: ModelFit, state: FitState) -> Array:
    """Q K Σ Kᵀ Q: what errors of the targets' coordinates do to the level.

    A coordinate is as wrong in the first epoch as in the last: it cannot look like a drift, and
    since the targets' constant offsets are taken off, it cannot by being hidden now and then.
    Interior at T₀ and exterior orientation take it all.
    """
    field = fit.series[0].field
    p = len(state.names)
    lever = np.zeros((p, len(field) * 3))
    for k, (s, part) in enumerate(zip(fit.series, fit.shares, strict=True)):
        weight = s.grid.weights[..., 0] / fit.variance
        noise = fit.noise[k]
        if noise is not None:
            weight = weight / noise[:, None] ** 2
        J = part.J[:, :16]
        sums = np.tensordot(weight, J, axes=(0, 0))  # (T, 16, q)
        A = np.einsum("tcp,tpq->tcq", s.partials[:, :, :16], sums)
        lever[state.columns(k)] += np.einsum("tcq,tcx->qtx", A, s.at.B).reshape(J.shape[2], -1)
    level = np.array([n.startswith(("interior.", "exterior.")) for n in state.names])
    drift = ~level
    Q = fit.Q[np.ix_(level, level)]
    mixed = fit.Q[np.ix_(level, drift)]
    own = fit.Q[np.ix_(drift, drift)]
    # what the points cannot see, a target's way along its ray, is held and has no variance
    scale = np.sqrt(np.where(np.diag(own) > 0, np.diag(own), 1.0))
    both = np.outer(scale, scale)
    Q = Q - mixed @ (np.linalg.pinv(own / both, rcond=1e-12, hermitian=True) / both) @ mixed.T
    moved = np.zeros((p, lever.shape[1]))
    moved[level] = Q @ (lever[level] * field.sigmas.ravel())
    result: Array = moved @ moved.T
    return result


def _span(series: list[ModelSeries], channel: str) -> tuple[float, float]:
    readings = [s.history.readings[channel] for s in series if channel in s.history.readings]
    values = np.concatenate(readings)
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    return float(np.floor(low * 10) / 10), float(np.ceil(high * 10) / 10)


def _rms(series: ModelSeries, model: ThermalModel) -> float:
    residuals = series.residuals(model.predict(series.history, series.field))
    return float(np.sqrt(np.nanmean(residuals**2)))


def _with_sds(effect: ModelEffect, sd: dict[str, float], series: list[ModelSeries]) -> ModelEffect:
    kind = effects.get(effect.name)
    if kind.seen_in == "noise":
        return effect
    found = {k: sd[f"{effect.name}.{k}"] for k in effect.values if f"{effect.name}.{k}" in sd}
    values = dict(effect.values)
    for key, parameter in kind.nonlinear.items():
        if parameter.role == "phase":
            values[key] = float(np.angle(np.exp(1j * values[key])))
        if parameter.role == "event":
            # a time between two frames: uniform over the interval
            found[key] = frame_interval(series[0].history.times) / np.sqrt(12.0)
    return ModelEffect(effect.name, values, found)
