"""The content of a disk at an instant, with the writes replayed that had been flushed.

dm-log-writes logs a write once the flush after it is complete, so the writes before a mark are the
least that a disk contains if its power fails at that instant.
Source: Linux, Documentation/admin-guide/device-mapper/log-writes.rst, drivers/md/dm-log-writes.c.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Iterator
from pathlib import Path

MAGIC = 0x6A736677736872
SUPER, ENTRY = struct.Struct("<QQQI"), struct.Struct("<QQQQ")
DISCARD, MARK = 4, 8


def entries(log: Path) -> Iterator[tuple[int, bytes, str]]:
    """Yield (offset in bytes, data, mark) of each entry counted in the log's header."""
    with log.open("rb") as file:
        magic, version, count, size = SUPER.unpack(file.read(SUPER.size))
        if (magic, version) != (MAGIC, 1):
            return  # the log is still empty
        at = size
        for _ in range(count):
            file.seek(at)
            sector, sectors, flags, length = ENTRY.unpack(file.read(ENTRY.size))
            mark = file.read(length).decode() if flags & MARK else ""
            at += size
            data = b""
            if sectors and not flags & DISCARD:
                file.seek(at)
                data = file.read(sectors * size)
                at += sectors * size
            yield sector * size, data, mark


def wait_for_mark(log: Path, mark: str, timeout_s: float = 30.0) -> None:
    """Wait until a mark is in the log; the kernel writes it with a delay."""
    deadline = time.monotonic() + timeout_s
    while not any(found == mark for _, _, found in entries(log)):
        if time.monotonic() > deadline:
            raise RuntimeError(f"{log}: no mark {mark!r} in {timeout_s:g} s")
        time.sleep(0.2)


def replay(log: Path, disk: Path, mark: str) -> int:
    """Apply the writes before a mark to a disk image; return their number."""
    with disk.open("r+b") as file:
        for number, (offset, data, found) in enumerate(entries(log)):
            if found == mark:
                return number
            file.seek(offset)
            file.write(data)
    raise RuntimeError(f"{log}: there is no mark {mark!r}")
