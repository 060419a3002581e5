"""Reading a server's store with the methods of `store.database.store.Store` that read.

Columns come by binary COPY: every row of the copy is as long as every other, since a missing number
comes as NaN. NumPy reads blocks of rows as they stand, and neither the server nor this process
holds the series as rows.
"""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self
from uuid import UUID

import numpy as np

from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES
from thermocald.store.database.columns import COLUMN_NAMES, sql_name
from thermocald.store.database.epochs import (
    stored_epoch,
    unpack_covariance,
    unpack_observations,
    unpack_rows,
)
from thermocald.store.recording.head import parse_head
from thermocald.store.recording.testfield_file import parse_testfield
from thermocald.store.series import Event, LoggedReading, SeriesReader, StoredEpoch, StoredSeries
from thermocald.store.server.connection import Connected, ServerAddress

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray
    from psycopg import Connection
    from psycopg.sql import Composable, Composed

    from thermocald.arrays import Array
    from thermocald.store.series import ObservationRows

_HEADER, _TRAILER = 19, 2  # bytes before the first row, and of the message after the last
_BLOCK = 50_000  # rows that become arrays at a time
_ORDER = ("number", "frame_time", "revision")
_EPOCHS = 500  # epochs fetched at a time by a server-side cursor
_LATEST = (
    "FROM epoch e WHERE series = %s AND NOT EXISTS (SELECT 1 FROM epoch later "
    "WHERE later.series = e.series AND later.number = e.number AND later.revision > e.revision "
    "AND later.revision > 0)"
)


