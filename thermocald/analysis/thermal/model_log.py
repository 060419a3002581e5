"""The log of temperatures that a thermal model is asked for: of a logger, a recording, a store."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import DataError
from thermocald.store.logger.temperatures import LogOptions, TemperatureLog, read_log
from thermocald.store.recording.head import read_head
from thermocald.store.sources import is_store, open_source, require_source

if TYPE_CHECKING:
    from pathlib import Path

    from thermocald.analysis.thermal.thermal_camera import ThermalCamera
    from thermocald.store.recording.head import CameraSpec


def read_model_log(
    thermal: ThermalCamera,
    path: Path,
    options: LogOptions | None = None,
    near: tuple[float, float] | None = None,
) -> TemperatureLog:
    """Read a log for a model; T is the column that the options name, else the model's reference,
    else the first.

    path: a logger's file, the folder or `epochs.csv` of a recording, or a store; near: as
    `read_log` takes it. Raises ConfigurationError where the log is of another camera's recording.
    """
    options = options or LogOptions()
    reference = next(iter(thermal.model.validity), None)
    wanted = options.temperatures[0] if options.temperatures else None
    if is_store(path):
        log, camera = _stored(path, wanted)
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
    if camera is not None:
        thermal.for_images(camera.sensor.width, camera.sensor.height, camera.name)
    return log.with_reference(wanted or reference)


def _stored(source: Path, wanted: str | None) -> tuple[TemperatureLog, CameraSpec]:
    """The readings of all series of one camera in the order of time, and the camera.

    Raises DataError for a channel that is not there or a source without readings, StoreError where
    several cameras are in it.
    """
    with open_source(source) as store:
        every = store.all_series()
        if len({(s.camera, s.identity.get("station")) for s in every}) != 1:
            store.find_series()  # says what there is
        names = list(dict.fromkeys(name for s in every for name in s.head.channels))
        if wanted is not None and wanted not in names:
            raise DataError(
                f"{store.path}: there is no channel {wanted!r}; there are: {', '.join(names)}"
            )
        parts: list[list[np.ndarray[tuple[int], np.dtype[np.float64]]]] = []
        for series in every:
            own = list(series.head.channels)
            columns = store.series_columns(series, ["temperature_time", *own])
            times = columns["temperature_time"]
            absent = np.full(times.size, np.nan)
            parts.append([times, *(columns[n] if n in own else absent for n in names)])
        path, camera = store.path, every[0].head.camera
    table = np.array([np.concatenate(column) for column in zip(*parts, strict=True)])
    table = table[:, np.isfinite(table[0])]
    if not table.shape[1]:
        raise DataError(f"{path}: holds no temperatures")
    # a reading that belongs to two epochs is one reading
    _, rows = np.unique(table[0], return_index=True)
    table = table[:, rows]
    return TemperatureLog(table[0], dict(zip(names, table[1:], strict=True))), camera
