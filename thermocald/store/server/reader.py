"""Reading a server's store with the methods of `store.database.store.Store` that read.

A column comes as one value, which the server puts together and NumPy reads as it stands, so that
neither of them holds the series as rows.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self
from uuid import UUID

import numpy as np

from thermocald.store.database.epochs import (
    latest_epochs,
    unpack_covariance,
    unpack_rows,
)
from thermocald.store.recording.head import parse_head
from thermocald.store.recording.testfield_file import parse_testfield
from thermocald.store.schema import COLUMN_NAMES, EPOCH_NUMBERS, EPOCH_TEXTS, sql_name
from thermocald.store.series import Event, SeriesReader, StoredEpoch, StoredSeries
from thermocald.store.server.connection import Connected, ServerAddress

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray
    from psycopg.sql import Composable

    from thermocald.arrays import Array
    from thermocald.store.recording.observation_file import ObservationRows

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

    def stamped_columns(
        self, series: StoredSeries, names: Sequence[str]
    ) -> dict[str, NDArray[Any]]:
        """Columns (E,) over all epochs by name, with times as they were stamped."""
        from psycopg import sql

        wanted = {name: _expression(name, series) for name in ("epoch", "frame_time", *names)}
        # without parameters: the name of a channel may hold a %
        latest = sql.SQL(_LATEST.replace("%s", "{}")).format(sql.Literal(_key(series)))
        statement = sql.SQL("SELECT {} {}").format(sql.SQL(", ").join(wanted.values()), latest)
        with self._transaction("columns cannot be read") as connection:
            (found,) = connection.execute(statement, binary=True).fetchall()
        columns = {name: _column(value) for name, value in zip(wanted, found, strict=True)}
        if np.any(np.diff(columns["epoch"]) <= 0):
            order = np.lexsort((columns["frame_time"], columns["epoch"]))
            columns = {name: column[order] for name, column in columns.items()}
        return {name: columns[name] for name in names}

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
        names = [*EPOCH_NUMBERS, *EPOCH_TEXTS, *(["covariance", "observations"] if details else [])]
        quoted = ", ".join(f'"{name}"' for name in names)
        statement = (
            f"SELECT {quoted} FROM epoch WHERE series = %s AND number >= %s "
            "AND number <= coalesce(%s, number) ORDER BY number, revision"
        )
        rows = self._stream(statement, (_key(series), first, last))
        return latest_epochs(
            (dict(zip(names, values, strict=True)) for values in rows),
            _details if details else None,
        )

    def observation_rows(self, series: StoredSeries, first: int, last: int) -> ObservationRows:
        """The observations of the epochs numbered `first` to `last`, without their quality."""
        statement = (
            "SELECT number, observations FROM epoch WHERE series = %s AND number >= %s "
            "AND number <= %s AND observations IS NOT NULL ORDER BY number, revision"
        )
        rows = self._stream(statement, (_key(series), first, last))
        return unpack_rows({number: bytes(data) for number, data in rows if data})

    def clock_steps(self, series: StoredSeries) -> list[Event]:
        """The steps of the clock of the station that a series is of, oldest first."""
        rows = self._query(
            "SELECT utc, kind, text, data FROM event WHERE kind = 'clock_step' "
            "AND station = %s ORDER BY utc, id",
            (series.identity["station"],),
        )
        return [Event(utc, kind, text, data=json.loads(d)) for utc, kind, text, d in rows]

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


def _details(row: Mapping[str, Any]) -> tuple[bytes, bytes]:
    return bytes(row["covariance"] or b""), bytes(row["observations"] or b"")


def _key(series: StoredSeries) -> UUID:
    """Return a series' key at the server, which is its id in every process that reads it."""
    return UUID(int=series.id)


def _expression(name: str, series: StoredSeries) -> Composable:
    """All numbers of a column as one value, NaN for NULL; the words of `status`, a line each."""
    from psycopg import sql

    if name == "status":
        return sql.SQL("string_agg(status, chr(10))")
    if name == "epoch":
        number: Composable = sql.SQL("number")
    elif name == "clock_trusted":
        number = sql.SQL("clock_trusted::int")
    elif name in COLUMN_NAMES:
        number = sql.Identifier(sql_name(name))
    else:
        column = sql.Identifier("temperatures" if name in series.head.channels else "extra")
        number = sql.SQL("({}::json->>{})").format(column, sql.Literal(name))
    return sql.SQL("string_agg(float8send(coalesce({}::float8, 'NaN')), '')").format(number)


def _column(value: bytes | str | None) -> NDArray[Any]:
    """The column (E,) in a value of `_expression`; NULL is that of a series without epochs."""
    if isinstance(value, str):
        return np.array(value.split("\n"))
    return np.frombuffer(value or b"", ">f8").astype(np.float64)
