"""The epochs of a recording or of a store's series, calibrated one by one and then as a series.

A long series is adjusted in blocks. A recording can also be replayed into a store.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np

from thermocald.acquisition.calibrator import EPOCHS_OF_A_BLOCK, Calibrator, calibrated_epochs
from thermocald.analysis.series.adjusted import table_of_series
from thermocald.analysis.series.drift import with_drifts
from thermocald.analysis.series.epochs import Epochs, calibrate_epochs
from thermocald.arrays import spread_rows
from thermocald.errors import DataError, UsageError
from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES, project
from thermocald.photogrammetry.epoch.adjustment import with_few_free
from thermocald.photogrammetry.field.testfield import same_targets
from thermocald.photogrammetry.linalg import median_known
from thermocald.photogrammetry.series.long_series import together_at_most
from thermocald.photogrammetry.series.normals import ObservationGrid
from thermocald.photogrammetry.series.result import SeriesSettings
from thermocald.store.database.store import Store
from thermocald.store.recording.sense import target_doubts
from thermocald.store.schema import COLUMN_NAMES
from thermocald.store.series import EpochResult, LoggedReading
from thermocald.store.server.connection import require_file
from thermocald.store.sources import StoredRecording

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.arrays import Array, Index
    from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings
    from thermocald.photogrammetry.field.testfield import Observations
    from thermocald.photogrammetry.series.normals import ObservationBlocks
    from thermocald.store.recording.reader import Recording
    from thermocald.store.series import StoredSeries


_STARTS = 25  # epochs of a long series that are calibrated one by one for initial values


def series_epochs(
    source: Recording | StoredRecording,
    settings: AdjustmentSettings,
    exterior: str,
    advance: Callable[[int], None] | None = None,
    jobs: int = 1,
) -> Epochs:
    """Adjust a recording, or the series of an open store, as one series.

    Frames without observations are measured. If a recording with observations is too long to be
    adjusted at once, only some epochs are calibrated one by one. exterior: `stored` returns the
    epochs of a store as they are; advance: receives the number of a recording's epochs done; jobs:
    processes, without effect on any bit. Raises DataError without a result.
    """
    if exterior != "stored":
        source.head.require_calibrated(source.title)
    calibrator, field = Calibrator.of_recording(source, settings), source.testfield
    blocks: ObservationBlocks = source
    observations: Callable[[int], Observations | None] = source.observations
    further = None
    if isinstance(source, StoredRecording):
        apart = _stored_epochs(source, exterior)
        if exterior == "stored" or not {"ok", "weak_geometry"} & set(apart.status):
            return apart
    elif source.has_observations and len(source) > together_at_most(len(field)):
        E, further = len(source), advance
        nothing, none = np.broadcast_to(np.nan, (E, 16)), np.broadcast_to(np.int64(0), (E,))
        apart = Epochs(  # these epochs are not calibrated one by one
            source.columns.numbers, source.columns.frame_time, _temperature(source), nothing,
            nothing, nothing[:, 0], none, none, ("ok",) * E, ("",) * E, "per_epoch",
        )  # fmt: skip
    else:
        apart, seen = calibrate_epochs(
            source.iter_epochs(), calibrator, _temperature(source), advance, jobs
        )
        blocks, observations = ObservationGrid.from_observations(field, seen), seen.__getitem__
    known = np.isfinite(apart.values[:, 0]).any()
    start = None if known else _start(source, observations, calibrator)
    together = SeriesSettings.of(settings, exterior)
    return table_of_series(source.head, field, apart, blocks, together, start, jobs, further)


def _start(
    source: Recording | StoredRecording,
    observations: Callable[[int], Observations | None],
    calibrator: Calibrator,
) -> Array:
    """Return initial parameters (16,): medians over some epochs from first to last.

    If every epoch is too weak by itself, only c and A1 are estimated: enough for initial values of
    a series that may determine all parameters together. Raises DataError if no epoch has a result.
    """
    some = map(observations, spread_rows(len(source), _STARTS).tolist())
    seen = [points for points in some if points is not None and len(points)]
    results = [calibrator.adjust(points) for points in seen]
    found = [r.values for r in results if r.ok]
    if not found and any(r.status == "weak_geometry" for r in results):
        firm = Calibrator.of_recording(source, with_few_free(calibrator.settings))
        found = [r.values for r in map(firm.adjust, seen) if r.ok]
    if not found:
        statuses = [r.status for r in results]
        common = max(statuses, key=statuses.count, default="")
        why = next((r.reason for r in results if r.status == common), "no target was measured")
        raise DataError(f"{source.title}: no epoch has a result; most often: {why}")
    return np.median(found, axis=0)


def misplaced_doubts(recording: Recording, rows: Index, values: Array) -> list[str]:
    """Return doubts about the positions of targets, from the cameras of some epochs.

    rows (n,): the epochs; values (n, 16): their cameras.
    """
    if not recording.has_observations:
        return []
    sensor, targets = recording.camera.sensor, recording.testfield
    found = np.full((len(rows), len(targets), 2), np.nan)
    for at, row, camera in zip(found, rows.tolist(), values, strict=True):
        if (seen := recording.observations(row)) is not None:
            expected = project(sensor, camera[:10], camera[10:], targets.points)
            at[seen.targets] = seen.points - expected[seen.targets]
    c_px = float(np.median(values[:, 0])) / sensor.pixel_pitch
    return target_doubts(targets.names, median_known(found), c_px)


def _temperature(source: Recording | StoredRecording) -> Array:
    """Return the reference temperature (E,) °C at the frames' times, NaN if unknown."""
    reference = next(iter(source.head.channels), None)
    if reference is None:
        return np.full(len(source), np.nan)
    return source.columns.at_frame(reference)


