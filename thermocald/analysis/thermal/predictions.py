"""Predictions of a thermal camera, at a time or along a log, as a document and as lines.

The temperature log comes from a logger, a recording or a store. A camera is steady from the time
after which every image point, projected onto a plane at the working distance, stays within the
wanted error of its position at the end of the history.
"""

from __future__ import annotations

import warnings
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.analysis.camera.undistortion import image_grid
from thermocald.analysis.thermal.modelled_camera import OTHER_UNITS
from thermocald.analysis.thermal.prediction_test import predicted_error
from thermocald.analysis.thermal.thermal_camera import steady_camera
from thermocald.errors import DataError, UsageError
from thermocald.numbers import celsius, percent, plain
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES, rays
from thermocald.physics.device import CameraDevice, read_camera_device, read_programme
from thermocald.physics.simulation import Simulation
from thermocald.physics.testfields import demonstration_field
from thermocald.result import Result
from thermocald.store.logger.options import LogOptions
from thermocald.store.logger.temperatures import TemperatureLog, read_log
from thermocald.store.recording.head import read_head
from thermocald.store.sources import is_store, open_source, require_source
from thermocald.thermal.reduce import reduce_series

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.figure import Figure

    from thermocald.analysis.camera.camera import Camera
    from thermocald.analysis.thermal.modelled_camera import Along
    from thermocald.analysis.thermal.thermal_camera import ThermalCamera
    from thermocald.arrays import Array
    from thermocald.store.recording.head import CameraSpec
    from thermocald.thermal.series import SeriesInput


def read_model_log(
    thermal: ThermalCamera,
    path: Path,
    options: LogOptions | None = None,
    near: tuple[float, float] | None = None,
) -> TemperatureLog:
    """Read the temperature log for a model.

    The reference is the column that the options name, else the model's reference, else the first.
    path: a logger's file, a recording's folder or `epochs.csv`, or a store; near: as in `read_log`.
    Warns of doubtful readings. Raises ConfigurationError for the recording of another camera.
    """
    options = options or LogOptions()
    reference = next(iter(thermal.model.validity), None)
    wanted = options.temperatures[0] if options.temperatures else None
    if is_store(path):
        log, camera = _read_store(path, wanted)
    else:
        folder = path if path.is_dir() else path.parent
        camera = None
        if path.is_dir() or (path.name == "epochs.csv" and (folder / "recording.yaml").is_file()):
            head = read_head(folder)
            camera = head.camera
            readings = folder / "readings.csv"
            path = readings if readings.is_file() else folder / "epochs.csv"
            options = replace(options, wanted=tuple(head.channels))
        else:
            options = replace(options, wanted=tuple(thermal.model.validity))
        log = read_log(require_source(path), options, near)
        for note in log.notes:
            if (doubt := note.removeprefix("doubtful: ")) != note:
                warnings.warn(f"{path}: {doubt}", stacklevel=3)
        given = next(iter(log.with_reference(wanted or reference).channels.values()))
        T = thermal.validity.worst(given[np.isfinite(given)]) if np.isfinite(given).any() else 0.0
        unit = thermal.validity.other_unit(T)
        if unit and camera is None and options.unit is None and thermal.validity.is_far(T):
            raise UsageError(
                f"{path}: {T:g} looks like {unit}: the model was fitted between "
                f"{thermal.validity.low:g} and {thermal.validity.high:g} °C; give --unit "
                f"{OTHER_UNITS[unit]}, or --unit degC if it is °C"
            )
    if camera is not None:
        thermal.for_images(camera.sensor.width, camera.sensor.height, camera.name)
    return log.with_reference(wanted or reference)


