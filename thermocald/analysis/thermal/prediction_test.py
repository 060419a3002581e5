"""How well a thermal model predicts a series that it was not fitted on.

Only what belongs to the series is estimated again: its level (one orientation, and a constant
offset per target, since a field's coordinates are not perfect) and what its effects call fresh (a
phase; an event, which no model can foresee). All drifts are the model's. What is left of the image
points is compared with the noise floor: image noise, and what the thermometer's noise, and the
times at which it was read, do to the prediction. The 95 % bands hold the model's own uncertainty
too; of a model that misses an effect no band is stated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.thermal.displacement import moved_targets
from thermocald.analysis.thermal.level import estimate_level, projected, series_means
from thermocald.analysis.thermal.own import with_own
from thermocald.analysis.thermal.sensitivity import derivatives, reading_operators, unresolved
from thermocald.analysis.thermal.thermal_model import targets_of
from thermocald.errors import ConfigurationError, DataError
from thermocald.photogrammetry.camera.camera_model import ExteriorOrientation
from thermocald.physics import catalogue
from thermocald.thermal.reduce import without_targets

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.physics.model import ThermalModel
    from thermocald.thermal.series import ReducedSeries

__all__ = ["PredictedError", "predicted_error"]

_BAND = 1.959964  # standard deviations that hold 95 %


@dataclass(frozen=True, slots=True)
class PredictedError:
    """Of one series: rms_px of measured minus predicted image points, floor_px: what noise alone
    would leave, coverage: fraction of the coordinates inside their 95 % band, NaN where the model
    misses an effect and no band is stated; object_mm: the rms on a plane at 10 m.
    """

    name: str
    rms_px: float
    floor_px: float
    coverage: float
    object_mm: float


def predicted_error(
    model: ThermalModel, series: ReducedSeries, thermometer_sd: float
) -> PredictedError:
    """Predict a series; thermometer_sd K of a reading.

    ConfigurationError for another camera, DataError without the model's reference thermometer.
    """
    source = series.source
    if source.sensor != model.sensor or source.camera != model.camera:
        raise ConfigurationError(
            f"the model is of camera {model.camera} ({model.sensor.width}×{model.sensor.height} "
            f"px), {source.name} of {source.camera} ({source.sensor.width}×"
            f"{source.sensor.height} px): a thermal model belongs to one camera"
        )
    series = _as_fitted(model, series)
    rows = np.array(
        [source.field.index[t] for t in targets_of(model.effects) if t in source.field.index]
    )
    model = _of_series(model, series, rows)
    history = series.readings_history
    prediction = model.predict(history, source.field)
    mean, _, _ = series_means(series, prediction)
    whole = slice(0, len(history.times))
    weights = series.weights[..., :2]
    points = source.grid.points
    used = weights > 0
    if len(rows):
        # a target that moves is not a gross error where it moves
        used[:, rows] = (source.grid.weights[:, rows, :2] > 0) & (
            np.abs(np.nan_to_num(points[:, rows] - projected(series, prediction, whole)[:, rows]
                                 - mean[rows])) < 1.0
        )  # fmt: skip
    residuals = points - projected(series, prediction, whole)
    residuals = np.where(used, residuals, 0.0)
    residuals = residuals - residuals.sum(axis=0) / np.maximum(used.sum(axis=0), 1)
    A = _partials(series, rows)
    noise = (model.image_sigma * prediction.noise_factor[:, None, None]) ** 2
    floor = noise + _variance(A, _thermometers(series, model, thermometer_sd))
    rms = float(np.sqrt(np.mean(residuals[used] ** 2)))
    coverage = float("nan")
    if not model.misses_an_effect:
        bands = floor + _variance(A, _parameters(series, model))
        coverage = float(np.mean(np.abs(residuals[used]) <= _BAND * np.sqrt(bands[used])))
    scale = source.sensor.pixel_pitch / model.interior.c * 10_000.0
    floor_px = float(np.sqrt(np.mean(floor[used])))
    return PredictedError(source.series or source.name, rms, floor_px, coverage, rms * scale)


def _as_fitted(model: ThermalModel, series: ReducedSeries) -> ReducedSeries:
    """The series with the model's T₀ and reference, whichever column stands first."""
    history = series.history
    reference = next(iter(model.validity), history.reference)
    if reference not in history.readings:
        raise DataError(
            f"{series.source.name}: has no temperature column {reference!r}, which the model was "
            f"fitted on; there are: {', '.join(history.readings)}"
        )
    series = series.in_basis(model.distortion)
    return replace(series, history=replace(history, T0=model.T0, reference=reference))


