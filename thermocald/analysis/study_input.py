"""Measured series for the study: from a store's columns, or from a recording adjusted on the spot.

A year of epochs is read column by column, and only a sample of its covariance matrices; a recording
is adjusted as one series with one exterior orientation.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from thermocald.analysis.correlations import correlations_of
from thermocald.analysis.dependence import thermometer_noise
from thermocald.analysis.measured import Clip, MeasuredSeries, Thermometer
from thermocald.errors import DataError
from thermocald.photogrammetry.camera_model import IOP_NAMES
from thermocald.photogrammetry.orientation import approximate_orientation
from thermocald.photogrammetry.series import SeriesSettings, adjust_series
from thermocald.store.readings import interpolate_readings

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.epoch import Epoch
    from thermocald.photogrammetry.series import SeriesAdjustment
    from thermocald.photogrammetry.testfield import Observations
    from thermocald.store.database import Store
    from thermocald.store.head import Head
    from thermocald.store.recording import Recording
    from thermocald.store.row import StoredSeries

    Array = NDArray[np.float64]

__all__ = ["adjusted_recording", "from_adjustment", "from_recording", "from_store", "load_series"]

_MOST_MATRICES = 5000
_MOST_EPOCHS = 50_000


def load_series(
    path: Path, label: str | None = None, thermometer_sd: float | None = None
) -> list[MeasuredSeries]:
    """Every series of a recording (a folder) or a store (a file).

    label: what the study treats as one camera, by default the camera's name; thermometer_sd: K, by
    default from the readings. Raises DataError where nothing can be studied.
    """
    if path.is_dir():
        from thermocald.store.recording import read_recording

        return [from_recording(read_recording(path), label, thermometer_sd)]
    from thermocald.store.database import Store

    with Store.open(path) as store:
        found = [from_store(store, s, label, thermometer_sd) for s in store.all_series()]
    if not found:
        raise DataError(f"{path}: the store holds no series")
    return found


def from_store(
    store: Store,
    series: StoredSeries,
    label: str | None = None,
    thermometer_sd: float | None = None,
) -> MeasuredSeries:
    """One series of a store; DataError where no epoch has a result."""

    def column(name: str) -> Array:
        values: Array = store.series_columns(series, [name])[name]
        return values

    ok, lost = _judged(store.series_columns(series, ["status"])["status"])
    source = f"{store.path}: {series.camera}/{series.name}"
    if not ok.any():
        raise DataError(f"{source}: no epoch has a result ({_in_words(lost)})")
    count = int(ok.sum())
    values, sds = np.empty((count, 10), order="F"), np.empty((count, 10), order="F")
    for k, name in enumerate(IOP_NAMES):
        values[:, k] = column(name)[ok]
        sds[:, k] = column(f"sd_{name}")[ok]
    number = column("epoch")[ok].astype(np.int64)
    time_s = column("frame_time")[ok]
    begin = time_s[0]
    time_s -= begin
    rows = _spread(count, _MOST_MATRICES)
    covariances = store.covariances(series, number[rows].tolist())[:, :10, :10]
    have = np.isfinite(covariances).all(axis=(1, 2))
    reading_time = column("temperature_time")
    thermometers = []
    for name, channel in series.head.channels.items():
        readings = column(name)
        thermometers.append(
            Thermometer(
                name,
                interpolate_readings(time_s + begin, reading_time, readings),
                thermometer_sd or thermometer_noise(readings, channel.resolution),
            )
        )
    start = f"-{series.start}" if series.start else ""
    return MeasuredSeries(
        label or series.camera + start,
        series.name,
        series.camera,
        series.head.camera.sensor,
        source,
        number,
        time_s,
        tuple(thermometers),
        values,
        sds,
        column("sigma0")[ok],
        column("redundancy")[ok],
        correlations_of(covariances[have]),
        rows[have],
        str(series.settings.get("exterior", "per_epoch")),
        lost,
        _stored_clip(store, series, number),
    )


def from_recording(
    recording: Recording, label: str | None = None, thermometer_sd: float | None = None
) -> MeasuredSeries:
    """A recording, adjusted as one series; DataError where it cannot be."""
    adjustment = adjusted_recording(recording)
    columns = recording.columns
    thermometers = [
        Thermometer(
            name,
            columns.at_frame(name),
            thermometer_sd or thermometer_noise(columns.temperatures[name], channel.resolution),
        )
        for name, channel in recording.channels.items()
    ]
    clip = None
    if any(columns.frames):
        rows = [i for i, frame in enumerate(columns.frames) if frame and adjustment.ok[i]]
        clip = _clip(
            [recording.epochs[i] for i in rows[:1] + rows[-1:]],
            recording.testfield.names,
            recording.camera.sensor.centre,
            recording.path,
        )
    return from_adjustment(
        recording.head,
        str(recording.path),
        columns.numbers,
        columns.frame_time,
        thermometers,
        adjustment,
        label,
        clip,
    )


def adjusted_recording(recording: Recording) -> SeriesAdjustment:
    """All epochs of a recording adjusted together, from approximate values of its best epoch."""
    if not recording.has_observations:
        raise DataError(
            f"{recording.path}: the frames are not measured yet; run `thermocald replay "
            f"{recording.path} --store FILE` and study the store"
        )
    if len(recording.columns) > _MOST_EPOCHS:
        raise DataError(
            f"{recording.path}: {len(recording.columns)} epochs are too many to be adjusted at "
            f"once (at most {_MOST_EPOCHS}); replay the recording into a store and study that"
        )
    observations = [epoch.observations for epoch in recording.epochs]
    best = max((o for o in observations if o is not None), key=len, default=None)
    if best is None:
        raise DataError(f"{recording.path}: no epoch has observations")
    interior, exterior, _ = approximate_orientation(
        recording.camera.sensor,
        recording.testfield.points[best.targets],
        best.points,
        recording.camera.principal_distance,
        recording.camera.interior,
    )
    return adjust_series(
        recording.camera.sensor,
        recording.testfield,
        observations,
        interior,
        exterior,
        SeriesSettings(),
    )


def from_adjustment(
    head: Head,
    source: str,
    number: NDArray[np.int64],
    frame_time: Array,
    thermometers: Iterable[Thermometer],
    adjustment: SeriesAdjustment,
    label: str | None = None,
    clip: Clip | None = None,
) -> MeasuredSeries:
    """A series that was adjusted as one; rows are epochs, thermometers at the frames' instants."""
    ok, lost = _judged(np.array(adjustment.status))
    if not ok.any():
        reasons = Counter(r for r in adjustment.reasons if r).most_common(1)
        why = reasons[0][0] if reasons else _in_words(lost)
        raise DataError(f"{source}: no epoch has a result: {why}")
    time_s = frame_time[ok]
    rows = _spread(int(ok.sum()), _MOST_MATRICES)
    covariances = adjustment.covariance[np.flatnonzero(ok)[rows]][:, :10, :10]
    return MeasuredSeries(
        label or head.camera.name,
        head.series,
        head.camera.name,
        head.camera.sensor,
        source,
        number[ok],
        time_s - time_s[0],
        tuple(Thermometer(t.name, t.values[ok], t.sd) for t in thermometers),
        np.asfortranarray(adjustment.values[ok, :10]),
        np.asfortranarray(adjustment.sd[ok, :10]),
        adjustment.sigma0[ok],
        adjustment.redundancy[ok],
        correlations_of(covariances),
        rows,
        adjustment.settings.exterior,
        lost,
        clip,
    )


