"""A thermal camera fitted to the series of a camera, or the type to those of several cameras."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.analysis.thermal.calibrations import fit_calibrations
from thermocald.analysis.thermal.prediction_test import predicted_error
from thermocald.analysis.thermal.thermal_camera import ThermalCamera
from thermocald.analysis.thermal.thermal_model import fit_thermal_model
from thermocald.analysis.thermal.type_model import fit_with_type, type_model, weight_of_type
from thermocald.physics.model_file import model_document
from thermocald.thermal.basis import choose_distortion

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.analysis.thermal.calibrations import Calibration
    from thermocald.analysis.thermal.prediction_test import PredictedError
    from thermocald.analysis.thermal.result import FittedModel
    from thermocald.physics.model import ModelEffect, ThermalModel
    from thermocald.thermal.series import ReducedSeries

_NUMBERS = ("interior", "distortion", "rates", "effects", "validity")


def fit_camera(
    series: Sequence[ReducedSeries], listed: Sequence[ModelEffect], T0: float | None
) -> ThermalCamera:
    """Fit one camera; of several series each is also predicted from a fit to the others."""
    fitted = fit_thermal_model(series, listed, T0)
    held = []
    for k, left_out in enumerate(series if len(series) > 1 else ()):
        rest = [s for i, s in enumerate(series) if i != k]
        model = fit_thermal_model(
            rest, list(fitted.model.effects), fitted.model.T0, search=False,
            distortion=fitted.model.distortion,
        )  # fmt: skip
        held.append(predicted_error(model.model, left_out, fitted.series[k].thermometer_sd))
    return ThermalCamera(fitted.model, _document(fitted, held))


def fit_camera_of_type(series: Sequence[ReducedSeries], kind: ThermalModel) -> ThermalCamera:
    """Fit one camera that was measured at few temperatures, helped by its type's model."""
    fitted = fit_with_type(series, kind)
    weights = weight_of_type(fitted.model, kind)
    about = {"name": kind.camera, "cameras": len(kind.fitted_on), "weights": weights}
    return ThermalCamera(fitted.model, {**_document(fitted, []), "type": about})


def fit_type(
    series: Sequence[ReducedSeries], listed: Sequence[ModelEffect], T0: float | None, name: str
) -> ThermalCamera:
    """Fit each of several cameras, and what their type is: the model of one more specimen."""
    cameras = list(dict.fromkeys(s.source.camera for s in series))
    if T0 is None:
        T0 = round(float(np.mean([s.history.temperature().mean() for s in series])), 1)
    own = [[s for s in series if s.source.camera == c] for c in cameras]
    distortion, _ = choose_distortion(series)
    models = [fit_thermal_model(s, listed, T0, distortion=distortion).model for s in own]
    found = type_model(models, name)
    document = {
        "format": "thermocald-fit/1",
        "camera": name,
        "cameras": cameras,
        "reference_temperature": T0,
        **_numbers(found),
        "series": [],
        "prediction_test": [],
    }
    return ThermalCamera(found, document)


def fit_to_calibrations(
    given: Sequence[Calibration], T0: float | None, temperature_sd: float, channel: str
) -> ThermalCamera:
    """Fit a camera to photographs that were calibrated at several temperatures."""
    found = fit_calibrations(given, T0, temperature_sd, channel)
    document = {
        "format": "thermocald-fit/1",
        "camera": found.model.camera,
        "reference_temperature": found.model.T0,
        **_numbers(found.model),
        "sigma0": found.sigma0,
        **found.model.evidence["fit"],
        "series": [],
        "calibrations": list(found.model.fitted_on),
        "prediction_test": [],
    }
    return ThermalCamera(found.model, document)


def _numbers(model: ThermalModel) -> dict[str, Any]:
    written = model_document(model)
    return {k: written[k] for k in _NUMBERS}


def _document(fitted: FittedModel, held: Sequence[PredictedError]) -> dict[str, Any]:
    return {
        "format": "thermocald-fit/1",
        "camera": fitted.model.camera,
        "reference_temperature": fitted.model.T0,
        **_numbers(fitted.model),
        "sigma0": fitted.sigma0,
        **fitted.model.evidence["fit"],
        "band": not fitted.model.misses_an_effect,
        "series": [asdict(s) | {"left_over_in_noise": s.left_over} for s in fitted.series],
        "prediction_test": [asdict(h) for h in held],
    }
