"""Reading a server's store with the methods of `store.database.store.Store` that read."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES
from thermocald.store.database.blob import (
    unpack_covariance,
    unpack_observations,
    unpack_rows,
)
from thermocald.store.database.epoch_columns import sql_name
from thermocald.store.database.epoch_table import StoredEpoch, stored_epoch
from thermocald.store.database.row import Event, LoggedReading, StoredSeries
from thermocald.store.database.series_reader import StampedReader
from thermocald.store.recording.head import parse_head
from thermocald.store.recording.testfield_file import parse_testfield
from thermocald.store.server.address import ServerAddress
from thermocald.store.server.columns import read_columns
from thermocald.store.server.connection import Connected, in_words

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from uuid import UUID

    from numpy.typing import NDArray

    from thermocald.arrays import Array
    from thermocald.store.database.blob import ObservationRows

__all__ = ["ServerStore"]

_BLOCK = 500  # epochs fetched at a time by a server-side cursor
_LATEST = (
    "FROM epoch e WHERE series = %s AND NOT EXISTS (SELECT 1 FROM epoch later "
    "WHERE later.series = e.series AND later.number = e.number AND later.revision > e.revision "
    "AND later.revision > 0)"
)


class ServerStore(Connected, StampedReader):
    """An open store on a server, narrowed to what its address selects; use it in a `with` block."""

    _remedy = "; select with ?station=…&camera=…&series=… in the address"

    def __init__(self, address: ServerAddress) -> None:
        self.path = Path(str(address))
        self._keys: list[UUID] = []
        super().__init__(address)

    @classmethod
    def open(cls, source: Path | str) -> Self:
        """Open by address. Raises UsageError, ServerGone, ServerError, StoreVersionError."""
        return cls(ServerAddress.parse(source))

    def all_series(self) -> list[StoredSeries]:
        """All series that the address selects, in the order in which they were begun."""
        wanted = self.address
        rows = self._query(
            "SELECT s.key, station, head, csv, start, identity, settings, created_utc "
            "FROM series s JOIN testfield USING (digest) "
            "WHERE station = coalesce(%s, station) AND camera = coalesce(%s, camera) "
            "AND name = coalesce(%s, name) ORDER BY created_utc, s.key",
            (wanted.station, wanted.camera, wanted.series),
        )
        return [
            StoredSeries(
                self._number(key),
                parse_head(json.loads(head), self.path),
                parse_testfield(csv, self.path),
                start,
                {"station": station, **json.loads(identity)},
                json.loads(settings),
                created,
            )
            for key, station, head, csv, start, identity, settings, created in rows
        ]

    def last_epoch(self, series: StoredSeries) -> int | None:
        """The number of the last epoch, None if there is none."""
        key = self._keys[series.id]
        ((last,),) = self._query("SELECT max(number) FROM epoch WHERE series = %s", (key,))
        return None if last is None else int(last)

    def series_columns(self, series: StoredSeries, names: Sequence[str]) -> dict[str, NDArray[Any]]:
        """Columns (E,) over all epochs by name, as `Store.series_columns`."""
        reading = in_words(self.address, "columns cannot be read")
        with reading, self._engine.connect() as connection:
            raw: Any = connection.connection.driver_connection
            return read_columns(raw, self._keys[series.id], series, names)

    def covariances(self, series: StoredSeries, numbers: Sequence[int]) -> Array:
        """(E, 16, 16) covariances of some epochs, NaN for those without a result."""
        rows = self._query(
            f"SELECT number, covariance {_LATEST} AND number = ANY(%s)",
            (self._keys[series.id], [int(n) for n in numbers]),
        )
        found = {number: unpack_covariance(bytes(data)) for number, data in rows if data}
        missing = np.full((16, 16), np.nan)
        return np.array([found.get(int(n), missing) for n in numbers]).reshape(-1, 16, 16)

    def _epochs(
        self, series: StoredSeries, first: int, last: int | None, details: bool
    ) -> Iterator[StoredEpoch]:
        blobs = ["covariance", "observations"] if details else []
        fields = [*_EPOCH, *(f'"{sql_name(n)}"' for n in PARAMETER_NAMES), *blobs]
        statement = (
            f"SELECT {', '.join(fields)} FROM epoch WHERE series = %s AND number >= %s "
            "AND number <= coalesce(%s, number) ORDER BY number, revision"
        )
        values = (self._keys[series.id], first, last)
        latest: StoredEpoch | None = None
        for row in self._stream(statement, values):
            stored = _epoch(row, details)
            if latest is not None and latest.epoch.number == stored.epoch.number:
                # a later calibration of observations that stay the same does not hold them again
                if stored.epoch.observations is None:
                    seen = latest.epoch.observations
                    stored = replace(stored, epoch=replace(stored.epoch, observations=seen))
            elif latest is not None:
                yield latest
            latest = stored
        if latest is not None:
            yield latest

    def observation_rows(self, series: StoredSeries, first: int, last: int) -> ObservationRows:
        """The observations of the epochs numbered `first` to `last`, without their quality."""
        statement = (
            "SELECT number, observations FROM epoch WHERE series = %s AND number >= %s "
            "AND number <= %s AND observations IS NOT NULL ORDER BY number, revision"
        )
        rows = self._stream(statement, (self._keys[series.id], first, last))
        return unpack_rows({number: bytes(data) for number, data in rows if data})

    def events(self, series: StoredSeries | None = None, since_utc: float = 0.0) -> list[Event]:
        """What happened, oldest first; of one series, or of all that the address selects."""
        keys = [self._keys[s.id] for s in ([series] if series else self.all_series())]
        rows = self._query(
            "SELECT utc, kind, text, series, epoch, data FROM event "
            "WHERE utc >= %s AND series = ANY(%s) ORDER BY utc, id",
            (since_utc, keys),
        )
        return [
            Event(utc, kind, text, self._number(key), epoch, json.loads(data))
            for utc, kind, text, key, epoch, data in rows
        ]

    def clock_steps(self, series: StoredSeries) -> list[Event]:
        """The steps of the clock of the station that a series is of, oldest first."""
        rows = self._query(
            "SELECT utc, kind, text, data FROM event WHERE kind = 'clock_step' "
            "AND station = %s ORDER BY utc, id",
            (series.identity["station"],),
        )
        return [Event(utc, kind, text, data=json.loads(d)) for utc, kind, text, d in rows]

    def readings(
        self, thermometer: str | None = None, since_utc: float = 0.0
    ) -> Iterator[LoggedReading]:
        """Readings apart from epochs of the address's station, in the order they were kept."""
        for name, utc, trusted, values in self._stream(
            "SELECT thermometer, utc, clock_trusted, temperatures FROM reading WHERE utc >= %s "
            "AND thermometer = coalesce(%s, thermometer) AND station = coalesce(%s, station) "
            "ORDER BY station, id",
            (since_utc, thermometer, self.address.station),
        ):
            yield LoggedReading(name, utc, json.loads(values), trusted)

    def _label(self, series: StoredSeries) -> str:
        return f"{series.identity['station']}: {series.camera}/{series.name}"

    def _number(self, key: UUID) -> int:
        """The handle of a series in this process; `StoredSeries.id` is a number."""
        if key not in self._keys:
            self._keys.append(key)
        return self._keys.index(key)

    def _stream(self, statement: str, values: Sequence[Any]) -> Iterator[tuple[Any, ...]]:
        """Rows by a server-side cursor: a year of epochs in constant memory."""
        with in_words(self.address, "it cannot be read"), self._engine.connect() as connection:
            raw: Any = connection.connection.driver_connection
            with raw.cursor(name="thermocald") as cursor:
                cursor.itersize = _BLOCK
                cursor.execute(statement, values)
                yield from cursor


_EPOCH = (
    "number", "revision", "frame_time", "temperature_time", "clock_trusted", "status", "reason",
    "sigma0", "redundancy", "n_observations", "rejected", "temperatures", "extra", "frame", "note",
)  # fmt: skip


def _epoch(row: tuple[Any, ...], details: bool) -> StoredEpoch:
    names = (*_EPOCH, *PARAMETER_NAMES, *(("covariance", "observations") if details else ()))
    field = dict(zip(names, row, strict=True))
    covariance, seen = field.get("covariance"), field.get("observations")
    return stored_epoch(
        field,
        unpack_covariance(bytes(covariance)) if covariance else None,
        unpack_observations(bytes(seen)) if seen else None,
    )