class ServerStore(Connected, SeriesReader):
    """An open store on a server, narrowed to what its address selects; use it in a `with` block."""

    _remedy = "; select with ?station=…&camera=…&series=… in the address"

    def __init__(self, address: ServerAddress) -> None:
        self.path = Path(str(address))
        super().__init__(address)

    @property
    def where(self) -> str:
        """The address without its password."""
        return str(self.address)

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
            "AND name = coalesce(%s, name) ORDER BY created_utc, station, camera, name, s.key",
            (wanted.station, wanted.camera, wanted.series),
        )
        return [
            StoredSeries(
                key.int,
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
        key = _key(series)
        ((last,),) = self._query("SELECT max(number) FROM epoch WHERE series = %s", (key,))
        return None if last is None else int(last)

    def stamped_columns(
        self, series: StoredSeries, names: Sequence[str]
    ) -> dict[str, NDArray[Any]]:
        """Columns (E,) over all epochs by name, with times as they were stamped."""
        with self._transaction("columns cannot be read") as connection:
            return _read_columns(connection, _key(series), series, names)

    def covariances(self, series: StoredSeries, numbers: Sequence[int]) -> Array:
        """(E, 16, 16) covariances of some epochs, NaN for those without a result."""
        rows = self._query(
            f"SELECT number, covariance {_LATEST} AND number = ANY(%s)",
            (_key(series), [int(n) for n in numbers]),
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
        values = (_key(series), first, last)
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
        rows = self._stream(statement, (_key(series), first, last))
        return unpack_rows({number: bytes(data) for number, data in rows if data})

    def events(self, series: StoredSeries | None = None, since_utc: float = 0.0) -> list[Event]:
        """What happened, oldest first; of one series, or of all that the address selects."""
        keys = [_key(s) for s in ([series] if series else self.all_series())]
        rows = self._query(
            "SELECT utc, kind, text, series, epoch, data FROM event "
            "WHERE utc >= %s AND series = ANY(%s) ORDER BY utc, id",
            (since_utc, keys),
        )
        return [
            Event(utc, kind, text, key.int, epoch, json.loads(data))
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

    def _stream(self, statement: str, values: Sequence[Any]) -> Iterator[tuple[Any, ...]]:
        """Rows by a server-side cursor: a year of epochs in constant memory."""
        with (
            self._transaction("it cannot be read") as connection,
            connection.cursor(name="thermocald") as cursor,
        ):
            cursor.itersize = _EPOCHS
            cursor.execute(statement, values)
            yield from cursor


_EPOCH = (
    "number", "revision", "frame_time", "temperature_time", "clock_trusted", "status", "reason",
    "sigma0", "redundancy", "n_observations", "rejected", "temperatures", "extra", "frame", "note",
)  # fmt: skip


def _key(series: StoredSeries) -> UUID:
    """Return a series' key at the server, which is its id in every process that reads it."""
    return UUID(int=series.id)


def _epoch(row: tuple[Any, ...], details: bool) -> StoredEpoch:
    names = (*_EPOCH, *PARAMETER_NAMES, *(("covariance", "observations") if details else ()))
    field = dict(zip(names, row, strict=True))
    covariance, seen = field.get("covariance"), field.get("observations")
    return stored_epoch(
        field,
        unpack_covariance(bytes(covariance)) if covariance else None,
        unpack_observations(bytes(seen)) if seen else None,
    )


def _read_columns(
    connection: Connection[Any], key: UUID, series: StoredSeries, names: Sequence[str]
) -> dict[str, NDArray[Any]]:
    """Columns (E,) over all epochs of a series by name, each epoch as it was calibrated last.

    connection: within a transaction; key: of the series at the server. Numbers are float64, NaN
    where an epoch has none; `status` is text.
    """
    from psycopg import sql

    words: list[str] = []
    if "status" in names:
        # a station that forwards now must not add a word between the two statements
        connection.execute("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ")
        found = connection.execute("SELECT DISTINCT status FROM epoch WHERE series = %s", (key,))
        words = sorted(word for (word,) in found)
    wanted = {name: _expression(name, series, words) for name in names}
    wanted |= {f" {name}": sql.SQL("{}::float8").format(sql.Identifier(name)) for name in _ORDER}
    statement = sql.SQL("COPY (SELECT {} FROM epoch WHERE series = {}) TO STDOUT (FORMAT BINARY)")
    values = sql.SQL(", ").join(wanted.values())
    copied = _copy(connection, statement.format(values, sql.Literal(key)), len(wanted))
    columns: dict[str, NDArray[Any]] = dict(zip(wanted, copied, strict=True))
    rows = _latest(*(columns.pop(f" {name}") for name in _ORDER))
    if rows is not None:
        columns = {name: column[rows] for name, column in columns.items()}
    if "status" in columns:
        columns["status"] = np.array(words, dtype=np.str_)[columns["status"].astype(np.int64) - 1]
    return columns


def _copy(connection: Connection[Any], statement: Composed, size: int) -> list[Array]:
    """The columns (E,) of a copy of `size` numbers a row."""
    fields = [("columns", ">i2")]
    for i in range(size):
        fields += [(f"length{i}", ">i4"), (f"value{i}", ">f8")]
    row = np.dtype(fields)
    blocks: list[list[Array]] = [[np.empty(0)] for _ in range(size)]
    with connection.cursor() as cursor, cursor.copy(statement) as copy:
        for messages in _messages(copy):
            found = np.frombuffer(messages, row)
            for i, column in enumerate(blocks):
                column.append(found[f"value{i}"].astype(np.float64))
    return [np.concatenate(column) for column in blocks]


def _messages(copy: Any) -> Iterator[bytes]:
    """The rows of a copy, many at a time, without its header and trailer."""
    start = _HEADER
    messages = iter(copy)
    while block := list(islice(messages, _BLOCK)):
        yield b"".join(m for m in block if len(m) != _TRAILER)[start:]
        start = 0


def _latest(numbers: Array, times: Array, revisions: Array) -> NDArray[np.intp] | None:
    """The rows of the last revisions, ordered by number and time; None where all are, in order."""
    steps = np.diff(numbers)
    if np.all(steps > 0):
        return None
    order: NDArray[np.intp] = np.lexsort((times, numbers))
    if not revisions.any():
        return order
    _, first, counts = np.unique(numbers[order], return_index=True, return_counts=True)
    highest = np.repeat(np.maximum.reduceat(revisions[order], first), counts)
    latest: NDArray[np.intp] = order[revisions[order] == highest]
    return latest


def _expression(name: str, series: StoredSeries, words: Sequence[str]) -> Composable:
    """A column as double precision, NaN for NULL; `status` as its place in `words`, from 1."""
    from psycopg import sql

    if name == "status":
        listed = sql.SQL(", ").join(map(sql.Literal, words))
        return sql.SQL("array_position(ARRAY[{}]::text[], status)::float8").format(listed)
    if name == "epoch":
        return sql.SQL("number::float8")
    if name == "clock_trusted":
        return sql.SQL("clock_trusted::int::float8")
    if name in COLUMN_NAMES:
        return sql.SQL("coalesce({}::float8, 'NaN')").format(sql.Identifier(sql_name(name)))
    column = "temperatures" if name in series.head.channels else "extra"
    return sql.SQL("coalesce(({}::json->>{})::float8, 'NaN')").format(
        sql.Identifier(column), sql.Literal(name)
    )