def _judged(status: NDArray[np.str_]) -> tuple[NDArray[np.bool_], dict[str, int]]:
    """Which epochs have a result, and how many have none for which reason."""
    ok = status == "ok"
    words, counts = np.unique(status[~ok], return_counts=True)
    return ok, {str(word).replace("_", " "): int(n) for word, n in zip(words, counts, strict=True)}


def _in_words(lost: Mapping[str, int]) -> str:
    return ", ".join(f"{n} × {reason}" for reason, n in lost.items()) or "it has no epochs"


def _spread(count: int, most: int) -> NDArray[np.int64]:
    """Up to `most` rows evenly over `count`."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))


def _stored_clip(store: Store, series: StoredSeries, number: NDArray[np.int64]) -> Clip | None:
    ends = [next(store.epochs(series, int(n), int(n))).epoch for n in (number[0], number[-1])]
    return _clip(ends, series.testfield.names, series.head.camera.sensor.centre, store.path.parent)


def _clip(ends: Sequence[Epoch], names: Sequence[str], centre: Array, folder: Path) -> Clip | None:
    """A clip about the target nearest to the image centre that both ends show; None without."""
    if len(ends) < 2 or any(e.frame is None or e.observations is None for e in ends):
        return None
    first, last = ends
    assert first.observations is not None
    assert last.observations is not None
    assert first.frame is not None
    assert last.frame is not None
    if not (folder / first.frame).is_file() or not (folder / last.frame).is_file():
        return None
    point = _nearest(first.observations, last.observations, centre)
    if point is None:
        return None
    target, (x, y) = point
    return Clip(
        names[target],
        folder / first.frame,
        folder / last.frame,
        first.number,
        last.number,
        (x, y),
    )


def _nearest(
    first: Observations, last: Observations, centre: Array
) -> tuple[int, tuple[float, float]] | None:
    both = np.isin(first.targets, last.targets)
    if not both.any():
        return None
    points = first.points[both]
    k = int(np.argmin(np.linalg.norm(points - centre, axis=1)))
    return int(first.targets[both][k]), (float(points[k, 0]), float(points[k, 1]))
