"""A thermal model from calibrations at several temperatures, for instance with a calibration board.

Each calibration gives an interior orientation with its covariance; together they give the interior
orientation at T₀ and the rates of c, x0, y0 by generalised least squares (Koch, Parameter
Estimation and Hypothesis Testing in Linear Models, 3.2). Parameters without a rate (distortion,
affinity) are constant, or the distortion follows the angle; the sum of squares tests that.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from datetime import datetime
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.linalg import block_diag
from scipy.special import chdtri

from thermocald.analysis.camera.camera import Camera, CameraDifference
from thermocald.analysis.thermal.modelled_camera import OTHER_UNITS
from thermocald.analysis.thermal.result import with_covariance
from thermocald.analysis.thermal.thermal_camera import ThermalCamera
from thermocald.errors import ConfigurationError, DataError, UsageError
from thermocald.photogrammetry import camera_files
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES, Sensor
from thermocald.physics.model import BASES, RATED, ThermalModel, choose_basis, distortion_along
from thermocald.store.logger.dialect import to_celsius
from thermocald.store.recording.reader import interpolate_readings
from thermocald.thermal.source import refuse_copies

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from thermocald.arrays import Array, Index
    from thermocald.physics.model import Distortion
    from thermocald.store.logger.clock import DeviceClock
    from thermocald.store.logger.temperatures import TemperatureLog

FORMAT = "thermocald-calibration/1"
_COPY = "holds the same camera as {}; give calibrations from different photographs"
_LEVEL = 1e-3
_LEAST_SPAN_K = 1.0
_HOT_C = 45.0  # if all are hotter, they may be in another unit, which gives them at most _WARM_C
_WARM_C = 60.0


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibrated camera and its file.

    photographs: how many there are; moments: of them, as the camera wrote them.
    """

    path: Path
    camera: Camera
    photographs: int = 0
    moments: tuple[datetime, ...] = ()

    def span(self, clock: DeviceClock) -> Array:
        """Return when the photographs were taken, s UTC. Raises DataError if that is not stored."""
        if not self.moments:
            raise DataError(
                f"{self.path}: does not state when its photographs were taken; give their "
                f"temperature: 21.5={self.path}"
            )
        return clock.utc(list(self.moments), lambda _: str(self.path))


def is_calibration(path: Path) -> bool:
    """Return whether a file is a document of `calibrate` or a camera that it wrote."""
    try:
        with path.open(encoding="utf-8") as file:
            return path.suffix == ".json" and '"thermocald-ca' in file.read(200)
    except (OSError, UnicodeDecodeError):
        return False


def read_calibration(path: Path, temperature: float | None) -> Calibration:
    """Read what `calibrate` wrote (`--json`, `--camera-out`). ConfigurationError names the file."""
    T = math.nan if temperature is None else temperature
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as cause:
        raise ConfigurationError(f"{path}: cannot be read: {cause}") from cause
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        found = camera_files.read(path)
        if found.covariance is None:
            raise ConfigurationError(f"{path}: the camera has no covariance: it cannot be weighted")
        sensor, values = found.model.sensor, found.model.interior.as_array()
        return Calibration(path, Camera(sensor, T, values, found.covariance, name=found.name))
    try:
        head, interior = document["camera"], document["interior"]
        names, r = document["correlations"]["names"], np.array(document["correlations"]["matrix"])
        sd = np.array([interior[f"sd_{name}"] for name in names])
        rows = [IOP_NAMES.index(name) for name in names]
        covariance = np.zeros((10, 10))
        covariance[np.ix_(rows, rows)] = r * np.outer(sd, sd)
        sensor = Sensor(head["width"], head["height"], head["pixel_pitch"])
        values = np.array([interior[n] for n in IOP_NAMES], dtype=float)
        camera = Camera(sensor, T, values, covariance, name=head["name"])
        good = [p for p in document["photographs"] if p["status"] == "ok"]
        moments = tuple(datetime.fromisoformat(p["time"]) for p in good if p.get("time"))
    except (KeyError, TypeError, ValueError) as cause:
        reason = document.get("reason") or f"{cause} is missing"
        raise ConfigurationError(f"{path}: holds no calibrated camera: {reason}") from cause
    return Calibration(path, camera, len(good), moments)


def with_log(calibration: Calibration, log: TemperatureLog, clock: DeviceClock) -> Calibration:
    """Return a calibration with its photographs' mean temperature; DataError outside the log."""
    times = calibration.span(clock)
    readings = interpolate_readings(times, log.times, next(iter(log.channels.values())))
    if not np.isfinite(readings).all():
        raise DataError(f"{calibration.path}: the log has no temperature for its photographs")
    return replace(calibration, camera=replace(calibration.camera, temperature=readings.mean()))


