"""Store and forward: a station's store stays the truth, and the server gets every row of it.

    store (SQLite, read only) ─► batch after the cursor ─► server ─► cursor ─► next batch

It runs in a process of its own and only reads the store, so that a slow, full or absent server
never delays a tick. A batch that fails is sent again, with growing pauses; a row that the server
refuses for what it holds is found by halving, noted and passed over.
"""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from thermocald.errors import ServerError, ServerGone, StoreVersionError
from thermocald.fleet.cursor import Cursor
from thermocald.fleet.frames import FrameSender
from thermocald.store.database.examination import KEPT
from thermocald.store.database.store import Store
from thermocald.store.server.writer import ServerWriter

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from thermocald.fleet.frames import FrameRule
    from thermocald.store.series import StoredSeries
    from thermocald.store.server.connection import ServerAddress


log = logging.getLogger(__name__)

BATCH = 200
"""Rows of a transaction: about 1 MB of epochs with 150 targets."""
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 2.0, 300.0
# a thousand stations that connect more often keep a server busy with that alone
_IDLE_S = 30.0
_REPORT_S = 60.0


@dataclass(frozen=True, slots=True)
class Progress:
    """What one round sent: rows by table and frames, and how many the server refused."""

    sent: Mapping[str, int]
    refused: int

    @property
    def rows(self) -> int:
        return sum(self.sent.values())


class Forwarder:
    """Sends one store to one server as one station.

    cursor: the file that holds how far; by default next to it. frames: which frames are sent
    too, None for none.
    """

    def __init__(
        self,
        store: Path,
        address: ServerAddress,
        station: str,
        cursor: Path | None = None,
        batch: int = BATCH,
        frames: FrameRule | None = None,
    ) -> None:
        self.store = store
        self.address = address
        self.station = station
        self.batch = batch
        self._path = cursor or store.with_name(f"{store.name}.forwarded")
        self._frames = FrameSender(frames) if frames is not None else None
        self._reported = -_REPORT_S
        self._waiting = 0  # as last reported

    def send_waiting(self, stop: Callable[[], bool] = lambda: False) -> Progress:
        """Send all that waits, batch by batch, until nothing waits or `stop()`.

        What was sent stays sent when it raises. Raises ServerGone (try again), ServerError,
        StoreError.
        """
        with Store.open(self.store) as store:
            cursor = Cursor.read(self._path, store, self.address.place, self.station)
            before = cursor.rows_refused
            count = {**dict.fromkeys(KEPT, 0), "frame": 0}
            if self._waits(store, cursor):
                with ServerWriter(self.address, self.station, store.identity) as writer:
                    self._send_all(store, writer, cursor, count, stop)
            return Progress(count, cursor.rows_refused - before)

    def _waits(self, store: Store, cursor: Cursor) -> bool:
        """Whether there is a reason to connect."""
        frames = self._frames is not None and store.frames_after(cursor.sent["frame"], 1)
        reported = not self._report_is_due and not self._waiting
        return not reported or bool(frames) or store.rows_waiting(cursor.sent) > 0

    def _send_all(
        self,
        store: Store,
        writer: ServerWriter,
        cursor: Cursor,
        count: dict[str, int],
        stop: Callable[[], bool],
    ) -> None:
        series = {one.id: one for one in store.all_series()}
        for table in KEPT:
            while not stop():
                if self._report_is_due:  # also while much waits
                    self._report(store, writer, cursor)
                rows = store.rows_after(table, cursor.sent[table], self.batch)
                if not rows:
                    break
                if any(r.get("series_id") not in {None, *series} for r in rows):
                    series = {one.id: one for one in store.all_series()}
                bad = self._send_sound(writer, table, rows, series)
                cursor.sent[table] = rows[-1]["id"]
                if bad:
                    cursor.refused.setdefault(table, []).extend(bad)
                cursor.write(self._path)
                count[table] += len(rows) - len(bad)
        if self._frames is not None:
            keep = partial(cursor.write, self._path)
            count["frame"] = self._frames.send(store, writer, series, cursor, keep, stop)
        if self._waiting:
            self._report(store, writer, cursor)

    def _send_sound(
        self,
        writer: ServerWriter,
        table: str,
        rows: list[dict[str, Any]],
        series: Mapping[int, StoredSeries],
    ) -> list[int]:
        """Send what is as it was written; the ids of rows that are damaged or refused."""
        damaged = []
        for row in rows:
            if why := row.pop("damage"):
                log.error("%s; it is not sent", why)
                damaged.append(int(row["id"]))
        sound = [row for row in rows if row["id"] not in damaged]
        return [*damaged, *(self._send(writer, table, sound, series) if sound else [])]

    @property
    def _report_is_due(self) -> bool:
        return time.monotonic() - self._reported >= _REPORT_S

    def _report(self, store: Store, writer: ServerWriter, cursor: Cursor) -> None:
        """Tell the server how this station is."""
        waiting = store.rows_waiting(cursor.sent)
        # where the answer is lost the server may have this report or the last one
        self._waiting = max(self._waiting, waiting)
        writer.report(waiting, cursor.rows_refused, time.time())
        self._waiting = waiting
        self._reported = time.monotonic()

    def _send(
        self,
        writer: ServerWriter,
        table: str,
        rows: list[dict[str, Any]],
        series: Mapping[int, StoredSeries],
    ) -> list[int]:
        """Send a batch; the ids of rows that the server refuses for what they hold."""
        try:
            writer.write(table, rows, series)
        except (ServerGone, StoreVersionError):
            raise
        except ServerError as error:
            if not error.about_values:
                raise
            if len(rows) == 1:
                log.error("%s %s is refused and passed over: %s", table, rows[0]["id"], error)
                return [int(rows[0]["id"])]
            half = len(rows) // 2
            return [
                *self._send(writer, table, rows[:half], series),
                *self._send(writer, table, rows[half:], series),
            ]
        return []


def forward_forever(
    forwarder: Forwarder,
    wait: Callable[[float], bool],
    report: Callable[[Progress | None, str], None] = lambda *_: None,
) -> None:
    """Send what waits, again and again, until `wait(seconds)` says that it should end.

    report(progress, trouble): after each round; trouble is empty where all was sent. An error
    that a person must mend is reported and tried again at the longest pause: nothing is lost
    meanwhile, the store keeps it.
    """
    pause, trouble = _FIRST_PAUSE_S, ""
    while True:
        try:
            progress = forwarder.send_waiting()
        except ServerError as error:
            if str(error) != trouble:
                log.warning("%s; rows wait in the store", error)
            trouble = str(error)
            report(None, trouble)
            pause = min(2 * pause, _LONGEST_PAUSE_S)
            if not isinstance(error, ServerGone):
                pause = _LONGEST_PAUSE_S
            if wait(pause):
                return
            continue
        if trouble:
            log.info("%s is reached again, %d rows sent", forwarder.address, progress.rows)
        pause, trouble = _FIRST_PAUSE_S, ""
        report(progress, "")
        if wait(_IDLE_S):
            return