def _of_series(model: ThermalModel, series: ReducedSeries, rows: NDArray[np.int64]) -> ThermalModel:
    """The model with what belongs to the series: orientation, phases, events."""
    others = without_targets(series, rows) if len(rows) else series
    model = with_own(model, others)
    if len(rows):
        m = moved_targets(others, rows)
        listed = []
        for e in model.effects:
            kind = catalogue.get(e.name)
            if kind.seen_in == "targets":
                time = {n: m.time for n, p in kind.nonlinear.items() if p.role == "event"}
                vector = dict(zip(kind.linear, m.vector.tolist(), strict=True))
                e = replace(e, values={**e.values, **vector, **time})
            listed.append(e)
        model = replace(model, effects=tuple(listed))
    start = replace(model, exterior=ExteriorOrientation.from_array(series.at.eop))
    level = estimate_level([others], [start], interior=False)
    return replace(model, exterior=level.exteriors[0])


def _partials(series: ReducedSeries, rows: NDArray[np.int64]) -> Array:
    """∂ image points / ∂ parameters (T, 2, 22): camera, scales of the field, a displacement."""
    at = series.at
    moving = np.zeros((len(at.B), 2, 3))
    if len(rows):
        moving[rows] = at.B[rows]
    points = series.source.field.points[:, None, :]
    return np.concatenate([at.A, at.B * points, moving], axis=2)


def _variance(A: Array, covariance: Array) -> Array:
    """Variances (E, T, 2) px² of the image points from parameters' covariances (E, 22, 22)."""
    found: Array = np.einsum("tcp,epq,tcq->etc", A, covariance, A, optimize=True)
    return found


def _thermometers(series: ReducedSeries, model: ThermalModel, thermometer_sd: float) -> Array:
    """Covariance (E, 22, 22) of an epoch's parameters, relative to the series' mean."""
    history = series.readings_history
    covariance = np.zeros((len(history.times), 22, 22))
    operators = reading_operators(history, model)
    means = [np.asarray(S.mean(axis=0)).ravel() for _, _, S in operators]
    for (c, a, S), mean_s in zip(operators, means, strict=True):
        for (d, b, R), mean_r in zip(operators, means, strict=True):
            if a != b:
                continue  # of another thermometer
            shared = np.asarray(S.multiply(R).sum(axis=1)).ravel()
            shared = shared - S @ mean_r - R @ mean_s + mean_s @ mean_r
            covariance += thermometer_sd**2 * shared[:, None, None] * np.outer(c, d)
    jump = series.thermometers[history.reference].slope_jump(history.times)
    for c, left in unresolved(history, model, jump):
        covariance += left[:, None, None] ** 2 * np.outer(c, c)
    return covariance


def _parameters(series: ReducedSeries, model: ThermalModel) -> Array:
    """Covariance (E, 22, 22) from the model's drift parameters; the level is the series' own."""
    history = series.readings_history
    if model.covariance is None:
        return np.zeros((len(history.times), 22, 22))
    own = {f"{e.name}.{n}" for e in model.effects for n in _fresh(e.name)}
    names = [
        n for n in model.covariance_names
        if not n.startswith(("exterior.", "interior.")) and n not in own
    ]  # fmt: skip
    rows = [model.covariance_names.index(n) for n in names]
    Q = np.array(model.covariance)[np.ix_(rows, rows)]
    J = derivatives(history, series.source.field, model, names)
    drift = J - J.mean(axis=0)
    found: Array = np.einsum("epi,ij,eqj->epq", drift, Q, drift, optimize=True)
    return found


def _fresh(name: str) -> tuple[str, ...]:
    """The numbers of an effect that a series has of its own."""
    kind = catalogue.get(name)
    return (*kind.fresh, *kind.linear) if kind.is_event else kind.fresh