def fit_calibrations(
    calibrations: Sequence[Calibration],
    T0: float | None = None,
    temperature_sd: float = 0.1,
    channel: str = "temperature",
) -> ThermalCamera:
    """Fit interior orientation and rates to calibrations.

    temperature_sd K: of each calibration's temperature. An effect is missing if the residuals are
    larger than the stated covariances allow. Raises DataError for temperatures too few or too close
    together, UsageError for cameras that differ or a calibration without a temperature.
    """
    first, cameras = calibrations[0], [c.camera for c in calibrations]
    free = np.flatnonzero(np.diag(first.camera.covariance) > 0)
    for one in calibrations:
        _require_alike(first, one, free)
    refuse_copies([(str(c.path), c.camera.values) for c in calibrations], _COPY, atol=0.0)
    T = np.array([camera.temperature for camera in cameras])
    if np.ptp(T) < _LEAST_SPAN_K:
        raise DataError(
            f"the calibrations are all between {T.min():.1f} and {T.max():.1f} °C: a thermal model "
            "needs at least two temperatures, preferably 20 K apart"
        )
    at = round(float(T.mean()), 1) if T0 is None else T0
    rated = [i for i, k in enumerate(free) if IOP_NAMES[k] in RATED]
    y = np.concatenate([camera.values[free] for camera in cameras])
    blocks = [camera.covariance[np.ix_(free, free)] for camera in cameras]
    mean = np.zeros(10)
    mean[free] = y.reshape(len(T), -1).mean(axis=0)
    found_in: dict[Distortion, tuple[Array, Array, float]] = {}
    for basis in BASES:
        M = np.eye(10) if basis == "image" else distortion_along(mean)
        M = M[np.ix_(free, free)]
        # ∂ parameters of each calibration / ∂ (interior, rates); M makes the distortion follow c
        A = np.vstack([np.hstack([np.eye(len(M)), (t - at) * M[:, rated]]) for t in T])
        found_in[basis] = _adjust(A, y, blocks, M[:, rated], temperature_sd)
    distortion, sure = choose_basis({basis: s for basis, (_, _, s) in found_in.items()})
    x, covariance, square = found_in[distortion]
    redundancy = len(y) - len(x)
    missing = bool(redundancy and square > chdtri(redundancy, _LEVEL))
    sigma0 = float(np.sqrt(square / redundancy)) if redundancy else 1.0
    if missing:
        covariance *= sigma0**2
    names = [f"interior.{IOP_NAMES[k]}" for k in free]
    names += [f"rates.{IOP_NAMES[free[i]]}" for i in rated]
    name, sensor, interior = cameras[0].name, cameras[0].sensor, cameras[0].interior
    span = float(T.min()), float(T.max())
    start = ThermalModel(
        name, sensor, at, interior, dict.fromkeys(RATED, 0.0), distortion=distortion,
        validity={channel: span}, name=name,
    )  # fmt: skip
    model = with_covariance(start, tuple(names), x, covariance)
    thermal = ThermalCamera(model)
    rms = [
        CameraDifference(("model", one.name), thermal.at(one.temperature).model, one.model).rms_px
        for one in cameras
    ]
    fitted_on: list[dict[str, Any]] = [
        {"calibration": str(c.path), "temperature": round(t, 3), "photographs": c.photographs,
         "rms_px": round(r, 5)}
        for c, t, r in zip(calibrations, T.tolist(), rms, strict=True)
    ]  # fmt: skip
    evidence = {"fit": {
        "effect_missing": missing, "misfit_px": round(max(rms), 5),
        "significance_sigmas": round(sigma0, 1), "distortion_sigmas": round(sure, 1),
    }}  # fmt: skip
    doubts = [
        f"every calibration is at {T.min():.0f} °C or more: are their temperatures in {unit}?"
        for unit, C in ((name, to_celsius(T, unit)) for name, unit in OTHER_UNITS.items())
        if T.min() > _HOT_C and C.min() > -_WARM_C and C.max() < _WARM_C
    ]
    fitted = {
        "sigma0": sigma0, "series": [], "calibrations": fitted_on, "prediction_test": [],
        "doubts": doubts,
    }  # fmt: skip
    return ThermalCamera(replace(model, fitted_on=fitted_on, evidence=evidence), fitted)


def _require_alike(first: Calibration, other: Calibration, free: Index) -> None:
    """Raise UsageError for an unknown temperature, another sensor or other free parameters."""
    if not math.isfinite(other.camera.temperature):
        raise UsageError(
            f"{other.path}: at which temperature? Write 21.5={other.path}, or give the "
            "thermometer's --log"
        )
    if (other.camera.name, other.camera.sensor) != (first.camera.name, first.camera.sensor):
        raise UsageError(f"{other.path}: is of another camera or sensor than {first.path}")
    own = np.flatnonzero(np.diag(other.camera.covariance) > 0)
    held = np.setdiff1d(np.arange(10), free)
    same = other.camera.values[held] == first.camera.values[held]
    if not np.array_equal(own, free) or not same.all():
        raise UsageError(
            f"{other.path}: other parameters were estimated than in {first.path}; calibrate both "
            "with the same --free"
        )


def _adjust(
    A: Array, y: Array, blocks: list[Array], by_rate: Array, temperature_sd: float
) -> tuple[Array, Array, float]:
    """Estimate the unknowns; also return their covariance and the residuals' sum of squares."""
    slope = np.zeros(len(by_rate))
    for _ in range(2):  # the effect of the temperature's sd depends on the rates
        moved = temperature_sd**2 * np.outer(slope, slope)
        weight = np.linalg.inv(block_diag(*(block + moved for block in blocks)))
        covariance = np.asarray(np.linalg.inv(A.T @ weight @ A), dtype=float)
        covariance = 0.5 * (covariance + covariance.T)
        x = covariance @ A.T @ weight @ y
        slope = by_rate @ x[len(by_rate) :]
    left = y - A @ x
    return x, covariance, float(left @ weight @ left)
