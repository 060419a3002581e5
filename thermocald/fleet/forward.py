"""Forwarding of a station's store to a server, which receives every row of it.

    store (SQLite, read only) ─► batch after the cursor ─► server ─► cursor ─► next batch

Forwarding runs in a separate process and only reads the store, so that a slow, full or absent
server never delays a tick. A batch that fails is sent again, with growing pauses. A row whose
values the server refuses is found by halving the batch, noted and skipped. The cursor is a small
file beside the store, replaced as a whole. If it is lost, only time is lost, since the server skips
rows that it has already.

Frames are by far the largest data: a rule chooses among those that the daemon keeps, and a daily
limit applies. Retention deletes a frame at its age, whether it was sent or not.
"""

from __future__ import annotations

import json
import logging
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from pydantic import BaseModel, ConfigDict, Field

from thermocald.acquisition.frame_folder import is_chosen
from thermocald.config import ForwardConfig
from thermocald.errors import OutputError, ServerError, ServerGone, StoreError
from thermocald.files import reading, write_text
from thermocald.names import FileFolder
from thermocald.store.database.columns import KEPT
from thermocald.store.database.store import Store
from thermocald.store.server.reader import ServerWriter

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from thermocald.store.database.epochs import KeptFrame
    from thermocald.store.series import StoredSeries
    from thermocald.store.server.connection import ServerAddress

_COUNTED = (*KEPT, "frame")
_OF = {"server", "station", "identity", "inode"}


