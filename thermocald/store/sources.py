"""The sources that analyses read series from: a store in a file or on a server, read alike.

A series in an open store is read as a recording is: columns, epochs, observations in blocks.
A store holds times as stamped; analyses get them corrected where the clock was wrong.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import StoreError
from thermocald.files import is_database, is_ordinary, reading, shown
from thermocald.photogrammetry.series.normals import ObservationGrid
from thermocald.store.recording.observation_file import grid_runs
from thermocald.store.recording.reader import EpochColumns, TemperatureLog
from thermocald.store.server.connection import ServerAddress, is_server

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from thermocald.arrays import Array
    from thermocald.epoch import Epoch
    from thermocald.photogrammetry.field.testfield import Observations, TestField
    from thermocald.store.recording.head import Head
    from thermocald.store.series import SeriesReader, StoredSeries

_NO_STORES = (".csv", ".parquet", ".yaml", ".yml", ".json", ".zip")  # files of a recording, …


def open_source(source: Path) -> SeriesReader:
    """Open a store to read corrected times: a file, or `postgresql://…?camera=…&series=…`.

    Raises StoreError; for a server also UsageError, ServerGone, ServerError.
    """
    if is_server(source):
        from thermocald.store.server.reader import ServerStore

        opened: SeriesReader = ServerStore.open(source)
    else:
        from thermocald.store.database.store import Store

        if source.suffix.lower() in _NO_STORES and is_ordinary(source) and not is_database(source):
            raise StoreError(
                f"{shown(source)}: is not a store; give a recording's folder or a store"
            )
        opened = Store.open(source)
    opened.corrected = True
    return opened


def is_store(source: Path) -> bool:
    """Return whether a source is a store: a server's address, or a file that SQLite wrote."""
    return is_server(source) or is_database(source)


def source_name(source: Path) -> str:
    """Return a source's name for messages and results: an address without its password."""
    if not is_server(source):
        return str(source)
    parsed = ServerAddress.parse(source)
    chosen = (parsed.station, parsed.camera, parsed.series)
    return " ".join([str(parsed), "/".join(part for part in chosen if part)]).strip()


def require_source(source: Path) -> Path:
    """Return a recording, a store or a server's address as given; StoreError if a path is missing.

    A server is not contacted until it is opened.
    """
    with reading(source, StoreError):
        if not (is_server(source) or source.exists()):
            raise StoreError(
                f"{shown(source)}: does not exist; give a recording (folder), a store (file), or "
                "postgresql://…"
            )
    return source


def stored_log(store: SeriesReader, series: StoredSeries) -> TemperatureLog | None:
    """Return the log that a replayed recording had beside its epochs, None without one."""
    kept = store.logged(series)
    if not kept:
        return None
    channels = {
        name: np.array([reading.values.get(name, np.nan) for reading in kept])
        for name in series.head.channels
    }
    return TemperatureLog(np.array([reading.utc for reading in kept]), channels)


@dataclass(frozen=True, eq=False)
class StoredRecording:
    """One series of an open store, with the interface of a `Recording`."""

    store: SeriesReader
    series: StoredSeries
    has_observations = True

    @property
    def head(self) -> Head:
        return self.series.head

    @property
    def testfield(self) -> TestField:
        return self.series.testfield

    @property
    def title(self) -> str:
        """The series' name in messages."""
        return f"{self.store.where}: {self.series.name}"

    @cached_property
    def columns(self) -> EpochColumns:
        """Times and temperatures, without the paths of frames."""
        channels = list(self.head.channels)
        names = ["epoch", "frame_time", "temperature_time", *channels]
        found = self.store.series_columns(self.series, names)
        return EpochColumns(
            found["epoch"].astype(np.int64), found["frame_time"], found["temperature_time"],
            {name: found[name] for name in channels}, (), {}, stored_log(self.store, self.series),
        )  # fmt: skip

    def further_columns(self) -> dict[str, Array]:
        """Return the numeric columns (E,) that a replayed recording had besides the usual ones."""
        names = self.series.settings.get("columns")
        return self.store.series_columns(self.series, names) if names else {}

    def extra_columns(self) -> dict[str, Array]:
        """Return the further columns (E,) by name, NaN for an epoch without a value."""
        epochs = self.store.epochs(self.series, details=False)
        names = sorted({name for stored in epochs for name in stored.extra})
        return self.store.series_columns(self.series, names)

    def __len__(self) -> int:
        return len(self.columns)

    @property
    def epochs(self) -> list[Epoch]:
        """All epochs with their observations."""
        return [stored.epoch for stored in self.store.epochs(self.series)]

    def observations(self, row: int) -> Observations | None:
        """Return the observations of one epoch (from 0)."""
        number = int(self.columns.numbers[row])
        return self.store.observations(self.series, number, number).get(number)

    def blocks(
        self, windows: Sequence[slice] | None = None
    ) -> Iterator[tuple[int, ObservationGrid]]:
        """Yield grids of consecutive epochs, each with its first epoch (from 0), within windows."""
        numbers = self.columns.numbers
        for run in grid_runs(len(self), len(self.testfield), windows):
            wanted = numbers[run].tolist()
            found = self.store.observations(self.series, wanted[0], wanted[-1])
            seen = [found.get(number) for number in wanted]
            yield run.start, ObservationGrid.from_observations(self.testfield, seen)
