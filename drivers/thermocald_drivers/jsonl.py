"""An output that writes each epoch's result as one line of JSON to a file or a named pipe.

    outputs:
      - {name: log, driver: jsonl, path: /var/lib/thermocald/results.jsonl}
      - {name: feed, driver: jsonl, path: /run/thermocald/results.fifo, timeout_s: 1}

A line is written completely or not at all: if the disk fills up or the daemon is killed within a
line, the incomplete line is removed. A file that was moved away (logrotate) is created again. A
pipe without a reader is an error; the output does not wait for one. A reader that is slower than
`timeout_s` is an error, too. JSON has no NaN or infinity: both become null.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import select
import stat
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from thermocald.errors import DeviceGone, DeviceTimeout, TransientDeviceError
from thermocald.files import is_unmounted, mount_point
from thermocald.hal import DriverOptions, Output
from thermocald.result import jsonable
from thermocald_drivers import support

if TYPE_CHECKING:
    from collections.abc import Mapping


_LONGEST_LINE = 1_000_000


def encode(result: Mapping[str, Any]) -> bytes:
    """Encode a result as JSON: numpy scalars as numbers, NaN and infinities as null."""
    return json.dumps(jsonable(dict(result)), default=str).encode()


class JsonLinesOutput(Output):
    """An output that appends to a file or writes to a pipe."""

    class Options(DriverOptions):
        path: support.Text
        timeout_s: Annotated[float, Field(ge=0.01, le=60.0)] = 1.0

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.path = Path(self.options.path)
        self.where = self.options.path
        self._mount = mount_point(self.path)

    def open(self) -> None:
        self.close()
        if is_unmounted(self.path, self._mount):
            raise DeviceGone(f"{self.path}: {self._mount} is no longer mounted")
        self._mount = mount_point(self.path)
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC
        try:
            self.handle = os.fdopen(os.open(self.path, flags, 0o644), "wb", buffering=0)
        except OSError as error:
            if error.errno == errno.ENXIO:
                raise DeviceGone(f"{self.path}: no program reads the pipe") from error
            raise support.fault(error, self.where, seen=self.seen, hint="check the path") from error
        mode = os.fstat(self.handle.fileno()).st_mode
        self._pipe = stat.S_ISFIFO(mode)
        if stat.S_ISREG(mode):
            if not mode & 0o600:  # under a umask of 777
                os.fchmod(self.handle.fileno(), 0o600)
            self._end_half_line()
        self.seen = True

    def emit(self, result: Mapping[str, Any]) -> None:
        self.opened()
        line = encode(result) + b"\n"
        try:
            mine, here = os.fstat(self.handle.fileno()), None
            with contextlib.suppress(FileNotFoundError):
                here = self.path.stat()
            if here is None or not os.path.samestat(here, mine):  # moved, or deleted
                self.open()
            self._write(line)
        except BrokenPipeError as error:
            raise DeviceGone(f"{self.path}: no program reads the pipe any longer") from error
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                full = f"{self.path}: the disk is full; the line was not written"
                raise TransientDeviceError(full) from error
            raise support.fault(error, str(self.path), seen=True) from error

    def _end_half_line(self) -> None:
        """Remove the partial line that a killed process or a power cut left at the end."""
        file_number = self.handle.fileno()
        size = os.fstat(file_number).st_size
        with contextlib.suppress(OSError), self.path.open("rb") as file:
            file.seek(max(0, size - _LONGEST_LINE))
            half = file.read().rpartition(b"\n")[2]
            try:
                json.loads(half or b"0")
                ours = False  # complete, so not written by this driver
            except ValueError:
                ours = half.strip(b"\0")[:1] in (b"", b"{")  # unwritten bytes may read as 0
            if ours and len(half) < _LONGEST_LINE:
                os.ftruncate(file_number, size - len(half))
            elif half:
                os.write(file_number, b"\n")

    def _write(self, line: bytes) -> None:
        """Write the whole line; on failure, remove the part that was written."""
        file_number = self.handle.fileno()
        start = os.fstat(file_number).st_size
        deadline = time.monotonic() + self.options.timeout_s
        written = 0
        try:
            while written < len(line):
                try:
                    written += os.write(file_number, line[written:])
                except BlockingIOError:
                    left = deadline - time.monotonic()
                    if left <= 0 or not select.select([], [file_number], [], left)[1]:
                        raise DeviceTimeout(f"{self.path}: the pipe's reader is too slow") from None
        except OSError:
            if written and not self._pipe:
                with contextlib.suppress(OSError):
                    os.ftruncate(file_number, start)
            raise