def _read_store(source: Path, wanted: str | None) -> tuple[TemperatureLog, CameraSpec]:
    """Read the readings of all series of a store's only camera, in order of time, and the camera.

    Raises DataError for an unknown channel or a store without readings, StoreError for a store with
    several cameras.
    """
    with open_source(source) as store:
        every = store.all_series()
        if len({(s.camera, s.identity.get("station")) for s in every}) != 1:
            store.find_series()  # raises an error that lists the series
        names = list(dict.fromkeys(name for s in every for name in s.head.channels))
        if wanted is not None and wanted not in names:
            raise DataError(
                f"{store.path}: there is no channel {wanted!r}; there are: {', '.join(names)}"
            )
        parts = [store.series_columns(series, ["temperature_time", *names]) for series in every]
        path, camera = store.path, every[0].head.camera
    table = np.concatenate([list(columns.values()) for columns in parts], axis=1)
    table = table[:, np.isfinite(table[0])]
    if not table.shape[1]:
        raise DataError(f"{path}: holds no temperatures")
    # two epochs may have the same reading
    _, rows = np.unique(table[0], return_index=True)
    table = table[:, rows]
    return TemperatureLog(table[0], dict(zip(names, table[1:], strict=True))), camera


def warm_up(along: Along, distance_mm: float, wanted_mm: float) -> tuple[float | None, Array]:
    """Find the time from which the camera is steady enough, s since the start.

    Returns None if the history ends before: if it still moves by more than a tenth of the wanted
    error during its last tenth, its end is not the steady state. Also returns the distance (E,) mm
    of the worst point from its final position. Raises DataError for fewer than ten times.
    """
    if len(along) < 10:
        raise DataError("a warm-up needs a history of at least 10 times")
    points = image_grid(along.sensor)
    r = rays(along.sensor, along.values, np.broadcast_to(points, (len(along), *points.shape)))
    places = distance_mm * r[..., :2] / -r[..., 2:]
    error = np.linalg.norm(places - places[-1], axis=2).max(axis=1)
    times = along.times - along.times[0]
    settled = error[-len(error) // 10 :].max() <= max(0.1 * wanted_mm, 1e-9)
    above = np.flatnonzero(error > wanted_mm)
    first = int(above[-1]) + 1 if len(above) else 0
    steady = float(times[first]) if settled and first < len(times) else None
    return steady, error


@dataclass(frozen=True, eq=False, repr=False)
class Prediction(Result):
    """The prediction of a thermal camera.

    thermal: the camera; document: what `predict --json` writes; said: the lines that it prints;
    state: the camera at a single temperature, else None.
    """

    thermal: ThermalCamera
    document: dict[str, Any]
    said: list[str]
    state: Camera | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return what `thermocald predict --json` writes."""
        return self.document

    def lines(self) -> list[str]:
        """Return what `thermocald predict` prints."""
        return self.said

    def plot(self) -> Figure:
        """Draw the distortion at the single temperature, or else the drift with temperature."""
        return self.thermal.plot() if self.state is None else self.state.plot()


def describe_camera(thermal: ThermalCamera, camera: Camera, distance: float) -> Prediction:
    """Describe a camera, and its uncertainty and drift on a plane at `distance` m."""
    error = camera.object_error(distance * 1000.0)
    T0 = thermal.model.T0
    reference = steady_camera(thermal, T0)
    moved = camera.object_distance(reference, distance * 1000.0)
    document = {
        "format": "thermocald-prediction/1",
        **camera.as_dict(),
        "distance_m": distance,
        "object_error_mm": float(np.sqrt(np.mean(error**2))),
        "drift_from_reference_mm": float(moved.max()),
    }
    in_space = (
        f"  on a plane at {distance:g} m: ± {plain(document['object_error_mm'], 'mm', 2)} "
        f"from this orientation's uncertainty; the drift since {celsius(T0)} °C is up to "
        f"{plain(document['drift_from_reference_mm'], 'mm', 3)}"
    )
    return Prediction(thermal, document, [*camera.lines(), in_space], camera)


def predict_along(thermal: ThermalCamera, log: TemperatureLog, extrapolate: bool) -> Prediction:
    """Predict the camera along a log, one row per reading; none, with a warning, in a gap of it."""
    known = log.known_at(log.times)
    if not known.all():
        warnings.warn(
            f"{int((~known).sum())} of {len(known)} times are in a gap of the temperature log of "
            "over ten of its intervals: nothing is predicted for them",
            stacklevel=3,
        )
    along = thermal.along(
        log.times, log.channels, log.times[known], extrapolate=extrapolate,
        temperature_sd=thermal.reading_sd,
    )  # fmt: skip
    header = ["time", "temperature", *IOP_NAMES, *(f"sd_{n}" for n in IOP_NAMES), "extrapolated_K"]
    rows = np.column_stack(
        [along.times, along.temperatures, along.values, along.sd, along.extrapolated]
    ).tolist()
    document = {
        "format": "thermocald-prediction/1",
        "camera": thermal.model.camera,
        "columns": header,
        "rows": rows,
    }
    lines = [",".join(header)]
    lines += [",".join(f"{v:.10g}" for v in row) for row in rows]
    return Prediction(thermal, document, lines)


def check_prediction(thermal: ThermalCamera, inputs: Sequence[SeriesInput]) -> Prediction:
    """Compare measured series with the model's prediction of them."""
    found, lines = [], []
    fitted = [f for f in thermal.model.fitted_on if "recording" in f]
    known = {(str(f["series"]), Path(str(f["recording"])).resolve()) for f in fitted}
    series = [reduce_series(s, strict=False) for s in inputs]
    for s in series:
        sensor = s.source.sensor
        sd = thermal.thermometer_sd or s.thermometers[s.history.reference].noise
        scaled = thermal.for_images(sensor.width, sensor.height, s.source.camera)
        error = predicted_error(scaled.model, s, sd)
        in_fit = (s.source.series, Path(s.source.name).resolve()) in known
        T = thermal.validity.worst(s.history.temperature())
        if thermal.validity.beyond(T):
            warnings.warn(f"{s.source.name}: {thermal.validity.place(T)}", stacklevel=3)
        found.append({**asdict(error), "in_fit": in_fit})
        bands = f"{percent(error.coverage, 1)} inside their 95 % bands"
        if thermal.model.misses_an_effect:
            bands = "no 95 % band is stated, as the model misses an effect"
        lines.append(
            f"{s.source.name}: predicted to {error.rms_px:.4f} px (noise alone "
            f"{error.floor_px:.4f}), {bands}, {error.object_mm:.2f} mm at 10 m"
            + ("; the model was fitted on this series: this is no test of it" if in_fit else "")
        )
    document = {
        "format": "thermocald-prediction-test/1",
        "camera": thermal.model.camera,
        "series": found,
    }
    return Prediction(thermal, document, lines)


def advise_warm_up(
    thermal: ThermalCamera, programme: Path, camera: Path | None, distance: float, wanted: float
) -> Prediction:
    """Predict how long the camera takes within a programme to be steady to `wanted` mm.

    distance: of the plane, m; camera: the device's file, which describes how it warms.
    """
    usual = CameraDevice(thermal.model.camera, thermal.model.sensor)
    device = usual if camera is None else read_camera_device(camera)
    history = Simulation(
        thermal.model, device, demonstration_field("plain"), read_programme(programme)
    ).true_history
    along = thermal.along(
        history.reading_times, dict(history.readings), history.times, extrapolate=True
    )
    steady_from, error = warm_up(along, distance * 1000.0, wanted)
    document = {
        "format": "thermocald-warm-up/1",
        "camera": thermal.model.camera,
        "distance_m": distance,
        "wanted_mm": wanted,
        "steady_from_s": steady_from,
        "error_at_begin_mm": float(error.max()),
        "temperature_at_end": float(along.temperatures[-1]),
    }
    if steady_from is None:
        said = "does not become steady within this programme: use a longer one"
    else:
        said = f"is steady to {wanted:g} mm at {distance:g} m after {steady_from:.0f} s"
    worst = f"(up to {document['error_at_begin_mm']:.1f} mm before)"
    return Prediction(thermal, document, [f"{thermal.model.camera} {said} {worst}"])
