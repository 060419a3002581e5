"""Series in a store: a recording replayed into one, and the table of what is stored."""

from __future__ import annotations

import sys
import time
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np

from thermocald.acquisition.calibrator import EPOCHS_OF_A_BLOCK, Calibrator, calibrated_epochs
from thermocald.analysis.series.adjusted import table_of_series
from thermocald.analysis.series.drift import with_drifts
from thermocald.analysis.series.epochs import Epochs
from thermocald.errors import DataError, UsageError
from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES
from thermocald.photogrammetry.series.blocks import ColumnSpool
from thermocald.photogrammetry.series.result import SeriesSettings
from thermocald.store.database.store import Store
from thermocald.store.series import EpochResult
from thermocald.store.stored_recording import StoredRecording

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings
    from thermocald.store.recording.reader import Recording
    from thermocald.store.series import StoredSeries


def replay_into(
    path: Path,
    recording: Recording,
    settings: AdjustmentSettings,
    exterior: str,
    advance: Callable[[int], None],
    jobs: int = 1,
) -> Epochs:
    """Calibrate a recording's epochs into a store, from where an earlier replay stopped.

    Returns the epochs with their drifts. jobs: processes; of a block of epochs that was
    interrupted those that are stored are calibrated again, so that the others are as they would be.

    Raises StoreError; DataError where the store's series of this name is of something else.
    """
    # A replay can be repeated: the end of the process must not lose anything, a power cut may.
    with Store.open(path, "append", durable=False) as store:
        series = _series(store, recording, settings)
        last = store.last_epoch(series)
        calibrator = Calibrator.of_recording(recording, settings)
        stored = 0 if last is None else int(np.searchsorted(recording.columns.numbers, last + 1))
        stored -= stored % EPOCHS_OF_A_BLOCK
        advance(stored)
        epochs = islice(recording.iter_epochs(), stored, None)
        for done in calibrated_epochs(calibrator, epochs, jobs):
            if last is None or done.epoch.number > last:
                result = EpochResult.from_adjustment(done.adjustment)
                store.append(series, done.epoch, result, extra=done.extra)
            advance(1)
        # while the store is open: targets are left out of a long series by reading it again
        source = StoredRecording(store, series)
        return with_drifts(table_of_stored(source, settings, exterior, jobs))


def _series(store: Store, recording: Recording, settings: AdjustmentSettings) -> StoredSeries:
    wanted = {"exterior": "per_epoch", "free": list(settings.free)}
    for series in store.all_series():
        if (series.camera, series.name) != (recording.camera.name, recording.series):
            continue
        if series.head != recording.head or series.testfield.names != recording.testfield.names:
            raise DataError(
                f"{store.path}: holds a series {series.camera}/{series.name} of another recording; "
                "use another store, or change `series` in recording.yaml"
            )
        if series.settings.get("free") != wanted["free"]:
            raise UsageError(
                f"{store.path}: series {series.name!r} was calibrated with --free "
                f"{','.join(series.settings.get('free', []))}; keep to that, or use another store"
            )
        return series
    return store.create_series(
        recording.head, recording.testfield, settings=wanted, created_utc=time.time()
    )


def table_of_stored(
    source: StoredRecording, settings: AdjustmentSettings, exterior: str, jobs: int = 1
) -> Epochs:
    """Return the table of a series in an open store. Raises DataError where it has no epochs."""
    store, series, size = source.store, source.series, len(source)
    if size == 0:
        raise DataError(f"{store.path}: series {series.name!r} has no epochs")
    names = ["sigma0", "n_observations", "n_rejected", "status"]
    columns = {n: c[:size] for n, c in store.series_columns(series, names).items()}
    ok = columns["status"] == "ok"
    if exterior != "stored":
        series.head.require_calibrated(str(store.path))
    known = ok | series.head.predicted
    reasons = [""] * size
    if not ok.all():
        rows = {int(n): i for i, n in enumerate(source.columns.numbers) if not ok[i]}
        for stored in store.epochs(series, details=False):
            if stored.epoch.number in rows:
                reasons[rows[stored.epoch.number]] = stored.result.reason
    reference = next(iter(series.head.channels), None)
    apart = Epochs(
        source.columns.numbers,
        source.columns.frame_time,
        np.full(size, np.nan) if reference is None else source.columns.at_frame(reference),
        _parameters(source, "", known),
        _parameters(source, "sd_", known),
        np.where(ok, columns["sigma0"], np.nan),
        columns["n_observations"].astype(np.int64),
        columns["n_rejected"].astype(np.int64),
        tuple(map(sys.intern, columns["status"].tolist())),
        tuple(reasons),
        "per_epoch",
        head=series.head,
    )
    if not ok.any() or exterior == "stored":
        return apart
    return table_of_series(
        series.head, series.testfield, apart, source, SeriesSettings.of(settings, exterior),
        jobs=jobs,
    )  # fmt: skip


def _parameters(source: StoredRecording, prefix: str, ok: NDArray[np.bool_]) -> Array:
    """Columns (E, 16) of all parameters, one after the other, for a year of epochs must fit."""
    spool = ColumnSpool(len(ok), 16)
    for k, name in enumerate(PARAMETER_NAMES):
        column = source.store.series_columns(source.series, [f"{prefix}{name}"])[f"{prefix}{name}"]
        spool.array[:, k] = np.where(ok, column[: len(ok)], np.nan)
        spool.release()
    return spool.array