def replay_into(
    path: Path,
    recording: Recording,
    settings: AdjustmentSettings,
    exterior: str,
    advance: Callable[[int], None],
    jobs: int = 1,
) -> Epochs:
    """Calibrate a recording's epochs into a store, from where an earlier replay stopped.

    Returns the epochs with their drifts. jobs: processes; the stored epochs of an interrupted block
    are calibrated again, so that the block's other epochs are the same as without the interruption.

    Raises StoreError; DataError if the store's series of this name is of another recording.
    """
    # not durable: a replay can be repeated after a power cut; the end of the process loses nothing
    columns = recording.further_columns()
    further = {name: column for name, column in columns.items() if name not in COLUMN_NAMES}
    with Store.open(require_file(path), "append", durable=False) as store:
        series = _open_series(store, recording, settings, list(further))
        log, last = recording.columns.readings, store.last_epoch(series)
        if log is not None and not store.logged(series):
            store.add_readings([
                LoggedReading(series.log_name, time, _known_of(log.channels, row))
                for row, time in enumerate(log.times.tolist())
            ])  # fmt: skip
        calibrator = Calibrator.of_recording(recording, settings)
        stored = 0 if last is None else int(np.searchsorted(recording.columns.numbers, last + 1))
        stored -= stored % EPOCHS_OF_A_BLOCK
        advance(stored)
        # a store names frames in its own folder only, relative to it
        home, folder = path.resolve().parent, recording.path.resolve()
        inside = folder.relative_to(home) if folder.is_relative_to(home) else None
        epochs = islice(recording.iter_epochs(), max(stored - 1, 0), None)
        before = next(epochs) if stored else None
        for done in calibrated_epochs(calibrator, epochs, jobs, before):
            if last is None or done.epoch.number > last:
                result = EpochResult.from_adjustment(done.adjustment)
                frame = done.epoch.frame
                if frame is not None:
                    frame = inside and inside / frame.relative_to(recording.path)
                epoch = replace(done.epoch, frame=frame)
                row = int(np.searchsorted(recording.columns.numbers, epoch.number))
                extra = {**_known_of(further, row), **done.extra}
                store.append(series, epoch, result, extra=extra)
            advance(1)
        # inside `with`: to leave targets out of a long series, the store is read again
        source = StoredRecording(store, series)
        return with_drifts(series_epochs(source, settings, exterior, jobs=jobs))


def _known_of(columns: Mapping[str, Array], row: int) -> dict[str, float]:
    """Return the values in a row of columns, without those that are missing."""
    return {name: float(c[row]) for name, c in columns.items() if np.isfinite(c[row])}


def _open_series(
    store: Store, recording: Recording, settings: AdjustmentSettings, further: list[str]
) -> StoredSeries:
    """Return the store's series of a recording, created if there is none."""
    wanted = {"exterior": "per_epoch", "free": list(settings.free)}
    wanted |= {"columns": further} if further else {}
    series = store.series_of(recording.camera.name, recording.series)
    if series is None:
        return store.create_series(
            recording.head, recording.testfield, settings=wanted, created_utc=time.time()
        )
    same_field = same_targets(series.testfield, recording.testfield)
    if series.head != recording.head or not same_field:
        of = "of another recording" if same_field else "with another test field"
        raise DataError(
            f"{store.path}: holds a series {series.camera}/{series.name} {of}; use another store, "
            "or change `series` in recording.yaml"
        )
    if series.settings.get("free") != wanted["free"]:
        raise UsageError(
            f"{store.path}: series {series.name!r} was calibrated with --free "
            f"{','.join(series.settings.get('free', []))}; use the same, or another store"
        )
    return series


def _stored_epochs(source: StoredRecording, exterior: str) -> Epochs:
    """Return a series' epochs as they are stored. Raises DataError if it has none."""
    store, series, size = source.store, source.series, len(source)
    if size == 0:
        raise DataError(f"{store.path}: series {series.name!r} has no epochs")
    names = ["sigma0", "n_observations", "n_rejected", "status"]
    columns = {n: c[:size] for n, c in store.series_columns(series, names).items()}
    ok = columns["status"] == "ok"
    known = ok | series.head.predicted
    reasons = [""] * size
    if not ok.all():
        rows = {int(n): i for i, n in enumerate(source.columns.numbers) if not ok[i]}
        for stored in store.epochs(series, details=False):
            if stored.epoch.number in rows:
                reasons[rows[stored.epoch.number]] = stored.result.reason
    return Epochs(
        source.columns.numbers,
        source.columns.frame_time,
        _temperature(source),
        _parameters(source, "", known),
        # they take as much memory as the values, and only stored epochs need them
        _parameters(source, "sd_", known)
        if exterior == "stored"
        else np.broadcast_to(np.nan, (size, 16)),
        np.where(ok, columns["sigma0"], np.nan),
        columns["n_observations"].astype(np.int64),
        columns["n_rejected"].astype(np.int64),
        tuple(map(sys.intern, columns["status"].tolist())),
        tuple(reasons),
        "per_epoch",
        head=series.head,
    )


def _parameters(source: StoredRecording, prefix: str, ok: NDArray[np.bool_]) -> Array:
    """Return the columns (E, 16) of all parameters."""
    out = np.empty((len(ok), 16))
    for k, name in enumerate(PARAMETER_NAMES):
        column = source.store.series_columns(source.series, [f"{prefix}{name}"])[f"{prefix}{name}"]
        out[:, k] = np.where(ok, column[: len(ok)], np.nan)
    return out
