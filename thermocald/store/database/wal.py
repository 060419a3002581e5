"""The end of a -wal file: whether transactions that were committed to it can no longer be read.

SQLite reads the frames of the file up to the first whose checksum does not match, and takes what
follows for what a crash cut off. That is right for the last transaction, which may not have been
committed; one that another follows, or that the index in the -shm file counts, was committed, and
what does not match is damage.
Formats: https://www.sqlite.org/fileformat2.html#the_write_ahead_log,
https://www.sqlite.org/walformat.html#the_wal_index_file_format
"""

from __future__ import annotations

import struct
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path


_HEADER = struct.Struct(">8I")  # magic, version, page size, sequence, two salts, two checksums
_FRAME = struct.Struct(">6I")  # page, size of the database after a commit, two salts, checksums
_MAGIC = 0x377F0682
_INDEX_BYTES = 48
_DAMAGED_SALT_BITS = 3  # salts of another run differ in about half of their 64 bits
_LOOKS, _PAUSE_S = 3, 0.02


@dataclass(frozen=True, slots=True)
class WalTail:
    """lost: committed transactions that cannot be read, -1 for all of them; unfinished: the last
    transaction cannot be read, and nothing says that it was committed: its writer was killed, or
    the file was cut off when it was copied, and more may have followed.
    """

    lost: int = 0
    unfinished: bool = False


def read_wal_tail(path: Path) -> WalTail:
    """Look at a -wal file, and at the -shm file beside it; it may be written meanwhile."""
    for _ in range(_LOOKS):
        tail = _look(path)
        if tail == WalTail():
            break
        time.sleep(_PAUSE_S)  # half of what is just being written looks like damage
    return tail


def _look(path: Path) -> WalTail:
    committed = _committed_frames(path)  # first: what is committed later may be read half-written
    try:
        data = path.read_bytes()
    except OSError:
        return WalTail()
    if len(data) < _HEADER.size:
        return WalTail()
    magic, _, page_size, _, *salts, first, second = _HEADER.unpack_from(data)
    order = ">" if magic & 1 else "<"
    sums = _checksum(order, data[:24], (0, 0))
    if magic & ~1 != _MAGIC or sums != (first, second) or page_size % 512:
        return WalTail(lost=-1)
    broken = earlier = False
    whole = ended = 0  # frames that are there, and up to the last end of a transaction
    commits: list[int] = []  # numbers of the frames that end a transaction, from the broken one on
    step = _FRAME.size + page_size
    for number, at in enumerate(range(_HEADER.size, len(data) - step + 1, step), 1):
        _, commit, *frame_salts, first, second = _FRAME.unpack_from(data, at)
        if frame_salts != salts:
            if not _nearly(frame_salts, salts):
                earlier = True  # of an earlier run
                break
            broken = True
        if not broken:
            head, page = data[at : at + 8], data[at + _FRAME.size : at + step]
            sums = _checksum(order, page, _checksum(order, head, sums))
            broken = sums != (first, second)
        whole, ended = number, number if commit else ended
        if broken and commit:
            commits.append(number)
    frames = committed.get(data[16:24], 0)
    if not broken:
        cut = ended < whole or (not earlier and (len(data) - _HEADER.size) % step)
        return WalTail(int(whole < frames), unfinished=bool(cut) and whole >= frames)
    lost = len([n for n in commits if n != commits[-1] or n <= frames])
    return WalTail(lost, unfinished=not lost)


def _nearly(some: list[int], salts: list[int]) -> bool:
    """Whether some salts are ours with a few bits changed."""
    bits = sum((one ^ two).bit_count() for one, two in zip(some, salts, strict=True))
    return bits <= _DAMAGED_SALT_BITS


def _committed_frames(wal: Path) -> dict[bytes, int]:
    """{salts of a -wal file: how many frames of it the index counts as committed}."""
    try:
        with wal.with_name(f"{wal.name.removesuffix('-wal')}-shm").open("rb") as file:
            one, two = file.read(_INDEX_BYTES), file.read(_INDEX_BYTES)
    except OSError:
        return {}
    if len(one) < _INDEX_BYTES or one != two:
        return {}
    order = "<" if struct.pack("=I", 1)[0] else ">"
    if _checksum(order, one[:40], (0, 0)) != struct.unpack("=2I", one[40:]):
        return {}
    return {one[32:40]: int(struct.unpack_from("=I", one, 16)[0])}


def _checksum(order: str, data: bytes, start: tuple[int, int]) -> tuple[int, int]:
    a, b = start
    words = struct.unpack(f"{order}{len(data) // 4}I", data)
    for one, two in zip(words[::2], words[1::2], strict=True):
        a = (a + one + b) & 0xFFFFFFFF
        b = (b + two + a) & 0xFFFFFFFF
    return a, b