class Cursor(BaseModel):
    """The last id sent of each growing table, from one store to one server.

    server: its address without the password. identity, inode: of the store and its file, since
    another store of the same name, or a restored one, is sent from its start. sent: {table: id};
    `frame`: the last epoch whose frame was examined. refused: {table: ids} of rows that the server
    refuses, for a person to examine. day, frame_bytes: size of the frames sent on that day (UTC,
    days since 1970).
    """

    model_config = ConfigDict(strict=True, extra="forbid")

    server: str
    station: str
    identity: str
    inode: int
    sent: dict[str, int] = Field(default_factory=lambda: dict.fromkeys(_COUNTED, 0))
    refused: dict[str, list[int]] = Field(default_factory=dict)
    day: int = 0
    frame_bytes: int = 0

    @classmethod
    def read(cls, path: Path, store: Store, server: str, station: str) -> Self:
        """Read the cursor of an earlier run; a new one if there is none for this store and server.

        Raises StoreError if the store is missing.
        """
        with reading(store.path, StoreError):
            inode = store.path.stat().st_ino
        fresh = cls(server=server, station=station, identity=store.identity, inode=inode)
        try:
            old = cls.model_validate_json(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return fresh
        old.sent = {**fresh.sent, **old.sent}
        same = old.model_dump(include=_OF) == fresh.model_dump(include=_OF)
        return old if same and {*old.sent} == {*_COUNTED} else fresh

    @property
    def rows_refused(self) -> int:
        return sum(map(len, self.refused.values()))

    def write(self, path: Path) -> None:
        """Replace the file as a whole; raises OutputError if it cannot be written."""
        write_text(path, json.dumps(self.model_dump()))


log = logging.getLogger(__name__)

_FRAMES = 1000  # read from the store at a time
_DAY_S = 86400
_LARGEST = 64_000_000
"""Limit of a frame's size in bytes: above a raw image of 48 megapixels, and far below the size of a
row that PostgreSQL accepts."""


BATCH = 200
"""Rows per transaction: about 1 MB of epochs with 150 targets."""
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 2.0, 300.0
# more frequent connections of a thousand stations would keep a server busy
_IDLE_S = 30.0
_REPORT_S = 60.0


@dataclass(frozen=True, slots=True)
class Progress:
    """The numbers of rows and frames that a round sent, by table, and of those refused."""

    sent: Mapping[str, int]
    refused: int

    @property
    def rows(self) -> int:
        return sum(self.sent.values())


@dataclass(eq=False)
class Forwarder:
    """The sender of a station's store to a server.

    cursor: the cursor's file, by default beside the store; frames: the folder in which the daemon
    keeps them; rule: which frames are sent too, and how much per day.
    """

    store: Path
    address: ServerAddress
    station: str
    cursor: Path | None = None
    batch: int = BATCH
    frames: Path = Path()
    rule: ForwardConfig = field(default_factory=ForwardConfig)

    def __post_init__(self) -> None:
        self._path = self.cursor or self.store.with_name(f"{self.store.name}.forwarded")
        self._clock = time.time
        self._reported = -_REPORT_S
        self._waiting = 0  # rows, as last reported
        self._full_on = -1  # day for which the limit of frames was reported

    def send_waiting(self) -> Progress:
        """Send all waiting rows and frames, batch by batch.

        After an error, what was sent remains sent. Raises ServerGone (try again), ServerError,
        StoreError.
        """
        with Store.open(self.store) as store:
            cursor = Cursor.read(self._path, store, self.address.place, self.station)
            before = cursor.rows_refused
            count = dict.fromkeys(_COUNTED, 0)
            choose = self.rule.frames != "none"
            frames = choose and store.frames_after(cursor.sent["frame"], 1)
            report = self._report_is_due or self._waiting
            if report or frames or store.rows_waiting(cursor.sent):
                with ServerWriter(self.address, self.station, store.identity) as writer:
                    for table in KEPT:
                        count[table] = self._send_rows(store, writer, cursor, table)
                    if choose:
                        count["frame"] = self._send_frames(store, writer, cursor)
                    if self._waiting:
                        self._report(store, writer, cursor)
            return Progress(count, cursor.rows_refused - before)

    def _send_rows(self, store: Store, writer: ServerWriter, cursor: Cursor, table: str) -> int:
        """Send the waiting rows of a table; return how many the server accepted."""
        count, series = 0, {one.id: one for one in store.all_series()}
        while True:
            if self._report_is_due:  # between batches too, if many rows wait
                self._report(store, writer, cursor)
            rows = store.rows_after(table, cursor.sent[table], self.batch)
            if not rows:
                return count
            if any(row.get("series_id") not in {None, *series} for row in rows):
                series = {one.id: one for one in store.all_series()}
            bad = []
            for row in rows:
                if why := row.pop("damage"):
                    log.error("%s; it is not sent", why)
                    bad.append(int(row["id"]))
            last = rows[-1]["id"]
            rows = [row for row in rows if row["id"] not in bad]
            refused = self._send_batch(writer, table, rows, series) if rows else []
            cursor.sent[table] = last
            if bad or refused:
                cursor.refused.setdefault(table, []).extend([*bad, *refused])
            cursor.write(self._path)
            count += len(rows) - len(refused)

    def _send_batch(
        self,
        writer: ServerWriter,
        table: str,
        rows: list[dict[str, Any]],
        series: Mapping[int, StoredSeries],
    ) -> list[int]:
        """Send rows; return the ids of those whose values the server refuses."""
        try:
            writer.write(table, rows, series)
        except ServerError as error:
            if not error.about_values:
                raise
            if len(rows) == 1:
                log.error("%s %s is refused and skipped: %s", table, rows[0]["id"], error)
                return [int(rows[0]["id"])]
            half = len(rows) // 2
            return [
                *self._send_batch(writer, table, rows[:half], series),
                *self._send_batch(writer, table, rows[half:], series),
            ]
        return []

    def _send_frames(self, store: Store, writer: ServerWriter, cursor: Cursor) -> int:
        """Send the chosen waiting frames up to the day's limit; return how many were accepted.

        A frame that retention has deleted is skipped.
        """
        count, rule = 0, self.rule
        files = FileFolder(self.frames)
        series = {one.id: one for one in store.all_series()}
        while frames := store.frames_after(cursor.sent["frame"], _FRAMES):
            for frame in frames:
                wanted = is_chosen(rule.frames, rule.every_n, frame.number, frame.eventful)
                data = _read_frame(files, frame) if wanted else None
                if frame.series not in series or (
                    data is not None and not self._has_room(cursor, len(data))
                ):
                    cursor.write(self._path)
                    return count
                if data is not None:
                    try:
                        writer.write_frame(series[frame.series], frame, data)
                        count += 1
                    except ServerError as error:
                        if not error.about_values:
                            raise
                        log.error("frame %s is refused and skipped: %s", frame.path, error)
                        cursor.refused.setdefault("frame", []).append(frame.id)
                    cursor.frame_bytes += len(data)
                cursor.sent["frame"] = frame.id
                if data is not None:
                    cursor.write(self._path)
            cursor.write(self._path)
        return count

    def _has_room(self, cursor: Cursor, size: int) -> bool:
        day = int(self._clock() // _DAY_S)
        if day != cursor.day:
            cursor.day, cursor.frame_bytes = day, 0
        # one frame a day is sent whatever its size, else a low limit would stop all of them
        most = int(self.rule.frames_mb_per_day * 1e6)
        if not cursor.frame_bytes or cursor.frame_bytes + size <= most:
            return True
        if self._full_on != day:
            log.warning(
                "%d MB of frames were sent today; the others are sent from tomorrow on",
                cursor.frame_bytes // 10**6,
            )
            self._full_on = day
        return False

    @property
    def _report_is_due(self) -> bool:
        return time.monotonic() - self._reported >= _REPORT_S

    def _report(self, store: Store, writer: ServerWriter, cursor: Cursor) -> None:
        """Report this station's state to the server."""
        waiting = store.rows_waiting(cursor.sent)
        # if the answer is lost, the server may have this report or the last one
        self._waiting = max(self._waiting, waiting)
        writer.report(waiting, cursor.rows_refused, time.time())
        self._waiting = waiting
        self._reported = time.monotonic()


def _read_frame(files: FileFolder, frame: KeptFrame) -> bytes | None:
    path = None if frame.path is None else files.find(frame.path)
    try:
        if path is None:
            return None
        if path.stat().st_size > _LARGEST:
            log.warning("%s: is larger than %d MB; it is not sent", path, _LARGEST // 10**6)
            return None
        return path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        log.warning("%s: cannot be read: %s; it is not sent", path, error.strerror)
        return None


def forward_forever(forwarder: Forwarder, wait: Callable[[float], bool]) -> None:
    """Send waiting rows repeatedly until `wait(seconds)` returns True.

    An error that a person must mend is logged, and the next attempt follows the longest pause;
    nothing is lost, since the rows stay in the store.
    """
    pause, trouble = _FIRST_PAUSE_S, ""
    while True:
        try:
            progress = forwarder.send_waiting()
        except (ServerError, OutputError) as error:  # a cursor on a card that is read-only
            if str(error) != trouble:
                log.warning("%s; rows wait in the store", error)
            trouble = str(error)
            may_pass = isinstance(error, ServerGone)
            pause = min(2 * pause, _LONGEST_PAUSE_S) if may_pass else _LONGEST_PAUSE_S
            if wait(pause):
                return
            continue
        if trouble:
            log.info("rows are sent to %s again: %d", forwarder.address, progress.rows)
        pause, trouble = _FIRST_PAUSE_S, ""
        if wait(_IDLE_S):
            return
