"""How well a thermal model predicts a series that it was not fitted on.

Only what belongs to the series is estimated anew: its level (one orientation, and a constant offset
per target, since a field's coordinates are not perfect) and what its effects call fresh (a phase;
an event, which no model can foresee). All drifts are the model's. What is left of the image points
is compared with the noise floor: image noise, and what the thermometer's noise, and the instants at
which it was read, do to the prediction. The 95 % bands hold the model's own uncertainty too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.thermal.fit import ModelFit
from thermocald.analysis.thermal.noise import open_courses
from thermocald.analysis.thermal.search import search_own
from thermocald.analysis.thermal.state import FitState, own_of
from thermocald.analysis.thermal.system import error_operators, jacobian
from thermocald.analysis.thermal.thermal_model import targets_of
from thermocald.errors import ConfigurationError, DataError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.analysis.thermal.series import ModelSeries
    from thermocald.simulation.history import History
    from thermocald.simulation.model import ThermalModel

    Array = NDArray[np.float64]

__all__ = ["PredictedError", "predicted_error"]

_BAND = 1.959964  # standard deviations that hold 95 %


@dataclass(frozen=True, slots=True)
class PredictedError:
    """Of one series: rms_px of measured minus predicted image points, floor_px: what noise alone
    would leave, coverage: share of the coordinates inside their 95 % band, object_mm: the rms on a
    plane at 10 m.
    """

    name: str
    rms_px: float
    floor_px: float
    coverage: float
    object_mm: float


def predicted_error(
    model: ThermalModel, series: ModelSeries, thermometer_sd: float
) -> PredictedError:
    """Predict a series; thermometer_sd K of a reading.

    ConfigurationError for another camera, DataError without the model's reference thermometer.
    """
    if series.sensor != model.sensor or series.camera != model.camera:
        raise ConfigurationError(
            f"the model is of camera {model.camera} ({model.sensor.width}×{model.sensor.height} "
            f"px), series {series.name} of {series.camera} ({series.sensor.width}×"
            f"{series.sensor.height} px): a thermal model belongs to one camera"
        )
    moving = targets_of(model.effects)
    if moving:
        series = series.displacing(moving)
    series = replace(series, history=_as_fitted(model, series))
    model, series = _oriented(model, series, thermometer_sd)
    prediction = model.predict(series.history, series.field)
    residuals = series.residuals(prediction)
    # what is constant over the series is the field's coordinates, and no prediction of a drift
    residuals = residuals - _mean(residuals)
    noise = (model.image_sigma * prediction.noise_factor[:, None, None]) ** 2
    floor = noise + _variance(series, _thermometers(series, model, thermometer_sd))
    bands = floor + _variance(series, _parameters(series, model))
    used = np.isfinite(residuals)
    rms = float(np.sqrt(np.mean(residuals[used] ** 2)))
    inside = np.abs(residuals[used]) <= _BAND * np.sqrt(bands[used])
    scale = series.sensor.pixel_pitch / model.interior.c * 10_000.0
    return PredictedError(
        series.name,
        rms,
        float(np.sqrt(np.mean(floor[used]))),
        float(np.mean(inside)),
        rms * scale,
    )


def _as_fitted(model: ThermalModel, series: ModelSeries) -> History:
    """The series' history with the model's T₀ and reference, whichever column stands first."""
    history = series.history
    reference = next(iter(model.validity), history.reference)
    if reference not in history.readings:
        raise DataError(
            f"{series.source}: has no temperature column {reference!r}, which the model was fitted "
            f"on; there are: {', '.join(history.readings)}"
        )
    return replace(history, T0=model.T0, reference=reference)


def _oriented(
    model: ThermalModel, series: ModelSeries, thermometer_sd: float
) -> tuple[ThermalModel, ModelSeries]:
    """The model with what belongs to the series, which loses its targets' constant offsets."""
    state = FitState(model, (series.start[10:].copy(),))
    state = replace(state, fixed=state.drifts)
    for place, effect in enumerate(model.effects):
        if own_of(effect):
            # the search is for the last effect of a model
            others = (*model.effects[:place], *model.effects[place + 1 :])
            moved = replace(state, model=replace(state.model, effects=(*others, effect)))
            found = search_own(series, moved, 0, free=False)
            state = replace(state, own=found.own, fixed=state.fixed | found.fixed)
    fit = ModelFit([series])
    fit.error_sds = [thermometer_sd]
    state = fit.solve(state)
    fit.take_off_offsets(state)
    state = fit.solve(state)
    return state.of_series(0), fit.series[0]


def _mean(residuals: Array) -> Array:
    """Mean over the epochs (T, 2) of what was observed."""
    seen = np.isfinite(residuals)
    count = np.maximum(seen.sum(axis=0), 1)
    total: Array = np.where(seen, residuals, 0.0).sum(axis=0) / count
    return total


def _variance(series: ModelSeries, covariance: Array) -> Array:
    """Variances (E, T, 2) px² of the image points from parameters' covariances (E, 22, 22)."""
    A = series.partials
    found: Array = np.einsum("tcp,epq,tcq->etc", A, covariance, A, optimize=True)
    return found


def _thermometers(series: ModelSeries, model: ThermalModel, thermometer_sd: float) -> Array:
    """Covariance (E, 22, 22) of an epoch's parameters, relative to the series' mean."""
    covariance = np.zeros((len(series), 22, 22))
    operators = error_operators(series, model)
    means = [np.asarray(S.mean(axis=0)).ravel() for _, S in operators]
    for (c, S), mean_s in zip(operators, means, strict=True):
        for (d, R), mean_r in zip(operators, means, strict=True):
            shared = np.asarray(S.multiply(R).sum(axis=1)).ravel()
            shared = shared - S @ mean_r - R @ mean_s + mean_s @ mean_r
            covariance += thermometer_sd**2 * shared[:, None, None] * np.outer(c, d)
    for c, open_ in open_courses(series, model):
        covariance += open_[:, None, None] ** 2 * np.outer(c, c)
    return covariance


def _parameters(series: ModelSeries, model: ThermalModel) -> Array:
    """Covariance (E, 22, 22) from the model's drift parameters; the level is the series' own."""
    names, J = jacobian(series, model, ())
    rows = [
        (i, model.covariance_names.index(n))
        for i, n in enumerate(names)
        if n in model.covariance_names and not n.startswith("exterior.")
    ]
    if not rows or model.covariance is None:
        return np.zeros((len(series), 22, 22))
    ours, theirs = (list(r) for r in zip(*rows, strict=True))
    Q = np.array(model.covariance)[np.ix_(theirs, theirs)]
    drift = J[:, :, ours] - J[:, :, ours].mean(axis=0)
    found: Array = np.einsum("epi,ij,eqj->epq", drift, Q, drift, optimize=True)
    return found
