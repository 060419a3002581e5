"""Writing a station's rows to the server: batches, each whole or not at all, nothing twice.

Keys are made here and not there, from what never changes: the same row sent again is the same key
and is passed over. So a role that may only insert is enough, and sending again is always safe.
"""

from __future__ import annotations

import hashlib
import json
from typing import TYPE_CHECKING, Any
from uuid import UUID, uuid5

from thermocald import __version__
from thermocald.errors import StoreVersionError
from thermocald.store.database.epochs import series_row
from thermocald.store.server.connection import Connected

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from psycopg import Connection

    from thermocald.store.database.epochs import KeptFrame
    from thermocald.store.series import StoredSeries
    from thermocald.store.server.connection import ServerAddress

_DAY_S = 86400.0
_SANE = (946_684_800.0, 4_102_444_800.0)  # s UTC: 2000 to 2100
_NAMESPACE = UUID("c1b7b0de-6c1e-5f0e-9d0d-7468656d6f63")
# Columns of a store's row that the server does not keep: they have a meaning in that file alone.
_LOCAL = {"epoch": {"id", "series_id"}, "event": {"series_id"}, "reading": set[str]()}


def series_key(station: str, store: UUID, series: StoredSeries) -> UUID:
    """The key of a series at the server: station, store, camera, name, and when it was begun."""
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
        self._days: set[int] = set()
        # {table: {column: type}} there: one query, as every round of a station needs it
        self._tables: dict[str, dict[str, str]] = {}
        try:
            for table, column, kind in self._query(
                "SELECT table_name, column_name, udt_name FROM information_schema.columns "
                "WHERE table_schema = 'public' ORDER BY ordinal_position"
            ):
                self._tables.setdefault(table, {})[column] = kind
        except BaseException:
            self.close()
            raise

    def write(
        self, table: str, rows: Sequence[Mapping[str, Any]], series: Mapping[int, StoredSeries]
    ) -> None:
        """Insert rows of a store's table in one transaction; what is there already stays as it is.

        series: the store's series by their ids; those of the rows are inserted with them.
        """
        if not rows:
            return
        keys = {id_: series_key(self.station, self.store, one) for id_, one in series.items()}
        ready = [self._row(table, row, keys) for row in rows]
        needed = {row["series_id"] for row in rows if row.get("series_id") is not None}
        days: set[int] = set()
        if table == "epoch":
            times = (row["frame_time"] for row in rows)
            # there is no month for what a clock says that was not set
            days = {int(t // _DAY_S) for t in times if _SANE[0] <= t <= _SANE[1]} - self._days
        with self._transaction(f"{len(rows)} {table}s were not sent") as connection:
            for id_ in sorted(needed):
                if keys[id_] not in self._sent:
                    row, csv = series_row(series[id_])
                    self._insert(connection, "testfield", [{"digest": row["digest"], "csv": csv}])
                    whose = {"key": keys[id_], "station": self.station, "store": self.store}
                    self._insert(connection, "series", [whose | row])
            for day in sorted(days):  # partitions for their months, of at most 31 days
                connection.execute("SELECT thermocald_month(%s)", (day * _DAY_S,))
            self._insert(connection, table, ready)
        # only what was committed counts as done
        self._sent.update(keys[id_] for id_ in needed)
        self._days |= days

    def write_frame(self, series: StoredSeries, frame: KeptFrame, data: bytes) -> None:
        """Insert the file of one epoch's frame; the server checks it against its SHA-256."""
        row = {
            "series": series_key(self.station, self.store, series),
            "number": frame.number,
            "frame_time": frame.frame_time,
            "name": str(frame.path),
            "digest": hashlib.sha256(data).hexdigest(),
            "data": data,
        }
        with self._transaction(f"the frame of epoch {frame.number} was not sent") as connection:
            self._insert(connection, "frame", [row])

    def report(self, waiting: int, refused: int, clock: float) -> None:
        """Say how this station is: rows that wait, rows refused, its own clock (s, UTC)."""
        values = (self.station, self.store, clock, waiting, refused, __version__)
        with self._transaction("the station's state was not sent") as connection:
            connection.execute("SELECT thermocald_report(%s, %s, %s, %s, %s, %s)", values)

    def _row(self, table: str, row: Mapping[str, Any], keys: Mapping[int, UUID]) -> dict[str, Any]:
        columns = self._tables[table]
        ready: dict[str, Any] = {}
        if table == "epoch" or "series" in columns:
            ready["series"] = keys.get(row["series_id"]) if row["series_id"] is not None else None
        if "station" in columns:
            ready["station"] = self.station
        for name, value in row.items():
            if name in _LOCAL[table]:
                continue
            if name not in columns:
                raise StoreVersionError(
                    f"{self.address}: the store's {table}s have a column {name!r} that the server "
                    "does not know; run `thermocald server init` there with this program's version"
                )
            if name == "clock_trusted":
                value = bool(value)
            # PostgreSQL's text knows no NUL; a note may hold what a broken device sent
            ready[name] = value.replace("\0", "\ufffd") if isinstance(value, str) else value
        return ready

    def _insert(
        self, connection: Connection[Any], table: str, rows: Sequence[Mapping[str, Any]]
    ) -> None:
        """One statement for all rows, of which those that are there already are passed over."""
        kinds = self._tables[table]
        names = list(rows[0])
        columns = ", ".join(f'"{name}"' for name in names)
        arrays = ", ".join(f"%b::{kinds[name]}[]" for name in names)
        values = tuple([_as(kinds[name], row[name]) for row in rows] for name in names)
        connection.execute(
            f'INSERT INTO "{table}" ({columns}) SELECT * FROM unnest({arrays}) '
            # no conflict target: naming one would ask for the right to read
            "ON CONFLICT DO NOTHING",
            values,
        )


def _as(kind: str, value: Any) -> Any:
    """A value as the column's type: an array must hold one type alone."""
    of = {"float8": float, "int4": int, "int8": int}.get(kind)
    return value if value is None or of is None else of(value)
