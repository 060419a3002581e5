"""Where analyses read series from: a store in a file, or one on a server; both answer alike.

A series in an open one is read as a recording is: columns, epochs, observations in blocks.
Analyses read times that are corrected where the clock was wrong; the store has them as stamped.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import StoreError
from thermocald.files import is_database
from thermocald.store.recording.observation_file import grid_runs
from thermocald.store.recording.reader import EpochColumns
from thermocald.store.server.connection import ServerAddress, is_server

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.epoch import Epoch
    from thermocald.photogrammetry.field.testfield import Observations, TestField
    from thermocald.photogrammetry.series.normals import ObservationGrid
    from thermocald.store.recording.head import Head
    from thermocald.store.series import SeriesReader, StoredSeries


def open_source(source: Path) -> SeriesReader:
    """Open a store for reading: a file, or `postgresql://…?camera=…&series=…`; times are corrected.

    Raises StoreError, for a server also UsageError, ServerGone, ServerError.
    """
    if is_server(source):
        from thermocald.store.server.reader import ServerStore

        opened: SeriesReader = ServerStore.open(source)
    else:
        from thermocald.store.database.store import Store

        opened = Store.open(source)
    opened.corrected = True
    return opened


def is_store(source: Path) -> bool:
    """Whether a source is a store: a server's address, or a file that SQLite wrote."""
    return is_server(source) or is_database(source)


def source_name(source: Path) -> str:
    """A source as messages and results name it: an address without its password."""
    if not is_server(source):
        return str(source)
    parsed = ServerAddress.parse(source)
    chosen = (parsed.station, parsed.camera, parsed.series)
    return " ".join([str(parsed), "/".join(part for part in chosen if part)]).strip()


def require_source(source: Path) -> Path:
    """A recording, a store or a server's address as given; StoreError for a path that is not there.

    A server is asked when it is opened.
    """
    if not is_server(source) and not source.exists():
        raise StoreError(
            f"{source}: does not exist; give a recording (folder), a store (file), or "
            "postgresql://…"
        )
    return source


@dataclass(frozen=True, eq=False)
class StoredRecording:
    """One series of an open store, as `Recording` is one of a folder; it has its observations."""

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
        """What messages call it."""
        return f"{self.store.path}: {self.series.name}"

    @cached_property
    def columns(self) -> EpochColumns:
        """Times and temperatures; files of frames are asked for one by one, see `framed`."""
        channels = list(self.head.channels)
        names = ["epoch", "frame_time", "temperature_time", *channels]
        found = self.store.series_columns(self.series, names)
        return EpochColumns(
            found["epoch"].astype(np.int64), found["frame_time"], found["temperature_time"],
            {name: found[name] for name in channels}, (), {},
        )  # fmt: skip

    def extra_columns(self) -> dict[str, Array]:
        """Return by name what else is stored of each epoch, (E,), NaN where it has none."""
        place = {int(number): row for row, number in enumerate(self.columns.numbers)}
        found: dict[str, Array] = {}
        for stored in self.store.epochs(self.series, details=False):
            for name, value in stored.extra.items():
                column = found.setdefault(name, np.full(len(place), np.nan))
                if (row := place.get(stored.epoch.number)) is not None:
                    column[row] = value
        return dict(sorted(found.items()))

    def __len__(self) -> int:
        return len(self.columns)

    @property
    def epochs(self) -> list[Epoch]:
        """All epochs with their observations."""
        return [stored.epoch for stored in self.store.epochs(self.series)]

    def observations(self, row: int) -> Observations | None:
        """What one epoch (from 0) shows."""
        return self._epoch(row).observations

    def framed(self, ok: NDArray[np.bool_]) -> list[tuple[int, Path]]:
        """The first and the last of some epochs (E,), from 0, and their frames, where kept."""
        found = [(row, self._epoch(row).frame) for row in np.flatnonzero(ok)[[0, -1]].tolist()]
        return [(row, self.store.path.parent / frame) for row, frame in found if frame is not None]

    def _epoch(self, row: int) -> Epoch:
        number = int(self.columns.numbers[row])
        return next(self.store.epochs(self.series, number, number)).epoch

    def blocks(
        self, windows: Sequence[slice] | None = None
    ) -> Iterator[tuple[int, ObservationGrid]]:
        """Grids of consecutive epochs, each with its first epoch (from 0); only of windows."""
        numbers = self.columns.numbers
        for run in grid_runs(len(self), len(self.testfield), windows):
            wanted = numbers[run]
            found = self.store.observation_rows(self.series, int(wanted[0]), int(wanted[-1]))
            # an epoch that came while the series was read is not among them
            found = found.rows(np.isin(found.epochs, wanted))
            found = replace(found, epochs=np.searchsorted(numbers, found.epochs))
            yield run.start, found.grid(run.start, run.stop, len(self.testfield))
