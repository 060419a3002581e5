"""Where analyses read series from: a store in a file, or one on a server; both answer alike.

Analyses read times that are corrected where the clock was wrong; the store has them as stamped.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import StoreError
from thermocald.store.database.series_reader import SeriesReader
from thermocald.store.database.times import SeriesTimes, series_times
from thermocald.store.server.address import ServerAddress, is_server

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.store.database.blob import ObservationRows
    from thermocald.store.database.epoch_table import StoredEpoch
    from thermocald.store.database.row import StoredSeries
    from thermocald.store.database.series_reader import StampedReader

    Array = NDArray[Any]

__all__ = [
    "CorrectedSource",
    "is_store",
    "open_source",
    "require_source",
    "source_name",
]

_SQLITE = b"SQLite format 3\0"


class CorrectedSource(SeriesReader):
    """An open store whose times are corrected, `database.times`; else as it is."""

    def __init__(self, stamped: StampedReader) -> None:
        self.path = stamped.path
        self._stamped = stamped
        self._times: dict[int, SeriesTimes | None] = {}

    def close(self) -> None:
        """Close the store."""
        self._stamped.close()

    def all_series(self) -> list[StoredSeries]:
        """As the store's."""
        return self._stamped.all_series()

    def find_series(self, camera: str | None = None, name: str | None = None) -> StoredSeries:
        """As the store's."""
        return self._stamped.find_series(camera, name)

    def covariances(self, series: StoredSeries, numbers: Sequence[int]) -> Array:
        """As the store's."""
        return self._stamped.covariances(series, numbers)

    def observation_rows(self, series: StoredSeries, first: int, last: int) -> ObservationRows:
        """As the store's."""
        return self._stamped.observation_rows(series, first, last)

    def series_columns(self, series: StoredSeries, names: Sequence[str]) -> dict[str, Array]:
        """As the store's, with corrected times."""
        columns = self._stamped.series_columns(series, names)
        timed = {"frame_time", "temperature_time"} & set(names)
        if timed and (times := self._corrected(series)) is not None:
            corrected = {"frame_time": times.frame, "temperature_time": times.reading}
            columns |= {name: corrected[name] for name in timed}
        return columns

    def _epochs(
        self, series: StoredSeries, first: int, last: int | None, details: bool
    ) -> Iterator[StoredEpoch]:
        times = self._corrected(series)
        for stored in self._stamped.epochs(series, first, last, details=details):
            if times is None:
                yield stored
                continue
            frame_time, temperature_time = times.of(stored.epoch.number)
            epoch = replace(stored.epoch, frame_time=frame_time, temperature_time=temperature_time)
            yield replace(stored, epoch=epoch)

    def _corrected(self, series: StoredSeries) -> SeriesTimes | None:
        """The times of a series; None where they are as they were stamped."""
        if series.id not in self._times:
            times = series_times(self._stamped, series)
            self._times[series.id] = times if np.any(times.corrections) else None
        return self._times[series.id]


def open_source(source: Path) -> SeriesReader:
    """Open a store for reading: a file, or `postgresql://…?camera=…&series=…`.

    Raises StoreError, for a server also UsageError, ServerGone, ServerError.
    """
    if is_server(source):
        from thermocald.store.server.reader import ServerStore

        return CorrectedSource(ServerStore.open(source))
    from thermocald.store.database.store import Store

    return CorrectedSource(Store.open(source))


def is_store(source: Path) -> bool:
    """Whether a source is a store: a server's address, or a file that SQLite wrote."""
    if is_server(source):
        return True
    try:
        with source.open("rb") as file:
            return file.read(len(_SQLITE)) == _SQLITE
    except OSError:
        return False


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
