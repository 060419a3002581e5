"""Measured series for the study, from recordings and stores.

Unless `exterior="per_epoch"` all epochs are adjusted together from their observations: one exterior
orientation for a camera that stood still, movements of its mount, or what the data show. With
`exterior="per_epoch"` a store's series is read as it was stored, column by column, with a sample of
its covariance matrices.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.statistics.significance import correlations_of
from thermocald.analysis.study.measured import Clip, MeasuredSeries, Thermometer
from thermocald.errors import DataError
from thermocald.photogrammetry.camera.camera_model import IOP_NAMES
from thermocald.photogrammetry.series.blocks import ColumnSpool, released
from thermocald.store.recording.readings import interpolate_readings
from thermocald.thermal.thermometer import estimate_reading_noise

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from thermocald.analysis.series.epochs import Epochs
    from thermocald.arrays import Array
    from thermocald.photogrammetry.field.testfield import Observations
    from thermocald.store.recording.head import Head
    from thermocald.store.recording.reader import Recording
    from thermocald.store.stored_recording import StoredRecording

_MOST_MATRICES = 5000


def refuse_copies(series: Sequence[MeasuredSeries]) -> None:
    """Raise DataError where two series hold the same epochs."""
    for i, one in enumerate(series):
        for other in series[:i]:
            if len(one) > 1 and len(one) == len(other) and np.array_equal(one.values, other.values):
                raise DataError(
                    f"{one.source} holds the same epochs as {other.source}; give each series once"
                )


def measured_series(
    source: Recording | StoredRecording,
    table: Epochs,
    observations: Callable[[int], Observations | None],
    label: str,
    thermometer_sd: float | None = None,
) -> MeasuredSeries:
    """Return a series that was adjusted together, as the study reads it.

    table: of its epochs; observations: what an epoch (from 0) shows; label: what the study treats
    as one camera; thermometer_sd K, by default from the readings. Raises DataError where no epoch
    has a result.
    """
    thermometers = _thermometers(source, np.ones(len(table), dtype=bool), thermometer_sd)
    clip = _clip(source, table.ok, observations) if table.ok.any() else None
    return _from_table(source.head, source.title, table, thermometers, label, clip)


def stored_series(
    recording: StoredRecording, label: str, thermometer_sd: float | None = None
) -> MeasuredSeries:
    """Return a series as it was stored; one column at a time, for a year of epochs must fit.

    Arguments and errors as of `measured_series`.
    """
    recording.head.require_calibrated(recording.title)
    store, series, size = recording.store, recording.series, len(recording)

    def column(name: str) -> Array:
        values: Array = store.series_columns(series, [name])[name][:size]
        return values

    ok, lost = _assessed(column("status").tolist())
    source = recording.title
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
    number, frame_time = recording.columns.numbers[ok], recording.columns.frame_time[ok]
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
        _thermometers(recording, ok, thermometer_sd),
        values,
        sds,
        column("sigma0")[ok],
        column("redundancy")[ok],
        correlations_of(covariances[have]),
        rows[have],
        str(series.settings.get("exterior", "per_epoch")),
        lost,
        _clip(recording, ok, recording.observations),
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
    ok, lost = _assessed(table.status)
    ok = _whole(ok, table.values[:, :10], table.sd[:, :10], lost)
    released(table.values)
    released(table.sd)
    if not ok.any():
        why = next((reason for reason in table.reasons if reason), _in_words(lost))
        raise DataError(f"{source}: no epoch has a result: {why}")
    adjustment = table.adjustment
    assert adjustment is not None  # a table with a result has one
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


def _thermometers(
    source: Recording | StoredRecording, rows: NDArray[np.bool_], sd: float | None
) -> tuple[Thermometer, ...]:
    """Every channel at the times of some frames (E,), its noise as given or from the readings."""
    columns, found = source.columns, []
    for name, channel in source.head.channels.items():
        times, readings = columns.readings_of(name)
        values = interpolate_readings(columns.frame_time[rows], times, readings)
        noise = estimate_reading_noise(times, readings, channel.resolution) if sd is None else sd
        found.append(Thermometer(name, values, noise))
    return tuple(found)


def _assessed(status: Sequence[str]) -> tuple[NDArray[np.bool_], dict[str, int]]:
    """Which epochs have a result, and how many have none for which reason."""
    ok = np.fromiter((word == "ok" for word in status), bool, len(status))
    lost = sorted((word, n) for word, n in Counter(status).items() if word != "ok")
    return ok, {word.replace("_", " "): n for word, n in lost}


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


def _clip(
    source: Recording | StoredRecording,
    ok: NDArray[np.bool_],
    observations: Callable[[int], Observations | None],
) -> Clip | None:
    """A clip about the target nearest to the image centre that both ends show; None without."""
    ends = source.framed(ok)
    if len(ends) != 2 or not all(frame.is_file() for _, frame in ends):
        return None
    (i, first_frame), (k, last_frame) = ends
    first, last = observations(i), observations(k)
    if first is None or last is None:
        return None
    both = np.isin(first.targets, last.targets)
    if not both.any():
        return None
    points = first.points[both]
    nearest = int(np.argmin(np.linalg.norm(points - source.head.camera.sensor.centre, axis=1)))
    target = source.testfield.names[int(first.targets[both][nearest])]
    numbers = source.columns.numbers
    return Clip(
        target, first_frame, last_frame, int(numbers[i]), int(numbers[k]),
        (float(points[nearest, 0]), float(points[nearest, 1])),
    )  # fmt: skip
