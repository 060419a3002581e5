"""A look at a -wal file: whether transactions that were committed to it cannot be read any more.

SQLite reads the frames of the file up to the first whose checksum does not match, and takes what
follows for what a crash cut off. Where whole transactions of the same run follow, it is damage.
Format: https://www.sqlite.org/fileformat2.html#the_write_ahead_log
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["lost_commits"]

_HEADER = struct.Struct(">8I")  # magic, version, page size, sequence, two salts, two checksums
_FRAME = struct.Struct(">6I")  # page, size of the database after a commit, two salts, checksums
_MAGIC = 0x377F0682


def lost_commits(path: Path) -> int:
    """How many transactions follow the first damaged frame of a -wal file; 0 if there is none.

    -1 where the file's own header is damaged: all of it is lost. Nobody must write the file.
    """
    try:
        data = path.read_bytes()
    except OSError:
        return 0
    if len(data) < _HEADER.size:
        return 0
    magic, _, page_size, _, *salts, first, second = _HEADER.unpack_from(data)
    order = ">" if magic & 1 else "<"
    sums = _checksum(order, data[:24], (0, 0))
    if magic & ~1 != _MAGIC or sums != (first, second):
        return -1
    broken, lost = False, 0
    step = _FRAME.size + page_size
    for at in range(_HEADER.size, len(data) - step + 1, step):
        _, commit, salt1, salt2, first, second = _FRAME.unpack_from(data, at)
        if [salt1, salt2] != salts:
            if not broken and _next_is_ours(data, at + step, salts):
                broken = True  # it is the salt that is damaged
                continue
            break  # of an earlier run
        if not broken:
            head, page = data[at : at + 8], data[at + _FRAME.size : at + step]
            sums = _checksum(order, page, _checksum(order, head, sums))
            broken = sums != (first, second)
        if broken and commit:
            lost += 1
    return lost


def _next_is_ours(data: bytes, at: int, salts: list[int]) -> bool:
    return len(data) >= at + _FRAME.size and list(_FRAME.unpack_from(data, at)[2:4]) == salts


def _checksum(order: str, data: bytes, start: tuple[int, int]) -> tuple[int, int]:
    a, b = start
    words = struct.unpack(f"{order}{len(data) // 4}I", data)
    for one, two in zip(words[::2], words[1::2], strict=True):
        a = (a + one + b) & 0xFFFFFFFF
        b = (b + two + a) & 0xFFFFFFFF
    return a, b
