"""Which frames a station sends, and how many bytes of them a day.

Frames are far larger than all else: a rule chooses among those that the daemon keeps, and a daily
limit bounds them. The forwarder only reads: retention deletes a frame when its time has come,
whether it was sent or not.
"""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from thermocald.errors import ServerError, ServerGone
from thermocald.names import FileFolder

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from thermocald.fleet.cursor import Cursor
    from thermocald.store.database.examination import KeptFrame
    from thermocald.store.database.store import Store
    from thermocald.store.series import StoredSeries
    from thermocald.store.server.writer import ServerWriter


log = logging.getLogger(__name__)

_ROWS = 1000
_DAY_S = 86400
_LARGEST = 64_000_000
"""Bytes of a frame: a raw of 48 megapixels is below, and a row of PostgreSQL may be far larger."""


@dataclass(frozen=True, slots=True)
class FrameRule:
    """Which frames are sent.

    folder: where the daemon keeps them; choose: `events` (epochs without a result, or in which the
    camera moved), `every_n`, or `all` that are kept; daily_bytes: what is above waits for the next
    day.
    """

    folder: Path
    choose: Literal["events", "every_n", "all"] = "events"
    every_n: int = 360
    daily_bytes: int = 200_000_000

    def wants(self, frame: KeptFrame) -> bool:
        """Whether the frame of an epoch is one to send."""
        if frame.path is None or self.choose == "all":
            return frame.path is not None
        return frame.eventful if self.choose == "events" else frame.number % self.every_n == 0


class FrameSender:
    """Sends the chosen frames of a store, from where its cursor stands."""

    def __init__(self, rule: FrameRule, clock: Callable[[], float] = time.time) -> None:
        self.rule = rule
        self._clock = clock
        self._files = FileFolder(rule.folder)
        self._full_on = -1  # the day whose limit was reported

    def send(
        self,
        store: Store,
        writer: ServerWriter,
        series: Mapping[int, StoredSeries],
        cursor: Cursor,
        keep: Callable[[], None],
        stop: Callable[[], bool],
    ) -> int:
        """Send what waits; how many were sent. `keep` writes the cursor.

        A frame that retention has deleted is passed over. Raises ServerGone, ServerError.
        """
        count = 0
        while frames := store.frames_after(cursor.sent["frame"], _ROWS):
            for frame in frames:
                if frame.series not in series or stop():
                    keep()
                    return count
                data = self._read(frame) if self.rule.wants(frame) else None
                if data is not None:
                    if not self._room(cursor, len(data)):
                        keep()
                        return count
                    count += self._send(writer, series[frame.series], frame, data, cursor)
                    cursor.sent["frame"] = frame.id
                    keep()
                cursor.sent["frame"] = frame.id
            keep()
        return count

    def _read(self, frame: KeptFrame) -> bytes | None:
        assert frame.path is not None
        path = self._files.find(frame.path)
        try:
            if path is None:
                return None
            if path.stat().st_size > _LARGEST:
                log.warning("%s: has more than %d MB and is not sent", path, _LARGEST // 10**6)
                return None
            return path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            log.warning("%s: cannot be read and is not sent: %s", path, error.strerror)
            return None

    def _room(self, cursor: Cursor, size: int) -> bool:
        day = int(self._clock() // _DAY_S)
        if day != cursor.day:
            cursor.day, cursor.frame_bytes = day, 0
        # one frame a day goes through whatever its size, else nothing ever would
        if cursor.frame_bytes and cursor.frame_bytes + size > self.rule.daily_bytes:
            if self._full_on != day:
                log.warning(
                    "%d MB of frames were sent today; the others wait for tomorrow",
                    cursor.frame_bytes // 10**6,
                )
                self._full_on = day
            return False
        cursor.frame_bytes += size
        return True

    @staticmethod
    def _send(
        writer: ServerWriter, series: StoredSeries, frame: KeptFrame, data: bytes, cursor: Cursor
    ) -> bool:
        try:
            writer.write_frame(series, frame, data)
        except ServerGone:
            cursor.frame_bytes -= len(data)
            raise
        except ServerError as error:
            if not error.about_values:
                cursor.frame_bytes -= len(data)
                raise
            log.error("frame %s is refused and passed over: %s", frame.path, error)
            cursor.refused.setdefault("frame", []).append(frame.id)
            return False
        return True
