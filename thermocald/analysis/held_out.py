"""How well a thermal model predicts a series that it was not fitted on.

Only what belongs to the set-up is estimated anew: one exterior orientation for the whole series,
and a constant offset per target, since a field's coordinates are not perfect. What is left of the
image points is compared with the noise floor: image noise, and what the thermometer's noise does to
the prediction.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.model_system import error_operators
from thermocald.errors import ConfigurationError
from thermocald.photogrammetry.camera_model import ExteriorOrientation
from thermocald.photogrammetry.normals import linearise

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.analysis.model_series import ModelSeries
    from thermocald.simulation.model import ThermalModel

    Array = NDArray[np.float64]

__all__ = ["PredictedError", "predicted_error"]

_ITERATIONS = 5
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
    """Predict a series; thermometer_sd K of a reading. ConfigurationError for another camera."""
    if series.sensor != model.sensor or series.camera != model.camera:
        raise ConfigurationError(
            f"the model is of camera {model.camera}, series {series.name} of {series.camera}: a "
            "thermal model belongs to one camera"
        )
    series = replace(series, history=replace(series.history, T0=model.T0))
    exterior = series.start[10:].copy()
    for _ in range(_ITERATIONS):
        here = replace(model, exterior=ExteriorOrientation.from_array(exterior))
        prediction = here.predict(series.history, series.field)
        delta = series.corrections(prediction)
        gradient = series.b - (series.N @ delta[:, :, None])[:, :, 0]
        N = series.N[:, 10:16, 10:16].sum(axis=0)
        exterior = exterior + np.linalg.solve(N, gradient[:, 10:16].sum(axis=0))
    here = replace(model, exterior=ExteriorOrientation.from_array(exterior))
    prediction = here.predict(series.history, series.field)
    residuals = series.residuals(prediction)
    # what is constant over the series is the field's coordinates, and no prediction of a drift
    residuals = residuals - _mean(residuals)
    variance = _variance(here, series, prediction.noise_factor, thermometer_sd)
    used = np.isfinite(residuals)
    rms = float(np.sqrt(np.mean(residuals[used] ** 2)))
    inside = np.abs(residuals[used]) <= _BAND * np.sqrt(variance[used])
    scale = series.sensor.pixel_pitch / model.interior.c * 10_000.0
    return PredictedError(
        series.name,
        rms,
        float(np.sqrt(np.mean(variance[used]))),
        float(np.mean(inside)),
        rms * scale,
    )


def _mean(residuals: Array) -> Array:
    """Mean over the epochs (T, 2) of what was observed."""
    seen = np.isfinite(residuals)
    count = np.maximum(seen.sum(axis=0), 1)
    total: Array = np.where(seen, residuals, 0.0).sum(axis=0) / count
    return total


def _variance(
    model: ThermalModel, series: ModelSeries, noise: Array, thermometer_sd: float
) -> Array:
    """Of measured minus predicted (E, T, 2) px²: image noise, and the thermometer's."""
    at = linearise(series.sensor, series.field, series.start[:10], series.start[10:])
    variance = np.broadcast_to(
        (model.image_sigma * noise[:, None, None]) ** 2, series.grid.points.shape
    ).copy()
    covariance = np.zeros((len(series), 16, 16))
    operators = error_operators(series, model)
    for c, S in operators:
        for d, R in operators:
            shared = np.asarray(S.multiply(R).sum(axis=1)).ravel()
            covariance += thermometer_sd**2 * shared[:, None, None] * np.outer(c[:16], d[:16])
    if operators:
        variance += np.einsum("tcp,epq,tcq->etc", at.A, covariance, at.A, optimize=True)
    return variance
