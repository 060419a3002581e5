"""Measured series for the study, from recordings and stores.

Unless `exterior="per_epoch"` all epochs are adjusted together from their observations: one exterior
orientation for a camera that stood still, movements of its mount, or what the data show. With
`exterior="per_epoch"` a store's series is read as it was stored, column by column, with a sample of
its covariance matrices.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.series.recorded import recorded_table
from thermocald.analysis.series.stored import table_of_stored
from thermocald.analysis.statistics.correlations import correlations_of
from thermocald.analysis.study.measured import Clip, MeasuredSeries, Thermometer
from thermocald.errors import DataError
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES
from thermocald.photogrammetry.epoch.adjustment import DEFAULT_FREE, AdjustmentSettings
from thermocald.photogrammetry.series.spool import ColumnSpool, released
from thermocald.photogrammetry.series.words import Words
from thermocald.store.recording.readings import interpolate_readings
from thermocald.thermal.thermometer import estimate_reading_noise

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.analysis.series.epochs import Epochs
    from thermocald.arrays import Array
    from thermocald.photogrammetry.field.testfield import Observations
    from thermocald.store.recording.head import Head
    from thermocald.store.recording.reader import Recording
    from thermocald.store.series import SeriesReader, StoredSeries

_MOST_MATRICES = 5000


def refuse_copies(series: Sequence[MeasuredSeries]) -> None:
    """Raise DataError where two series hold the same epochs."""
    for i, one in enumerate(series):
        for other in series[:i]:
            if len(one) > 1 and len(one) == len(other) and np.array_equal(one.values, other.values):
                raise DataError(
                    f"{one.source} holds the same epochs as {other.source}; give each series once"
                )


def from_recording(
    recording: Recording,
    label: str | None = None,
    thermometer_sd: float | None = None,
    exterior: str = "auto",
    free: Sequence[str] = DEFAULT_FREE,
    advance: Callable[[int], None] | None = None,
    jobs: int = 1,
) -> MeasuredSeries:
    """A recording, its frames measured where they are not, adjusted as one series."""
    columns, camera = recording.columns, recording.camera
    settings = AdjustmentSettings(free=tuple(free))
    table, observations = recorded_table(recording, settings, exterior, advance, jobs)
    thermometers = [
        _thermometer(
            name,
            columns.frame_time,
            *columns.readings_of(name),
            channel.resolution,
            thermometer_sd,
        )
        for name, channel in recording.channels.items()
    ]
    ok = table.ok
    framed = [i for i, frame in enumerate(columns.frames) if frame and ok[i]]
    clip = None
    if len(framed) > 1:
        first, last = framed[0], framed[-1]
        clip = _clip(
            (recording.path / columns.frames[first], recording.path / columns.frames[last]),
            (int(columns.numbers[first]), int(columns.numbers[last])),
            (observations(first), observations(last)),
            recording.testfield.names,
            camera.sensor.centre,
        )
    return _from_table(
        recording.head, str(recording.path), table, thermometers, label or camera.name, clip
    )


def from_store(
    store: SeriesReader,
    series: StoredSeries,
    label: str | None = None,
    thermometer_sd: float | None = None,
    exterior: str = "auto",
    jobs: int = 1,
) -> MeasuredSeries:
    """One series of a store; DataError where no epoch has a result."""
    series.head.require_calibrated(store.where)
    start = f"-{series.start}" if series.start else ""
    label = label or series.camera + start
    count = len(store.series_columns(series, ["epoch"])["epoch"])
    if exterior != "per_epoch" and count:
        free = tuple(series.settings.get("free", DEFAULT_FREE))
        table = table_of_stored(store, series, AdjustmentSettings(free=free), exterior, jobs)
        thermometers = _stored_thermometers(store, series, table.frame_time, thermometer_sd)
        source = f"{store.path}: {series.camera}/{series.name}"
        clip = _stored_clip(store, series, table.number[table.ok])
        return _from_table(series.head, source, table, thermometers, label, clip)
    return _from_columns(store, series, label, thermometer_sd)


def _from_columns(
    store: SeriesReader, series: StoredSeries, label: str, thermometer_sd: float | None
) -> MeasuredSeries:
    """A series as it was stored; one column at a time, for a year of epochs must fit."""

    def column(name: str) -> Array:
        values: Array = store.series_columns(series, [name])[name]
        return values

    ok, lost = _assessed(store.series_columns(series, ["status"])["status"].tolist())
    source = f"{store.path}: {series.camera}/{series.name}"
    if not ok.any():
        raise DataError(f"{source}: no epoch has a result ({_in_words(lost)})")
    count = int(ok.sum())
    spools = ColumnSpool(count, 10), ColumnSpool(count, 10)
    for k, name in enumerate(IOP_NAMES):
        for spool, prefix in zip(spools, ("", "sd_"), strict=True):
            spool.array[:, k] = column(f"{prefix}{name}")[ok]
            spool.release()
    values, sds = (spool.array for spool in spools)
    whole = _whole(np.ones(count, dtype=bool), values, sds, lost)
    if not whole.all():
        ok[ok] = whole
        values, sds, count = _columns(values, whole), _columns(sds, whole), int(whole.sum())
    if not count:
        raise DataError(f"{source}: no epoch has a result ({_in_words(lost)})")
    number = column("epoch")[ok].astype(np.int64)
    frame_time = column("frame_time")[ok]
    rows = _spread(count, _MOST_MATRICES)
    covariances = store.covariances(series, number[rows].tolist())[:, :10, :10]
    have = np.isfinite(covariances).all(axis=(1, 2))
    return MeasuredSeries(
        label,
        series.name,
        series.camera,
        series.head.camera.sensor,
        source,
        number,
        frame_time - frame_time[0],
        tuple(_stored_thermometers(store, series, frame_time, thermometer_sd)),
        values,
        sds,
        column("sigma0")[ok],
        column("redundancy")[ok],
        correlations_of(covariances[have]),
        rows[have],
        str(series.settings.get("exterior", "per_epoch")),
        lost,
        _stored_clip(store, series, number),
        float(frame_time[0]),
    )


def _from_table(
    head: Head,
    source: str,
    table: Epochs,
    thermometers: Sequence[Thermometer],
    label: str,
    clip: Clip | None,
) -> MeasuredSeries:
    """A series that was adjusted together; thermometers at the times of all its epochs."""
    adjustment = table.adjustment
    assert adjustment is not None  # table_of_series always has one
    ok, lost = _assessed(table.status)
    ok = _whole(ok, table.values[:, :10], table.sd[:, :10], lost)
    released(table.values)
    released(table.sd)
    if not ok.any():
        why = next((reason for reason in table.reasons if reason), _in_words(lost))
        raise DataError(f"{source}: no epoch has a result: {why}")
    of = np.arange(len(ok)) if table.sampled is None else table.sampled
    have = np.flatnonzero(ok[of] & adjustment.ok)
    some = have[_spread(len(have), _MOST_MATRICES)]
    covariances = adjustment.covariance[some][:, :10, :10]
    rows = (np.cumsum(ok) - 1)[of[some]]
    time_s = table.frame_time[ok]
    return MeasuredSeries(
        label,
        head.series,
        head.camera.name,
        head.camera.sensor,
        source,
        table.number[ok],
        time_s - time_s[0],
        tuple(Thermometer(t.name, t.values[ok], t.sd) for t in thermometers),
        _columns(table.values, ok),
        _columns(table.sd, ok),
        table.sigma0[ok],
        table.redundancy[ok],
        correlations_of(covariances),
        rows,
        table.exterior,
        lost,
        clip,
        float(time_s[0]),
        adjustment.choice,
        adjustment.noise_ratio,
        table.field_movements,
    )


def _columns(values: Array, ok: NDArray[np.bool_]) -> Array:
    """The interior orientation (n, 10) of the epochs with a result, column by column on disk."""
    spool = ColumnSpool(int(ok.sum()), 10)
    for k in range(10):
        spool.array[:, k] = values[ok, k]
        released(values)
        spool.release()
    return spool.array


def _thermometer(
    name: str,
    frame_time: Array,
    reading_time: Array,
    readings: Array,
    resolution: float | None,
    sd: float | None,
) -> Thermometer:
    values = interpolate_readings(frame_time, reading_time, readings)
    known = estimate_reading_noise(reading_time, readings, resolution) if sd is None else sd
    return Thermometer(name, values, known)


def _stored_thermometers(
    store: SeriesReader, series: StoredSeries, frame_time: Array, sd: float | None
) -> list[Thermometer]:
    reading_time = store.series_columns(series, ["temperature_time"])["temperature_time"]
    return [
        _thermometer(
            name,
            frame_time,
            reading_time,
            store.series_columns(series, [name])[name],
            channel.resolution,
            sd,
        )
        for name, channel in series.head.channels.items()
    ]


def _assessed(status: Sequence[str]) -> tuple[NDArray[np.bool_], dict[str, int]]:
    """Which epochs have a result, and how many have none for which reason."""
    words = Words.of(status)
    lost = sorted((word, n) for word, n in words.counts().items() if word != "ok")
    return words.are("ok"), {word.replace("_", " "): n for word, n in lost}


def _whole(
    ok: NDArray[np.bool_], values: Array, sds: Array, lost: dict[str, int]
) -> NDArray[np.bool_]:
    """Of the epochs with a result, those with a number wherever others have one; counts the rest.

    A covariance matrix at the edge of singularity can have negative variances, that is not an sd.
    """
    whole = ok.copy()
    for k in range(values.shape[1]):
        whole &= np.isfinite(values[:, k])
        has = np.isfinite(sds[:, k])
        if (has & ok).any():
            whole &= has
        released(values)
        released(sds)
    missing = int(np.count_nonzero(ok & ~whole))
    if missing:
        lost["no standard deviation"] = missing
    return whole


def _in_words(lost: Mapping[str, int]) -> str:
    return ", ".join(f"{n} × {reason}" for reason, n in lost.items()) or "it has no epochs"


def _spread(count: int, most: int) -> NDArray[np.int64]:
    """Up to `most` rows evenly over `count`."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))


def _stored_clip(
    store: SeriesReader, series: StoredSeries, number: NDArray[np.int64]
) -> Clip | None:
    first, last = (next(store.epochs(series, int(n), int(n))).epoch for n in number[[0, -1]])
    if first.frame is None or last.frame is None:
        return None
    folder = store.path.parent
    return _clip(
        (folder / first.frame, folder / last.frame),
        (first.number, last.number),
        (first.observations, last.observations),
        series.testfield.names,
        series.head.camera.sensor.centre,
    )


def _clip(
    frames: tuple[Path, Path],
    numbers: tuple[int, int],
    observations: tuple[Observations | None, Observations | None],
    names: Sequence[str],
    centre: Array,
) -> Clip | None:
    """A clip about the target nearest to the image centre that both ends show; None without."""
    first, last = observations
    if first is None or last is None or not all(path.is_file() for path in frames):
        return None
    both = np.isin(first.targets, last.targets)
    if not both.any():
        return None
    points = first.points[both]
    k = int(np.argmin(np.linalg.norm(points - centre, axis=1)))
    target = names[int(first.targets[both][k])]
    return Clip(target, *frames, *numbers, (float(points[k, 0]), float(points[k, 1])))
