"""The series of stations on a server: written in batches, read with the methods of `Store`.

A batch is inserted as a whole or not at all, and no row twice. The client makes the keys from what
never changes, so a row sent again has the same key and is skipped. A role that may only insert is
enough, and sending again is always safe.

A column is read as one value, which the server concatenates and NumPy reads directly, so neither of
them holds the series as rows.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self
from uuid import UUID, uuid5

import numpy as np

from thermocald import __version__
from thermocald.store.database.epochs import (
    latest_epochs,
    parse_series,
    series_row,
    unpack_covariance,
)
from thermocald.store.schema import COLUMN_NAMES, EPOCH_NUMBERS, EPOCH_TEXTS, sql_name
from thermocald.store.series import Event, SeriesReader, StoredEpoch, StoredSeries
from thermocald.store.server.connection import Connected, ServerAddress

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray
    from psycopg import Connection
    from psycopg.sql import Composable

    from thermocald.arrays import Array
    from thermocald.store.database.epochs import KeptFrame


_EPOCHS = 500  # epochs fetched at a time by a server-side cursor
_LATEST = (
    "FROM epoch e WHERE series = %s AND NOT EXISTS (SELECT 1 FROM epoch later "
    "WHERE later.series = e.series AND later.number = e.number AND later.revision > e.revision "
    "AND later.revision > 0)"
)


class ServerStore(Connected, SeriesReader):
    """An open store on a server: the series that its address selects; use it in a `with` block."""

    _remedy = "; select with ?station=…&camera=…&series=… in the address"

    def __init__(self, address: ServerAddress) -> None:
        self.path = Path(str(address))
        super().__init__(address)

    @property
    def where(self) -> str:
        return str(self.address)

    @classmethod
    def open(cls, source: Path | str) -> Self:
        """Open an address. Raises UsageError, ServerGone, ServerError, StoreVersionError."""
        return cls(ServerAddress.parse(source))

    def all_series(self) -> list[StoredSeries]:
        """Return all series that the address selects, in the order in which they were begun."""
        wanted = self.address
        rows = self._query(
            "SELECT station, s.key, head, csv, start, identity, settings, created_utc "
            "FROM series s JOIN testfield USING (digest) "
            "WHERE station = coalesce(%s, station) AND camera = coalesce(%s, camera) "
            "AND name = coalesce(%s, name) ORDER BY created_utc, station, camera, name, s.key",
            (wanted.station, wanted.camera, wanted.series),
        )
        every = [(station, parse_series(self.where, key.int, *row)) for station, key, *row in rows]
        return [replace(s, identity={"station": station, **s.identity}) for station, s in every]

    def stamped_columns(
        self, series: StoredSeries, names: Sequence[str]
    ) -> dict[str, NDArray[Any]]:
        from psycopg import sql

        wanted = {name: _expression(name, series) for name in ("epoch", "frame_time", *names)}
        # no placeholders, as the name of a channel may hold a %
        latest = sql.SQL(_LATEST.replace("%s", "{}")).format(sql.Literal(_key(series)))
        statement = sql.SQL("SELECT {} {}").format(sql.SQL(", ").join(wanted.values()), latest)
        with self._transaction("columns cannot be read") as connection:
            (found,) = connection.execute(statement, binary=True).fetchall()
        columns = {
            name: np.array(value.split("\n")) if isinstance(value, str)
            else np.frombuffer(value or b"", ">f8").astype(np.float64)  # NULL without epochs
            for name, value in zip(wanted, found, strict=True)
        }  # fmt: skip
        if np.any(np.diff(columns["epoch"]) <= 0):
            order = np.lexsort((columns["frame_time"], columns["epoch"]))
            columns = {name: column[order] for name, column in columns.items()}
        return {name: columns[name] for name in names}

    def covariances(self, series: StoredSeries, numbers: Sequence[int]) -> Array:
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
        with (  # a server-side cursor: constant memory
            self._transaction("it cannot be read") as connection,
            connection.cursor(name="thermocald") as cursor,
        ):
            cursor.itersize = _EPOCHS
            cursor.execute(statement, (_key(series), first, last))
            rows = (dict(zip(names, values, strict=True)) for values in cursor)
            yield from latest_epochs(
                rows, itemgetter("covariance", "observations") if details else None
            )

    def clock_steps(self, series: StoredSeries) -> list[Event]:
        """Return the clock steps of the series' station, oldest first."""
        rows = self._query(
            "SELECT utc, kind, text, data FROM event WHERE kind = 'clock_step' "
            "AND station = %s ORDER BY utc, id",
            (series.identity["station"],),
        )
        return [Event(utc, kind, text, data=json.loads(d)) for utc, kind, text, d in rows]

    def _label(self, series: StoredSeries) -> str:
        return f"{series.identity['station']}: {series.camera}/{series.name}"


def _key(series: StoredSeries) -> UUID:
    """Return a series' key on the server, which is its id in every process that reads it."""
    return UUID(int=series.id)


