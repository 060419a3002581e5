"""The temperatures in a store, of a file or of a server, as a log to predict and correct with."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.thermal.temperature_log import TemperatureLog
from thermocald.errors import DataError
from thermocald.store.sources import open_source

if TYPE_CHECKING:
    from pathlib import Path

    from thermocald.store.recording.head import CameraSpec

__all__ = ["stored_temperature_log"]


def stored_temperature_log(
    source: Path, reference: str | None = None
) -> tuple[TemperatureLog, CameraSpec]:
    """The readings of all series of one camera in the order of time, and the camera.

    reference: the channel that is T, by default the first. DataError for a channel that is not
    there or a source without readings; StoreError where several cameras are in it.
    """
    with open_source(source) as store:
        every = store.all_series()
        if len({(s.camera, s.identity.get("station")) for s in every}) != 1:
            store.find_series()  # says what there is
        names = list(dict.fromkeys(name for s in every for name in s.head.channels))
        if reference is not None and reference not in names:
            raise DataError(
                f"{store.path}: there is no channel {reference!r}; there are: {', '.join(names)}"
            )
        ordered = sorted(names, key=lambda name: name != reference)
        parts: list[list[np.ndarray[tuple[int], np.dtype[np.float64]]]] = []
        for series in every:
            own = list(series.head.channels)
            columns = store.series_columns(series, ["temperature_time", *own])
            times = columns["temperature_time"]
            absent = np.full(times.size, np.nan)
            parts.append([times, *(columns[n] if n in own else absent for n in ordered)])
        path, camera = store.path, every[0].head.camera
    table = np.array([np.concatenate(column) for column in zip(*parts, strict=True)])
    table = table[:, np.isfinite(table[0])]
    if not table.shape[1]:
        raise DataError(f"{path}: holds no temperatures")
    # a reading that belongs to two epochs is one reading
    _, rows = np.unique(table[0], return_index=True)
    table = table[:, rows]
    return TemperatureLog(table[0], dict(zip(ordered, table[1:], strict=True))), camera
