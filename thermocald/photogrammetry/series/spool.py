"""Arrays of a long series on disk: what a year of epochs gives is larger than memory should be."""

from __future__ import annotations

import ctypes
import gc
import mmap
import tempfile
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from thermocald.arrays import Array


_LONG = 2_000_000  # rows
_MMAP_THRESHOLD, _LARGE_BYTES = -3, 1 << 24  # of malloc.h; two million numbers


class ColumnSpool:
    """An array (rows, columns), column by column in a file without a name.

    array: NaN at first, to be written and read like any other; it ends with its last reference.
    The system may drop what is not in use from memory, and does on `release`.
    """

    def __init__(self, rows: int, columns: int) -> None:
        if rows > _LONG:
            _map_large_arrays()
        size = max(rows * columns, 1) * 8
        with tempfile.TemporaryFile() as file:
            file.truncate(size)
            self._map = mmap.mmap(file.fileno(), size)
        flat = np.frombuffer(self._map, dtype=np.float64)[: rows * columns]
        self.array: Array = flat.reshape(columns, rows).T

    def release(self) -> None:
        """Take what was written or read out of memory."""
        self._map.madvise(mmap.MADV_DONTNEED)


def _map_large_arrays() -> None:
    """Have freed arrays of 16 MB and more leave this process at once.

    Otherwise the C library keeps those of up to 32 MB, a column of a year, for later ones that do
    not fit into their place, and the process holds twice what it uses.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:  # glibc
        mallopt(_MMAP_THRESHOLD, _LARGE_BYTES)


def give_back() -> None:
    """Return what is not used any more to the system.

    A recording that was read is part of a circle of references, which waits to be collected; the C
    library keeps what many blocks have left.
    """
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:  # glibc
        trim(0)


def released(array: Array) -> None:
    """Take an array of a spool, or a view of it, out of memory; others stay as they are."""
    owner: object = array.base
    while owner is not None and not isinstance(owner, mmap.mmap):
        owner = owner.obj if isinstance(owner, memoryview) else getattr(owner, "base", None)
    if isinstance(owner, mmap.mmap):
        owner.madvise(mmap.MADV_DONTNEED)