def _expression(name: str, series: StoredSeries) -> Composable:
    """Return the SQL of a column as one value: its numbers, NaN for NULL, or lines of `status`."""
    from psycopg import sql

    if name == "status":
        return sql.SQL("string_agg(status, chr(10))")
    if name == "clock_trusted":
        number: Composable = sql.SQL("clock_trusted::int")
    elif name in COLUMN_NAMES:
        number = sql.Identifier(sql_name(name))
    else:
        column = sql.Identifier("temperatures" if name in series.head.channels else "extra")
        number = sql.SQL("({}::json->>{})").format(column, sql.Literal(name))
    return sql.SQL("string_agg(float8send(coalesce({}::float8, 'NaN')), '')").format(number)


_DAY_S = 86400.0
_PLAUSIBLE = (946_684_800.0, 4_102_444_800.0)  # s UTC: 2000 to 2100
_NAMESPACE = UUID("c1b7b0de-6c1e-5f0e-9d0d-7468656d6f63")
# Columns of a store's row that the server does not store: their values are only valid in the file.
_LOCAL = {"epoch": {"id", "series_id"}, "event": {"series_id"}, "reading": set[str]()}


def series_key(station: str, store: UUID, series: StoredSeries) -> UUID:
    """Return the key of a series on the server: station, store, camera, name, its beginning."""
    text = json.dumps([station, str(store), series.camera, series.name, series.created_utc])
    return uuid5(_NAMESPACE, text)


class ServerWriter(Connected):
    """An open connection that inserts for one station; use it in a `with` block.

    Raises ServerGone (try again later), ServerError, StoreVersionError.
    """

    def __init__(self, address: ServerAddress, station: str, store: str) -> None:
        super().__init__(address)
        self.station = station
        self.store = UUID(store)
        self._sent: set[UUID] = set()

    def write(
        self, table: str, rows: Sequence[Mapping[str, Any]], series: Mapping[int, StoredSeries]
    ) -> None:
        """Insert rows of a store's table in one transaction; existing rows stay unchanged.

        series: the store's series by their ids; those of the rows are inserted too.
        """
        if not rows:
            return
        keys = {id_: series_key(self.station, self.store, one) for id_, one in series.items()}
        ready = [self._row(table, row, keys) for row in rows]
        needed = {row["series_id"] for row in rows if row.get("series_id") is not None}
        times = (row["frame_time"] for row in rows if table == "epoch")
        # a clock that was not set gives a time without a month's table
        days = {t // _DAY_S for t in times if _PLAUSIBLE[0] <= t <= _PLAUSIBLE[1]}
        with self._transaction(f"{len(rows)} {table}s were not sent") as connection:
            for id_ in sorted(needed):
                if keys[id_] not in self._sent:
                    row, csv = series_row(series[id_])
                    self._insert(connection, "testfield", [{"digest": row["digest"], "csv": csv}])
                    owner = {"key": keys[id_], "station": self.station, "store": self.store}
                    self._insert(connection, "series", [owner | row])
            for day in sorted(days):  # creates the months' partitions
                connection.execute("SELECT thermocald_month(%s)", (day * _DAY_S,))
            self._insert(connection, table, ready)
        # only what was committed counts as done
        self._sent.update(keys[id_] for id_ in needed)

    def write_frame(self, series: StoredSeries, frame: KeptFrame, data: bytes) -> None:
        """Insert the file of one epoch's frame; the server checks its SHA-256."""
        row = {
            "series": series_key(self.station, self.store, series), "number": frame.number,
            "frame_time": frame.frame_time, "name": str(frame.path),
            "digest": hashlib.sha256(data).hexdigest(), "data": data,
        }  # fmt: skip
        with self._transaction(f"the frame of epoch {frame.number} was not sent") as connection:
            self._insert(connection, "frame", [row])

    def report(self, waiting: int, refused: int, clock: float) -> None:
        """Report the station's state: numbers of waiting and refused rows, its clock (s UTC)."""
        values = (self.station, self.store, clock, waiting, refused, __version__)
        with self._transaction("the station's state was not sent") as connection:
            connection.execute("SELECT thermocald_report(%s, %s, %s, %s, %s, %s)", values)

    def _row(self, table: str, row: Mapping[str, Any], keys: Mapping[int, UUID]) -> dict[str, Any]:
        ready: dict[str, Any] = {}
        if "series_id" in row:
            ready["series"] = keys.get(row["series_id"]) if row["series_id"] is not None else None
        if table != "epoch":
            ready["station"] = self.station
        for name, value in row.items():
            if name in _LOCAL[table]:
                continue
            if name == "clock_trusted":
                value = bool(value)
            # PostgreSQL's text cannot hold NUL, which a broken device may send in a note
            ready[name] = value.replace("\0", "\ufffd") if isinstance(value, str) else value
        return ready

    def _insert(
        self, connection: Connection[Any], table: str, rows: Sequence[Mapping[str, Any]]
    ) -> None:
        """Insert rows by one statement, which skips those that exist."""
        from psycopg import RawCursor

        columns = ", ".join(f'"{name}"' for name in rows[0])
        places = map("${}".format, range(1, len(rows) * len(rows[0]) + 1))
        lines = (", ".join(line) for line in zip(*[places] * len(rows[0]), strict=True))
        RawCursor(connection).execute(
            # naming a conflict target would need permission to read
            f'INSERT INTO "{table}" ({columns}) VALUES ({"), (".join(lines)}) '
            "ON CONFLICT DO NOTHING",
            [value for row in rows for value in row.values()],
        )
