"""What a year of epochs gives is larger than memory should be: columns on disk, and short words."""

from __future__ import annotations

import ctypes
import gc
import mmap
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, overload

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array, Mask


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


_AT_ONCE = 100_000


class Words(Sequence[str]):
    """A sequence of words; numbers (E,): of each epoch's word in `words`."""

    __slots__ = ("_numbers", "_words")
    __hash__ = None  # type: ignore[assignment]  # it compares by its content, as a list does

    def __init__(self, numbers: NDArray[np.unsignedinteger], words: Sequence[str]) -> None:
        self._numbers = numbers
        self._words = tuple(words)

    @classmethod
    def of(cls, words: Iterable[str]) -> Words:
        """The words of any sequence; of this class as they are."""
        if isinstance(words, Words):
            return words
        known: dict[str, int] = {}
        every = (known.setdefault(str(word), len(known)) for word in words)
        numbers = np.fromiter(every, dtype=np.uint32)
        return cls(numbers, tuple(known))

    @classmethod
    def repeated(cls, word: str, count: int) -> Words:
        """One word, `count` times."""
        return cls(np.broadcast_to(np.uint16(0), (count,)), (word,))

    def __len__(self) -> int:
        return len(self._numbers)

    @overload
    def __getitem__(self, index: int) -> str: ...

    @overload
    def __getitem__(self, index: slice) -> Words: ...

    def __getitem__(self, index: int | slice) -> str | Words:
        if isinstance(index, slice):
            return Words(self._numbers[index], self._words)
        return self._words[int(self._numbers[index])]

    def __iter__(self) -> Iterator[str]:
        for first in range(0, len(self), _AT_ONCE):
            for number in self._numbers[first : first + _AT_ONCE].tolist():
                yield self._words[number]

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Sequence) or isinstance(other, str):
            return NotImplemented
        return len(self) == len(other) and all(a == b for a, b in zip(self, other, strict=True))

    def __contains__(self, word: object) -> bool:
        return self.count(word) > 0

    def __repr__(self) -> str:
        return f"Words({self.counts()})"

    def are(self, word: str) -> Mask:
        """(E,): the epochs with this word."""
        if word not in self._words:
            return np.zeros(len(self), dtype=bool)
        mask: Mask = self._numbers == self._words.index(word)
        return mask

    def count(self, word: object) -> int:
        """How many epochs have this word."""
        return self.counts().get(str(word), 0)

    def counts(self) -> dict[str, int]:
        """How many epochs have each word, those that none has left out."""
        found = np.bincount(self._numbers, minlength=len(self._words))
        return {word: int(n) for word, n in zip(self._words, found, strict=True) if n}
