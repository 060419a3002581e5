"""Each epoch's result as one line of JSON, into a file or a named pipe.

    outputs:
      - {name: log, driver: jsonl, path: /var/lib/thermocald/results.jsonl}
      - {name: feed, driver: jsonl, path: /run/thermocald/results.fifo, timeout_s: 1}

A line is written completely or not at all: if the disk fills up within a line, the incomplete line
is removed. A file that was moved away (logrotate) is created again. A pipe without a reader is an
error; it is not waited for. NaN and infinities become null, since JSON has neither.
"""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import select
import stat
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.errors import DeviceGone, DeviceTimeout, TransientDeviceError
from thermocald.hal import Output
from thermocald_drivers import support

if TYPE_CHECKING:
    from collections.abc import Mapping

    from thermocald.hal import Clock

__all__ = ["JsonLinesOutput", "encode"]


def encode(result: Mapping[str, Any]) -> bytes:
    """One result as JSON; numpy scalars as numbers, NaN and infinities as null."""
    return json.dumps({key: _plain(value) for key, value in result.items()}).encode()


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return value if isinstance(value, str | int | bool | None) else str(value)


class JsonLinesOutput(Output):
    """Appends to a file, or writes into a pipe."""

    def __init__(self, *, clock: Clock, path: str, timeout_s: float = 1.0) -> None:
        self.clock = clock
        self.path = Path(support.text("path", path))
        self.timeout_s = support.number("timeout_s", timeout_s, 0.01, 60, "s")
        self._file = -1
        self._seen = False

    def open(self) -> None:
        self.close()
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC
        try:
            self._file = os.open(self.path, flags, 0o644)
        except OSError as error:
            if error.errno == errno.ENXIO:
                raise DeviceGone(f"{self.path}: nobody reads the pipe") from error
            raise support.fault(error, str(self.path), seen=self._seen) from error
        self._pipe = stat.S_ISFIFO(os.fstat(self._file).st_mode)
        self._seen = True

    def close(self) -> None:
        file, self._file = self._file, -1
        if file >= 0:
            os.close(file)

    def emit(self, result: Mapping[str, Any]) -> None:
        if self._file < 0:
            raise DeviceGone(f"{self.path}: not open")
        line = encode(result) + b"\n"
        try:
            self._reopen_if_moved()
            self._write(line)
        except BrokenPipeError as error:
            raise DeviceGone(f"{self.path}: nobody reads the pipe any more") from error
        except OSError as error:
            if isinstance(error, TransientDeviceError):
                raise
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise TransientDeviceError(
                    f"{self.path}: the disk is full; line not written"
                ) from error
            raise support.fault(error, str(self.path), seen=True) from error

    def _reopen_if_moved(self) -> None:
        try:
            here = self.path.stat()
        except FileNotFoundError:
            here = None
        mine = os.fstat(self._file)
        if here is None or (here.st_ino, here.st_dev) != (mine.st_ino, mine.st_dev):
            self.open()

    def _write(self, line: bytes) -> None:
        """Write the whole line; on failure remove what was written of it."""
        start = os.fstat(self._file).st_size
        deadline = time.monotonic() + self.timeout_s
        written = 0
        try:
            while written < len(line):
                try:
                    written += os.write(self._file, line[written:])
                except BlockingIOError:
                    left = deadline - time.monotonic()
                    if left <= 0 or not select.select([], [self._file], [], left)[1]:
                        raise DeviceTimeout(f"{self.path}: the pipe's reader is too slow") from None
        except OSError:
            if written and not self._pipe:
                with contextlib.suppress(OSError):
                    os.ftruncate(self._file, start)
            raise
